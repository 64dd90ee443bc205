"""Generated terrain for pictures: its heights, its faces and its colours."""

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from polypod.arrays import Array

if TYPE_CHECKING:
    from polypod import _core

LARGEST_FACE = 0.25
"""Edges are cut into pieces no longer than this, m, so that faces sort by their distance."""
COLORS = np.array([[104.0, 132.0, 150.0], [188.0, 194.0, 188.0], [226.0, 204.0, 160.0]])
"""Colours of the lowest, the middle and the highest ground."""


class Ground:
    """The simulator's ground, which all envs of a task share."""

    def __init__(self, entry: "_core.TerrainEntry") -> None:
        """Reads an entry of `VecSim.terrain`."""
        self.vertices: npt.NDArray[np.float32] = entry["vertices"]
        """Corners of the triangles, m, [n, 3]."""
        self.triangles: npt.NDArray[np.uint32] = entry["triangles"]
        """Triangles as indices into the vertices, [m, 3]."""
        self._heights = entry["heights"]
        self._origin, self._cell = np.array(entry["origin"], dtype=np.float64), float(entry["cell"])
        low, high = float(self.vertices[:, 2].min()), float(self.vertices[:, 2].max())
        # level ground has the middle colour; hills and pits of one size differ from it by the same
        # amount
        self._range = max(abs(low), abs(high), 0.05)
        self._faces: tuple[npt.NDArray[np.float32], ...] | None = None

    def heights(self, places: Array) -> Array:
        """Heights of the articulated engine's ground below places [..., 2], m, [...]."""
        cells = (np.asarray(places, dtype=np.float64) - self._origin) / self._cell
        size = np.array(self._heights.shape)
        cells = np.clip(cells, 0.0, size - 1.000001)
        first = cells.astype(np.intp)
        i, j = first[..., 0], first[..., 1]
        u, v = cells[..., 0] - i, cells[..., 1] - j
        # cells are cut from the first to the last corner
        table = self._heights
        a, c = table[i, j].astype(np.float64), table[i + 1, j + 1].astype(np.float64)
        b, d = table[i + 1, j].astype(np.float64), table[i, j + 1].astype(np.float64)
        return np.where(u >= v, a + u * (b - a) + v * (c - b), a + v * (d - a) + u * (c - d))

    def colors(self, heights: npt.ArrayLike) -> Array:
        """Colours of heights [...], m, from 0 to 255, [..., 3]."""
        share = 0.5 + 0.5 * np.asarray(heights, dtype=np.float64) / self._range
        channels = [np.interp(share, [0.0, 0.5, 1.0], COLORS[:, channel]) for channel in range(3)]
        return np.stack(channels, axis=-1)

    def around(self, place: Array, radius: float) -> tuple[Array, Array, Array]:
        """Corners [n, 4, 3], middles and unit normals [n, 3] of the small faces about a place, m.

        A triangle repeats its last corner.
        """
        if self._faces is None:
            corners = _cut(_faces(self.vertices, self.triangles))
            normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
            whole = lengths[:, 0] > 1e-9
            corners = corners[whole]
            self._faces = (corners, corners.mean(axis=1), normals[whole] / lengths[whole])
        corners, middles, normals = self._faces
        near = np.flatnonzero(
            (np.abs(middles[:, 0] - np.float32(place[0])) < radius)
            & (np.abs(middles[:, 1] - np.float32(place[1])) < radius)
        )
        near = near[np.linalg.norm(middles[near, :2] - place[:2], axis=1) < radius]
        return (corners[near].astype(np.float64), middles[near].astype(np.float64), normals[near].astype(np.float64))


def _faces(vertices: npt.NDArray[np.float32], triangles: npt.NDArray[np.uint32]) -> npt.NDArray[np.float32]:
    """Two triangles a, b, c and a, c, d make one face."""
    pairs = triangles[: len(triangles) // 2 * 2].reshape(-1, 6)
    whole = (pairs[:, 0] == pairs[:, 3]) & (pairs[:, 2] == pairs[:, 4])
    if len(triangles) % 2 == 0 and whole.all():
        return vertices[pairs[:, [0, 1, 2, 5]]]
    return vertices[triangles[:, [0, 1, 2, 2]]]


def _cut(faces: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """The same surface in pieces of at most `LARGEST_FACE`."""
    edges = np.linalg.norm(np.roll(faces, -1, axis=1) - faces, axis=2)
    lengths = np.stack([np.maximum(edges[:, 0], edges[:, 2]), np.maximum(edges[:, 1], edges[:, 3])], axis=1)
    counts = np.maximum(np.ceil(lengths / LARGEST_FACE - 1e-3).astype(int), 1)
    pieces = []
    for along, across in np.unique(counts, axis=0):
        a, b, c, d = np.moveaxis(faces[(counts == (along, across)).all(axis=1)], 1, 0)
        u = np.linspace(0.0, 1.0, along + 1, dtype=np.float32)[None, :, None, None]
        v = np.linspace(0.0, 1.0, across + 1, dtype=np.float32)[None, None, :, None]
        a, b, c, d = (corner[:, None, None, :] for corner in (a, b, c, d))
        grid = (1.0 - u) * (1.0 - v) * a + u * (1.0 - v) * b + u * v * c + (1.0 - u) * v * d
        corners = (grid[:, :-1, :-1], grid[:, 1:, :-1], grid[:, 1:, 1:], grid[:, :-1, 1:])
        pieces.append(np.stack(corners, axis=3).reshape(-1, 4, 3))
    return np.concatenate(pieces)
