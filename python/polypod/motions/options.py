"""Options of tracking tasks: `motions.` of `--set`, with their defaults in tracking.toml."""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from polypod import _core
from polypod.compat import tomllib
from polypod.motions.names import PREFIX

FILE = Path(__file__).parent / "tracking.toml"

Positive = Annotated[float, Meta(gt=0.0, le=1e6)]
Range = Annotated[list[float], Meta(min_length=2, max_length=2)]


TERMS = {
    "motion_global_anchor_position_error_exp": ("reward", "exp(-e^2 / std^2) of the distance e of the base, m."),
    "motion_global_anchor_orientation_error_exp": ("reward", "exp(-e^2 / std^2) of the base's angle e, rad."),
    "motion_relative_body_position_error_exp": (
        "reward",
        "exp(-e / std^2) of the mean e of the key links' squared distances, m^2, where the reference has the base's "
        "place on the ground and its heading.",
    ),
    "motion_relative_body_orientation_error_exp": (
        "reward",
        "exp(-e / std^2) of the mean e of the key links' squared angles, rad^2, where the reference has the base's "
        "heading.",
    ),
    "motion_global_body_linear_velocity_error_exp": (
        "reward",
        "exp(-e / std^2) of the mean e of the key links' squared errors of velocity, m^2/s^2.",
    ),
    "motion_global_body_angular_velocity_error_exp": (
        "reward",
        "exp(-e / std^2) of the mean e of the key links' squared errors of angular velocity, rad^2/s^2.",
    ),
    "bad_anchor_pos": ("termination", "The base is that far from the reference's, m."),
    "bad_anchor_heading": ("termination", "The base's heading is that far from the reference's, rad; polypod's own."),
    "bad_anchor_pos_z_only": ("termination", "The base is that much higher or lower than the reference's, m."),
    "bad_anchor_ori": ("termination", "The vertical's z component in base axes differs that much."),
    "bad_motion_body_pos_z_only": ("termination", "A foot or hand is that much higher or lower, m."),
    "motion_command": (
        "observation",
        "Of each joint and frame of `look_ahead`: position less the default pose, rad, and velocity, rad/s.",
    ),
    "motion_phase": ("observation", "Share of the motion that is over, and seconds that remain, at most 10."),
    "motion_anchor_pos_b": ("observation", "Position of the reference's base in base axes, m."),
    "motion_anchor_ori_b": ("observation", "X and z axes of the reference's base in base axes."),
}
"""Terms of tracking tasks: their kind and meaning."""


class RewardOptions(msgspec.Struct, forbid_unknown_fields=True):
    """A reward term: `weight * exp(-error / std^2)`."""

    weight: float
    """Factor of the term."""
    std: Positive
    """Width of the bell curve, in the error's units."""


class ThresholdOptions(msgspec.Struct, forbid_unknown_fields=True):
    """A termination."""

    threshold: Positive | None = None
    """Deviation beyond which the episode fails; null leaves the termination out."""


class ResetOptions(msgspec.Struct, forbid_unknown_fields=True):
    """Noise on the reference where an episode of a training begins."""

    play_noise: Annotated[float, Meta(ge=0.0, le=1.0)]
    """Share of it in `eval` and `play`."""
    pose_range: dict[str, Range]
    """Ranges of the base's pose: x, y, z, m; roll, pitch, yaw, rad."""
    velocity_range: dict[str, Range]
    """Ranges of the base's velocity: x, y, z, m/s; roll, pitch, yaw, rad/s."""
    joint_position_range: Range
    """Range of each joint's position, rad."""


class SamplingOptions(msgspec.Struct, forbid_unknown_fields=True):
    """Adaptive sampling of the frame where an episode begins."""

    adaptive: bool
    """Whether segments that fail come more often; false: all are as likely."""
    bin_s: Positive
    """Length of a segment, s."""
    kernel_size: Annotated[int, Meta(ge=1, le=100)]
    """Segments before a failure for which it counts, its own included."""
    kernel_lambda: Annotated[float, Meta(gt=0.0, le=1.0)]
    """Factor on a failure from each segment to the one before."""
    uniform_ratio: Annotated[float, Meta(gt=0.0, le=1.0)]
    """Weight of segments that never fail, in failures per control step."""
    alpha: Annotated[float, Meta(gt=0.0, le=1.0)]
    """Share of the latest control step in the smoothed failures."""


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """Options of tasks that track motions: `--set motions.KEY=VALUE`."""

    clips: Annotated[list[str], Meta(min_length=1, max_length=1000)]
    """Names of drawn motions, or paths of motions."""
    look_ahead: Annotated[list[Annotated[int, Meta(ge=0, le=500)]], Meta(min_length=1, max_length=16)]
    """Frames of the reference that `motion_command` observes, control steps from now."""
    rewards: dict[str, RewardOptions]
    """Reward terms."""
    terminations: dict[str, ThresholdOptions]
    """Terminations."""
    reset: ResetOptions
    """Noise where an episode begins."""
    sampling: SamplingOptions
    """Frames where episodes begin."""

    def as_dict(self) -> dict[str, Any]:
        """Returns the options as dicts and lists, for a manifest."""
        built: dict[str, Any] = msgspec.to_builtins(self)
        return built


_AXES = ("x", "y", "z", "roll", "pitch", "yaw")


def options(changes: Sequence[str] = ()) -> Options:
    """The defaults with `key=value` changes. Raises ConfigError, which names the key."""
    tables = _defaults()
    if changes:
        tables = tomllib.loads(_core.with_overrides(json.dumps(tables), list(changes)))
    return parse(tables, f"--set {PREFIX}{f' {PREFIX}'.join(changes)}"[:200] if changes else str(FILE))


def parse(tables: Mapping[str, Any], where: str) -> Options:
    """Options of tables. Raises ConfigError, which begins with `where`."""
    try:
        found = msgspec.convert(tables, Options)
    except msgspec.ValidationError as error:
        text, _, place = str(error).partition(" - at `$")
        raise _core.ConfigError(f"{where}: motions{place.rstrip('`')}: {text}; see docs/motions.md") from error
    defaults = _defaults()
    for kind in ("rewards", "terminations"):
        known = defaults[kind]
        for name in getattr(found, kind):
            if name not in known:
                raise _core.ConfigError(f"{where}: motions.{kind}.{name}: no such term; use one of {', '.join(known)}")
    for key in ("pose_range", "velocity_range"):
        for axis, (low, high) in getattr(found.reset, key).items():
            if axis not in _AXES or low > high:
                raise _core.ConfigError(
                    f"{where}: motions.reset.{key}.{axis} = [{low:g}, {high:g}]; write lower and upper end of one of "
                    f"{', '.join(_AXES)}"
                )
    return found


@cache
def _defaults() -> dict[str, Any]:
    return tomllib.loads(FILE.read_text())
