"""The one definition of walking: the commands that it is judged by, the figures, and the bounds.

A robot walks if, over episodes of `EPISODE_S` in which its command changes every `SEGMENT_S`,

- its planar velocity error is at most `MAX_ERROR_XY` and at most `MAX_SHARE_OF_STILL` of a standing
  robot's,
- its yaw rate error is at most `MAX_ERROR_YAW`, and its pure turns reach `LEAST_TURN` of what is
  asked,
- it falls in at most `MAX_FALL_RATE` of the episodes,
- told to stop, it drifts at most `MAX_DRIFT_XY` and `MAX_DRIFT_YAW`.

`Schedule.draw` makes the commands, `Record` measures a simulation of any engine, `Walking` holds
one robot's figures, and `walks` and `why_not` judge them. See `Walking` for the exact formulas.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.arrays import Array

EPISODE_S = 20.0
"""Length of an episode, s."""
SEGMENT_S = 5.0
"""Time between two commands, s."""

MAX_ERROR_XY = 0.25
"""Planar velocity error, m/s."""
MAX_SHARE_OF_STILL = 0.5
"""Planar velocity error over that of a robot that stands still."""
MAX_ERROR_YAW = 0.25
"""Yaw rate error, rad/s."""
LEAST_TURN = 0.6
"""Yaw rate of a pure turn over the commanded one, in the direction that the robot turns to less
well."""
MAX_FALL_RATE = 0.05
"""Share of the episodes with a fall."""
MAX_DRIFT_XY = 0.05
"""Mean planar velocity of a robot that is told to stop, m/s."""
MAX_DRIFT_YAW = 0.05
"""Mean yaw rate of a robot that is told to stop, rad/s."""

BOUNDS = {
    "error_vel_xy": MAX_ERROR_XY,
    "error_vel_xy_of_still": MAX_SHARE_OF_STILL,
    "error_vel_yaw": MAX_ERROR_YAW,
    "turn_reached": LEAST_TURN,
    "fall_rate": MAX_FALL_RATE,
    "drift_xy": MAX_DRIFT_XY,
    "drift_yaw": MAX_DRIFT_YAW,
}
"""All bounds, as files of results say them; `turn_reached` is the least, the others are the
most."""

BOX, TURN, SIDE, STOP = KINDS = ("box", "turn", "side", "stop")
"""Kinds of a segment: a draw from the whole command box, a pure turn, a pure side-step, no velocity
at all."""

SETTLES_S = {TURN: 1.0, SIDE: 1.0, STOP: 2.0}
"""Time after the command, s, from which the mean motion of a segment is taken."""

LEAST_RANGE = 0.1
"""A box has turns (side-steps) if it reaches this yaw rate, rad/s (left or right velocity, m/s):
twice the drift that a standing robot may have."""

_PATTERNS = (
    (BOX, TURN, STOP, SIDE),
    (TURN, BOX, SIDE, BOX),
    (SIDE, BOX, STOP, TURN),
    (BOX, SIDE, BOX, TURN),
)
"""Kinds of the segments of an episode. An env has one turn and one side-step, every other env has a
stop, and a stop comes after a motion."""

_SPEEDS = ("lin_vel_x", "lin_vel_y", "ang_vel_z")

Ranges = Mapping[str, Sequence[float]]
"""A robot's command box, as `VecSim.command_ranges` gives it: `lin_vel_x`, `lin_vel_y` (m/s),
`ang_vel_z` (rad/s)."""


@dataclasses.dataclass(frozen=True)
class Schedule:
    """The commands of an episode of some envs."""

    commands: npt.NDArray[np.float32]
    """Forward and left velocity, m/s, and yaw rate, rad/s, [segments, envs, 3]."""
    kinds: npt.NDArray[np.str_]
    """Kinds of the segments, of `KINDS`, [segments, envs]."""
    steps_per_segment: int
    """Control steps."""
    steps: int
    """Control steps of an episode."""

    @classmethod
    def draw(cls, ranges: Ranges, num_envs: int, steps: int, step_dt: float, seed: int) -> "Schedule":
        """The commands that walking is judged by, of the envs of one robot.

        An env's commands depend on the seed, its index among the robot's envs and the robot's
        ranges alone. Turns and side-steps have half to all of the largest speed of their direction,
        and directions alternate between envs. Where the box has no turns or no side-steps, draws
        from the whole box take their place.

        Args:
            ranges: the robot's command box.
            num_envs: number of the robot's envs.
            steps: control steps of the episode.
            step_dt: length of a control step, s.
            seed: of the draws.
        """
        steps_per_segment = max(1, round(SEGMENT_S / step_dt))
        segments = max(1, -(-steps // steps_per_segment))
        asked = kinds_of(ranges)
        low, high = (np.array([ranges[key][end] for key in _SPEEDS], dtype=np.float64) for end in (0, 1))
        commands, kinds = np.zeros((segments, num_envs, 3)), np.full((segments, num_envs), BOX, dtype="U4")
        for env in range(num_envs):
            draws = np.random.default_rng((seed, env)).random((segments, 3))
            number = seed + env
            for segment in range(segments):
                round_, place = divmod(segment, len(_PATTERNS[0]))
                kind = _PATTERNS[number % len(_PATTERNS)][place]
                kind = kind if kind in asked else BOX
                kinds[segment, env] = kind
                if kind == BOX:
                    commands[segment, env] = low + (high - low) * draws[segment]
                elif kind == TURN:
                    is_left = (number + number // 4 + round_) % 2 == 0
                    commands[segment, env, 2] = _speed(low[2], high[2], is_left, draws[segment, 2])
                elif kind == SIDE:
                    is_left = (number // 2 + number // 8 + round_) % 2 == 0
                    commands[segment, env, 1] = _speed(low[1], high[1], is_left, draws[segment, 1])
        return cls(commands.astype(np.float32), kinds, steps_per_segment, steps)

    @classmethod
    def constant(cls, command: npt.ArrayLike, num_envs: int, steps: int) -> "Schedule":
        """One command for all envs and the whole episode; its kind is read off the command."""
        commands = np.tile(np.asarray(command, dtype=np.float32), (1, num_envs, 1))
        x, y, turn = commands[0, 0].tolist()
        kind = STOP if x == y == turn == 0.0 else TURN if x == y == 0.0 else SIDE if x == turn == 0.0 else BOX
        return cls(commands, np.full((1, num_envs), kind, dtype="U4"), steps, steps)

    @classmethod
    def elsewhere(cls, num_envs: int, steps: int) -> "Schedule":
        """Commands from elsewhere: `Record.add` is told them in each control step."""
        kinds = np.full((1, num_envs), BOX, dtype="U4")
        return cls(np.zeros((1, num_envs, 3), dtype=np.float32), kinds, steps, steps)

    @classmethod
    def joined(cls, schedules: Sequence["Schedule"]) -> "Schedule":
        """The schedules of several robots, one after the other, as their envs are in a batch."""
        commands = np.concatenate([each.commands for each in schedules], axis=1)
        kinds = np.concatenate([each.kinds for each in schedules], axis=1)
        return cls(commands, kinds, schedules[0].steps_per_segment, schedules[0].steps)

    def of_envs(self, envs: slice) -> "Schedule":
        """The schedule of some of the envs."""
        return dataclasses.replace(self, commands=self.commands[:, envs], kinds=self.kinds[:, envs])

    def changes_at(self, step: int) -> bool:
        """Whether new commands hold from a control step on."""
        return step % self.steps_per_segment == 0

    def at(self, step: int) -> npt.NDArray[np.float32]:
        """The commands of a control step, [envs, 3]."""
        return self.commands[step // self.steps_per_segment]


def episode_steps(step_dt: float) -> int:
    """Control steps of an episode of `EPISODE_S`, for control steps of `step_dt`, s."""
    return math.ceil(EPISODE_S / step_dt - 1e-9)


def schedule_of(sim: _core.VecSim, steps: int, seed: int) -> Schedule:
    """`Schedule.draw` for all robots of a simulation, in the order of its envs."""
    ranges, envs = sim.command_ranges(), {robot: sim.env_ids(robot) for robot in sim.robots}
    return Schedule.joined(
        [Schedule.draw(ranges[robot], end - start, steps, sim.step_dt, seed) for robot, (start, end) in envs.items()]
    )


def kinds_of(ranges: Ranges) -> tuple[str, ...]:
    """The kinds of segments that a command box has, of `KINDS`.

    A pure turn needs yaw rates of `LEAST_RANGE` and more, and a box that contains zero forward and
    zero left velocity. A pure side-step needs such left velocities, and a box that contains zero
    forward velocity and zero yaw rate.
    """
    x, y, turn = (ranges[key] for key in _SPEEDS)
    has_none = [low <= 0.0 <= high for low, high in (x, y, turn)]
    turns = max(map(abs, turn)) >= LEAST_RANGE and has_none[0] and has_none[1]
    steps_aside = max(map(abs, y)) >= LEAST_RANGE and has_none[0] and has_none[2]
    return (BOX, *([TURN] * turns), *([SIDE] * steps_aside), STOP)


def _speed(low: float, high: float, is_left: bool, draw: float) -> float:
    """Half to all of the largest speed to the left (positive) or right.

    If there is none, of the other direction.
    """
    left = high >= LEAST_RANGE and (is_left or low > -LEAST_RANGE)
    return float(np.clip((high if left else low) * (0.5 + 0.5 * draw), low, high))


@dataclasses.dataclass(frozen=True)
class Segments:
    """One robot's segments of one kind; errors are means over their time, a fall ends a segment."""

    count: int
    error_vel_xy: float
    error_vel_yaw: float
    still_error_vel_xy: float
    still_error_vel_yaw: float
    fall_rate: float
    """Share of the segments in which the robot fell."""


