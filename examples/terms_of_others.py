"""Terms of mjlab's and Isaac Lab's velocity tasks that are not built in, under their names.

polypod train --task velocity_flat --terms examples/terms_of_others.py
"""

import functools
import json

import numpy as np

from polypod import terms

held_force = terms.memory("held_force", size=64)
"""Largest force on each foot since it touched down, N."""
peak_height = terms.memory("peak_height", size=64)
"""Largest height of each foot since it left the ground, m."""


@functools.cache
def limits(env):
    """Lower and upper limit, effort and velocity limit of each joint, [num_envs, joints] each."""
    found = [np.full(env.joint_pos.shape, end) for end in (-np.inf, np.inf, np.inf, np.inf)]
    for robot, info in json.loads(env.sim.robot_info()).items():
        for column, joint, sign in zip(info["columns"], info["joint_of_slot"], info["slot_signs"], strict=True):
            ends = [info["lower"][joint], info["upper"][joint]][:: int(sign)]
            ends = [
                fallback if end is None else sign * end for end, fallback in zip(ends, (-np.inf, np.inf), strict=True)
            ]
            most = [info[key][joint] for key in ("effort_limit", "velocity_limit")]
            for array, value in zip(
                found, [*ends, *(np.inf if value is None else value for value in most)], strict=True
            ):
                array[env.env_ids(robot), column] = value
    return found


def force(env):
    """Normal force on each foot, N."""
    return env.contact_forces[:, 2::3]


def landed(env):
    """Whether each foot has touched down in this control step."""
    return (env.feet_contact_time > 0.0) & (env.feet_contact_time <= env.step_dt)


def moves(env):
    """Whether a velocity is commanded."""
    return np.linalg.norm(env.command, axis=1) > 0.1


@terms.observation(size=1, mirror="per_foot", group="critic")
def foot_contact(env):
    """1 where a foot touches the ground."""
    return env.feet_contact_time > 0.0


@terms.observation(size=1, mirror="per_foot", group="critic")
def foot_contact_forces(env):
    """Logarithm of 1 and the force on each foot, N."""
    return np.log1p(np.abs(force(env)))


@foot_contact.update
def watch_feet(env):
    """Keeps the peaks of height and force of each foot."""
    feet, touches = env.feet_height.shape[1], env.feet_contact_time > 0.0
    peak, held = env.memory["peak_height"][:, :feet], env.memory["held_force"][:, :feet]
    peak[:] = np.where(touches & ~landed(env), 0.0, np.maximum(peak, env.feet_height))
    held[:] = np.where(touches, np.maximum(np.where(landed(env), 0.0, held), force(env)), 0.0)


@terms.reward(weight=1.0)
def upright(env):
    """Gravity along the base's downward axis."""
    return np.exp(-np.square(env.projected_gravity[:, :2]).sum(axis=1) / 0.2)


@terms.reward(weight=1.0)
def variable_posture(env):
    """Joints near the default pose, the nearer the slower the command."""
    std = np.where(moves(env), 0.5, 0.1)[:, np.newaxis]
    error = np.square((env.joint_pos - env.default_joint_pos) / std) * env.action_mask
    return np.exp(-error.sum(axis=1) / env.action_mask.sum(axis=1))


@terms.reward(weight=-0.25)
def feet_swing_height(env):
    """Peak height of a swing against 0.1 m, where feet touch down."""
    peak = env.memory["peak_height"][:, : env.feet_height.shape[1]]
    return (np.square(peak / 0.1 - 1.0) * landed(env)).sum(axis=1) * moves(env)


@terms.reward(weight=-1e-5)
def soft_landing(env):
    """Force with which feet touch down, N."""
    return (env.memory["held_force"][:, : env.feet_height.shape[1]] * landed(env)).sum(axis=1) * moves(env)


@terms.curriculum()
def command_vel(env, ids):
    """Wider commands in stages, by robots that earn most of the reward for their velocity."""
    widest = {}
    for robot in env.robots:
        low, high = env.sim.command_ranges()[robot]["lin_vel_x"]
        mine = np.intersect1d(ids, env.env_ids(robot))
        if mine.size and (env.episode_length[mine] >= env.max_episode_length).mean() > 0.8:
            env.sim.set_command_ranges(robot, lin_vel_x=(max(low - 0.05, -2.0), min(high + 0.05, 2.0)))
        widest[robot] = high
    return widest


@terms.reward(weight=-1e-3)
def joint_vel_l1(env):
    """Speeds of the joints, rad/s."""
    return np.abs(env.joint_vel).sum(axis=1)


@terms.reward(weight=-1.0)
def joint_vel_limits(env):
    """Speeds beyond 90 % of the limits, rad/s, at most 1 each."""
    return np.clip(np.abs(env.joint_vel) - 0.9 * limits(env)[3], 0.0, 1.0).sum(axis=1)


@terms.reward(weight=-1e-3)
def action_l2(env):
    """Squares of the actions."""
    return np.square(env.last_action).sum(axis=1)


@terms.reward(weight=-1e-3)
def contact_forces(env):
    """Forces on feet beyond three times that of an even stand of 50 kg, N."""
    return np.maximum(force(env) - 500.0, 0.0).sum(axis=1)


@terms.termination()
def joint_vel_out_of_limit(env):
    """A joint is twice as fast as its limit."""
    return (np.abs(env.joint_vel) > 2.0 * limits(env)[3]).any(axis=1)


@terms.termination()
def joint_pos_out_of_limit(env):
    """A joint is 0.2 rad beyond a limit."""
    low, high = limits(env)[:2]
    return (((env.joint_pos < low - 0.2) | (env.joint_pos > high + 0.2)) & env.action_mask).any(axis=1)
