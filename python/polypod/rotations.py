"""Rotations in space: unit quaternions (w, x, y, z), one or rows of them, and matrices."""

import math

import numpy as np
import numpy.typing as npt

from polypod.arrays import Array


def matrix(quaternion: npt.ArrayLike) -> Array:
    """[..., 3, 3], whose columns are the turned axes, of quaternions [..., 4]."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def heading(quaternion: npt.ArrayLike) -> Array:
    """[...], angle of the turned x axis on the ground, rad."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    return np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))


def product(left: npt.ArrayLike, right: npt.ArrayLike) -> Array:
    """[..., 4], turns by `right` and then by `left`."""
    w, x, y, z = np.moveaxis(np.asarray(left, dtype=np.float64), -1, 0)
    a, b, c, d = np.moveaxis(np.asarray(right, dtype=np.float64), -1, 0)
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=-1,
    )


def inverse(quaternion: npt.ArrayLike) -> Array:
    """[..., 4], the reverse turns."""
    return np.asarray(quaternion, dtype=np.float64) * [1.0, -1.0, -1.0, -1.0]


def of_axes(axes: Array) -> Array:
    """Quaternion of a rotation matrix [3, 3], whose columns are the turned axes."""
    (a, b, c), (d, e, f), (g, h, i) = axes
    squares = np.array([1.0 + a + e + i, 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i])
    # the largest of the four numbers first, by which the others are divided
    rows = [
        [squares[0], h - f, c - g, d - b],
        [h - f, squares[1], b + d, c + g],
        [c - g, b + d, squares[2], f + h],
        [d - b, c + g, f + h, squares[3]],
    ]
    largest = np.array(rows[int(squares.argmax())])
    quaternion: Array = largest / np.linalg.norm(largest)
    return quaternion


def of_angles(roll: float, pitch: float, yaw: float) -> Array:
    """Quaternion of rotations about the fixed x, y and z axes, in this order, rad."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(0.5 * a), math.sin(0.5 * a)) for a in (roll, pitch, yaw))
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def x_axis_to(direction: Array) -> Array:
    """Quaternion of the shortest turn of the x axis into a direction [3] that is not zero."""
    x, y, z = direction / np.linalg.norm(direction)
    if x < -1.0 + 1e-9:
        return np.array([0.0, 0.0, 0.0, 1.0])
    turn = np.array([1.0 + x, 0.0, -z, y])
    return turn / np.linalg.norm(turn)
