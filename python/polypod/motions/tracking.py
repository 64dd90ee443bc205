"""Terms of tracking tasks, with the names and formulas of BeyondMimic (whole_body_tracking).

A frame of the reference is a control step. It goes on after the physics, so that rewards compare
the state after a step with the frame of that time: a perfect follower gets 1 from each term.
"""

import json
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, rotations, simulated
from polypod.arrays import Array
from polypod.compat import tomllib
from polypod.motions import library, sampling
from polypod.motions.body import body_of
from polypod.motions.names import COMMAND, observes_motions, split
from polypod.motions.options import Options, RewardOptions, options, parse
from polypod.motions.reference import Errors, Reference, errors_in
from polypod.python_terms import Declared, Memory, Terms
from polypod.python_terms import declarations as terms

Ids = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

LOOK_AHEAD = 3
"""Frames that the tasks' `motion_command` observes without a change."""
SOURCE = "motions"


def terms_of_task(task: str, robots: Sequence[str] | None, overrides: Sequence[str]) -> tuple[Terms | None, list[str]]:
    """Terms of a task that tracks motions, or None, and its changes without `motions.`.

    Raises ConfigError for options of another task, and for unknown ones.
    """
    changes, own = split(overrides)
    if not own and not observes_motions(task, changes):
        return None, changes
    return again(None, task, robots, changes, own), changes


def again(
    found: Terms | None, task: str, robots: Sequence[str] | None, changes: Sequence[str], own: Sequence[str]
) -> Terms:
    """The terms for these robots, or those of the task, with changed options.

    `found` are the terms so far; None: those of the task, with the usual options.

    Raises ConfigError for options of a task that tracks no motions, and of terms that are no task's
    own.
    """
    if found is None:
        if own and not observes_motions(task, changes):
            raise _core.ConfigError(
                f"--set motions.{own[0]}: {task} tracks no motions; leave it out, or take the task "
                "tracking_flat_humanoid"
            )
        settled = options(own)
    elif found.options is None:
        raise _core.ConfigError(
            f"--set motions.{own[0]}: --terms {found.path} takes no options of tracking tasks; leave it out"
        )
    else:
        tables = found.options
        if own:
            tables = tomllib.loads(_core.with_overrides(json.dumps(dict(tables)), list(own)))
        settled = parse(tables, "motions")
    return declared(settled, _core.task_robots(task, list(changes)) if robots is None else robots)


def of_manifest(tables: dict[str, Any], name: str) -> Terms:
    """The terms of a run by the options in its manifest. Raises ConfigError."""
    return declared(parse(tables, f"{name}: manifest"), [name])


def widths(found: Terms, overrides: Sequence[str]) -> list[str]:
    """Changes of a task, with that of a policy that observes another number of frames."""
    frames = len((found.options or {}).get("look_ahead", [0] * LOOK_AHEAD))
    text = f"observations.policy.{COMMAND}.external.size={2 * frames}"
    return list(overrides) if frames == LOOK_AHEAD or text in overrides else [*overrides, text]


