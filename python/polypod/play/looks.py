"""Appearance of robots in the browser: smooth bodies made of their collision shapes."""

import colorsys
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from polypod.render import mesh
from polypod.render.mesh import Mesh
from polypod.render.raster import Color

BODY: dict[str, Color] = {
    "base": (206, 210, 216),
    "torso": (206, 210, 216),
    "arm": (96, 102, 114),
    "head": (150, 156, 166),
    "hip": (70, 76, 86),
    "shank": (70, 76, 86),
    "foot": (34, 37, 42),
    "other": (150, 156, 166),
}
"""Colours of a robot's bodies, by group; thighs have the robot's own colour."""
EDGE = 0.2
"""Radius of a rounded edge, in shortest edges of the box or in radii of the cylinder."""
MOST_EDGE = 0.03
"""Largest radius of a rounded edge, m."""
STEPS = 4
"""Faces across a rounded edge."""
SIDES = 24
"""Corners of a circle."""


@dataclasses.dataclass(frozen=True)
class Look:
    """A piece of a robot's link, in the link's frame."""

    link: int
    mesh: Mesh
    color: Color
    smooth: bool = True


@dataclasses.dataclass(frozen=True)
class Model:
    """All pieces of a robot's link as one file."""

    link: int
    glb: bytes
    """Binary glTF, in the link's frame."""
    top: float
    """Largest z of the mesh, m."""


def accent(index: int) -> Color:
    """The colour of the robot at a place among others.

    Orange, then as far from the last ones as there are.
    """
    hue = (0.08 + 0.375 * index) % 1.0
    red, green, blue = colorsys.hls_to_rgb(hue, 0.52, 0.68)
    return round(255 * red), round(255 * green), round(255 * blue)


def of_shapes(outline: dict[str, Any], color: Color) -> list[Look]:
    """Looks of the collision shapes of a robot.

    Args:
        outline: the robot's entry of `VecSim.robot_shapes`.
        color: of its thighs.
    """
    looks = []
    for body in outline["bodies"]:
        shade = color if body["group"] == "thigh" else BODY.get(body["group"], BODY["other"])
        for shape in body["shapes"]:
            solid = smooth(shape).moved(shape["position"], shape["quaternion"])
            looks.append(Look(body["link"], solid, shade, smooth=shape["shape"] != "hull"))
    return looks


def smooth(description: dict[str, Any]) -> Mesh:
    """The mesh of a shape in its own frame, edges rounded.

    `description` as in `VecSim.robot_shapes`.
    """
    match description["shape"]:
        case "box":
            return rounded_box(description["size"])
        case "sphere":
            return _turned(_arc(description["radius"], 0.0, -90.0, 90.0))
        case "capsule":
            half, radius = 0.5 * description["length"], description["radius"]
            return _turned([*_arc(radius, -half, -90.0, 0.0), *_arc(radius, half, 0.0, 90.0)])
        case "cylinder":
            half, radius = 0.5 * description["length"], description["radius"]
            edge = min(EDGE * radius, 0.5 * half, MOST_EDGE)
            lower = [(z, radius - edge + r) for z, r in _arc(edge, edge - half, -90.0, 0.0)]
            upper = [(z, radius - edge + r) for z, r in _arc(edge, half - edge, 0.0, 90.0)]
            return _turned([(-half, 0.0), *lower, *upper, (half, 0.0)])
    return mesh.shape(description)


def rounded_box(size: Sequence[float]) -> Mesh:
    """A box about the origin with these edge lengths, m, whose edges and corners are round."""
    half = 0.5 * np.asarray(size, dtype=np.float64)
    radius = min(EDGE * 2.0 * float(half.min()), MOST_EDGE)
    inner = half - radius
    # a grid on each side, dense where it bends, is drawn to the round surface
    bend = radius * np.tan(np.linspace(0.0, 0.25 * np.pi, STEPS + 1))
    lines = [np.concatenate([-(reach + bend[::-1]), reach + bend]) for reach in inner]
    sides = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            grid = np.zeros((len(lines[u]), len(lines[v]), 3))
            grid[..., axis] = sign * half[axis]
            grid[..., u], grid[..., v] = lines[u][:, None], lines[v][None, :]
            core = np.clip(grid, -inner, inner)
            outward = grid - core
            points = core + radius * outward / np.linalg.norm(outward, axis=2, keepdims=True)
            side = mesh.grid_of(points)
            # counter-clockwise from outside on either side
            sides.append(side if sign > 0.0 else Mesh(side.vertices, side.faces[:, ::-1]))
    return _welded(mesh.joined(sides))


def _arc(radius: float, height: float, start: float, stop: float) -> list[tuple[float, float]]:
    return mesh.arc(radius, height, start, stop, SIDES)


def _turned(profile: Sequence[tuple[float, float]]) -> Mesh:
    return _welded(mesh.revolved(profile, SIDES))


def _welded(solid: Mesh) -> Mesh:
    """The mesh with each corner once, so that light varies smoothly.

    A face without area is left out.
    """
    points = solid.vertices
    _, first, place = np.unique(np.round(points, 7), axis=0, return_index=True, return_inverse=True)
    faces = place.reshape(-1)[solid.faces]
    triangles = np.concatenate([faces[:, [0, 1, 2, 2]], faces[:, [0, 2, 3, 3]]])
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    return Mesh(points[first], triangles[(a != b) & (b != c) & (c != a)])
