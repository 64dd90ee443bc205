"""Names that the tests share."""

import os
from pathlib import Path
from typing import Any, TypeVar

_Size = TypeVar("_Size")
_TIERS = ("core", "extended")
_TIER = os.environ.get("POLYPOD_TEST_TIER", "core")
if _TIER not in _TIERS:
    raise ValueError(f"POLYPOD_TEST_TIER={_TIER}: use one of {', '.join(_TIERS)}")


def size(core: _Size, extended: _Size) -> _Size:
    """Returns the size that a test has in the tier named by `POLYPOD_TEST_TIER`.

    `core` is the default.

    Both tiers make the same assertions. The extended tier takes more samples, seeds or robots.
    """
    return extended if _TIER == "extended" else core


def some(robots: list[str], core: tuple[str, ...]) -> list[str]:
    """Names among `robots` that a test takes: those of `core`, or all in the extended tier."""
    return size([name for name in robots if name in core], robots)


TASK = "Velocity-Flat-HeteroQuadruped-v0"

SHORT = ("sim.episode_length_s=0.4",)
"""Episodes of 20 control steps: time-outs within a quick test."""

ROBOTS = size(["anymal_b", "unitree_a1", "unitree_b2", "spot"], None)
"""Robots of tests of something else than the robots: one per reward group. None: all of the task.

All eight take 0.2 s to load, most of it for the collision meshes of the ANYmals.
"""

SMALL_TERRAIN = ("scene.terrain.num_rows=2", "scene.terrain.num_cols=10", "scene.terrain.border_width=2.0")
"""Rough ground with one column or two of each type of tile, for tests of something else than the
ground."""

PLAY_TERRAIN = ("scene.terrain.num_rows=5", "scene.terrain.num_cols=10", "scene.terrain.border_width=2.0")
"""The tiles of the Play variants of rough ground without the wide border, for tests of what is
sensed of the ground."""

TINY: dict[str, Any] = {"num_envs": 64, "robots": ROBOTS, "seed": 5, "overrides": ["sim.episode_length_s=1.0"]}
"""Options of a training that takes about a second."""

_ROOT = Path(__file__).parents[2]
_POLICIES = _ROOT / "python" / "polypod" / "policies"
(FLAT_POLICY,) = (_POLICIES / "flat_universal").glob("model_*.pt")
(ROUGH_POLICY,) = (_POLICIES / "rough_universal").glob("model_*.pt")
(LEGGED_POLICY,) = (_POLICIES / "any_legged").glob("model_*.pt")
"""Bundled checkpoints."""
(MASKED_POLICY,) = (_ROOT / "tests" / "data" / "policies" / "legged_masked").glob("model_*.pt")
"""A perceptron with a column for every joint of 24 robots, trained by `legged_finish`."""
ROBOT_FOLDER = _ROOT / "assets" / "robots"
