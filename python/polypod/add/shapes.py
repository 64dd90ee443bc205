"""Shapes of a compiled MJCF file that touch the ground."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from polypod.add.compiling import Compiled, matrix, mujoco
from polypod.add.description import Shape
from polypod.add.ellipsoid import BALL_ERROR, ball
from polypod.add.surfaces import surface_of
from polypod.arrays import Array

FOOT_NAMES = re.compile(r"foot|feet|toe|sole|ankle_?roll|^(fl|fr|rl|rr|hl|hr|lf|rf|lh|rh)\d*$", re.IGNORECASE)
"""Names of geoms that stand on the ground."""
SOLE = 0.01
"""Shapes of a limb's end whose lowest points are this close to the lowest one stand on the ground,
m."""
ROUND = 1e-3
"""Relative difference up to which an ellipsoid is a sphere."""


def standing(made: Compiled, data: Any, geoms: Sequence[int], body: int) -> set[int]:
    """Shapes of a limb's end that stand on the ground; empty where all of them do.

    Args:
        made: the compiled file.
        data: `mujoco.MjData` in the pose that the file states.
        geoms: shapes of the body.
        body: the limb's end.
    """
    model = made.model
    if len(geoms) < 2 or any(_moving_below(made, child) for child in _children(made, body)):
        return set()
    named = {geom for geom in geoms if FOOT_NAMES.search(made.named("GEOM", geom))}
    first = {geom for geom in geoms if int(model.geom_priority[geom]) > 0}
    depth = {geom: _lowest(made, data, geom) for geom in geoms}
    low = {geom for geom in geoms if depth[geom] <= min(depth.values()) + SOLE}
    chosen: set[int] = next((some for some in (named, first, low) if 0 < len(some) < len(geoms)), set())
    return chosen


def _children(made: Compiled, body: int) -> list[int]:
    return [child for child in made.inside if int(made.model.body_parentid[child]) == body and child != body]


def _moving_below(made: Compiled, body: int) -> bool:
    is_moved = any(made.moves(joint) for joint in made.joints_of(body))
    return is_moved or any(_moving_below(made, child) for child in _children(made, body))


def _lowest(made: Compiled, data: Any, geom: int) -> float:
    """Lowest point of a geom in the home pose, m."""
    model = made.model
    body = int(model.geom_bodyid[geom])
    turn = matrix(data.xquat[body]) @ matrix(model.geom_quat[geom])
    middle = data.xpos[body] + matrix(data.xquat[body]) @ model.geom_pos[geom]
    down = turn.T @ np.array([0.0, 0.0, -1.0])
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    types = mujoco().mjtGeom
    if kind == int(types.mjGEOM_MESH):
        return float(middle[2] - (hull_of(made, geom)[0] @ down).max())
    reach = {
        int(types.mjGEOM_SPHERE): size[0],
        int(types.mjGEOM_CAPSULE): size[0] + size[1] * abs(down[2]),
        int(types.mjGEOM_CYLINDER): size[0] * np.hypot(down[0], down[1]) + size[1] * abs(down[2]),
        int(types.mjGEOM_ELLIPSOID): np.linalg.norm(size * down),
    }.get(kind, float(np.abs(size * down).sum()))
    return float(middle[2] - reach)


def shape_of(made: Compiled, geom: int, anchor: Array, ellipsoids: dict[str, float], notes: list[str]) -> Shape | None:
    """Collision shape for a geom; None for a kind that no robot of polypod's has.

    Args:
        made: the compiled file.
        geom: number of the geom.
        anchor: origin of the link in the frame of the geom's body, m.
        ellipsoids: gets the error of the polyhedron that stands for an ellipsoid, m, by its name.
        notes: gets a line for a geom that is left out.
    """
    model, types = made.model, mujoco().mjtGeom
    at, turn = np.array(model.geom_pos[geom]) - anchor, matrix(model.geom_quat[geom])
    kind, size = int(model.geom_type[geom]), [float(edge) for edge in model.geom_size[geom]]
    name = made.named("GEOM", geom) or f"geom_{geom}"
    surface = surface_of(made, geom)
    if kind == int(types.mjGEOM_SPHERE):
        return Shape("sphere", (size[0],), at, turn, surface=surface)
    if kind == int(types.mjGEOM_CAPSULE):
        return Shape("capsule", (size[0], 2.0 * size[1]), at, turn, surface=surface)
    if kind == int(types.mjGEOM_CYLINDER):
        return Shape("cylinder", (size[0], 2.0 * size[1]), at, turn, surface=surface)
    if kind == int(types.mjGEOM_BOX):
        return Shape("box", tuple(2.0 * edge for edge in size), at, turn, surface=surface)
    if kind == int(types.mjGEOM_ELLIPSOID):
        if max(size) - min(size) <= ROUND * max(size):
            return Shape("sphere", (max(size),), at, turn, surface=surface)
        ellipsoids[name] = BALL_ERROR * max(size)
        vertices, faces = ball(np.array(size))
        return Shape("mesh", (), at, turn, _file_name(name), vertices, faces, surface)
    if kind == int(types.mjGEOM_MESH):
        vertices, faces = hull_of(made, geom)
        return Shape("mesh", (), at, turn, _file_name(f"{name}_{geom}"), vertices, faces, surface)
    notes.append(f"geom {name}: a plane, height field or distance field on the robot: left out")
    return None


def hull_of(made: Compiled, geom: int) -> tuple[Array, Any]:
    """Corners and faces of the convex hull of a geom's mesh.

    All corners where MuJoCo has made no hull.
    """
    model = made.model
    mesh = int(model.geom_dataid[geom])
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    vertices = np.array(model.mesh_vert[first : first + count], dtype=np.float64)
    graph = int(model.mesh_graphadr[mesh])
    if graph < 0:
        every = np.arange(len(vertices))
        return vertices, np.stack([every] * 3, axis=1)
    points, sides = int(model.mesh_graph[graph]), int(model.mesh_graph[graph + 1])
    ids = np.array(model.mesh_graph[graph + 2 + points : graph + 2 + 2 * points])
    end = graph + 2 + 3 * points + 3 * sides
    corners = np.array(model.mesh_graph[end : end + 3 * sides]).reshape(-1, 3)
    places = np.full(len(vertices), -1)
    places[ids] = np.arange(points)
    return vertices[ids], places[corners]


def _file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:80]
