"""Measures of a control step, for all envs: float64 arrays of the state in, [num_envs] out."""

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.arrays import Array

CONTACT_FORCE = 1.0
"""N, above which a foot is in contact: the threshold of the task's contact sensors."""

STUMBLE = 4.0
"""A foot stumbles while the ground pushes it sideways with more than this many times the vertical
force: it has met a wall."""

TRACKING_STD = 0.5
"""m/s and rad/s, of the reference's tracking rewards."""


def tracking(error_xy: npt.ArrayLike, error_yaw: npt.ArrayLike) -> Array:
    """The reference's `track_lin_vel_xy_exp` and `track_ang_vel_z_exp`, scaled to at most 1.

    The second counts half as much.

    Args:
        error_xy: [num_envs], of the planar velocity, m/s.
        error_yaw: [num_envs], of the yaw rate, rad/s.
    """
    linear, turning = (
        np.exp(-np.square(np.asarray(error, dtype=np.float64) / TRACKING_STD)) for error in (error_xy, error_yaw)
    )
    return (linear + 0.5 * turning) / 1.5


def joint_power(effort: npt.ArrayLike, velocity: npt.ArrayLike) -> Array:
    """Mechanical power of the joints, W: the sum of |effort x velocity|.

    Braking counts as driving does: no motor here gives back what it absorbs.

    Args:
        effort: [num_envs, joints], N m.
        velocity: [num_envs, joints], rad/s.
    """
    return np.abs(np.asarray(effort, dtype=np.float64) * np.asarray(velocity, dtype=np.float64)).sum(axis=1)


def foot_slip(forces: npt.ArrayLike, velocities: npt.ArrayLike) -> tuple[Array, Array]:
    """Planar speeds of the feet that are in contact, summed, m/s, and how many are in contact.

    A foot's velocity is that of its centre: a round foot that rolls without sliding counts too,
    with the speed of its middle.

    Args:
        forces: [num_envs, 3 feet], net contact force on each foot, N.
        velocities: [num_envs, 3 feet], m/s, world axes.
    """
    force, velocity = (np.asarray(x, dtype=np.float64) for x in (forces, velocities))
    force, velocity = (x.reshape(len(x), -1, 3) for x in (force, velocity))
    contact = np.linalg.norm(force, axis=2) > CONTACT_FORCE
    speed = np.linalg.norm(velocity[:, :, :2], axis=2)
    return (speed * contact).sum(axis=1), contact.sum(axis=1).astype(np.float64)


def stumbles(forces: npt.ArrayLike) -> Array:
    """Number of feet that stumble, see `STUMBLE`.

    Args:
        forces: [num_envs, 3 feet], net contact force on each foot, N, world axes.
    """
    force = np.asarray(forces, dtype=np.float64)
    force = force.reshape(len(force), -1, 3)
    sideways = np.linalg.norm(force[:, :, :2], axis=2)
    is_met = (sideways > CONTACT_FORCE) & (sideways > STUMBLE * np.abs(force[:, :, 2]))
    return is_met.sum(axis=1).astype(np.float64)


def of_step(sim: _core.VecSim) -> dict[str, Array]:
    """All measures that an evaluation sums up, each [num_envs], of the step just taken."""
    names = ("base_lin_vel", "base_ang_vel", "command", "joint_effort", "joint_vel", "contact_forces", "feet_vel")
    state = {name: sim.state(name).astype(np.float64) for name in names}
    wanted, velocity = state["command"], state["base_lin_vel"][:, :2]
    slip, contact = foot_slip(state["contact_forces"], state["feet_vel"])
    error_xy = np.linalg.norm(wanted[:, :2] - velocity, axis=1)
    error_yaw = np.abs(wanted[:, 2] - state["base_ang_vel"][:, 2])
    return {
        "steps": np.ones(sim.num_envs),
        "reward": sim.reward.astype(np.float64),
        "fell": sim.terminated.astype(np.float64),
        "xy": error_xy,
        "yaw": error_yaw,
        "tracking": tracking(error_xy, error_yaw),
        "still_xy": np.linalg.norm(wanted[:, :2], axis=1),
        "still_yaw": np.abs(wanted[:, 2]),
        "power": joint_power(state["joint_effort"], state["joint_vel"]),
        "speed": np.linalg.norm(velocity, axis=1),
        "slip": slip,
        "contact": contact,
        "stumbles": stumbles(state["contact_forces"]),
    }
