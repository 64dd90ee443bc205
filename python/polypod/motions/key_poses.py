"""Motions drawn as key poses: data of the package, made for any humanoid by joint roles."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, field

from polypod import _core, rotations
from polypod.arrays import Array
from polypod.compat import tomllib
from polypod.files import read_bytes
from polypod.motions import balance
from polypod.motions.body import SIDES, Body
from polypod.motions.motion import Motion

FOLDER = Path(__file__).parent / "drawn"
"""Motions that the package has, one TOML each."""
MAX_BYTES = 1 << 20
FPS = 50.0
"""Frame rate of drawn motions, Hz: that of the control steps."""
GRAVITY = 9.81
MISSED = 0.01
"""Largest distance of a foot from where it is drawn, m."""
LIFTING = 0.15
"""Share of a step in which the foot rises before it moves on, and sinks before it stands."""
SINK = 2.5
"""Time in which a jump goes down into the crouch, in roots of leg length over gravity."""

Time = Annotated[float, Meta(ge=0.0, le=600.0)]
Share = Annotated[float, Meta(ge=-20.0, le=20.0)]
Degrees = Annotated[float, Meta(ge=-3600.0, le=3600.0)]


class Base(msgspec.Struct, forbid_unknown_fields=True):
    """Pose of the base: changes from the default pose."""

    forward: Share | None = None
    """Displacement along the world's x axis, in leg lengths."""
    left: Share | None = None
    """Displacement along the world's y axis, in leg lengths."""
    up: Share | None = None
    """Displacement upwards, in leg lengths."""
    roll: Degrees | None = None
    """Angle about the x axis, degrees."""
    pitch: Degrees | None = None
    """Angle about the y axis, degrees."""
    yaw: Degrees | None = None
    """Angle about the z axis, degrees."""


class Pose(msgspec.Struct, forbid_unknown_fields=True):
    """A key pose. Numbers that it leaves out are as in the key poses around it."""

    time: Time
    """When the robot is in the pose, s."""
    base: Base = field(default_factory=Base)
    """Pose of the base."""
    joints: dict[str, Degrees] = field(default_factory=dict)
    """Changes from the default pose by role, in degrees; patterns such as `*_ELBOW`."""


class Step(msgspec.Struct, forbid_unknown_fields=True):
    """A foot that leaves the ground and stands elsewhere."""

    foot: str
    """Foot that steps: L or R."""
    start: Time
    """Time at which it leaves the ground, s."""
    duration: Annotated[float, Meta(gt=0.05, le=60.0)]
    """Time until it stands again, s."""
    forward: Share = 0.0
    """Place where it then stands, relative to that in the default pose, leg lengths."""
    left: Share = 0.0
    """Place to the left, in the same way."""
    yaw: Degrees = 0.0
    """Heading in which it then stands; its place is turned by it about the world's origin."""
    lift: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.15
    """Greatest height, in leg lengths."""


class Jump(msgspec.Struct, forbid_unknown_fields=True):
    """Both feet in the air, as a throw flies."""

    start: Time
    """When the feet leave the ground, s."""
    height: Annotated[float, Meta(gt=0.0, le=1.0)]
    """Height by which the base rises in the flight, leg lengths."""
    crouch: Annotated[float, Meta(gt=0.0, le=0.6)]
    """Depth by which it sinks before and after, leg lengths."""


class Drawing(msgspec.Struct, forbid_unknown_fields=True):
    """A motion drawn as key poses: `polypod motions draw FILE.toml`."""

    title: str
    """The motion in a few words."""
    duration: Annotated[float, Meta(gt=0.0, le=600.0)]
    """Length of the motion, s."""
    pose: list[Pose] = field(default_factory=list)
    """Key poses."""
    step: list[Step] = field(default_factory=list)
    """Steps of the feet, which stand still between them."""
    jump: list[Jump] = field(default_factory=list)
    """Jumps."""


@dataclass(frozen=True)
class _Track:
    """Key numbers over time."""

    times: Array
    values: Array

    def at(self, times: Array) -> Array:
        """Monotone cubic interpolation, after Fritsch and Carlson; constant where keys are."""
        if len(self.times) == 1:
            return np.full_like(times, self.values[0])
        h, d = np.diff(self.times), np.diff(self.values) / np.diff(self.times)
        slopes = np.zeros_like(self.values)
        both = d[:-1] * d[1:] > 0.0
        a, b = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = (a + b) / (a / d[:-1] + b / d[1:])
        slopes[1:-1] = np.where(both, mean, 0.0)
        at = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(h) - 1)
        t = np.clip((times - self.times[at]) / h[at], 0.0, 1.0)
        left, right = self.values[at], self.values[at + 1]
        value: Array = (
            left * (1.0 + 2.0 * t) * (1.0 - t) ** 2
            + slopes[at] * h[at] * t * (1.0 - t) ** 2
            + right * t * t * (3.0 - 2.0 * t)
            + slopes[at + 1] * h[at] * t * t * (t - 1.0)
        )
        return value


