"""Reference motions: joint positions and base poses over time, and their files."""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, rotations
from polypod.arrays import Array
from polypod.files import read_bytes, write_bytes

MAX_BYTES = 256 << 20
"""Largest size of a file of a motion, bytes."""
MAX_FRAMES = 1_000_000
ARRAYS = ("fps", "joint_names", "joint_pos", "base_pos", "base_quat")
"""Arrays that each file has."""
OPTIONAL = ("robot", "link_names", "link_pos", "link_quat")
UNIT = 1e-3
"""Largest deviation of a quaternion's length from one."""
BASE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""First columns of a .csv, as in Unitree's retargeted LAFAN1."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """A motion of one robot, at a fixed frame rate. World axes, z up, the ground at z = 0."""

    name: str
    robot: str
    """Name of the robot; empty: not known."""
    fps: float
    """Frames per second."""
    joint_names: tuple[str, ...]
    """Joints, as in the robot's URDF."""
    joint_pos: Array
    """Positions of the joints, [frames, joints], rad."""
    base_pos: Array
    """Positions of the base's frame, [frames, 3], m."""
    base_quat: Array
    """Orientations of the base, w, x, y, z, [frames, 4]."""
    link_names: tuple[str, ...] = ()
    """Links whose positions the motion's file says."""
    link_pos: Array | None = None
    """Positions of the links, [frames, links, 3], m."""
    notes: tuple[str, ...] = ()
    """Sentences on what the making of the motion has lost."""

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.joint_pos)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last frame, s."""
        return (self.frames - 1) / self.fps

    def resampled(self, fps: float) -> "Motion":
        """The motion at another frame rate; between frames it is linear, and turns are shortest."""
        if math.isclose(fps, self.fps, rel_tol=1e-9):
            return self
        count = math.floor(self.duration_s * fps + 1e-6) + 1
        place = np.minimum(np.arange(count) * (self.fps / fps), self.frames - 1.0)
        before = np.minimum(place.astype(np.int64), max(self.frames - 2, 0))
        after = np.minimum(before + 1, self.frames - 1)
        share = (place - before)[:, np.newaxis]

        def linear(values: Array) -> Array:
            mixed: Array = values[before] * (1.0 - share) + values[after] * share
            return mixed

        quat = rotations.between(self.base_quat[before], self.base_quat[after], share[:, 0])
        return replace(
            self,
            fps=fps,
            joint_pos=linear(self.joint_pos),
            base_pos=linear(self.base_pos),
            base_quat=quat,
            link_pos=None,
        )


def save(motion: Motion, path: Path, **links: npt.NDArray[Any]) -> None:
    """Writes a motion as .npz.

    Args:
        motion: the motion.
        path: its file.
        **links: `link_names`, `link_pos` and `link_quat`, if the file is to have them.

    Raises:
        ConfigError: for another ending of the name.
        OSError: where it cannot be written.
    """
    if path.suffix != ".npz":
        raise _core.ConfigError(f"{path}: a motion is written as .npz; change the name's ending")
    arrays: dict[str, Any] = {
        "fps": np.float64(motion.fps),
        "robot": np.array(motion.robot),
        "joint_names": np.array(motion.joint_names),
        "joint_pos": motion.joint_pos.astype(np.float32),
        "base_pos": motion.base_pos.astype(np.float32),
        "base_quat": motion.base_quat.astype(np.float32),
        **links,
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def read(path: Path) -> Motion:
    """Reads a motion from an .npz.

    Raises ConfigError, which names the file, the array, the problem and a remedy.
    """
    data = _bytes(path)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            names = set(archive.files)
            if missing := [name for name in ARRAYS if name not in names]:
                raise _core.ConfigError(
                    f"{path}: {missing[0]}: this array is missing; a motion has {', '.join(ARRAYS)}: write it with "
                    "`polypod motions import`"
                )
            if unknown := sorted(names - {*ARRAYS, *OPTIONAL}):
                raise _core.ConfigError(
                    f"{path}: {unknown[0]}: no array of a motion; it has {', '.join((*ARRAYS, *OPTIONAL))}"
                )
            arrays = {name: _array(path, archive, name) for name in archive.files}
    except _core.ConfigError:
        raise
    except Exception as error:  # NumPy and zipfile have many
        raise _core.ConfigError(f"{path} is no .npz of a motion: {error}; write it again") from error
    return _checked(path, arrays)


def read_csv(path: Path, robot: str, fps: float, joints: Sequence[str] | None = None) -> Motion:
    """Reads a motion from a .csv: a row per frame of x, y, z, qx, qy, qz, qw and the joints.

    Args:
        path: the file.
        robot: name of the robot.
        fps: frames per second.
        joints: names of the joints' columns; None: the first line names all columns.

    Raises:
        ConfigError: as `read`.
    """
    if not 0.0 < fps <= 10_000.0:
        raise _core.ConfigError(f"--fps {fps:g} must be above 0 and at most 10000")
    try:
        text = _bytes(path).decode()
        rows = [row for row in csv.reader(io.StringIO(text)) if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise _core.ConfigError(f"{path} is no text of columns with commas between: {error}") from error
    if not rows:
        raise _core.ConfigError(f"{path} is empty; a motion has a row per frame")
    header = [name.strip() for name in rows[0]]
    if not _is_number(header[0]):
        columns, rows = header, rows[1:]
        if tuple(columns[:7]) != BASE_COLUMNS:
            raise _core.ConfigError(
                f"{path}, line 1: the columns begin with {', '.join(columns[:7])}; they must begin with "
                f"{', '.join(BASE_COLUMNS)}"
            )
    elif joints is None:
        raise _core.ConfigError(
            f"{path}: the first line names no columns; name the joints in the order of the columns with --joints A,B,C"
        )
    else:
        columns = [*BASE_COLUMNS, *joints]
    for number, row in enumerate(rows, 1):
        if len(row) != len(columns):
            raise _core.ConfigError(
                f"{path}, frame {number}: {len(row)} columns; {len(columns)} are named: {', '.join(columns[:9])}, ..."
            )
    try:
        values = np.array(rows, dtype=np.float64).reshape(len(rows), len(columns))
    except ValueError as error:
        raise _core.ConfigError(f"{path}: {error}; write numbers") from error
    return _checked(
        path,
        {
            "fps": np.float64(fps),
            "robot": np.array(robot),
            "joint_names": np.array(columns[7:]),
            "joint_pos": values[:, 7:],
            "base_pos": values[:, :3],
            "base_quat": values[:, [6, 3, 4, 5]],
        },
    )


def _bytes(path: Path) -> bytes:
    try:
        return read_bytes(path, MAX_BYTES)
    except OSError as error:
        raise _core.ConfigError(f"cannot read {path}: {error.strerror}; name the file of a motion") from error
    except ValueError as error:
        raise _core.ConfigError(f"cannot read {path}: {error}; name the file of a motion") from error


def _array(path: Path, archive: Any, name: str) -> npt.NDArray[Any]:
    try:
        array: npt.NDArray[Any] = archive[name]
    except ValueError as error:
        raise _core.ConfigError(
            f"{path}: {name}: {error}; objects of Python are refused, since reading them runs code: write numbers or "
            "strings"
        ) from error
    return array


def _checked(path: Path, arrays: dict[str, npt.NDArray[Any]]) -> Motion:
    def fail(name: str, problem: str, remedy: str) -> _core.ConfigError:
        return _core.ConfigError(f"{path}: {name}: {problem}; {remedy}")

    for name in ("fps", "joint_pos", "base_pos", "base_quat", "link_pos", "link_quat"):
        if name not in arrays:
            continue
        if arrays[name].dtype.kind not in "fiu":
            raise fail(name, f"{arrays[name].dtype}", "write numbers")
        if not np.isfinite(arrays[name]).all():
            place = ", ".join(map(str, np.argwhere(~np.isfinite(arrays[name]))[0]))
            raise fail(name, f"the number at [{place}] is not finite", "mend the frame, or cut it out")
    for name in ("robot", "joint_names", "link_names"):
        if name in arrays and arrays[name].dtype.kind != "U":
            raise fail(name, f"{arrays[name].dtype}", "write text, such as np.array([...], dtype=str)")
    if arrays["fps"].size != 1 or not 0.0 < float(arrays["fps"].item()) <= 10_000.0:
        raise fail("fps", f"{arrays['fps'].tolist()}", "write one frame rate above 0, Hz")
    joints = [str(name) for name in arrays["joint_names"].reshape(-1)]
    if len(set(joints)) != len(joints) or not joints:
        raise fail("joint_names", f"{len(joints)} names, of which {len(set(joints))} differ", "name each joint once")
    frames = arrays["joint_pos"].shape[0] if arrays["joint_pos"].ndim else 0
    if not 2 <= frames <= MAX_FRAMES:
        raise fail("joint_pos", f"{frames} frames", f"write 2 to {MAX_FRAMES:,}")
    links = arrays["link_names"].size if "link_names" in arrays else 0
    shapes: dict[str, tuple[int, ...]] = {
        "joint_pos": (frames, len(joints)),
        "base_pos": (frames, 3),
        "base_quat": (frames, 4),
    }
    shapes |= {"link_pos": (frames, links, 3), "link_quat": (frames, links, 4)}
    for name, shape in shapes.items():
        if name in arrays and arrays[name].shape != shape:
            raise fail(name, f"shape {arrays[name].shape}", f"write {shape}: frames first, in the order of the names")
    for name in ("base_quat", "link_quat"):
        if name in arrays:
            length = np.linalg.norm(arrays[name].astype(np.float64), axis=-1)
            if (wrong := np.abs(length - 1.0) > UNIT).any():
                at = np.argwhere(wrong)[0]
                raise fail(
                    name,
                    f"the quaternion of frame {at[0]} has length {length[tuple(at)]:.4g}",
                    "write unit quaternions w, x, y, z",
                )
    robot = str(arrays["robot"].item()) if "robot" in arrays and arrays["robot"].size == 1 else ""
    motion = Motion(
        name=path.stem,
        robot=robot,
        fps=float(arrays["fps"].item()),
        joint_names=tuple(joints),
        joint_pos=arrays["joint_pos"].astype(np.float64),
        base_pos=arrays["base_pos"].astype(np.float64),
        base_quat=rotations.continuous(rotations.unit(arrays["base_quat"].astype(np.float64))),
        link_names=tuple(str(name) for name in arrays["link_names"].reshape(-1)) if links else (),
        link_pos=arrays["link_pos"].astype(np.float64) if links and "link_pos" in arrays else None,
    )
    return motion


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def velocities(motion: Motion) -> tuple[Array, Array, Array]:
    """Velocities by central differences of the frames; one-sided at both ends.

    Returns those of the base's origin, m/s, and its angular velocities, rad/s, world axes, both
    [frames, 3], and [frames, joints], rad/s.
    """
    linear = np.gradient(motion.base_pos, 1.0 / motion.fps, axis=0)
    joints = np.gradient(motion.joint_pos, 1.0 / motion.fps, axis=0)
    before = np.maximum(np.arange(motion.frames) - 1, 0)
    after = np.minimum(np.arange(motion.frames) + 1, motion.frames - 1)
    turn = rotations.product(motion.base_quat[after], rotations.inverse(motion.base_quat[before]))
    angular = rotations.vector(turn) * (motion.fps / (after - before))[:, np.newaxis]
    return linear, angular, joints