@dataclasses.dataclass(frozen=True)
class Walking:
    """One robot's figures over the schedule. A figure that was not measured is NaN.

    With v(t) the planar velocity of the base's centre of mass in base axes, w(t) the yaw rate about
    the base's z axis, and v*(t), w*(t) the commanded ones, a bar for the mean over time:

    - `error_vel_xy` is the mean over episodes of the time average of |v* - v|, `still_error_vel_xy`
      that of |v*|; `error_vel_yaw` and `still_error_vel_yaw` are those of |w* - w| and |w*|.
      Episodes end with a fall.
    - `turn_reached` is mean(w) / w* of a pure turn, each from 1 s after its command to its end,
      averaged over the turns to the left and over those to the right: the smaller of the two.
      `side_reached` is the same of the left velocity of pure side-steps.
    - `drift_xy` is |mean(v)| and `drift_yaw` is |mean(w)| from 2 s after a stop to the end of the
      segment, averaged over the stops: the length of the mean vector, so that a robot that sways in
      place does not drift.

    Segments that a fall cuts short count in the errors and in the falls, not in `turn_reached`,
    `side_reached` and `drift_xy`, `drift_yaw`.
    """

    episodes: int
    duration_s: float
    """Length of an episode without a fall, s."""
    kinds: tuple[str, ...]
    """Kinds of segments that the robot's command box has: what it is asked."""
    error_vel_xy: float
    still_error_vel_xy: float
    error_vel_yaw: float
    still_error_vel_yaw: float
    fall_rate: float
    turn_reached: float
    side_reached: float
    drift_xy: float
    drift_yaw: float
    by_kind: dict[str, Segments] = dataclasses.field(default_factory=dict)
    """Figures by kind of segment, of kinds that came up."""

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "Walking":
        """Reads `dataclasses.asdict`, where None stands for NaN.

        Raises KeyError or TypeError for anything else.
        """
        by_kind = {kind: Segments(**numbers_of(Segments, entry)) for kind, entry in content["by_kind"].items()}
        return cls(**{**numbers_of(cls, content), "kinds": tuple(content["kinds"]), "by_kind": by_kind})


