"""Arrays are the simulator's own and valid for as long as promised, or copies on request."""

import numpy as np


def test_observations_survive_one_further_step(make, actions):
    env = make()
    env.reset(seed=0)
    first = env.step(actions(env, 0))[0]
    kept = first.copy()
    second = env.step(actions(env, 1))[0]
    np.testing.assert_array_equal(first, kept)
    assert not np.shares_memory(first, second)


def test_nothing_is_copied(make, actions):
    env = make()
    env.reset(seed=0)
    observations = [env.step(actions(env, step))[0] for step in range(4)]
    assert np.shares_memory(observations[0], observations[2])
    assert np.shares_memory(observations[1], observations[3])
    rewards = [env.step(actions(env, step))[1] for step in range(2)]
    assert np.shares_memory(*rewards)


def test_copies_can_be_kept(make, actions):
    env, twin = make(copy=True), make()
    env.reset(seed=0)
    twin.reset(seed=0)
    kept, expected = [], []
    for step in range(5):
        drawn = actions(env, step)
        kept.append(env.step(drawn)[:4])
        expected.append([array.copy() for array in twin.step(drawn)[:4]])
    for arrays, expected_arrays in zip(kept, expected, strict=True):
        for array, expected_array in zip(arrays, expected_arrays, strict=True):
            np.testing.assert_array_equal(array, expected_array)


def test_actions_are_not_kept(make, actions):
    env, twin = make(), make()
    env.reset(seed=0)
    twin.reset(seed=0)
    drawn = actions(env, 0)
    env.step(drawn)
    drawn[:] = 1e6
    expected = actions(env, 0)
    twin.step(expected)
    np.testing.assert_array_equal(env.step(expected)[0], twin.step(expected)[0])
