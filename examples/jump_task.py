"""A task of one's own in Python: robots that trot, and jump to a commanded height.

A command, an observation with history, a reward, a termination, events, resets to given states, a
curriculum and a curve:

    polypod train --task velocity_flat --robots unitree_go2 --terms examples/jump_task.py
"""

import numpy as np

from polypod import terms

HEIGHT = 0.3
"""Height of the base when the robot stands, m."""

level = terms.memory("level", fill=0.0, per_env=False)
phase = terms.memory("phase")


@terms.command(size=1, units="m", resampling_time_s=(1.0, 2.0))
def jump_height(env, ids):
    """Height of the base above its height in standing, m."""
    return env.random.uniform(0.0, 0.05 + 0.25 * env.memory["level"][0], ids)


@terms.observation(size=2, history_length=3)
def clock(env):
    """Sine and cosine of the phase of the jump."""
    angle = 2.0 * np.pi * env.memory["phase"][:, 0]
    return np.stack([np.sin(angle), np.cos(angle)], axis=1)


@clock.update
def advance(env):
    """The clock goes round in half a second."""
    env.memory["phase"][:] = (env.memory["phase"] + np.float32(2.0 * env.step_dt)) % np.float32(1.0)


@clock.reset
def begin(env, ids):
    """Each episode begins somewhere in the jump."""
    env.memory["phase"][ids] = env.random.uniform(0.0, 1.0, ids)


@terms.reward(weight=2.0)
def reach_height(env):
    """One where the base is as high as commanded, in the second half of the clock's round."""
    error = env.base_height - HEIGHT - env.commands["jump_height"][:, 0]
    return np.exp(-((error / 0.05) ** 2)) * (env.memory["phase"][:, 0] > 0.5)


@terms.termination()
def too_low(env):
    """The base is on the ground."""
    return env.base_height < 0.12


@terms.event(mode="interval", interval_range_s=(3.0, 6.0))
def nudge(env, ids):
    """A push to the side."""
    velocity = np.zeros((env.num_envs, 3), dtype=np.float32)
    velocity[ids, 1] = env.random.uniform(-0.5, 0.5, ids)[:, 0]
    env.sim.push(velocity)


@terms.event(mode="reset")
def in_flight(env, ids):
    """Every second robot begins in the air, on its way up."""
    mine = ids[ids % 2 == 1]
    env.sim.set_state(mine, base_pos=env.base_pos[mine] + np.float32([0.0, 0.0, 0.1]), base_lin_vel=[0.0, 0.0, 1.0])


@terms.curriculum()
def higher(env, ids):
    """Higher jumps once robots earn half of the reward, and faster commands with them."""
    earned = env.episode_reward("reach_height")[ids].mean() / (0.02 * env.max_episode_length)
    if earned > 0.5:
        env.memory["level"][0] = min(env.memory["level"][0] + 0.01, 1.0)
        for robot in env.robots:
            env.sim.set_command_ranges(robot, lin_vel_x=(-0.5, 0.5 + env.memory["level"][0]))
    return {"level": env.memory["level"][0], "earned": earned}


@terms.metric()
def height_error(env):
    """Distance of the base from the commanded height, m."""
    return np.abs(env.base_height - HEIGHT - env.commands["jump_height"][:, 0])