FIGURES = tuple(
    field.name for field in dataclasses.fields(Walking) if field.type is float and field.name != "duration_s"
)
"""Names of the numbers that describe a robot."""


def numbers_of(kind: type[Any], content: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of a dataclass from the result of `dataclasses.asdict`; None stands for NaN."""
    floats = {field.name for field in dataclasses.fields(kind) if field.type is float}
    return {key: math.nan if value is None and key in floats else value for key, value in content.items()}


class Record:
    """Record of a simulation that follows a schedule, env by env, until each env's first fall."""

    def __init__(self, schedule: Schedule, step_dt: float) -> None:
        """Begins an episode.

        Args:
            schedule: the commands.
            step_dt: length of a control step, s.
        """
        self.schedule, self.step_dt = schedule, step_dt
        segments, num_envs = schedule.kinds.shape
        self.active = np.ones(num_envs, dtype=np.bool_)
        """Envs whose robot has not fallen yet, [envs]."""
        self.fell = np.zeros(num_envs, dtype=np.bool_)
        self.step = 0
        self._kinds = schedule.kinds
        # a segment begins to count for the mean motion after its kind's time
        after = {kind: round(SETTLES_S.get(kind, 0.0) / step_dt) for kind in KINDS}
        self._settled_from = np.vectorize(after.__getitem__, otypes=[np.int64])(schedule.kinds)
        self._steps, self._settled, self._fell_in = (np.zeros((segments, num_envs)) for _ in range(3))
        self._motion = np.zeros((segments, num_envs, 3))
        self._errors = np.zeros((segments, num_envs, 4))

    def add(
        self,
        velocity: npt.ArrayLike,
        yaw_rate: npt.ArrayLike,
        fell: npt.NDArray[np.bool_],
        command: npt.ArrayLike | None = None,
    ) -> None:
        """Adds a control step. A state that is not finite is a fall.

        Args:
            velocity: [envs, 2], planar velocity of the base's centre of mass after the step, base
                axes, m/s.
            yaw_rate: [envs], rad/s.
            fell: [envs], whether the step ended the episode with a fall.
            command: [envs, 3], the commands of the step; None: those of the schedule.
        """
        wanted = np.asarray(self.schedule.at(self.step) if command is None else command, dtype=np.float64)
        motion = np.column_stack([np.asarray(velocity, dtype=np.float64), np.asarray(yaw_rate, dtype=np.float64)])
        segment, since = divmod(self.step, self.schedule.steps_per_segment)
        is_finite = np.isfinite(motion).all(axis=1)
        active = self.active & is_finite
        errors = np.column_stack(
            [
                np.linalg.norm(wanted[:, :2] - motion[:, :2], axis=1),
                np.abs(wanted[:, 2] - motion[:, 2]),
                np.linalg.norm(wanted[:, :2], axis=1),
                np.abs(wanted[:, 2]),
            ]
        )
        self._steps[segment] += active
        self._errors[segment] += np.where(active[:, None], errors, 0.0)
        settled = active & (since >= self._settled_from[segment])
        self._settled[segment] += settled
        self._motion[segment] += np.where(settled[:, None], motion, 0.0)
        falls = self.active & (np.asarray(fell, dtype=np.bool_) | ~is_finite)
        self._fell_in[segment] += falls
        self.fell |= falls
        self.active &= ~falls
        self.step += 1

    @property
    def steps(self) -> Array:
        """Control steps until the first fall, [envs]."""
        steps: Array = self._steps.sum(axis=0)
        return steps

    def sums(self, envs: slice = slice(None)) -> dict[str, Array]:
        """Sums over each env's episode by which success is judged, named as in `of_step`."""
        xy, _, still_xy, _ = self._errors[:, envs].sum(axis=0).T
        return {"steps": self.steps[envs], "fell": self.fell[envs].astype(np.float64), "xy": xy, "still_xy": still_xy}

    def walking(self, envs: slice = slice(None), kinds: Sequence[str] | None = None) -> Walking:
        """The figures of the envs of one robot; `kinds` as `figures`."""
        return figures([self], envs, kinds)


def figures(records: Sequence[Record], envs: slice = slice(None), kinds: Sequence[str] | None = None) -> Walking:
    """One robot's figures over several episodes.

    Args:
        records: one per episode, of the same envs.
        envs: those of the robot.
        kinds: the kinds of segments that are asked, see `kinds_of`; None: those that the schedules
            have.
    """
    first = records[0]
    steps, settled, fell_in = (
        np.concatenate([getattr(each, key)[:, envs] for each in records], axis=1)
        for key in ("_steps", "_settled", "_fell_in")
    )
    errors, motion = (
        np.concatenate([getattr(each, key)[:, envs] for each in records], axis=1) for key in ("_errors", "_motion")
    )
    commands = np.concatenate([each.schedule.commands[:, envs] for each in records], axis=1).astype(np.float64)
    kind_of = np.concatenate([each.schedule.kinds[:, envs] for each in records], axis=1)
    settled_from = np.concatenate([each._settled_from[:, envs] for each in records], axis=1)
    whole = (settled == first.schedule.steps_per_segment - settled_from) & (settled > 0)
    mean = motion / np.maximum(settled, 1.0)[..., None]
    per_episode = errors.sum(axis=0) / np.maximum(steps.sum(axis=0), 1.0)[:, None]
    xy, yaw, still_xy, still_yaw = (float(value) for value in per_episode.mean(axis=0))
    stops = whole & (kind_of == STOP)
    by_kind = {}
    for kind in KINDS:
        here = (kind_of == kind) & (steps > 0)
        if here.any():
            over_time = (errors[here].sum(axis=0) / steps[here].sum()).tolist()
            by_kind[kind] = Segments(
                count=int(here.sum()),
                error_vel_xy=over_time[0],
                error_vel_yaw=over_time[1],
                still_error_vel_xy=over_time[2],
                still_error_vel_yaw=over_time[3],
                fall_rate=float(fell_in[here].mean()),
            )
    return Walking(
        episodes=int(steps.shape[1]),
        duration_s=first.schedule.steps * first.step_dt,
        kinds=tuple(kinds) if kinds is not None else tuple(kind for kind in KINDS if (kind_of == kind).any()),
        error_vel_xy=xy,
        still_error_vel_xy=still_xy,
        error_vel_yaw=yaw,
        still_error_vel_yaw=still_yaw,
        fall_rate=float(fell_in.sum(axis=0).mean()),
        turn_reached=_reached(whole & (kind_of == TURN), mean[..., 2], commands[..., 2]),
        side_reached=_reached(whole & (kind_of == SIDE), mean[..., 1], commands[..., 1]),
        drift_xy=float(np.linalg.norm(mean[stops][:, :2], axis=1).mean()) if stops.any() else math.nan,
        drift_yaw=float(np.abs(mean[stops][:, 2]).mean()) if stops.any() else math.nan,
        by_kind=by_kind,
    )


def _reached(here: npt.NDArray[np.bool_], mean: Array, asked: Array) -> float:
    """The smaller of the mean achieved shares to the left and to the right.

    NaN without a whole segment.
    """
    sides = [mean[side] / asked[side] for side in (here & (asked > 0.0), here & (asked < 0.0)) if side.any()]
    return min((float(side.mean()) for side in sides), default=math.nan)


def faults(walking: Walking, whole: bool = True) -> dict[str, str]:
    """The clauses of the definition that a robot does not meet, each with its numbers.

    Args:
        walking: the robot's figures.
        whole: also count what was not measured, and episodes that are shorter than `EPISODE_S`.
    """
    found = {}
    share = MAX_SHARE_OF_STILL * walking.still_error_vel_xy
    checks = {
        "falls": (walking.fall_rate, MAX_FALL_RATE, "falls in {0:.1%} of the episodes, {1:.0%} allowed"),
        "planar error": (walking.error_vel_xy, MAX_ERROR_XY, "planar error {0:.3f} m/s, {1:g} allowed"),
        "share of still": (
            walking.error_vel_xy if walking.still_error_vel_xy > 0.0 else 0.0,
            share,
            f"planar error {{0:.3f}} m/s, {{1:.3f}} allowed ({MAX_SHARE_OF_STILL:g} of standing still's)",
        ),
        "yaw error": (walking.error_vel_yaw, MAX_ERROR_YAW, "yaw error {0:.3f} rad/s, {1:g} allowed"),
    }
    if STOP in walking.kinds:
        checks["drift"] = (walking.drift_xy, MAX_DRIFT_XY, "told to stop, drifts at {0:.3f} m/s, {1:g} allowed")
        checks["yaw drift"] = (walking.drift_yaw, MAX_DRIFT_YAW, "told to stop, turns at {0:.3f} rad/s, {1:g} allowed")
    for clause, (value, most, text) in checks.items():
        if value > most:
            found[clause] = text.format(value, most)
    if TURN in walking.kinds and walking.turn_reached < LEAST_TURN:
        found["turn"] = f"pure turns reach {walking.turn_reached:.0%} of what is asked, {LEAST_TURN:.0%} wanted"
    if whole:
        missing = [clause for clause, (value, _, _) in checks.items() if math.isnan(value)]
        missing += ["turn"] if TURN in walking.kinds and math.isnan(walking.turn_reached) else []
        for clause in missing:
            found[clause] = f"{clause}: not measured"
        if walking.duration_s < EPISODE_S - 1e-6:
            found["length"] = f"episodes of {walking.duration_s:g} s, {EPISODE_S:g} s wanted"
    return found


def why_not(walking: Walking) -> list[str]:
    """The clauses of the definition that a robot does not meet, with their numbers.

    Empty if it walks.
    """
    return list(faults(walking).values())


def walks(walking: Walking) -> bool:
    """Whether a robot walks, by the definition of this module."""
    return not faults(walking)


def shortfall(walking: Walking) -> float:
    """Distance of a robot from walking.

    0 where it meets the bounds, and more the further figures lie beyond them.

    Each figure counts by the part of the way from its bound to its worst value, at most 1: falls to
    every episode, errors to those of a standing robot, a turn to no turn, drifts to twice their
    bounds. A figure that was not measured counts 1. The sum orders checkpoints of one training that
    do not walk yet.
    """
    errors = (
        (walking.error_vel_xy, min(MAX_ERROR_XY, MAX_SHARE_OF_STILL * walking.still_error_vel_xy)),
        (walking.error_vel_yaw, MAX_ERROR_YAW),
    )
    stills = walking.still_error_vel_xy, walking.still_error_vel_yaw
    parts = [_beyond(walking.fall_rate, MAX_FALL_RATE, 1.0)]
    parts += [_beyond(value, bound, still) for (value, bound), still in zip(errors, stills, strict=True)]
    if TURN in walking.kinds:
        parts.append(_beyond(-walking.turn_reached, -LEAST_TURN, 0.0))
    if STOP in walking.kinds:
        parts.append(_beyond(walking.drift_xy, MAX_DRIFT_XY, 2.0 * MAX_DRIFT_XY))
        parts.append(_beyond(walking.drift_yaw, MAX_DRIFT_YAW, 2.0 * MAX_DRIFT_YAW))
    return sum(parts)


def _beyond(value: float, bound: float, worst: float) -> float:
    """Part of the way from a bound to the worst value, from 0 to 1."""
    if math.isnan(value):
        return 1.0
    if value <= bound:
        return 0.0
    return min((value - bound) / (worst - bound), 1.0) if worst > bound else 1.0
