"""Collision shapes and obstacles as polygons."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import rotations
from polypod.arrays import Array

ROUND = 12
"""Corners of a circle."""
LARGEST_FACE = 0.15
"""Edges of flat faces are cut into pieces no longer than this, m, so that faces sort by their
distance."""
MOST_CUTS = 16
"""Pieces along an edge of a mesh's triangle, at most."""


@dataclasses.dataclass(frozen=True)
class Mesh:
    """Convex outward polygons of three or four corners."""

    vertices: Array
    """Corners of the faces, m, [n, 3]."""
    faces: npt.NDArray[np.intp]
    """Faces as indices counter-clockwise from outside, [m, 4]; a triangle repeats its last
    corner."""

    def moved(self, position: npt.ArrayLike, quaternion: npt.ArrayLike) -> "Mesh":
        """Returns the mesh in the parent frame of a pose: m, and (w, x, y, z)."""
        return Mesh(self.vertices @ rotations.matrix(quaternion).T + np.asarray(position, dtype=np.float64), self.faces)

    def triangles(self) -> npt.NDArray[np.uint32]:
        """The same faces as triangles, [k, 3]."""
        a, b, c, d = self.faces.T
        both = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)[c != d]])
        return both.astype(np.uint32)

    def split(self) -> tuple["Mesh", "Mesh"]:
        """Returns the faces that reach above the ground, and the faces that reach below."""
        heights = self.vertices[self.faces][..., 2]
        above, below = heights.max(axis=1) > 0.0, heights.min(axis=1) < 0.0
        return Mesh(self.vertices, self.faces[above]), Mesh(self.vertices, self.faces[below])


def lit(corners: Array, camera: Array, light: Array) -> tuple[npt.NDArray[np.bool_], Array]:
    """Finds the faces with corners [n, 4, 3] that look at the camera, [n], and their brightness.

    Args:
        corners: m; a triangle repeats its last corner.
        camera: where it is, m.
        light: where light comes from, of unit length.
    """
    # product of the diagonals; a triangle keeps its sense
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    lengths = np.linalg.norm(normals, axis=1)
    facing = (lengths > 1e-12) & (np.einsum("ij,ij->i", normals, camera - corners.mean(axis=1)) > 0.0)
    return facing, 0.62 + 0.38 * np.clip(normals[facing] @ light / lengths[facing], -0.6, 1.0)


def shape(description: Mapping[str, Any]) -> Mesh:
    """The mesh of a shape in its own frame.

    `description` as in `VecSim.robot_shapes` or a task's obstacles.
    """
    match description["shape"]:
        case "sphere":
            return revolved(arc(description["radius"], 0.0, -90.0, 90.0))
        case "box":
            return box(description["size"])
        case "cylinder":
            half, radius = 0.5 * description["length"], description["radius"]
            return revolved([(-half, 0.0), (-half, radius), (half, radius), (half, 0.0)])
        case "capsule":
            half, radius = 0.5 * description["length"], description["radius"]
            return revolved([*arc(radius, -half, -90.0, 0.0), *arc(radius, half, 0.0, 90.0)])
        case "hull":
            faces = np.array(description["triangles"], dtype=np.intp).reshape(-1, 3)
            return Mesh(np.array(description["points"], dtype=np.float64), faces[:, [0, 1, 2, 2]])
    raise ValueError(f"no shape {description['shape']!r}")


def obstacle(description: Mapping[str, Any]) -> list[Mesh]:
    """The meshes of an obstacle of a resolved task's scene, in the env's frame."""
    roll, pitch, yaw = description.get("rpy", (0.0, 0.0, 0.0))
    turn = rotations.of_angles(roll, pitch, yaw)
    match description["shape"]:
        case "ramp":
            parts = [_ramp(description["size"])]
        case "stairs":
            depth, width, height = description["size"]
            count = description["steps"]
            parts = []
            for step in range(count):
                top = height * (step + 1)
                middle = ((step + 0.5 - 0.5 * count) * depth, 0.0, 0.5 * top)
                parts.append(box((depth, width, top)).moved(middle, (1.0, 0.0, 0.0, 0.0)))
        case "heightfield":
            parts = [_surface(description["size"], description["heights"])]
        case "mesh":
            vertices = np.array(description["vertices"], dtype=np.float64) * description["scale"]
            parts = [_cut_up(vertices, np.array(description["triangles"], dtype=np.intp))]
        case _:
            parts = [shape(description)]
    return [part.moved(description["position"], turn) for part in parts]


def floor(openings: Sequence[Array], half: float) -> Mesh:
    """The plane at height zero up to `half` from the origin, m, without some rectangles.

    Their outlines are given.
    """
    cuts = []
    for axis in (0, 1):
        edges = [corner[axis] for outline in openings for corner in outline]
        cuts.append(np.unique(np.clip([-half, half, *edges], -half, half)))
    grid = np.zeros((len(cuts[0]), len(cuts[1]), 3))
    grid[..., 0], grid[..., 1] = cuts[0][:, None], cuts[1][None, :]
    plane = grid_of(grid)
    middles = plane.vertices[plane.faces][..., :2].mean(axis=1)
    is_open = np.zeros(len(middles), dtype=np.bool_)
    for outline in openings:
        low, high = outline[:, :2].min(axis=0), outline[:, :2].max(axis=0)
        is_open |= ((low < middles) & (middles < high)).all(axis=1)
    return Mesh(plane.vertices, plane.faces[~is_open])