class Tracker:
    """The references of a simulator's robots, and how far its envs are from them."""

    def __init__(self, env: Any, found: Options, sources: Sequence[str]) -> None:
        """Makes the clips for the robots of `env`, whose names or paths are `sources`."""
        self.options = found
        info = simulated.robots(env.sim)
        self.robots: list[str] = env.robots
        self.references: list[Reference] = []
        self.columns: list[Ids] = []
        self.ahead: list[npt.NDArray[np.float32]] = []
        """Joints of each robot, [frames, 2 look-ahead, actions]: positions, then velocities."""
        self.com: list[Array] = []
        shapes = simulated.shapes(env.sim)
        for robot, source in zip(self.robots, sources, strict=True):
            if held := info[robot].get("held_joints"):
                raise _core.ConfigError(
                    f"{env.sim.task_name}: actions.joint_pos.joint_names leaves out {held[0]['slot']} of {robot}, but "
                    "a motion moves all joints; remove joint_names from the task"
                )
            body = body_of(source)
            clips = library.clips_of(found.clips, body.source)
            self.references.append(Reference.of(body, clips, env.step_dt))
            self.columns.append(np.array(info[robot]["columns"], dtype=np.int64))
            self.ahead.append(_ahead(self.references[-1], found.look_ahead, self.columns[-1], env.sim.num_actions))
            self.com.append(np.array(shapes[robot]["base_com"], dtype=np.float64))
        self.rows = [env.env_ids(robot) for robot in self.robots]
        self.bins = _bins(found, len(self.robots))
        self._errors: list[Errors] | None = None
        self._command = np.zeros((env.num_envs, 2 * len(found.look_ahead), env.sim.num_actions), dtype=np.float32)
        self._command_of = np.full(env.num_envs, -1, dtype=np.int64), np.zeros_like(self._command[:, 0])
        """Frames and default poses that it was computed for."""

    def clear(self) -> None:
        """Compares again, after a step or a reset."""
        self._errors = None

    def errors(self, env: Any) -> list[Errors]:
        """Errors of each robot's envs."""
        if self._errors is None:
            self._errors = []
            for robot, reference, rows in zip(self.robots, self.references, self.rows, strict=True):
                self._errors.append(errors_in(env.sim, robot, reference, env.memory["motion_frame"][rows, 0]))
        return self._errors

    def per_env(self, env: Any, value: Callable[[Errors, Reference], Array]) -> Array:
        """A number of each env's errors, [num_envs, ...]."""
        parts = [value(found, ref) for found, ref in zip(self.errors(env), self.references, strict=True)]
        whole: Array = np.zeros((env.num_envs, *parts[0].shape[1:]), dtype=parts[0].dtype)
        for rows, part in zip(self.rows, parts, strict=True):
            whole[rows] = part
        return whole

    def anchor_pos(self, env: Any, base_pos: Array, base_quat: Array) -> Array:
        """Position of the reference's base in base axes, m, [num_envs, 3]."""
        pos = np.zeros((env.num_envs, 3))
        for reference, rows in zip(self.references, self.rows, strict=True):
            pos[rows] = reference.base_pos[env.memory["motion_frame"][rows, 0]]
        return rotations.rotated(rotations.inverse(base_quat), pos - base_pos)

    def anchor_ori(self, env: Any, base_quat: Array) -> Array:
        """Orientation of the reference's base in base axes, [num_envs, 4]."""
        quat = np.zeros((env.num_envs, 4))
        for reference, rows in zip(self.references, self.rows, strict=True):
            quat[rows] = reference.base_quat[env.memory["motion_frame"][rows, 0]]
        return rotations.product(rotations.inverse(base_quat), quat)

    def advance(self, env: Any) -> None:
        """Goes on by a frame; the last one of a clip stays."""
        for clips, rows in zip(self.references, self.rows, strict=True):
            last = clips.last[env.memory["motion_clip"][rows, 0]]
            env.memory["motion_frame"][rows, 0] = np.minimum(env.memory["motion_frame"][rows, 0] + 1, last)
        self.bins.decay(env.memory)
        self.clear()

    def command(self, env: Any) -> npt.NDArray[np.float32]:
        """Positions less the default pose, then velocities, [num_envs, 2 look-ahead * joints].

        Only envs whose frame has changed are computed: after a reset they are few.
        """
        frame, default = env.memory["motion_frame"][:, 0], env.default_joint_pos
        frame_before, default_before = self._command_of
        due = (frame != frame_before) | (default != default_before).any(axis=1)
        for ahead, columns, rows in zip(self.ahead, self.columns, self.rows, strict=True):
            mine = rows[due[rows]]
            if not mine.size:
                continue
            is_whole = mine.size == rows.size
            values = self._command[mine[0] : mine[-1] + 1] if is_whole else np.empty_like(self._command[: mine.size])
            # without clip NumPy buffers the output; frames are within the reference anyway
            np.take(ahead, frame[mine], axis=0, out=values, mode="clip")
            present = np.zeros(env.sim.num_actions, dtype=np.float32)
            present[columns] = 1.0
            values[:, ::2] -= (default[mine] * present)[:, np.newaxis]
            if not is_whole:
                self._command[mine] = values
        frame_before[:], default_before[:] = frame, default
        return self._command.reshape(env.num_envs, -1)

    def phase(self, env: Any) -> Array:
        """Share of the clip that is over, and seconds that remain, at most 10, [num_envs, 2]."""
        whole = np.zeros((env.num_envs, 2))
        for reference, rows in zip(self.references, self.rows, strict=True):
            clip, frame = env.memory["motion_clip"][rows, 0], env.memory["motion_frame"][rows, 0]
            first, last = reference.first[clip], reference.last[clip]
            whole[rows, 0] = (frame - first) / np.maximum(last - first, 1)
            whole[rows, 1] = np.minimum((last - frame) * env.step_dt, 10.0)
        return whole

    def choose(self, env: Any, ids: Ids) -> None:
        """Samples clips and frames for episodes of a training."""
        for index, (reference, rows) in enumerate(zip(self.references, self.rows, strict=True)):
            mine = ids[np.isin(ids, rows)]
            if not mine.size:
                continue
            drawn = env.random.uniform(0.0, 1.0, mine, size=2).astype(np.float64)
            clip, share = self.bins.sample(env.memory, index, drawn)
            first, last = reference.first[clip], reference.last[clip]
            # the last frame is where an episode ends
            frame = first + np.floor(share * (last - first)).astype(np.int64)
            env.memory["motion_clip"][mine, 0] = clip
            env.memory["motion_frame"][mine, 0] = np.minimum(frame, last - 1)
        env.memory["motion_noise"][ids, 0] = 1

    def next_clip(self, env: Any, ids: Ids) -> None:
        """Lets envs without sampling begin clips from their start, in turn."""
        turn = env.memory["motion_turn"]
        for reference, rows in zip(self.references, self.rows, strict=True):
            mine = ids[np.isin(ids, rows)]
            clip = (turn[mine, 0] + mine - (rows[0] if rows.size else 0)) % len(reference.names)
            env.memory["motion_clip"][mine, 0] = clip
            env.memory["motion_frame"][mine, 0] = reference.first[clip]
        turn[ids, 0] += 1

    def place(self, env: Any, ids: Ids) -> None:
        """Puts envs into the state of their frames, with noise where it is sampled."""
        length = env.sim.episode_length.copy()
        parts: list[tuple[Ids, dict[str, Array]]] = []
        for reference, columns, com, rows in zip(self.references, self.columns, self.com, self.rows, strict=True):
            mine = ids[np.isin(ids, rows)]
            if not mine.size:
                continue
            frame = env.memory["motion_frame"][mine, 0]
            noise = np.where(env.memory["motion_noise"][mine, 0] > 0, 1.0, self.options.reset.play_noise)
            moved, turned, pushed, spun, bent = self._noise(env, mine, noise, len(columns))
            quat = rotations.unit(rotations.product(turned, reference.base_quat[frame]))
            back = rotations.inverse(quat)
            angular = rotations.rotated(back, reference.base_ang_vel[frame] + spun)
            linear = rotations.rotated(back, reference.base_lin_vel[frame] + pushed) + np.cross(angular, com)
            joints, speeds = np.zeros((mine.size, env.sim.num_actions)), np.zeros((mine.size, env.sim.num_actions))
            body = reference.body
            limits = np.stack([body.by_slot(body.lower), body.by_slot(body.upper)])
            low, high = limits.min(axis=0), limits.max(axis=0)
            joints[:, columns] = np.clip(reference.joint_pos[frame] + bent, low, high)
            speeds[:, columns] = reference.joint_vel[frame]
            state = {
                "base_pos": reference.base_pos[frame] + moved,
                "base_quat": quat,
                "base_lin_vel": linear,
                "base_ang_vel": angular,
                "joint_pos": joints,
                "joint_vel": speeds,
            }
            parts.append((mine, state))
            left = reference.last[env.memory["motion_clip"][mine, 0]] - frame
            # the episode runs out of time at the clip's end: that truncates it
            length[mine] = np.maximum(env.max_episode_length - left, 0)
        if parts:
            # one call for all robots, since each call computes what follows from the states
            whole = {key: np.concatenate([state[key] for _, state in parts]) for key in parts[0][1]}
            env.sim.set_state(np.concatenate([mine for mine, _ in parts]), **whole)
        env.sim.set_episode_length(length)
        env.refresh()
        self.clear()

    def _noise(self, env: Any, ids: Ids, noise: Array, joints: int) -> tuple[Array, Array, Array, Array, Array]:
        pose, velocity = self.options.reset.pose_range, self.options.reset.velocity_range
        drawn = np.zeros((ids.size, 12 + joints))
        if (noisy := noise > 0.0).any():
            mine = ids[noisy]
            drawn[noisy] = env.random.uniform(-1.0, 1.0, mine, size=12 + joints)

        def scaled(ranges: dict[str, list[float]], column: int, axis: str) -> Array:
            low, high = ranges.get(axis, [0.0, 0.0])
            value: Array = noise * (low + 0.5 * (drawn[:, column] + 1.0) * (high - low))
            return value

        axes = ("x", "y", "z", "roll", "pitch", "yaw")
        poses = [scaled(pose, i, axis) for i, axis in enumerate(axes)]
        speeds = [scaled(velocity, 6 + i, axis) for i, axis in enumerate(axes)]
        low, high = self.options.reset.joint_position_range
        bent = noise[:, np.newaxis] * (low + 0.5 * (drawn[:, 12:] + 1.0) * (high - low))
        return (
            np.stack(poses[:3], axis=1),
            rotations.of_angles(*poses[3:]),
            np.stack(speeds[:3], axis=1),
            np.stack(speeds[3:], axis=1),
            bent,
        )


