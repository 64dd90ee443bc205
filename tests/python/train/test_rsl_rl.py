"""The adapter does what rsl_rl's runner relies on."""

import numpy as np
import pytest
import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

import polypod
import polypod.rsl_rl
from common import SHORT


@pytest.fixture
def env(make):
    return polypod.rsl_rl.VecEnv(make(overrides=SHORT))


def test_types_and_shapes(env):
    observations = env.get_observations()
    assert isinstance(observations, TensorDict)
    assert observations.batch_size == torch.Size([16])
    observations, rewards, dones, extras = env.step(torch.zeros(16, 12))
    assert (observations["policy"].shape, observations["policy"].dtype) == ((16, 48), torch.float32)
    assert (rewards.shape, rewards.dtype) == ((16,), torch.float32)
    assert (dones.shape, dones.dtype) == ((16,), torch.int64)
    assert extras["time_outs"].shape == (16,)


def test_the_runner_records_the_observation_that_it_acted_on(env):
    """rsl_rl stores observation t after step t + 1.

    With one reused buffer it would store observation t + 1.
    """
    observations = env.get_observations()
    storage = RolloutStorage("rl", 16, 30, observations, [12], "cpu")
    acted_on = []
    generator = torch.Generator().manual_seed(0)
    for _ in range(30):
        acted_on.append(observations["policy"].clone())
        transition = RolloutStorage.Transition()
        transition.observations = observations
        transition.actions = torch.randn(16, 12, generator=generator)
        observations, transition.rewards, transition.dones, _ = env.step(transition.actions)
        transition.values = transition.actions_log_prob = torch.zeros(16, 1)
        transition.distribution_params = (transition.actions,)
        storage.add_transition(transition)
    torch.testing.assert_close(storage.observations["policy"], torch.stack(acted_on), rtol=0, atol=0)


def test_steps_equal_those_of_the_vector_env(env, make, actions):
    twin = make(overrides=SHORT)
    for step in range(40):
        drawn = actions(twin, step)
        observations, rewards, dones, extras = env.step(torch.from_numpy(drawn))
        expected, expected_rewards, terminated, truncated, _ = twin.step(drawn)
        np.testing.assert_array_equal(observations["policy"].numpy(), expected)
        np.testing.assert_array_equal(rewards.numpy(), expected_rewards)
        np.testing.assert_array_equal(dones.numpy(), terminated | truncated)
        np.testing.assert_array_equal(extras["time_outs"].numpy(), truncated & ~terminated)


def test_what_a_step_hands_out_survives_the_next_one(env):
    """Observations for one further step, all else for good, also where episodes end."""
    random = torch.Generator().manual_seed(0)
    kept = []
    for _ in range(25):
        before = env.get_observations()
        observed = {name: group.clone() for name, group in before.items()}
        _, rewards, dones, extras = env.step(torch.randn(16, 12, generator=random))
        for name, group in before.items():
            assert torch.equal(group, observed[name])
        handed = [rewards, dones, extras["time_outs"]]
        kept.append((handed, [tensor.clone() for tensor in handed]))
    assert sum(int(copies[1].sum()) for _, copies in kept) >= 16
    for handed, copies in kept:
        for tensor, copy in zip(handed, copies, strict=True):
            assert torch.equal(tensor, copy)


def test_what_is_written_into_the_episode_lengths_changes_nothing(env):
    env.episode_length_buf += 7  # an assignment of the whole tensor
    assert env.episode_length_buf.tolist() == [7] * 16
    env.episode_length_buf.zero_()
    assert env.episode_length_buf.tolist() == [7] * 16


def test_episode_lengths_can_be_set(env):
    lengths = torch.arange(16)
    env.episode_length_buf = lengths
    torch.testing.assert_close(env.episode_length_buf, lengths)
    env.step(torch.zeros(16, 12))
    assert env.episode_length_buf[0] in (0, 1)
    env.episode_length_buf = torch.full((16,), 19)
    _, _, dones, _ = env.step(torch.zeros(16, 12))
    assert dones.all()
    torch.testing.assert_close(env.episode_length_buf, torch.zeros(16, dtype=torch.int64))


def test_bad_episode_lengths(env):
    with pytest.raises(ValueError, match=r"\(16,\)"):
        env.episode_length_buf = torch.zeros(15, dtype=torch.int64)
    with pytest.raises(ValueError, match="integer"):
        env.episode_length_buf = torch.zeros(16)


def test_log_of_ended_episodes(env):
    logs = [env.step(torch.zeros(16, 12))[3].get("log") for _ in range(20)]
    assert logs[-1], "all episodes end in step 20"
    assert all("/" in key and isinstance(value, float) for log in logs if log for key, value in log.items())
    assert any(key.startswith("Episode_Reward/spot/") for key in logs[-1])


def test_other_autoreset_modes_are_refused(make):
    with pytest.raises(polypod.ConfigError, match="same_step"):
        polypod.rsl_rl.VecEnv(make(autoreset="next_step"))


def test_actions_of_another_shape(env):
    with pytest.raises(ValueError, match=r"\(16, 12\)"):
        env.step(torch.zeros(1, 12))
