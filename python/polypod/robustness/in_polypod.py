"""The battery in polypod: all robots of a condition in one batch."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, simulated
from polypod.arrays import Floats
from polypod.evaluation import Policy, play_task, undisturbed
from polypod.evaluation.rollout import as_trained
from polypod.evaluation.walking import Record, Schedule, episode_steps
from polypod.networks.policies import reset
from polypod.observation import placed, terms_of
from polypod.robustness import overrides, schedules
from polypod.robustness.body import Body, bodies
from polypod.robustness.conditions import Condition

Step = Callable[[int, int], None]
"""Called with the control steps done and those to do."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """Setting that all conditions of a battery share."""

    task: str
    """The Play variant."""
    trained: tuple[str, ...]
    """`key=value` pairs that the policy was trained with."""
    given: tuple[str, ...]
    """`key=value` pairs of the user; they come before those of a condition."""
    sources: tuple[str, ...]
    """The robots: names, or paths of configs."""
    slots: tuple[str, ...]
    """Columns of the policy's action."""
    seed: int
    steps: int | None
    """Control steps of an episode; None: a whole one."""
    threads: int | None

    @classmethod
    def of(cls, manifest: Mapping[str, Any], sources: Sequence[str], **given: Any) -> "Setting":
        """The setting of a policy; `given` are the other fields."""
        return cls(
            task=play_task(manifest["task"]),
            trained=tuple(manifest["overrides"]),
            sources=tuple(sources),
            slots=tuple(manifest["canonical_joint_names"]),
            **given,
        )

    def sim(self, num_envs: int, changes: Sequence[str] = (), *, randomized: bool = False) -> _core.VecSim:
        """A simulation with `num_envs` of each robot, as in `polypod eval`, and these changes."""
        switches = as_trained(self.task, self.trained) if randomized else undisturbed(self.task, self.trained)
        return _core.VecSim(
            self.task,
            num_envs * len(self.sources),
            robots=list(self.sources),
            seed=self.seed,
            threads=self.threads,
            overrides=[*self.trained, *switches, *self.given, *changes],
            autoreset="disabled",
            slots=list(self.slots),
        )

    def length(self, sim: _core.VecSim) -> int:
        """Control steps of an episode."""
        return min(self.steps or episode_steps(sim.step_dt), sim.max_episode_length)


def changes_of(condition: Condition, robots: Mapping[str, Body], physics_dt: float) -> list[str]:
    """`key=value` pairs of a condition for these robots; physics steps are of `physics_dt`, s."""
    pairs = [pair for body in robots.values() for pair in condition.overrides(body)]
    if condition.delay_s > 0.0:
        pairs += overrides.delay(round(condition.delay_s / physics_dt))
    return list(dict.fromkeys(pairs))


def schedules_of(
    condition: Condition, sim: _core.VecSim, robots: Mapping[str, Body], steps: int, seed: int
) -> tuple[Schedule, list[str]]:
    """The commands of all envs, and the robots whose command boxes have none of that kind.

    The commands of these are zero.
    """
    parts, lacking = [], []
    for name, body in robots.items():
        start, end = sim.env_ids(name)
        schedule = condition.commands(body.ranges, end - start, steps, sim.step_dt, seed)
        if schedule is None:
            lacking.append(name)
            schedule = schedules.walking(body.ranges, end - start, steps, sim.step_dt, seed)
        parts.append(schedule)
    return Schedule.joined(parts), lacking


def description_columns(sim: _core.VecSim) -> npt.NDArray[np.intp]:
    """Columns of the observation that describe the robot."""
    places = [at for term, at in placed(terms_of(sim)) if term.source == "robot_constant"]
    return np.array([column for at in places for column in range(at.start, at.stop)], dtype=np.intp)


@dataclasses.dataclass(frozen=True)
class Nominal:
    """The robots where nothing is changed."""

    robots: dict[str, Body]
    """Bodies by name, in the order of the batch."""
    physics_dt: float
    """Physics step of the task, s."""
    columns: npt.NDArray[np.intp]
    """Columns of the observation that describe the robot."""
    described: Floats
    """Descriptions that the policy is shown, [envs, columns]."""

    @classmethod
    def of(cls, setting: Setting, num_envs: int) -> "Nominal":
        """The nominal robots of a setting, `num_envs` of each."""
        sim = setting.sim(num_envs)
        columns = description_columns(sim)
        dt = simulated.config(sim)["task"]["sim"]["dt"]
        return cls(bodies(sim, setting.sources), dt, columns, sim.observation[:, columns].copy())


@dataclasses.dataclass(frozen=True)
class Ran:
    """Record of a simulation in a condition."""

    record: Record
    envs: dict[str, slice]
    """Envs of each robot."""
    lacking: list[str]
    """Robots whose command boxes have no commands of the condition."""


def run(setting: Setting, nominal: Nominal, condition: Condition, policy: Policy, num_envs: int, progress: Step) -> Ran:
    """Runs an episode of a condition.

    The policy is told what it is told of the nominal robots, since nobody measures a payload or a
    worn motor for it. With the randomisation of the training, it is told what the task says.

    Args:
        setting: the battery's setting.
        nominal: of as many envs.
        condition: the condition.
        policy: from observations to actions.
        num_envs: envs of each robot.
        progress: told after each control step.
    """
    changes = changes_of(condition, nominal.robots, nominal.physics_dt)
    sim = setting.sim(num_envs, changes, randomized=condition.is_randomized)
    steps = setting.length(sim)
    schedule, lacking = schedules_of(condition, sim, nominal.robots, steps, setting.seed)
    pushes = schedules.Pushes.draw(num_envs, steps, sim.step_dt, setting.seed) if condition.is_pushed else None
    told = None if condition.is_randomized or not len(nominal.columns) else nominal.described
    if told is not None and condition.description_error > 0.0:
        error, size = condition.description_error, len(nominal.columns)
        told = told * np.tile(schedules.description_factors(num_envs, size, error, setting.seed), (len(sim.robots), 1))
    sim.set_command(schedule.at(0))
    sim.reset()
    reset(policy)
    record = Record(schedule, sim.step_dt)
    for step in range(steps):
        observation = sim.observation
        if told is not None:
            observation = observation.copy()
            observation[:, nominal.columns] = told
        if step + 1 < steps and schedule.changes_at(step + 1):
            # the step ends with an observation that shows the next command
            sim.set_command(schedule.at(step + 1))
        if pushes is not None and (added := pushes.at(step)) is not None:
            sim.push(np.tile(added, (len(sim.robots), 1)))
        sim.step(policy(observation))
        record.add(sim.state("base_lin_vel")[:, :2], sim.state("base_ang_vel")[:, 2], sim.terminated)
        progress(step + 1, steps)
        done = sim.terminated | sim.truncated
        if not record.active.any():
            break
        if done.any():
            sim.reset(mask=done)
            reset(policy, done)
    return Ran(record, {name: slice(*sim.env_ids(name)) for name in sim.robots}, lacking)
