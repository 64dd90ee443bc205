"""The battery in MuJoCo, each robot and condition separately.

It runs on the twin of `polypod.sim2sim` or a maker's model.
"""

import dataclasses
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod.arrays import Floats
from polypod.evaluation.walking import Record, Schedule
from polypod.export.robot import RobotInterface, interfaces
from polypod.export.runtime import OnnxPolicy
from polypod.mujoco_model import robot as model_robot
from polypod.policy import LoadedPolicy
from polypod.robustness import schedules, twins
from polypod.robustness.body import Body
from polypod.robustness.conditions import Condition
from polypod.robustness.in_polypod import Setting
from polypod.sim2sim import beginning, on_model, run, told
from polypod.sim2sim.driven import Driven, FoldedPolicy
from polypod.sim2sim.maker import Choices, Maker

AS_IS = 0
"""Value in place of `condim` for contacts of a maker's model as its file has them."""


@dataclasses.dataclass(frozen=True)
class MakersModel:
    """A maker's MuJoCo model of the robot."""

    file: Path
    map: Path | None = None
    """See `polypod.sim2sim.mapping.Given.read`."""
    choices: Choices = dataclasses.field(default_factory=Choices)


class PolicyPerEnv:
    """Several graphs of the same inputs, one for each row."""

    def __init__(self, policies: Sequence[OnnxPolicy]) -> None:
        """Takes one policy per env."""
        self._policies = policies
        self.inputs: dict[str, int] = policies[0].inputs

    def __call__(self, **inputs: npt.ArrayLike) -> dict[str, Floats]:
        """Runs each graph on its row; see `OnnxPolicy`."""
        rows = [
            policy(**{name: np.asarray(value)[env : env + 1] for name, value in inputs.items()})
            for env, policy in enumerate(self._policies)
        ]
        return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}

    def reset(self) -> None:
        """Forgets the past of all rows."""
        for policy in self._policies:
            policy.reset()


class Mujoco:
    """A policy and its robots in MuJoCo."""

    def __init__(self, loaded: LoadedPolicy, setting: Setting, num_envs: int, model: MakersModel | None = None) -> None:
        """Draws the initial states, as polypod does.

        Args:
            loaded: the policy.
            setting: the battery's setting.
            num_envs: envs of each robot.
            model: in place of the twin; of the only robot.

        Raises:
            ConfigError: for a policy that cannot be exported, a task with obstacles, and where
                MuJoCo, ONNX or onnxruntime is missing.
        """
        manifest: dict[str, Any] = loaded.manifest
        options = beginning.Options(
            envs_per_robot=num_envs, steps=setting.steps, seed=setting.seed, overrides=setting.given
        )
        overrides = [*manifest["overrides"], *setting.given]
        self._network = loaded.network
        self._interfaces = interfaces({**manifest, "overrides": overrides}, setting.sources)
        self._episode = run.Episode(manifest, list(setting.sources), options)
        self._model = model
        for name, source in zip(self._interfaces, setting.sources, strict=True):
            physics = self._episode.physics
            if model is not None:
                robot = model_robot.of(self._episode.sim, name, source)
                dt = on_model.load_model(model.file, robot, model.map, model.choices).dt
                physics = dataclasses.replace(physics, dt=dt)
            beginning.check_steps(physics, self._episode.step_dt, name)
        self._setting, self.num_envs = setting, num_envs
        self._stops = threading.Event()

    def stop(self) -> None:
        """Lets all threads leave `run` soon."""
        self._stops.set()

    def schedule(self, condition: Condition, body: Body) -> Schedule | None:
        """Commands of a robot's envs; None where its command box has none of that kind."""
        steps = self._setting.length(self._episode.sim)
        return condition.commands(body.ranges, self.num_envs, steps, self._episode.step_dt, self._setting.seed)

    def twin(self, condition: Condition, condim: int, body: Body) -> Driven:
        """A robot as the condition makes it, in its initial states."""
        interface, late = self._interfaces[body.name], round(condition.delay_s / self._episode.task_dt)
        start = self._episode.start[body.name]
        twin: Driven
        if self._model is None:
            policy = self._policy(condition, interface)
            twin = beginning.twin_of(self._episode, body.name, body.source, interface, policy, late)
        else:
            twin = self._of_maker(self._model, body, condition, late)
            start = on_model.started(twin.reference, twin.robot, *start)
        if condim != AS_IS:
            twins.contact(condim, condition.torsional)(twin, body)
        if condition.twin is not None:
            condition.twin(twin, body)
        twin.refresh()
        twin.reset(*start)
        return twin

    def _of_maker(self, model: MakersModel, body: Body, condition: Condition, late: int) -> Maker:
        """The maker's model with the policy, before its first reset."""
        robot = model_robot.of(self._episode.sim, body.name, body.source)
        compiled = on_model.compiled(model.file, robot, model.map, model.choices)
        interface, _ = told.interface_on(compiled, self._interfaces[body.name])
        policy = self._policy(condition, interface)
        ends, outlines = self._episode.ends(body.name, interface), self._episode.outlines[body.name]["bodies"]
        return on_model.made(compiled, self._episode, robot, interface, ends, outlines, policy, late)

    def run(self, condition: Condition, condim: int, body: Body, schedule: Schedule) -> Record:
        """Runs an episode of a condition with contacts of `condim`."""
        twin = self.twin(condition, condim, body)
        step_dt = self._episode.step_dt
        pushes = None
        if condition.is_pushed:
            pushes = schedules.Pushes.draw(self.num_envs, schedule.steps, step_dt, self._setting.seed)
        record = Record(schedule, step_dt)
        for step in range(schedule.steps):
            if pushes is not None and (added := pushes.at(step)) is not None:
                twin.push(added)
            seen = twin.step(schedule.at(step), record.active)
            record.add(seen.velocity, seen.yaw_rate, seen.fell)
            if self._stops.is_set() or not record.active.any():
                break
        return record

    def _policy(self, condition: Condition, interface: RobotInterface) -> FoldedPolicy:
        if condition.description_error == 0.0:
            return self._folded(interface)
        sizes = {term: len(numbers) for term, numbers in interface.constants.items()}
        factors = schedules.description_factors(
            self.num_envs, sum(sizes.values()), condition.description_error, self._setting.seed
        )
        return PolicyPerEnv([self._folded(_misdescribed(interface, row)) for row in factors])

    def _folded(self, interface: RobotInterface) -> OnnxPolicy:
        return OnnxPolicy.of(self._network, interface)


def _misdescribed(interface: RobotInterface, factors: Floats) -> RobotInterface:
    """The interface with other numbers of the robot, by the factors of all terms in order."""
    constants: dict[str, Floats] = {}
    for term, numbers in interface.constants.items():
        share, factors = factors[: len(numbers)], factors[len(numbers) :]
        constants[term] = numbers * share
    return dataclasses.replace(interface, constants=constants)
