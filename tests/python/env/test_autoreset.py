"""The three autoreset modes, measured against one another: only who resets, and when, differs."""

import gymnasium
import numpy as np
import pytest

from common import SHORT, size

STEPS = size(60, 600)


def test_same_step_equals_disabled_with_masked_resets(make, actions):
    """A twin without autoreset sees the true final observations.

    After a masked reset it sees the new ones.
    """
    env, twin = make(overrides=SHORT), make(overrides=SHORT, autoreset="disabled")
    env.reset(seed=3)
    twin.reset(seed=3)
    ended = 0
    for step in range(STEPS):
        drawn = actions(env, step)
        observations, rewards, terminated, truncated, infos = env.step(drawn)
        seen, twin_rewards, twin_terminated, twin_truncated, twin_infos = twin.step(drawn)
        assert twin_infos == {}
        np.testing.assert_array_equal(rewards, twin_rewards)
        np.testing.assert_array_equal(terminated, twin_terminated)
        np.testing.assert_array_equal(truncated, twin_truncated)
        done = terminated | truncated
        if done.any():
            np.testing.assert_array_equal(infos["_final_obs"], done)
            for row in np.flatnonzero(done):
                np.testing.assert_array_equal(infos["final_obs"][row], seen[row])
            seen = twin.reset(options={"reset_mask": done})[0]
            ended += done.sum()
        np.testing.assert_array_equal(observations, seen)
    assert ended > env.num_envs


def test_next_step_equals_disabled_one_step_late(make, actions):
    env = make(overrides=SHORT, autoreset="next_step")
    env.reset(seed=3)
    done = np.zeros(env.num_envs, dtype=np.bool_)
    ended = 0
    for step in range(STEPS):
        _, rewards, terminated, truncated, infos = env.step(actions(env, step))
        assert infos == {}
        assert not (terminated | truncated)[done].any()
        np.testing.assert_array_equal(rewards[done], 0.0)
        np.testing.assert_array_equal(env.sim.episode_length[done], 0)
        done = terminated | truncated
        ended += done.sum()
    assert ended > env.num_envs


def test_next_step_shows_the_final_observation_first(make, actions):
    env, twin = make(overrides=SHORT, autoreset="next_step"), make(overrides=SHORT)
    env.reset(seed=3)
    twin.reset(seed=3)
    fresh = np.ones(env.num_envs, dtype=np.bool_)
    while fresh.any():
        drawn = actions(env, int(env.sim.episode_length.max()))
        observations, _, terminated, truncated, _ = env.step(drawn)
        infos = twin.step(drawn)[4]
        first_ends = fresh & (terminated | truncated)
        for row in np.flatnonzero(first_ends):
            np.testing.assert_array_equal(observations[row], infos["final_obs"][row])
        fresh &= ~first_ends


def test_time_outs_are_truncations(make):
    env = make(overrides=SHORT)
    env.reset(seed=3)
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    survivors = np.ones(env.num_envs, dtype=np.bool_)
    for _ in range(env.max_episode_length - 1):
        _, _, terminated, truncated, _ = env.step(still)
        survivors &= ~terminated
        assert not truncated.any()
    assert survivors.any()
    _, _, _, truncated, _ = env.step(still)
    np.testing.assert_array_equal(truncated, survivors)


def test_a_masked_reset_leaves_the_other_envs_alone(make, actions):
    env = make(autoreset="disabled")
    env.reset(seed=3)
    before = env.step(actions(env, 0, scale=0.1))[0].copy()
    mask = np.arange(env.num_envs) % 2 == 0
    after, _ = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], before[~mask])
    assert (after[mask] != before[mask]).any(axis=1).all()
    np.testing.assert_array_equal(env.sim.episode_length, np.where(mask, 0, 1))


def test_disabled_refuses_to_step_an_ended_episode(make):
    env = make(overrides=SHORT, autoreset="disabled")
    env.reset(seed=3)
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    done = np.zeros(env.num_envs, dtype=np.bool_)
    while not done.any():
        _, _, terminated, truncated, _ = env.step(still)
        done = terminated | truncated
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset_mask"):
        env.step(still)
    env.reset(options={"reset_mask": done})
    env.step(still)
