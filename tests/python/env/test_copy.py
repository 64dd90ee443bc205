"""Arrays that are handed out are the caller's to keep.

On request they are the simulator's own, valid as promised.
"""

import numpy as np
import pytest

STEPS = 50


def test_everything_can_be_kept(make, actions):
    """Arrays of 50 steps keep the values that `step` returned, over ends of episodes."""
    env = make(overrides={"sim.episode_length_s": 0.4})
    kept, expected = [env.reset(seed=0)[0]], []
    expected.append(kept[0].copy())
    ends = 0
    for step in range(STEPS):
        *arrays, infos = env.step(actions(env, step))
        arrays += [infos["_final_obs"], *infos["final_obs"][infos["_final_obs"]]] if infos else []
        ends += int(infos["_final_obs"].sum()) if infos else 0
        kept += arrays
        expected += [np.copy(array) for array in arrays]
    assert ends >= 2 * env.num_envs
    for array, was in zip(kept, expected, strict=True):
        np.testing.assert_array_equal(array, was)
    observations = [array for array in kept if array.shape == env.observation_space.shape]
    assert len(np.unique(np.stack(observations), axis=0)) == STEPS + 1


def test_observations_survive_one_further_step_without_copies(make, actions):
    env = make(copy=False)
    env.reset(seed=0)
    first = env.step(actions(env, 0))[0]
    kept = first.copy()
    second = env.step(actions(env, 1))[0]
    np.testing.assert_array_equal(first, kept)
    assert not np.shares_memory(first, second)


def test_nothing_is_copied_on_request(make, actions):
    env = make(copy=False)
    env.reset(seed=0)
    observations = [env.step(actions(env, step))[0] for step in range(4)]
    assert np.shares_memory(observations[0], observations[2])
    assert np.shares_memory(observations[1], observations[3])
    rewards = [env.step(actions(env, step))[1] for step in range(2)]
    assert np.shares_memory(*rewards)


def test_copies_are_the_same_numbers(make, actions):
    env, twin = make(), make(copy=False)
    env.reset(seed=0)
    twin.reset(seed=0)
    for step in range(5):
        drawn = actions(env, step)
        for array, own in zip(env.step(drawn)[:4], twin.step(drawn)[:4], strict=True):
            np.testing.assert_array_equal(array, own)


def test_the_adapter_of_rsl_rl_does_not_copy(make, actions):
    torch = pytest.importorskip("torch")
    from polypod.rsl_rl import VecEnv

    env = VecEnv(make())
    drawn = torch.from_numpy(actions(env.unwrapped, 0))
    observations = [env.step(drawn)[0]["policy"].numpy() for _ in range(3)]
    assert np.shares_memory(observations[0], observations[2])


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
