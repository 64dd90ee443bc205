"""Getting up in MuJoCo and in polypod, from the same poses.

For tasks whose rewards have `upright` and `torso_height`. Links of a robot pass through each other
in MuJoCo.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.evaluation import Policy, rising
from polypod.evaluation.rising import Goal, Rising
from polypod.export.robot import interfaces
from polypod.export.runtime import OnnxPolicy
from polypod.networks.policies import reset
from polypod.policy import load
from polypod.python_terms import Terms
from polypod.runs.own_terms import terms_of_run
from polypod.sim2sim.beginning import Beginning, Options, Step, begun, check_steps
from polypod.sim2sim.compared import Compared
from polypod.sim2sim.run import Progress, conditions_of
from polypod.sim2sim.twin import Twin


@dataclasses.dataclass(frozen=True)
class BothRising:
    """Figures of one robot that gets up in both simulators."""

    polypod: Rising
    mujoco: Rising

    @property
    def transfers(self) -> bool:
        """Whether it gets up in MuJoCo in `rising.ENOUGH` of the episodes."""
        return self.mujoco.rate >= rising.ENOUGH


@dataclasses.dataclass(frozen=True)
class RisingComparison(Compared[BothRising]):
    """All robots that get up, and what they were measured on."""


class Poses(Beginning):
    """Poses from which both simulators let robots get up."""

    always_illegal: tuple[str, ...] = ()

    def __init__(
        self, manifest: dict[str, Any], sources: list[str], options: Options, terms: Terms | None = None
    ) -> None:
        """Draws the poses; `terms` are the run's. Raises ConfigError where nothing is to get up."""
        super().__init__(manifest, sources, options, terms)
        self.goals: Mapping[str, Goal] = rising.goals(self.sim, self.resolved)
        if missing := [name for name in self.sim.robots if name not in self.goals]:
            raise _core.ConfigError(
                f"{self.sim.task_name}: {missing[0]} is not rewarded for `upright` and `torso_height`; sim2sim cannot "
                "say whether it gets up"
            )
        if "base_contact" in self.terminations:
            self.always_illegal = Beginning.always_illegal


def compare(
    checkpoint: Path, robots: Sequence[str] | None, options: Options, progress: Progress = lambda *_: None
) -> RisingComparison:
    """Lets the policy of a checkpoint get up in both simulators.

    Args and errors are those of `polypod.sim2sim.compare`.
    """
    options.check()
    loaded = load(checkpoint, robots=robots)
    manifest = loaded.manifest
    sources = list(manifest["robot_sources"] if robots is None else robots)
    poses = Poses(manifest, sources, options, terms_of_run(manifest, options.terms, str(checkpoint)))
    known = interfaces({**manifest, "overrides": [*manifest["overrides"], *options.overrides]}, sources)
    policies = {}
    for name, interface in known.items():
        check_steps(poses.physics, poses.step_dt, name)
        policies[name] = OnnxPolicy.of(loaded.network, interface)
    conditions = conditions_of(poses, checkpoint, robots, options)
    ours = _in_polypod(poses, loaded.runner(), progress)
    results = {}
    for source, (name, interface) in zip(sources, known.items(), strict=True):
        twin, step = begun(poses, name, source, interface, policies[name])
        results[name] = BothRising(ours[name], _in_mujoco(poses, name, twin, step, progress))
    return RisingComparison(**conditions, robots=results, finer=poses.finer)


def _in_polypod(poses: Poses, policy: Policy, progress: Progress) -> dict[str, Rising]:
    sim = poses.sim
    record = rising.Record(sim, poses.goals)
    running = np.ones(sim.num_envs, dtype=np.bool_)
    reset(policy)
    for step in range(poses.steps):
        sim.step(np.where(running[:, np.newaxis], policy(sim.observation), np.float32(0.0)))
        running &= ~sim.terminated
        record.add(running)
        progress("polypod", step + 1, poses.steps)
    found = record.episodes()
    return {name: _figures(found, slice(*sim.env_ids(name))) for name in sim.robots}


def _in_mujoco(poses: Poses, name: str, twin: Twin, step_by: Step, progress: Progress) -> Rising:
    goal = poses.goals[name]
    uptime = rising.Uptime(twin.num_envs, poses.step_dt)
    running: npt.NDArray[np.bool_] = np.ones(twin.num_envs, dtype=np.bool_)
    no_command = np.zeros((twin.num_envs, 3), dtype=np.float32)
    for step in range(poses.steps):
        running &= ~step_by(no_command, running.copy()).fell
        uptime.add(running & rising.is_up(goal, twin.projected_gravity(), twin.base_height()))
        progress(name, step + 1, poses.steps)
    return _figures(uptime.episodes(), slice(None))


def _figures(found: Mapping[str, npt.NDArray[np.float64]], envs: slice) -> Rising:
    return rising.rising(**{key: values[envs] for key, values in found.items()})
