"""Balance of drawn motions: the base sways so that steps can be walked at their pace.

The zero-moment point is where the ground's force must act for a motion to happen. Beyond the soles
no ground can push, so that no policy can follow. The wanted point is under the foot that stands; a
linear inverted pendulum says how far the body moves for it (Kajita et al., Biped walking pattern
generation by using preview control of zero-moment point, ICRA 2003). Rounds with the whole body's
inverse dynamics make up for what the pendulum leaves out.
"""

import numpy as np

from polypod import rotations
from polypod.arrays import Array
from polypod.motions.body import Body
from polypod.motions.motion import Motion, velocities

ROUNDS = 6
"""Corrections, at most."""
CLOSE = 0.004
"""Distance from the wanted points at which they end, m."""
SHIFT_S = 0.5
"""Time in which a standing robot moves its weight before its first step and after its last one,
s."""
INWARD = 0.05
"""Distance of the wanted point under a foot from the middle of its sole, towards the other foot, in
distances of the feet: hips and ankles bear less with it."""
LEAST_LOAD = 0.2
"""Share of the weight below which a robot counts as flying: it has no zero-moment point."""


def zero_moment_points(body: Body, motion: Motion) -> Array:
    """Points where the ground's force acts, m, [frames, 2]; NaN in flight."""
    qpos = body.qpos(motion)
    linear, angular, joints = velocities(motion)
    speeds = np.zeros((len(qpos), 6 + len(body.joints)))
    speeds[:, :3] = linear
    speeds[:, 3:6] = rotations.rotated(rotations.inverse(qpos[:, 3:7]), angular)
    speeds[:, [6 + body.joints.index(name) for name in motion.joint_names]] = joints
    effort = body.effort(qpos, speeds, np.asarray(np.gradient(speeds, 1.0 / motion.fps, axis=0)))
    force, moment = effort[:, :3], rotations.rotated(qpos[:, 3:7], effort[:, 3:6])
    moment = moment + np.cross(qpos[:, :3], force)
    weight = float(np.median(force[:, 2]))
    safe = np.where(force[:, 2] > LEAST_LOAD * weight, force[:, 2], np.nan)
    return np.stack([-moment[:, 1] / safe, moment[:, 0] / safe], axis=1)


def loads(spans: list[list[tuple[float, float]]], times: Array) -> Array:
    """Share of the weight on each foot, [frames, 2].

    Args:
        spans: of each foot, when it is off the ground: begin and end, s.
        times: [frames], s.
    """
    keys = [(float(times[0]), 0.5), (float(times[-1]), 0.5)]
    steps = sorted((begin, end, side) for side in range(2) for begin, end in spans[side])
    for index, (begin, end, side) in enumerate(steps):
        left = float(side == 1)
        if index == 0 or begin - steps[index - 1][1] > 2.0 * SHIFT_S:
            keys.append((begin - SHIFT_S, 0.5))
        if index + 1 == len(steps) or steps[index + 1][0] - end > 2.0 * SHIFT_S:
            keys.append((end + SHIFT_S, 0.5))
        keys += [(begin, left), (end, left)]
    keys.sort()
    left_load: Array = np.interp(times, [key[0] for key in keys], [key[1] for key in keys])
    return np.stack([left_load, 1.0 - left_load], axis=1)


def wanted(body: Body, position: Array, yaw: Array, load: Array) -> Array:
    """Zero-moment points that stand on the soles, [frames, 2].

    A sole bears its weight where it does in the default pose, as far as an ankle can hold that.

    Args:
        body: the robot.
        position: [frames, 2, 3], of the feet, m.
        yaw: headings of the feet, [frames, 2], rad.
        load: of the feet, see `loads`.
    """
    ahead = float(body.rest_point[0] - body.feet[:, 0].mean()) + body.lean
    inward = INWARD * (body.feet[1, 1] - body.feet[0, 1]) * np.array([1.0, -1.0])
    cos, sin = np.cos(yaw), np.sin(yaw)
    center = position[..., :2] + np.stack([ahead * cos - inward * sin, ahead * sin + inward * cos], axis=-1)
    point: Array = (load[..., np.newaxis] * center).sum(axis=1)
    return point


def sway(error: Array, height: float, fps: float, gravity: float) -> Array:
    """Motion of a pendulum whose zero-moment point moves by `error`, [frames, 2].

    It is at rest at the ends, and solves c - height / gravity c'' = error by elimination.
    """
    k = height / gravity * fps * fps
    count = len(error)
    moved = np.zeros_like(error)
    if count < 3:
        return moved
    upper, value = np.zeros(count), error.copy()
    value[0] = value[-1] = 0.0
    for i in range(1, count - 1):
        pivot = 1.0 + 2.0 * k - k * upper[i - 1]
        upper[i] = k / pivot
        value[i] = (value[i] + k * value[i - 1]) / pivot
    for i in range(count - 2, 0, -1):
        moved[i] = value[i] + upper[i] * moved[i + 1]
    return moved
