"""Rotations in space: unit quaternions (w, x, y, z), one or arrays of them, and matrices."""

import math

import numpy as np
import numpy.typing as npt

from polypod.arrays import Array


def matrix(quaternion: npt.ArrayLike) -> Array:
    """Rotation matrices of quaternions [..., 4], [..., 3, 3]; the columns are the turned axes."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def heading(quaternion: npt.ArrayLike) -> Array:
    """Angle of the turned x axis on the ground, rad, [...]."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    return np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))


def product(left: npt.ArrayLike, right: npt.ArrayLike) -> Array:
    """Products of quaternions, [..., 4]: turns by `right` and then by `left`."""
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
    """The reverse turns, [..., 4]."""
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


def of_angles(roll: npt.ArrayLike, pitch: npt.ArrayLike, yaw: npt.ArrayLike) -> Array:
    """Quaternions of turns about the fixed x, y and z axes, in this order, by angles [...], rad."""

    def about(axis: int, turn: npt.ArrayLike) -> Array:
        rotation = np.zeros((*np.shape(turn), 3))
        rotation[..., axis] = turn
        return of_vector(rotation)

    return product(about(2, yaw), product(about(1, pitch), about(0, roll)))


def matrix_of_angles(roll: float, pitch: float, yaw: float) -> Array:
    """Rotation matrix of `of_angles`, [3, 3]: `rpy` of a URDF."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def matrix_about(axis: npt.ArrayLike, angle: float) -> Array:
    """Rotation matrix of an angle, rad, about a direction [3] of unit length, [3, 3]."""
    x, y, z = np.asarray(axis, dtype=np.float64)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: Array = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
    return turned


def angles(turn: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a matrix [3, 3], rad; yaw is 0 where pitch is a right angle."""
    level = float(np.hypot(turn[0, 0], turn[1, 0]))
    pitch = float(np.arctan2(-turn[2, 0], level))
    if level < 1e-9:
        # only the sum or the difference of roll and yaw counts
        return float(np.arctan2(-turn[1, 2], turn[1, 1])), pitch, 0.0
    return float(np.arctan2(turn[2, 1], turn[2, 2])), pitch, float(np.arctan2(turn[1, 0], turn[0, 0]))


def x_axis_to(direction: Array) -> Array:
    """Quaternion of the shortest turn of the x axis into a direction [3] that is not zero."""
    x, y, z = direction / np.linalg.norm(direction)
    if x < -1.0 + 1e-9:
        return np.array([0.0, 0.0, 0.0, 1.0])
    turn = np.array([1.0 + x, 0.0, -z, y])
    return turn / np.linalg.norm(turn)


def unit(quaternion: Array) -> Array:
    """Quaternions of length one, [..., 4]."""
    scaled: Array = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return scaled


def continuous(quaternion: Array) -> Array:
    """The same turns with signs that do not jump between frames, [frames, 4]."""
    flips = np.where((quaternion[1:] * quaternion[:-1]).sum(axis=-1) < 0.0, -1.0, 1.0)
    signs = np.concatenate([[1.0], np.cumprod(flips)])
    signed: Array = quaternion * signs[:, np.newaxis]
    return signed


def rotated(quaternion: Array, vector: Array) -> Array:
    """The turned vectors, [..., 3]."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    a, b, c = (vector[..., i] for i in range(3))
    # twice the cross product; np.cross takes three times as long
    d, e, f = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    turned: Array = np.stack(
        [a + w * d + (y * f - z * e), b + w * e + (z * d - x * f), c + w * f + (x * e - y * d)], axis=-1
    )
    return turned


def vector(quaternion: Array) -> Array:
    """Axis times angle of the shortest turns, rad, [..., 3]."""
    q = np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    scaled: Array = q[..., 1:] * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 2.0)
    return scaled


def of_vector(turn: Array) -> Array:
    """Quaternions of rotation vectors, [..., 4], the inverse of `vector`."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    share = np.where(angle > 1e-9, np.sin(0.5 * angle) / np.maximum(angle, 1e-12), 0.5)
    return np.concatenate([np.cos(0.5 * angle), share * turn], axis=-1)


def of_yaw(angle: Array) -> Array:
    """Quaternions of turns to the left, [..., 4]."""
    zero = np.zeros_like(angle)
    return np.stack([np.cos(0.5 * angle), zero, zero, np.sin(0.5 * angle)], axis=-1)


def yaw(quaternion: Array) -> Array:
    """Parts of turns that are about the world's z axis, [..., 4]."""
    return of_yaw(heading(quaternion))


def angle(left: Array, right: Array) -> Array:
    """Angle between two orientations, rad, [...]."""
    q = product(left, inverse(right))
    between_them: Array = 2.0 * np.arctan2(np.linalg.norm(q[..., 1:], axis=-1), np.abs(q[..., 0]))
    return between_them


def between(left: Array, right: Array, share: Array) -> Array:
    """Turns that go from `left` to `right` by these shares [...] of the shortest way, [..., 4]."""
    way = vector(product(right, inverse(left)))
    return unit(product(of_vector(way * share[..., np.newaxis]), left))
