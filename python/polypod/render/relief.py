"""Uneven ground in a picture, and what stands on it: who hides whom is decided pixel by pixel."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod.arrays import Array
from polypod.extras import package
from polypod.render.camera import NEAR, Lens
from polypod.render.ground import LARGEST_FACE, Ground
from polypod.render.mesh import Mesh, lit

RADIUS = 9.0
"""Radius around the middle of the picture within which ground is drawn, m; it fades from two thirds
of it on."""
SHADOW_RADIUS = 1.6
"""Radius around the middle of a robot within which it casts a shadow, m."""
SHADOW_PIXEL = 0.008
"""Size of a pixel of the shadows, m."""
SHADED = 0.68
"""Share of the light that is left in a shadow."""
CHECKED = 0.965
"""Brightness of every other square metre."""
IN_FRONT = 0.012
"""Distance at which a solid may lie behind the ground that touches it and be seen, m."""


class _Layer:
    """Faces of which each pixel knows the nearest."""

    def __init__(self, lens: Lens, corners: Array, colors: Array) -> None:
        """Draws faces with corners [n, 4, 3], m, and colours [n, 3]; all face the camera."""
        pixels, depths = lens.project(corners)
        seen = depths.min(axis=1) > NEAR
        for axis in range(2):
            seen &= (pixels[..., axis].max(axis=1) >= 0.0) & (pixels[..., axis].min(axis=1) <= lens.pixels[axis])
        corners, pixels = corners[seen], pixels[seen]
        self.lens = lens
        self.colors = np.clip(np.concatenate([np.zeros((1, 3)), colors[seen]]), 0.0, 255.0).astype(np.uint8)
        points = (corners - lens.origin) @ lens.view.T
        normals = np.cross(points[:, 2] - points[:, 0], points[:, 3] - points[:, 1])
        middles = points.mean(axis=1)
        self.middles = np.concatenate([np.full((1, 3), 1e9), middles @ lens.view + lens.origin])
        """Middles of the faces in the world, m, [n + 1, 3]."""
        # one over the depth is linear in the pixel
        reach = np.einsum("ij,ij->i", normals, middles)
        self._planes = np.concatenate(
            [np.zeros((1, 3)), normals / np.where(np.abs(reach) > 1e-12, reach, 1e-12)[:, None]]
        )
        self._planes = self._planes.astype(np.float32)
        image, draw = (package(f"PIL.{name}", "drawing pictures", "play") for name in ("Image", "ImageDraw"))
        canvas = image.new("I", lens.pixels, 0)
        pen = draw.Draw(canvas)
        order = np.argsort(-np.einsum("ij,ij->i", middles, middles))
        for number, outline in zip((order + 1).tolist(), pixels[order].reshape(-1, 8).tolist(), strict=True):
            pen.polygon(outline, fill=number)
        self.faces: npt.NDArray[np.int32] = np.asarray(canvas)
        """Number of the face that is seen plus one, [height, width]; zero where there is none."""

    def depths(self, rows: Any, columns: Any, rays: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Depths of pixels along their rays, m, [n]; very far where there is no face."""
        inverse = np.einsum("ij,ij->i", self._planes[self.faces[rows, columns]], rays)
        return np.float32(1.0) / np.maximum(inverse, np.float32(1e-6))


def picture(
    lens: Lens,
    ground: Ground,
    target: Sequence[float],
    solids: Sequence[tuple[Mesh, tuple[int, int, int]]],
    middles: Sequence[Array],
    light: Array,
    sky: tuple[int, int, int],
) -> npt.NDArray[np.uint8]:
    """Picture of the ground and the solids on it, [height, width, 3].

    Args:
        lens: the camera.
        ground: the ground in view.
        target: point in the middle of the picture, m.
        solids: in world axes, each with its colour.
        middles: of the robots, m; shadows are cast around them.
        light: where light comes from, of unit length.
        sky: colour of the sky.
    """
    layer = _ground(lens, ground, np.asarray(target, dtype=np.float64), light, np.array(sky, dtype=np.float64))
    layer.colors[0] = sky
    picture = layer.colors[layer.faces]
    above = _solids(lens, solids, light)
    if above is None:
        return picture
    _cast(picture, layer, [solid for solid, _ in solids], middles, light)
    rows, columns = np.nonzero(above.faces)
    rays = lens.rays(rows, columns)
    visible = above.depths(rows, columns, rays) < layer.depths(rows, columns, rays) + np.float32(IN_FRONT)
    rows, columns = rows[visible], columns[visible]
    picture[rows, columns] = above.colors[above.faces[rows, columns]]
    return picture


