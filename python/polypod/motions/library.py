"""The clips of a task for each of its robots."""

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from polypod import _core
from polypod.motions import key_poses, motion
from polypod.motions.body import body_of
from polypod.motions.motion import Motion
from polypod.motions.retarget import retarget

MAX_DURATION_S = 3600.0
"""Longest motion, s."""
LINK_ERROR = 0.02
"""Largest distance between the links of a file and those that its joints give, m."""


def read(path: Path) -> Motion:
    """Reads a motion, and compares its links with where its joints put them.

    Raises ConfigError, which names the file, the array, the problem and a remedy.
    """
    found = motion.read(path)
    if found.link_pos is None or not found.robot:
        return found
    body = body_of(found.robot)
    frames = np.unique(np.linspace(0, found.frames - 1, 16).astype(np.int64))
    position, _ = body.kinematics(body.qpos(found)[frames])
    for column, link in enumerate(found.link_names):
        if link not in body.links:
            raise _core.ConfigError(f"{path}: link_names: {body.name} has no link {link!r}; write the URDF's names")
        error = float(
            np.linalg.norm(position[:, body.links.index(link)] - found.link_pos[frames, column], axis=-1).max()
        )
        if error > LINK_ERROR:
            raise _core.ConfigError(
                f"{path}: link_pos: {link} is {error:.3f} m from where the joints of {body.name} put it; write the "
                "poses of the URDF's frames, or leave the links out"
            )
    return found


@functools.lru_cache(maxsize=64)
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
    found = read(Path(clip))
    if found.duration_s > MAX_DURATION_S:
        raise _core.ConfigError(f"{clip}: {found.duration_s:.0f} s are more than {MAX_DURATION_S:.0f}; cut it")
    if found.robot in ("", body.name, body.source):
        body.qpos(found)
        return replace(found, robot=body.source)
    return retarget(found, body_of(found.robot), body)


def _is_file(clip: str) -> bool:
    return clip.endswith(".npz")
