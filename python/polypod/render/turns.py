"""Quaternions (w, x, y, z), one or rows of them."""

import numpy as np
import numpy.typing as npt

from polypod.render.mesh import Array


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
    """[..., 4], of unit quaternions."""
    return np.asarray(quaternion, dtype=np.float64) * [1.0, -1.0, -1.0, -1.0]


def heading(quaternion: npt.ArrayLike) -> float:
    """Angle of the turned x axis on the ground, rad."""
    w, x, y, z = np.asarray(quaternion, dtype=np.float64)
    return float(np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z)))


def about_z(angle: float) -> Array:
    """A turn about the z axis, rad."""
    return np.array([np.cos(0.5 * angle), 0.0, 0.0, np.sin(0.5 * angle)])


def x_axis_to(direction: Array) -> Array:
    """The shortest turn of the x axis into a direction [3] that is not zero."""
    x, y, z = direction / np.linalg.norm(direction)
    if x < -1.0 + 1e-9:
        return np.array([0.0, 0.0, 0.0, 1.0])
    turn = np.array([1.0 + x, 0.0, -z, y])
    return turn / np.linalg.norm(turn)


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