def names() -> list[str]:
    """Names of the motions of the package."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def read(name: str) -> Drawing:
    """Reads a drawn motion of the package, or of a .toml.

    Raises ConfigError, which names the file and the element.
    """
    path = FOLDER / f"{name}.toml" if name in names() else Path(name)
    try:
        tables = tomllib.loads(read_bytes(path, MAX_BYTES).decode())
    except OSError as error:
        raise _core.ConfigError(
            f"cannot read the motion {name}: {error.strerror}; there are {', '.join(names())}, or name a file"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _core.ConfigError(f"{path} is no TOML: {error}") from error
    try:
        drawing = msgspec.convert(tables, Drawing)
    except msgspec.ValidationError as error:
        text, _, place = str(error).partition(" - at `$")
        where = place.rstrip("`").lstrip(".")
        raise _core.ConfigError(f"{path}: {where}: {text}; see docs/motions.md") from error
    for step in drawing.step:
        if step.foot not in SIDES:
            raise _core.ConfigError(f"{path}: step: foot = {step.foot!r} is not one of {', '.join(SIDES)}")
    return drawing


def title(name: str) -> str:
    """Content of a motion of the package, in words."""
    return read(name).title


def duration(name: str) -> float:
    """Length of a drawn motion, s."""
    return read(name).duration


def draw(name: str, body: Body) -> Motion:
    """Makes a drawn motion for a body: legs by inverse kinematics, all other joints by role.

    Raises ConfigError where a foot cannot come to its place within `MISSED`.
    """
    drawing = read(name)
    times = np.arange(math.floor(drawing.duration * FPS + 1e-6) + 1) / FPS
    leg = body.leg
    base = {key: _track(drawing.pose, key).at(times) for key in ("forward", "left", "up", "roll", "pitch", "yaw")}
    air = np.zeros_like(times)
    up = base["up"] * leg
    for jump in drawing.jump:
        own, flight = _jump(jump, leg, times)
        up, air = up + own, air + flight
    position = np.stack([base["forward"] * leg, base["left"] * leg, body.height + up], axis=1)
    position += rotations.rotated(rotations.of_yaw(np.radians(base["yaw"])), np.array([body.lean, 0.0, 0.0]))
    quat = rotations.of_angles(*(np.radians(base[key]) for key in ("roll", "pitch", "yaw")))
    slots = np.tile(body.by_slot(body.default), (len(times), 1))
    lost: list[str] = []
    for pattern, track in _joints(drawing.pose).items():
        mine = [slot for slot in body.slots if fnmatchcase(slot, pattern)]
        if not mine:
            lost.append(f"{body.name} has no {pattern}")
        for slot in mine:
            slots[:, body.slots.index(slot)] += np.radians(track.at(times))
    joints = body.by_joint(slots)
    clipped = np.clip(joints, body.lower, body.upper)
    lost += clip_notes(body, joints, clipped)
    feet, yaw = _feet(drawing.step, body, times)
    feet[:, :, 2] += air[:, np.newaxis]
    soles = np.stack([_turned(yaw[:, side], body.soles[side]) for side in range(2)], axis=1)
    qpos, missed = body.with_feet(np.concatenate([position, quat, clipped], axis=1), feet, soles)
    if drawing.step and not drawing.jump:
        qpos, missed = _balanced(drawing.step, body, times, qpos, (feet, yaw, soles))
    if (worst := float(missed.max())) > MISSED:
        frame, side = np.unravel_index(int(missed.argmax()), missed.shape)
        raise _core.ConfigError(
            f"{name}: at {times[frame]:.2f} s the foot {SIDES[int(side)]} of {body.name} misses its place by "
            f"{worst:.3f} m; draw shorter steps, or a lower base"
        )
    return _motion(Path(name).stem, body, qpos, lost)


def _motion(name: str, body: Body, qpos: Array, lost: Sequence[str] = ()) -> Motion:
    return Motion(
        name=name,
        robot=body.source,
        fps=FPS,
        joint_names=body.joints,
        joint_pos=qpos[:, 7:],
        base_pos=qpos[:, :3],
        base_quat=qpos[:, 3:7],
        notes=tuple(lost),
    )


def _balanced(
    steps: Sequence[Step], body: Body, times: Array, qpos: Array, feet: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Sways the base so that the feet can push where the motion needs it.

    Args:
        steps: of the feet.
        body: the robot.
        times: [frames], s.
        qpos: [frames, 7 + joints], as drawn.
        feet: their positions, headings and orientations.

    Returns:
        As `Body.with_feet`.
    """
    position, yaw, soles = feet
    spans = [[(step.start, step.start + step.duration) for step in steps if step.foot == foot] for foot in SIDES]
    goal = balance.wanted(body, position, yaw, balance.loads(spans, times))
    missed = np.zeros((len(times), 2))
    for _ in range(balance.ROUNDS):
        error = goal - balance.zero_moment_points(body, _motion("", body, qpos))
        if float(np.abs(error[1:-1]).max()) < balance.CLOSE:
            break
        moved = qpos.copy()
        moved[:, :2] += balance.sway(error, float(qpos[:, 2].mean()), FPS, GRAVITY)
        qpos, missed = body.with_feet(moved, position, soles)
    return qpos, missed