def _ground(lens: Lens, ground: Ground, target: Array, light: Array, sky: Array) -> _Layer:
    corners, middles, normals = ground.around(target, RADIUS)
    # walls have two sides
    away = np.einsum("ij,ij->i", normals, lens.origin - middles) < 0.0
    normals[away & (np.abs(normals[:, 2]) < 0.1)] *= -1.0
    facing = np.einsum("ij,ij->i", normals, lens.origin - middles) > 0.0
    corners, middles, normals = corners[facing], middles[facing], normals[facing]
    brightness = 0.55 + 0.45 * np.clip(normals @ light, -0.4, 1.0)
    squares = np.floor(middles[:, :2]).sum(axis=1) % 2.0
    colors = ground.colors(middles[:, 2]) * (brightness * np.where(squares > 0.5, 1.0, CHECKED))[:, None]
    distance = np.linalg.norm(middles[:, :2] - target[:2], axis=1) / RADIUS
    fade = np.clip(3.0 * distance - 2.0, 0.0, 1.0)[:, None]
    return _Layer(lens, corners, colors * (1.0 - fade) + sky * fade)


def _solids(lens: Lens, solids: Sequence[tuple[Mesh, tuple[int, int, int]]], light: Array) -> _Layer | None:
    if not solids:
        return None
    corners = np.concatenate([solid.vertices[solid.faces] for solid, _ in solids])
    colors = np.concatenate([np.tile(color, (len(solid.faces), 1)) for solid, color in solids]).astype(np.float64)
    facing, brightness = lit(corners, lens.origin, light)
    return _Layer(lens, corners[facing], colors[facing] * brightness[:, None])


def _cast(
    picture: npt.NDArray[np.uint8], layer: _Layer, solids: Sequence[Mesh], middles: Sequence[Array], light: Array
) -> None:
    """Darkens the ground where a solid stands between it and the light."""
    image, draw = (package(f"PIL.{name}", "drawing pictures", "play") for name in ("Image", "ImageDraw"))
    across = np.cross(light, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(light, across), light])
    corners = np.concatenate([solid.vertices[solid.faces] for solid in solids]) @ axes.T
    size = round(2.0 * SHADOW_RADIUS / SHADOW_PIXEL)
    for middle in middles:
        corner = axes @ middle - SHADOW_RADIUS
        seen = (corners[..., :2] - corner[:2]) / SHADOW_PIXEL
        near = ((seen > 0.0) & (seen < size)).all(axis=(1, 2))
        if not near.any():
            continue
        height = image.new("F", (size, size), -1e9)
        pen = draw.Draw(height)
        for outline, level in zip(seen[near].reshape(-1, 8).tolist(), corners[near][..., 2].mean(axis=1), strict=True):
            pen.polygon(outline, fill=float(level))
        low, high = seen[near].min(axis=(0, 1)), seen[near].max(axis=(0, 1))
        # only faces of the ground that may lie in the shadow's bounds are looked at pixel by pixel
        margin = LARGEST_FACE / SHADOW_PIXEL
        ground = (layer.middles @ axes.T[:, :2] - corner[:2]) / SHADOW_PIXEL
        under = ((ground > low - margin) & (ground < high + margin)).all(axis=1)
        rows, columns = np.nonzero(under[layer.faces])
        rays = layer.lens.rays(rows, columns)
        points = rays @ (axes @ layer.lens.view.T).T.astype(np.float32)
        points *= layer.depths(rows, columns, rays)[:, None]
        points += (axes @ layer.lens.origin - [*corner[:2], 0.0]).astype(np.float32)
        at = (points[:, :2] * np.float32(1.0 / SHADOW_PIXEL)).astype(np.int32)
        at = np.clip(at, 0, size - 1)  # nothing casts a shadow on the edge
        shaded = np.asarray(height)[at[:, 1], at[:, 0]] > points[:, 2]
        dark = (rows[shaded], columns[shaded])
        picture[dark] = (SHADED * picture[dark]).astype(np.uint8)
