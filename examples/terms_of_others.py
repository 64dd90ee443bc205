"""Terms of mjlab's and Isaac Lab's velocity tasks that are not built in, under their names.

polypod train --task velocity_flat_legged --terms examples/terms_of_others.py
"""

import functools

import numpy as np

from polypod import Simulation, rotations, terms
from polypod.terms import Reward

held_force = terms.memory("held_force", size=64)  # largest force on each foot since it touched down, N
peak_height = terms.memory("peak_height", size=64)  # largest height of each foot since it left the ground, m
second_last = terms.memory("second_last", size=64)  # action before the last one


@functools.cache
def bounds(env):
    """Corners of the terrain, m; a plane has none."""
    if (ground := env.sim.terrain()) is None:
        return np.array([-np.inf]), np.array([np.inf])
    low = np.array(ground["origin"])
    return low, low + ground["cell"] * (np.array(ground["heights"].shape) - 1)


@functools.cache
def twin(env, robot):
    """Physics of a robot's envs without a task, for quantities that a batch does not have."""
    return Simulation(robot, len(env.env_ids(robot)))


def squares(array):
    """Sum of squares of each env."""
    return np.square(array).sum(axis=1)


def bell(error, std):
    """exp(-error^2 / std^2)."""
    return np.exp(-squares(error) / std**2)


def upright_error(env, velocity):
    """Commanded velocity less one in base axes, in axes that turn with the heading alone."""
    x, y, z = np.einsum("nij,nj->in", rotations.matrix(env.base_quat), velocity)
    heading = rotations.heading(env.base_quat)
    cosine, sine = np.cos(heading), np.sin(heading)
    return env.command - np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1)


def per_foot(env):
    """Quantities of each foot, [num_envs, feet]: m, m/s, N."""
    touches, count = env.feet_contact_time > 0.0, env.feet_height.shape[1]
    return {
        "height": env.feet_height,
        "speed": np.linalg.norm(env.feet_vel.reshape(env.num_envs, count, 3)[..., :2], axis=2),
        "force": env.contact_forces[:, 2::3],
        "touches": touches,
        "landed": touches & (env.feet_contact_time <= env.step_dt),
        "peak": env.memory["peak_height"][:, :count],
        "held": env.memory["held_force"][:, :count],
    }


@terms.observation(size=1, mirror="per_foot", group="critic")
def foot_contact(env):
    """1 where a foot touches the ground."""
    return env.feet_contact_time > 0.0


@terms.observation(size=1, mirror="per_foot", group="critic")
def foot_contact_forces(env):
    """Logarithm of 1 and the normal force on each foot, N."""
    return np.log1p(np.abs(env.contact_forces[:, 2::3]))


@foot_contact.update
def watch(env):
    """Keeps the peaks of height and force of each foot."""
    foot = per_foot(env)
    foot["peak"][:] = np.where(foot["touches"] & ~foot["landed"], 0.0, np.maximum(foot["peak"], foot["height"]))
    foot["held"][:] = foot["touches"] * np.maximum(foot["held"] * ~foot["landed"], foot["force"])


def pose(env):
    """Bell curve over the distance of the joints from the default pose, wider for fast commands."""
    speed = np.linalg.norm(env.command, axis=1)[:, np.newaxis]
    std = np.select([speed < 0.05, speed < 1.5], [0.1, 0.5], 0.8)
    return np.exp(-squares((env.joint_pos - env.default_joint_pos) / std) / env.action_mask.sum(axis=1))


def body_ang_vel(env, robot):
    """Squared roll and pitch rates of the torso, or of the base, world axes, (rad/s)^2."""
    names = env.sim.link_names(robot)
    torso = next((name for name in names if "torso" in name), names[0])
    return squares(env.sim.links(robot, [torso])["ang_vel"][:, 0, :2])


def angular_momentum(env, robot):
    """Square of the angular momentum about the centre of mass, (kg m^2/s)^2."""
    twin(env, robot).set_state(qpos=env.sim.qpos(robot), qvel=env.sim.qvel(robot))
    return squares(twin(env, robot).momentum()[1])


def by_robot(weight, value):
    """A reward that asks the simulator about one robot after the other."""
    return Reward(lambda env: np.concatenate([value(env, robot) for robot in env.robots]), weight)


def feet(weight, cost):
    """A cost of each foot, of robots that are told to move."""
    return Reward(lambda env: cost(env, **per_foot(env)).sum(axis=1) * (squares(env.command) > 0.05**2), weight)


rewards = {
    # mjlab; velocities that nobody commanded are errors
    "track_linear_velocity": Reward(lambda env: bell(env.command * [1, 1, 0] - env.base_lin_vel, 0.5), 2.0),
    "track_angular_velocity": Reward(lambda env: bell(env.command * [0, 0, 1] - env.base_ang_vel, 0.5**0.5), 2.0),
    "pose": Reward(pose, 1.0),
    "body_ang_vel": by_robot(-0.05, body_ang_vel),
    "angular_momentum": by_robot(-0.02, angular_momentum),
    "feet_in_flight": feet(0.5, lambda env, **_: (env.feet_air_time > 0.05) & (env.feet_air_time <= 0.5)),
    "feet_clearance": feet(-2.0, lambda env, height, speed, **_: np.abs(height - 0.1) * speed),
    "feet_swing_height": feet(-0.25, lambda env, peak, landed, **_: np.square(peak / 0.1 - 1.0) * landed),
    "feet_slip": feet(-0.1, lambda env, speed, touches, **_: np.square(speed) * touches),
    "soft_landing": feet(-1e-5, lambda env, held, landed, **_: held * landed),
    # Isaac Lab; velocities in axes that stay upright
    "track_lin_vel_xy_yaw_frame_exp": Reward(lambda env: bell(upright_error(env, env.base_lin_vel)[:, :2], 0.5), 1.0),
    "track_ang_vel_z_world_exp": Reward(lambda env: bell(upright_error(env, env.base_ang_vel)[:, 2:], 0.5), 1.0),
    "joint_vel_l1": Reward(lambda env: np.abs(env.joint_vel).sum(axis=1), -1e-3),
    "action_l2": Reward(lambda env: squares(env.last_action), -1e-3),
    "contact_forces": feet(-1e-3, lambda env, force, **_: np.maximum(force - 500.0, 0.0)),
}


@terms.termination(time_out=True)
def out_of_terrain_bounds(env):
    """The base is less than 3 m from the edge of the terrain."""
    place, (low, high) = (env.sim.env_origins() + env.base_pos)[:, :2], bounds(env)
    return ((place < low + 3.0) | (place > high - 3.0)).any(axis=1)


@terms.metric()
def mean_action_acc(env):
    """Mean size of the second difference of the actions."""
    oldest = env.memory["second_last"][:, : env.last_action.shape[1]]
    value = np.abs(env.last_action - 2.0 * env.previous_action + oldest).mean(axis=1)
    oldest[:] = env.previous_action
    return value