def clip_notes(body: Body, wanted: Array, clipped: Array) -> list[str]:
    """Sentences on joints that their limits stop, [frames, joints]."""
    beyond = np.degrees(np.abs(wanted - clipped)).max(axis=0)
    return [
        f"{joint} stops at its limit, up to {beyond[i]:.0f} deg short"
        for i, joint in enumerate(body.joints)
        if beyond[i] > 0.5
    ]


def _turned(yaw: Array, sole: Array) -> Array:
    return rotations.product(rotations.of_yaw(yaw), np.broadcast_to(sole, (len(yaw), 4)))


def _track(poses: Sequence[Pose], key: str) -> _Track:
    keys = [(pose.time, value) for pose in poses if (value := getattr(pose.base, key)) is not None]
    return _sorted(keys)


def _joints(poses: Sequence[Pose]) -> Mapping[str, _Track]:
    patterns = dict.fromkeys(pattern for pose in poses for pattern in pose.joints)
    return {
        pattern: _sorted([(pose.time, pose.joints[pattern]) for pose in poses if pattern in pose.joints])
        for pattern in patterns
    }


def _sorted(keys: list[tuple[float, float]]) -> _Track:
    """Keys in the order of their times; the default pose at 0 if there is none."""
    by_time: dict[float, Any] = {0.0: 0.0, **dict(sorted(keys))}
    times = sorted(by_time)
    return _Track(np.array(times), np.array([by_time[time] for time in times], dtype=np.float64))


def _feet(steps: Sequence[Step], body: Body, times: Array) -> tuple[Array, Array]:
    """Positions [frames, 2, 3] and headings [frames, 2] of the feet."""
    position = np.tile(body.feet, (len(times), 1, 1))
    yaw = np.zeros((len(times), 2))
    for side, name in enumerate(SIDES):
        at, heading = body.feet[side], 0.0
        for step in sorted((step for step in steps if step.foot == name), key=lambda step: step.start):
            share = np.clip((times - step.start) / step.duration, 0.0, 1.0)
            gone = _smooth(np.clip((share - LIFTING) / (1.0 - 2.0 * LIFTING), 0.0, 1.0))
            end = math.radians(step.yaw)
            place = rotations.rotated(rotations.of_yaw(np.array(end)), body.feet[side])
            to = place + body.leg * np.array([step.forward, step.left, 0.0])
            later = share > 0.0
            position[later, side] = at + gone[later, np.newaxis] * (to - at)
            position[:, side, 2] += np.where(later, body.leg * step.lift * np.sin(np.pi * share) ** 2, 0.0)
            yaw[later, side] = heading + gone[later] * (end - heading)
            at, heading = to, end
    return position, yaw


def _smooth(share: Array) -> Array:
    """Minimum-jerk way from 0 to 1."""
    way: Array = share**3 * (10.0 + share * (6.0 * share - 15.0))
    return way


def _jump(jump: Jump, leg: float, times: Array) -> tuple[Array, Array]:
    """Height of the base and of the feet in a jump, m.

    The base sinks, is pushed up with one acceleration, flies, is slowed down in the same way, and
    rises.
    """
    rise, crouch = jump.height * leg, jump.crouch * leg
    speed = math.sqrt(2.0 * GRAVITY * rise)
    flight, push, sink = 2.0 * speed / GRAVITY, 2.0 * crouch / speed, SINK * math.sqrt(leg / GRAVITY)
    # mirrored about the middle of the flight
    t = np.abs(times - jump.start - 0.5 * flight) - 0.5 * flight
    arc = rise - 0.5 * GRAVITY * (t + 0.5 * flight) ** 2
    pushed = -crouch + 0.5 * speed / push * (push - t) ** 2
    sunk = -crouch * (1.0 - _smooth(np.clip((t - push) / sink, 0.0, 1.0)))
    base = np.where(t < 0.0, arc, np.where(t < push, pushed, sunk))
    return base, np.where(t < 0.0, arc, 0.0)
