"""Pictures and meshes of a task's ground: `polypod terrain`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from polypod import _core, extras
from polypod.files import write_bytes, write_filled

if TYPE_CHECKING:
    from PIL import Image

_MOST_PIXELS = 2400
_SUN = np.array([-0.5, 0.4, 0.77])
_LOW, _HIGH = np.array([46.0, 78.0, 108.0]), np.array([232.0, 220.0, 196.0])


def save(task: str, out: Path, overrides: Sequence[str] = ()) -> str:
    """Writes a task's ground to a file.

    Args:
        task: name, alias or path.
        out: `.png` gives a shaded map (x to the right, y upwards), `.stl` the triangles, `.npz` the
            heights.
        overrides: `key=value` changes to the task.

    Returns:
        Summary of the written file, in words.

    Raises:
        ConfigError: the ground is a plane or has no triangles; `out` cannot be written or has
            another suffix.
    """
    suffix = out.suffix.lower()
    if suffix not in (".png", ".stl", ".npz"):
        raise _core.ConfigError(f"--out {out}: the suffix decides what is written; use .png, .stl or .npz")
    ground = _core.terrain(task, list(overrides))
    try:
        if suffix == ".png":
            image = picture(ground)
            write_filled(out, lambda file: image.save(file, format="PNG"))
        elif suffix == ".npz":
            origin, cell = ground["origin"], ground["cell"]
            write_filled(
                out, lambda file: np.savez_compressed(file, heights=ground["heights"], origin=origin, cell=cell)
            )
        else:
            write_bytes(out, _stl(ground, out))
    except OSError as error:
        raise _core.ConfigError(f"cannot write {out}: {error.strerror}; choose another --out") from error
    heights = ground["heights"]
    (rows, columns), cell = heights.shape, ground["cell"]
    return (
        f"{out}: {ground['task']}, {(rows - 1) * cell:.1f} x {(columns - 1) * cell:.1f} m, "
        f"{len(ground['tiles'])} tiles, heights from {heights.min():.3f} to {heights.max():.3f} m"
    )


def picture(ground: "_core.TerrainEntry") -> "Image.Image":
    """A map of the heights, lit from the upper left, with the types of tiles next to it.

    The types of tiles are written next to their columns.
    """
    images, drawing = (extras.package(f"PIL.{name}", "a picture", "play") for name in ("Image", "ImageDraw"))
    heights = ground["heights"]
    step = max(1, -(-max(heights.shape) // _MOST_PIXELS))
    coarse = heights[::step, ::step]
    slope_x, slope_y = np.gradient(coarse, step * ground["cell"])
    normal = np.stack([-slope_x, -slope_y, np.ones_like(coarse)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    light = np.clip(normal @ (_SUN / np.linalg.norm(_SUN)), 0.0, 1.0)[..., None]
    low, high = float(coarse.min()), float(coarse.max())
    share = ((coarse - low) / max(high - low, 1e-6))[..., None]
    shaded = (_LOW + (_HIGH - _LOW) * share) * (0.35 + 0.65 * light)
    # x to the right, y upwards
    image: Image.Image = images.fromarray(np.ascontiguousarray(shaded.transpose(1, 0, 2)[::-1]).astype(np.uint8))
    draw = drawing.Draw(image)
    for _, column, name, (x, y) in ground["tiles"]:
        first = min(x for _, other, _, (x, _) in ground["tiles"] if other == column)
        if x == first:
            across = (x - ground["origin"][0]) / (step * ground["cell"])
            up = image.height - (y - ground["origin"][1]) / (step * ground["cell"])
            draw.text((across, up), name, fill=(255, 255, 255), stroke_width=2, stroke_fill=(0, 0, 0), anchor="lm")
    return image


def _stl(ground: "_core.TerrainEntry", out: Path) -> bytes:
    """The ground's triangles as binary STL."""
    if not len(ground["triangles"]):
        raise _core.ConfigError(f"--out {out}: {ground['task']} has no generated terrain to make a mesh of; use .npz")
    corners: npt.NDArray[np.float32] = ground["vertices"][ground["triangles"]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets = np.zeros(len(corners), facet)
    facets["normal"], facets["corners"] = normals / np.maximum(lengths, 1e-12), corners
    return b"polypod terrain".ljust(80) + np.uint32(len(facets)).tobytes() + facets.tobytes()