def _ahead(reference: Reference, look_ahead: Sequence[int], columns: Ids, actions: int) -> npt.NDArray[np.float32]:
    """Joint positions some steps after each frame, [frames, 2 look-ahead, actions]."""
    whole = np.zeros((len(reference.joint_pos), 2 * len(look_ahead), actions), dtype=np.float32)
    frame = np.arange(len(whole))
    last = np.repeat(reference.last, reference.last - reference.first + 1)
    for i, steps in enumerate(look_ahead):
        at = np.minimum(frame + steps, last)
        whole[:, 2 * i, columns] = reference.joint_pos[at]
        whole[:, 2 * i + 1, columns] = reference.joint_vel[at] * (frame + steps <= last)[:, np.newaxis]
    return whole


def declared(found: Options, sources: Sequence[str]) -> Terms:
    """All terms of a tracking task.

    Args:
        found: options.
        sources: names or paths of the simulation's robots, in its order.
    """
    trackers: weakref.WeakKeyDictionary[Any, Tracker] = weakref.WeakKeyDictionary()

    def tracker(env: Any) -> Tracker:
        known = trackers.get(env)
        if known is None:
            known = trackers[env] = Tracker(env, found, sources)
        return known

    entries: list[Any] = [
        terms.memory("motion_clip", dtype="int64"),
        terms.memory("motion_frame", dtype="int64"),
        terms.memory("motion_noise", dtype="int64"),
        terms.memory("motion_turn", dtype="int64", keep=True),
        *_bins(found, len(sources)).memories(),
        *_events(tracker),
        *_observations(tracker, found),
        *_rewards(tracker, found),
        *_terminations(tracker, found),
        *_curves(tracker),
    ]
    kept: list[Declared | Memory | tuple[str, terms.Reward]] = list(terms.declared_by(entries))
    return Terms.of(kept, SOURCE, options=found.as_dict())


