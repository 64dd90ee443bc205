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


class RewardOptions(msgspec.Struct, forbid_unknown_fields=True):
    """A reward term: `weight * exp(-error / std^2)`."""

    weight: float
    std: Positive


class ThresholdOptions(msgspec.Struct, forbid_unknown_fields=True):
    """A termination; a threshold of null leaves it out."""

    threshold: Positive | None


class ResetOptions(msgspec.Struct, forbid_unknown_fields=True):
    """Noise on the reference where an episode of a training begins."""

    play_noise: Annotated[float, Meta(ge=0.0, le=1.0)]
    """Share of it in `eval` and `play`."""

    pose_range: dict[str, Range]
    velocity_range: dict[str, Range]
    joint_position_range: Range


class SamplingOptions(msgspec.Struct, forbid_unknown_fields=True):
    """Adaptive sampling of the frame where an episode begins."""

    adaptive: bool
    bin_s: Positive
    kernel_size: Annotated[int, Meta(ge=1, le=100)]
    kernel_lambda: Annotated[float, Meta(gt=0.0, le=1.0)]
    uniform_ratio: Annotated[float, Meta(gt=0.0, le=1.0)]
    alpha: Annotated[float, Meta(gt=0.0, le=1.0)]


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """All options."""

    clips: Annotated[list[str], Meta(min_length=1, max_length=1000)]
    look_ahead: Annotated[list[Annotated[int, Meta(ge=0, le=500)]], Meta(min_length=1, max_length=16)]
    rewards: dict[str, RewardOptions]
    terminations: dict[str, ThresholdOptions]
    reset: ResetOptions
    sampling: SamplingOptions

    def as_dict(self) -> dict[str, Any]:
        """The same as dicts and lists, for a manifest."""
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