def box(size: Sequence[float]) -> Mesh:
    """A box about the origin with these edge lengths, m; large faces are cut up."""
    half = 0.5 * np.asarray(size, dtype=np.float64)
    meshes = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        pieces = [max(1, math.ceil(2.0 * half[i] / LARGEST_FACE)) for i in (u, v)]
        for sign in (-1.0, 1.0):
            # counter-clockwise from outside on either side
            along, across = (u, v) if sign > 0.0 else (v, u)
            counts = pieces if sign > 0.0 else pieces[::-1]
            a = np.linspace(-half[along], half[along], counts[0] + 1)
            b = np.linspace(-half[across], half[across], counts[1] + 1)
            grid = np.zeros((len(a), len(b), 3))
            grid[..., axis], grid[..., along], grid[..., across] = sign * half[axis], a[:, None], b[None, :]
            meshes.append(grid_of(grid))
    return joined(meshes)


def _ramp(size: Sequence[float]) -> Mesh:
    x, y, z = 0.5 * size[0], 0.5 * size[1], size[2]
    corners = [[-x, -y, 0], [-x, y, 0], [x, -y, 0], [x, y, 0], [x, -y, z], [x, y, z]]
    faces = [[0, 4, 5, 1], [2, 3, 5, 4], [0, 1, 3, 2], [0, 2, 4, 4], [1, 5, 3, 3]]
    return Mesh(np.array(corners, dtype=np.float64), np.array(faces, dtype=np.intp))


def _surface(size: Sequence[float], heights: Sequence[Sequence[float]]) -> Mesh:
    table = np.array(heights, dtype=np.float64)
    grid = np.zeros((*table.shape, 3))
    grid[..., 0] = np.linspace(-0.5 * size[0], 0.5 * size[0], table.shape[0])[:, None]
    grid[..., 1] = np.linspace(-0.5 * size[1], 0.5 * size[1], table.shape[1])[None, :]
    grid[..., 2] = table
    return grid_of(grid)


def arc(radius: float, height: float, start: float, stop: float, sides: int = ROUND) -> list[tuple[float, float]]:
    """Points (height, distance from the axis) of a meridian between two latitudes, degrees.

    Args:
        radius: of the ball, m.
        height: of its middle, m.
        start: latitude of the first point.
        stop: latitude of the last one.
        sides: corners of a whole circle.
    """
    count = max(2, round(sides * (stop - start) / 360.0)) + 1
    angles = np.radians(np.linspace(start, stop, count))
    return [(height + radius * float(np.sin(a)), radius * max(0.0, float(np.cos(a)))) for a in angles]


def revolved(profile: Sequence[tuple[float, float]], sides: int = ROUND) -> Mesh:
    """The solid of revolution of a profile (height, distance), from bottom to top, about z."""
    angles = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    heights, radii = np.array(profile).T
    grid = np.zeros((sides + 1, len(profile), 3))
    grid[..., 0] = np.cos(angles)[:, None] * radii
    grid[..., 1] = np.sin(angles)[:, None] * radii
    grid[..., 2] = heights
    return grid_of(grid)


def _cut_up(vertices: Array, triangles: npt.NDArray[np.intp]) -> Mesh:
    """Triangles with edges of at most `LARGEST_FACE` or a `MOST_CUTS`th of their length."""
    corners = vertices[triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    pieces = np.clip(np.ceil(longest / LARGEST_FACE), 1, MOST_CUTS).astype(np.intp)
    parts = []
    for count in np.unique(pieces):
        # places (i, j) of a triangular grid with `count` pieces along each edge, and the faces
        # between them
        places = [(i, j) for i in range(count + 1) for j in range(count + 1 - i)]
        number = {place: index for index, place in enumerate(places)}
        upright = [(number[i, j], number[i + 1, j], number[i, j + 1]) for i, j in places if i + j < count]
        inverted = [(number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]) for i, j in places if i + j < count - 1]
        faces = np.array(upright + inverted, dtype=np.intp)[:, [0, 1, 2, 2]]
        weights = np.array([(count - i - j, i, j) for i, j in places]) / count
        points = np.einsum("pk,tkd->tpd", weights, corners[pieces == count])
        starts = len(places) * np.arange(len(points))
        parts.append(Mesh(points.reshape(-1, 3), (faces + starts[:, None, None]).reshape(-1, 4)))
    return joined(parts)


def grid_of(points: Array) -> Mesh:
    """Quadrilaterals between points [n, m, 3]."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    corners = (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    return Mesh(points.reshape(-1, 3), np.stack([corner.ravel() for corner in corners], axis=1))


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes of one frame as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))