def _bins(found: Options, robots: int) -> sampling.Bins:
    """Bins of the clips; snapshots hold their state."""
    return sampling.Bins([library.duration(clip) for clip in found.clips], found.sampling, robots)


Find = Callable[[Any], Tracker]


def _events(tracker: Find) -> list[Any]:
    @terms.event(mode="reset", play=False)
    def sample_motion_frame(env: Any, ids: Ids) -> None:
        tracker(env).choose(env, ids)

    @terms.event(mode="reset")
    def reset_to_motion(env: Any, ids: Ids) -> None:
        known = tracker(env)
        begins = ids[env.memory["motion_noise"][ids, 0] == 0]
        if begins.size:
            known.next_clip(env, begins)
        known.place(env, ids)

    return [sample_motion_frame, reset_to_motion]


def _observations(tracker: Find, found: Options) -> list[Any]:
    @terms.observation(size=2 * len(found.look_ahead), mirror="per_joint", name=COMMAND)
    def command(env: Any) -> npt.NDArray[np.float32]:
        return tracker(env).command(env)

    @command.update
    def advance(env: Any) -> None:
        tracker(env).advance(env)

    @terms.observation(size=2)
    def motion_phase(env: Any) -> Array:
        return tracker(env).phase(env)

    @terms.observation(size=3, units="m", mirror="vector")
    def motion_anchor_pos_b(env: Any) -> Array:
        return tracker(env).anchor_pos(env, env.base_pos.astype(np.float64), env.base_quat.astype(np.float64))

    @terms.observation(size=6, mirror="vector")
    def motion_anchor_ori_b(env: Any) -> Array:
        return axes(tracker(env).anchor_ori(env, env.base_quat.astype(np.float64)))

    return [command, motion_phase, motion_anchor_pos_b, motion_anchor_ori_b]


