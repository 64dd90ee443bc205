"""Height fields of files as the ground of a task: pictures and NumPy arrays.

A field becomes an obstacle of a task's TOML; heights below zero are holes in the ground.
"""

import io
import json
from pathlib import Path

import numpy as np

from polypod import _core, extras
from polypod.arrays import Array
from polypod.files import read_bytes, write_text

MOST_BYTES = 64 << 20
"""Largest size of a file of heights."""
MOST_HEIGHTS = 100_000
"""Largest number of heights: a task's TOML names each of them."""
DIGITS = 4
"""Digits of a height behind the point, m."""


def read(path: Path, span: tuple[float, float] | None = None) -> Array:
    """Heights of a file, `[i, j]` in m: `i` along x, `j` along y.

    Args:
        path: `.npy` with heights in m; or a grey picture of 8 or 16 bits, x to the right and y
            upwards.
        span: heights of black and of white, m; for pictures alone.

    Raises:
        ConfigError: the file cannot be read, or holds no table of heights.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy" and span is not None:
        raise _core.ConfigError(f"{path}: a .npy file holds heights in m; leave out --range")
    if suffix == ".png" and span is None:
        raise _core.ConfigError(f"{path}: a picture says no heights; add --range LOW HIGH, m of black and of white")
    if suffix not in (".npy", ".png"):
        raise _core.ConfigError(f"{path}: heights come as .npy or .png")
    try:
        content = read_bytes(path, MOST_BYTES)
    except OSError as error:
        raise _core.ConfigError(f"cannot read {path}: {error.strerror}; name a file of heights") from error
    heights = _of_array(path, content) if span is None else _of_picture(path, content, span)
    if heights.ndim != 2 or min(heights.shape) < 2:
        shape = " x ".join(map(str, heights.shape))
        raise _core.ConfigError(f"{path}: {shape} numbers are no table of heights; write at least 2 x 2")
    if heights.size > MOST_HEIGHTS:
        raise _core.ConfigError(
            f"{path}: {heights.size:,} heights are more than {MOST_HEIGHTS:,}; take every second row and column"
        )
    if not np.isfinite(heights).all():
        row, column = (int(place[0]) for place in np.nonzero(~np.isfinite(heights)))
        raise _core.ConfigError(f"{path}: height [{row}, {column}] is {heights[row, column]}; write finite numbers")
    return heights


def write_task(out: Path, heights: Array, cell: float, task: str) -> None:
    """Writes a task with these heights as the ground around every env's origin.

    Args:
        out: the TOML.
        heights: `[i, j]` in m, see `read`.
        cell: distance of neighbouring heights, m.
        task: name or alias of the task that it extends.

    Raises:
        ConfigError: for a cell that is no length, or a file that cannot be written.
    """
    if not 1e-3 <= cell <= 100.0:
        raise _core.ConfigError(f"--cell {cell} must be from 0.001 to 100 m")
    if out.suffix.lower() != ".toml":
        raise _core.ConfigError(f"--out {out}: heights become a task; use .toml")
    size = [round(cell * (count - 1), 9) for count in heights.shape]
    rows = ",\n".join("    [" + ", ".join(f"{height:.{DIGITS}f}" for height in row) + "]" for row in heights + 0.0)
    words = [word.capitalize() for word in "".join(c if c.isalnum() else " " for c in out.stem).split()]
    # a string of JSON is one of TOML; a path is relative to the file that extends it
    base = json.dumps(str(Path(task).resolve()) if task.endswith(".toml") else task, ensure_ascii=False)
    text = f"""extends = {base}
name = "{"-".join([*words, "v0"])}"

[[scene.obstacles]]
shape = "heightfield"
position = [0.0, 0.0, 0.0]
size = {size}   # m
heights = [   # m, one line along x
{rows},
]
"""
    try:
        write_text(out, text)
    except OSError as error:
        raise _core.ConfigError(f"cannot write {out}: {error.strerror}; choose another --out") from error


def _of_array(path: Path, content: bytes) -> Array:
    try:
        found = np.load(io.BytesIO(content), allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise _core.ConfigError(f"{path} is no array of NumPy's: {str(error).splitlines()[0]}") from error
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiu":
        raise _core.ConfigError(f"{path} holds no numbers; save an array of heights, m")
    return found.astype(np.float64)


def _of_picture(path: Path, content: bytes, span: tuple[float, float]) -> Array:
    images = extras.package("PIL.Image", "a picture", "play")
    low, high = span
    if not (np.isfinite([low, high]).all() and low < high):
        raise _core.ConfigError(f"--range {low:g} {high:g}: black must be lower than white")
    try:
        with images.open(io.BytesIO(content), formats=["PNG"]) as image:
            if image.width * image.height > MOST_HEIGHTS:
                raise _core.ConfigError(
                    f"{path}: {image.width} x {image.height} pixels are more than {MOST_HEIGHTS:,}; make it smaller"
                )
            if image.mode not in ("1", "L", "I;16", "I"):
                raise _core.ConfigError(f"{path}: its colours ({image.mode}) say no heights; save it in grey")
            most = {"1": 1.0, "L": 255.0}.get(image.mode, 65535.0)
            grey = np.asarray(image).astype(np.float64) / most
    except (OSError, SyntaxError, ValueError, images.DecompressionBombError) as error:
        raise _core.ConfigError(f"{path} is no PNG: {error}") from error
    # columns lie along x, and the lowest line is the smallest y
    return np.ascontiguousarray((low + (high - low) * grey)[::-1].T)
