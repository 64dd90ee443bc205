"""A policy that tracks motions, in MuJoCo.

The reference comes from polypod's terms; all else is read from MuJoCo's state. Episodes begin in
the states of those in polypod, and end by the same deviations.

MuJoCo's stiffest contacts are not solved closely enough by steps of 5 ms under light feet with weak
ankles: some robots fall at 5 ms that stand at 2, 1 and 0.5 ms.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, rotations, simulated
from polypod.arrays import Array, Floats
from polypod.evaluation.tracking import ClipResult, Seen, Trial, terms_of
from polypod.export.robot import RobotInterface, interfaces
from polypod.export.runtime import OnnxPolicy
from polypod.motions.reference import errors
from polypod.motions.tracking import COMMAND, DEVIATIONS, Tracker, axes
from polypod.mujoco_model import robot as model_robot
from polypod.policy import load
from polypod.sim2sim.beginning import Options, check_steps, physics_of
from polypod.sim2sim.driven import Drive
from polypod.sim2sim.twin import Twin

DT = 0.002
"""MuJoCo's physics step where none is named, s, unless the task's is smaller: its own default."""


class _WithReference:
    """A folded policy that is given the reference in addition to the robot's sensors."""

    def __init__(self, policy: OnnxPolicy, trial: Trial, rows: slice) -> None:
        self.policy, self.rows = policy, rows
        self.env = trial.sim.view
        self.tracker = Tracker(self.env, trial.options, trial.sources)
        self.twin: Twin | None = None

    @property
    def inputs(self) -> Mapping[str, int]:
        """Inputs that sensors give."""
        return {name: size for name, size in self.policy.inputs.items() if not name.startswith("motion_")}

    def __call__(self, **inputs: npt.ArrayLike) -> dict[str, Floats]:
        """Adds the reference."""
        base_pos, base_quat = np.zeros((self.env.num_envs, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (self.env.num_envs, 1))
        if self.twin is not None:
            base_pos[self.rows], base_quat[self.rows] = self.twin.qpos[:, :3], self.twin.qpos[:, 3:7]
        known: dict[str, npt.NDArray[Any]] = {
            COMMAND: self.tracker.command(self.env),
            "motion_phase": self.tracker.phase(self.env),
            "motion_anchor_pos_b": self.tracker.anchor_pos(self.env, base_pos, base_quat),
            "motion_anchor_ori_b": axes(self.tracker.anchor_ori(self.env, base_quat)),
        }
        own = {name: known[name][self.rows].astype(np.float32) for name in self.policy.inputs if name in known}
        return self.policy(**inputs, **own)

    def reset(self) -> None:
        """Forgets what all envs have seen."""
        self.policy.reset()


def measure_checkpoint(
    checkpoint: Path,
    robots: Sequence[str] | None = None,
    clips: Sequence[str] | None = None,
    options: Options | None = None,
    **arguments: Any,
) -> dict[str, dict[str, ClipResult]]:
    """Tracks motions with a checkpoint in MuJoCo, see `polypod.evaluation.tracking`.

    MuJoCo's step, integrator, friction and contacts are those of the `options`.

    Raises ConfigError where MuJoCo, ONNX or onnxruntime is missing.
    """
    options = options or Options()
    options.check()
    loaded = load(checkpoint, None, robots)
    manifest = loaded.manifest
    sources = list(manifest["robot_sources"] if robots is None else robots)
    trial = Trial(manifest, sources, terms_of(manifest, str(checkpoint), clips), **arguments)
    known = interfaces({**manifest, "overrides": manifest["overrides"]}, sources)
    for source, (name, interface) in zip(sources, known.items(), strict=True):
        own = OnnxPolicy.of(loaded.network, interface)
        policy = _WithReference(own, trial, slice(*trial.sim.env_ids(name)))
        policy.twin = twin = _twin(trial, name, source, interface, policy, options)
        _run(trial, name, twin, policy)
    return trial.results()


def _twin(
    trial: Trial, name: str, source: str, interface: RobotInterface, policy: _WithReference, options: Options
) -> Twin:
    task = simulated.config(trial.sim)["task"]
    robot = model_robot.of(trial.sim, name, source)
    count = len(trial.seen[name].clip)
    dt = float(task["sim"]["dt"])
    drive = Drive(
        interface,
        policy,
        step_dt=trial.sim.step_dt,
        physics_dt=dt,
        delays=np.tile([bounds[0] for bounds in robot.actuators.delay], (count, 1)).astype(np.float64),
    )
    physics = physics_of(task, options, min(dt, DT))
    check_steps(physics, trial.sim.step_dt, name)
    return Twin(robot, [], physics, drive)


def _run(trial: Trial, name: str, twin: Twin, policy: _WithReference) -> None:
    sim, seen = trial.sim, trial.seen[name]
    frames = sim.view.memory["motion_frame"][policy.rows, 0]
    last = seen.reference.last[seen.clip]
    twin.reset(sim.qpos(name), sim.qvel(name))
    commands = np.zeros((len(frames), 3), dtype=np.float32)
    for _ in range(trial.steps):
        twin.step(commands, seen.running.copy())
        frames[:] = np.minimum(frames + 1, last)
        _see(trial, seen, frames, twin.qpos, twin.qvel)
        if not seen.running.any():
            break


def _see(trial: Trial, seen: Seen, frames: npt.NDArray[np.int64], qpos: Array, qvel: Array) -> None:
    body = seen.reference.body
    safe = np.where(seen.running[:, np.newaxis], qpos, qpos[:1] * 0.0 + np.eye(qpos.shape[1])[3])
    safe[:, 3:7] = rotations.unit(safe[:, 3:7])
    links = body.moving(safe, np.where(seen.running[:, np.newaxis], qvel, 0.0))
    found = errors(seen.reference, frames, *(values[:, seen.reference.links] for values in links))
    fell = np.zeros(len(frames), dtype=np.bool_)
    for term, option in trial.options.terminations.items():
        if option.threshold is not None:
            fell |= DEVIATIONS[term](found, seen.reference) > option.threshold
    if not np.isfinite(found.anchor_pos[seen.running]).all():
        raise _core.ConfigError(f"{body.name}: MuJoCo's state is not finite any more; use an earlier checkpoint")
    seen.add(found, fell, frames >= seen.reference.last[seen.clip])
