"""Height fields of files as the ground of a task: pictures and NumPy arrays.

A field becomes an obstacle of a task's TOML, or several become the levels of its tiles; heights
below zero are holes in the ground.
"""

import io
import json
from collections.abc import Sequence
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


LEVELS = 10
"""Levels of tiles of one file, whose heights are scaled."""
COLUMNS = 4
"""Tiles of a level: as many envs as one likes share them."""


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
    _write(
        out,
        cell,
        task,
        f"""[[scene.obstacles]]
shape = "heightfield"
position = [0.0, 0.0, 0.0]
size = {_size(heights, cell)}   # m
heights = [   # m, one line along x
{_table(heights)},
]
""",
    )


def write_tiles(
    out: Path, fields: Sequence[Array], cell: float, task: str, scale: tuple[float, float] | None, platform: float
) -> None:
    """Writes a task whose terrain is tiles of these heights, a level of difficulty each.

    Args:
        out: the TOML.
        fields: `[i, j]` in m, see `read`: the easiest first, all of one size.
        cell: distance of neighbouring heights, m.
        task: name or alias of the task that it extends.
        scale: factors of the heights at the easiest and the hardest level. None: 1.
        platform: edge length of the level square in the middle, m.

    Raises:
        ConfigError: for fields of different sizes, for numbers that are no lengths, or a file that
            cannot be written.
    """
    sizes = sorted({field.shape for field in fields})
    if len(sizes) > 1:
        (a, b), (c, d) = sizes[:2]
        raise _core.ConfigError(f"--heights: levels of {a} x {b} and of {c} x {d} heights; make all of one size")
    extent = _size(fields[0], cell)
    if not 0.0 <= platform < min(extent):
        raise _core.ConfigError(f"--platform {platform} must be from 0 to less than the tile's {min(extent)} m")
    low, high = (1.0, 1.0) if scale is None else scale
    if not (np.isfinite([low, high]).all() and low <= high):
        raise _core.ConfigError(f"--scale {low:g} {high:g}: the easiest level's factor comes first")
    levels = ",\n".join(f"  [\n{_table(field)},\n  ]" for field in fields)
    _write(
        out,
        cell,
        task,
        f"""[scene.terrain]
size = {extent}   # m
num_rows = {len(fields) if scale is None else max(LEVELS, len(fields))}   # levels
num_cols = {COLUMNS}
border_width = 10.0

[[scene.terrain.sub_terrains]]
name = "heightfield"
type = "heightfield"
proportion = 1.0
height_scale_range = [{float(low)}, {float(high)}]
platform_width = {float(platform)}
levels = [   # m, one line along x
{levels},
]
""",
    )


def _size(heights: Array, cell: float) -> list[float]:
    """Edge lengths of a field, m."""
    return [round(cell * (count - 1), 9) for count in heights.shape]


def _table(heights: Array) -> str:
    """Rows of a TOML array."""
    return ",\n".join("    [" + ", ".join(f"{height:.{DIGITS}f}" for height in row) + "]" for row in heights + 0.0)


def _write(out: Path, cell: float, task: str, scene: str) -> None:
    """Writes a task that extends another."""
    if not 1e-3 <= cell <= 100.0:
        raise _core.ConfigError(f"--cell {cell} must be from 0.001 to 100 m")
    if out.suffix.lower() != ".toml":
        raise _core.ConfigError(f"--out {out}: heights become a task; use .toml")
    words = [word.capitalize() for word in "".join(c if c.isalnum() else " " for c in out.stem).split()]
    # a string of JSON is one of TOML; a path is relative to the file that extends it
    base = json.dumps(str(Path(task).resolve()) if task.endswith(".toml") else task, ensure_ascii=False)
    text = f"""extends = {base}
name = "{"-".join([*words, "v0"])}"

{scene}"""
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
