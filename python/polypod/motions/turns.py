"""Rows of unit quaternions (w, x, y, z): turns of vectors, differences, interpolation."""

import numpy as np

from polypod import rotations
from polypod.arrays import Array


def unit(quaternion: Array) -> Array:
    """[..., 4] of length one."""
    scaled: Array = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return scaled


def continuous(quaternion: Array) -> Array:
    """[frames, 4], the same turns with signs that do not jump between frames."""
    flips = np.where((quaternion[1:] * quaternion[:-1]).sum(axis=-1) < 0.0, -1.0, 1.0)
    signs = np.concatenate([[1.0], np.cumprod(flips)])
    signed: Array = quaternion * signs[:, np.newaxis]
    return signed


def rotated(quaternion: Array, vector: Array) -> Array:
    """[..., 3], the turned vectors."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    a, b, c = (vector[..., i] for i in range(3))
    # twice the cross product; np.cross takes three times as long
    d, e, f = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    turned: Array = np.stack(
        [a + w * d + (y * f - z * e), b + w * e + (z * d - x * f), c + w * f + (x * e - y * d)], axis=-1
    )
    return turned


def vector(quaternion: Array) -> Array:
    """[..., 3], axis times angle of the shortest turns, rad."""
    q = np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    scaled: Array = q[..., 1:] * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 2.0)
    return scaled


def of_vector(turn: Array) -> Array:
    """[..., 4], the inverse of `vector`."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    share = np.where(angle > 1e-9, np.sin(0.5 * angle) / np.maximum(angle, 1e-12), 0.5)
    return np.concatenate([np.cos(0.5 * angle), share * turn], axis=-1)


def of_yaw(angle: Array) -> Array:
    """[..., 4], turns to the left."""
    zero = np.zeros_like(angle)
    return np.stack([np.cos(0.5 * angle), zero, zero, np.sin(0.5 * angle)], axis=-1)


def yaw(quaternion: Array) -> Array:
    """[..., 4], the part of turns that is about the world's z axis."""
    return of_yaw(rotations.heading(quaternion))


def angle(left: Array, right: Array) -> Array:
    """[...], angle between two orientations, rad."""
    q = rotations.product(left, rotations.inverse(right))
    between_them: Array = 2.0 * np.arctan2(np.linalg.norm(q[..., 1:], axis=-1), np.abs(q[..., 0]))
    return between_them


def between(left: Array, right: Array, share: Array) -> Array:
    """[..., 4], turns that go from `left` to `right` by these shares [...] of the shortest way."""
    way = vector(rotations.product(right, rotations.inverse(left)))
    return unit(rotations.product(of_vector(way * share[..., np.newaxis]), left))


def of_rpy(roll: Array, pitch: Array, yaw_angle: Array) -> Array:
    """[..., 4], as `polypod.rotations.of_angles`, of arrays."""

    def about(axis: int, turn: Array) -> Array:
        rotation = np.zeros((*turn.shape, 3))
        rotation[..., axis] = turn
        return of_vector(rotation)

    return rotations.product(about(2, yaw_angle), rotations.product(about(1, pitch), about(0, roll)))
