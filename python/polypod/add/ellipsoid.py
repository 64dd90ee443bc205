"""A polyhedron that stands for an ellipsoid."""

from typing import Any

import numpy as np

from polypod.arrays import Array

BALL_POINTS = 32
"""Points that stand for an ellipsoid: the most that the loader keeps of a mesh."""
_COSINE = 0.922602
"""Cosine of the largest angle between a direction and the nearest of the points on a sphere."""
BALL_ERROR = (1.0 - _COSINE) / (1.0 + _COSINE)
"""Largest error of the height over the ground at which an ellipsoid touches it, as a share of the
longest half axis."""


def ball(size: Array) -> tuple[Array, Any]:
    """Corners and faces of a polyhedron for an ellipsoid with these half axes.

    It is as far within the ellipsoid as beyond it.

    A linear map of a sphere keeps shares: the corners are those of an icosahedron and a
    dodecahedron on a sphere.
    """
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    signs = [-1.0, 1.0]
    tips = [np.roll([0.0, a, b * golden], turn) for turn in range(3) for a in signs for b in signs]
    rest = [np.array([a, b, c]) for a in signs for b in signs for c in signs]
    rest += [np.roll([0.0, a * golden, b / golden], turn) for turn in range(3) for a in signs for b in signs]
    points = np.array([point / np.linalg.norm(point) for point in (*tips, *rest)])
    faces = []
    for tip in range(len(tips)):
        up = points[tip]
        near = len(tips) + np.argsort(points[len(tips) :] @ up)[-5:]
        along = np.cross(up, points[near[0]])
        across = np.cross(up, along)
        around = near[np.argsort(np.arctan2(points[near] @ across, points[near] @ along))]
        faces += [[tip, int(one), int(next_one)] for one, next_one in zip(around, np.roll(around, -1), strict=True)]
    return points * size * (2.0 / (1.0 + _COSINE)), np.array(faces)
