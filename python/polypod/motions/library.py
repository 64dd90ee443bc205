"""The clips of a task for each of its robots."""

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from polypod import _core
from polypod.motions import key_poses, motion
from polypod.motions.body import body_of
from polypod.motions.motion import Motion
from polypod.motions.retarget import retarget

MAX_DURATION_S = 3600.0


def duration(clip: str) -> float:
    """Length of a clip, s, without making it for a body. Raises ConfigError."""
    if _is_file(clip):
        return motion.read(Path(clip)).duration_s
    return key_poses.duration(clip)


def clip_of(clip: str, robot: str) -> Motion:
    """A clip for a robot: drawn, read, or retargeted from the robot that the file names.

    Args:
        clip: name of a drawn motion, or path of an .npz or of a drawing's .toml.
        robot: name, or path of a config.

    Raises:
        ConfigError: for a clip that cannot be used.
    """
    return _clip_of(clip, str(robot))


def clips_of(clips: Sequence[str], robot: str) -> list[Motion]:
    """`clip_of` for each."""
    return [clip_of(clip, robot) for clip in clips]


@functools.lru_cache(maxsize=64)
def _clip_of(clip: str, robot: str) -> Motion:
    body = body_of(robot)
    if not _is_file(clip):
        return key_poses.draw(clip, body)
    found = motion.read(Path(clip))
    if found.duration_s > MAX_DURATION_S:
        raise _core.ConfigError(f"{clip}: {found.duration_s:.0f} s are more than {MAX_DURATION_S:.0f}; cut it")
    if found.robot in ("", body.name, body.source) or not found.robot:
        body.qpos(found)
        return replace(found, robot=body.source)
    return retarget(found, body_of(found.robot), body)


def _is_file(clip: str) -> bool:
    return clip.endswith(".npz")
