"""Rewards of different scales come out on one, and each robot's keep their proportions."""

import torch

from polypod.training.reward_scale import RewardScale


def _feed(scale: RewardScale, steps: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    out = []
    for _ in range(steps):
        rewards = torch.randn(64, generator=generator)
        rewards[32:] *= 25.0
        dones = torch.rand(64, generator=generator) < 0.02
        out.append(scale(rewards, dones))
    return torch.stack(out)


def test_robots_end_on_one_scale() -> None:
    scaled = _feed(RewardScale([(0, 32), (32, 64)], 0.99, "cpu"), 2000, seed=1)[500:]
    small, large = scaled[:, :32].std(), scaled[:, 32:].std()
    assert abs(float(small / large) - 1.0) < 0.1
    assert 0.05 < float(small) < 0.5  # returns of deviation 1 from independent rewards at gamma = 0.99


def test_one_step_scales_all_rewards_of_a_robot_alike() -> None:
    scale = RewardScale([(0, 3), (3, 4)], 0.99, "cpu")
    rewards = torch.tensor([1.0, 2.0, -4.0, 7.0])
    scaled = scale(rewards, torch.zeros(4))
    ratios = scaled[:3] / rewards[:3]
    torch.testing.assert_close(ratios, ratios[:1].expand(3))


def test_a_restored_scale_goes_on_as_the_old_one() -> None:
    old, new = (RewardScale([(0, 32), (32, 64)], 0.99, "cpu") for _ in range(2))
    _feed(old, 50, seed=2)
    new.restore({name: value.clone() for name, value in old.state().items()})
    assert torch.equal(_feed(old, 20, seed=3), _feed(new, 20, seed=3))