def axes(quaternion: Array) -> Array:
    """The x and z axes of orientations, [n, 6]: a mirror changes both as vectors."""
    matrix = rotations.matrix(quaternion)
    return np.concatenate([matrix[..., 0], matrix[..., 2]], axis=-1)


def _square(error: npt.NDArray[Any]) -> Array:
    """Sum of squares over the last axis."""
    # sums over so short an axis are slow
    total: Array = np.einsum("...i,...i->...", error, error)
    return total


ERRORS: dict[str, Callable[[Errors, Reference], Array]] = {
    "motion_global_anchor_position_error_exp": lambda e, _: _square(e.anchor_pos),
    "motion_global_anchor_orientation_error_exp": lambda e, _: np.square(e.anchor_ori),
    "motion_relative_body_position_error_exp": lambda e, _: _square(e.link_pos).mean(axis=-1),
    "motion_relative_body_orientation_error_exp": lambda e, _: np.square(e.link_ori).mean(axis=-1),
    "motion_global_body_linear_velocity_error_exp": lambda e, _: _square(e.link_lin_vel).mean(axis=-1),
    "motion_global_body_angular_velocity_error_exp": lambda e, _: _square(e.link_ang_vel).mean(axis=-1),
}
"""Error of each reward term, [n]: the square of m, rad, m/s or rad/s, its mean over the key
links."""


def _rewards(tracker: Find, found: Options) -> list[Any]:
    def one(name: str, option: RewardOptions) -> Any:
        error = ERRORS[name]

        @terms.reward(weight=option.weight, name=name)
        def bell(env: Any) -> Array:
            value: Array = np.exp(-tracker(env).per_env(env, error) / (option.std * option.std))
            return value

        return bell

    return [one(name, option) for name, option in found.rewards.items()]


DEVIATIONS: dict[str, Callable[[Errors, Reference], Array]] = {
    "bad_anchor_pos": lambda e, _: np.linalg.norm(e.anchor_pos, axis=1),
    "bad_anchor_heading": lambda e, _: np.abs(e.heading),
    "bad_anchor_pos_z_only": lambda e, _: np.abs(e.anchor_pos[:, 2]),
    "bad_anchor_ori": lambda e, _: e.gravity,
    "bad_motion_body_pos_z_only": lambda e, ref: np.abs(e.link_pos[:, ref.ends, 2]).max(axis=1),
}
"""Deviation of each termination, [n]."""


def _terminations(tracker: Find, found: Options) -> list[Any]:
    def one(name: str, threshold: float) -> Any:
        @terms.termination(name=name)
        def beyond(env: Any) -> Bools:
            is_beyond: Bools = tracker(env).per_env(env, DEVIATIONS[name]) > threshold
            return is_beyond

        return beyond

    return [one(name, o.threshold) for name, o in found.terminations.items() if o.threshold is not None]


def _curves(tracker: Find) -> list[Any]:
    @terms.metric()
    def error_anchor_pos(env: Any) -> Array:
        return tracker(env).per_env(env, lambda e, _: np.linalg.norm(e.anchor_pos, axis=-1))

    @terms.metric()
    def error_anchor_rot(env: Any) -> Array:
        return tracker(env).per_env(env, lambda e, _: e.anchor_ori)

    @terms.metric()
    def error_body_pos(env: Any) -> Array:
        return tracker(env).per_env(env, lambda e, _: np.sqrt(_square(e.link_pos)).mean(axis=-1))

    @terms.curriculum()
    def motion_sampling(env: Any, ids: Ids) -> dict[str, float]:
        known = tracker(env)
        failed = ids[env.sim.terminated[ids]]
        curves: dict[str, float] = {}
        for index, (reference, rows) in enumerate(zip(known.references, known.rows, strict=True)):
            mine = failed[np.isin(failed, rows)]
            clip, frame = env.memory["motion_clip"][mine, 0], env.memory["motion_frame"][mine, 0]
            share = (frame - reference.first[clip]) / np.maximum(reference.last[clip] - reference.first[clip], 1)
            known.bins.count(env.memory, index, clip, share)
            curves |= {f"{known.robots[index]}/{k}": v for k, v in known.bins.curves(env.memory, index).items()}
        return curves

    return [error_anchor_pos, error_anchor_rot, error_body_pos, motion_sampling]


__all__ = ["COMMAND", "ERRORS", "Tracker", "again", "declared", "of_manifest", "terms_of_task", "widths"]
