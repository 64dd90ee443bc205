"""Each robot's advantages come out with mean 0 and deviation 1, in their own order."""

import torch

from polypod.training.advantages import normalize_per_robot


def test_each_robot_has_the_same_scale() -> None:
    generator = torch.Generator().manual_seed(0)
    advantages = torch.randn(24, 48, 1, generator=generator)
    advantages[:, 32:] = 100.0 * advantages[:, 32:] + 7.0
    before = advantages.clone()
    normalize_per_robot(advantages, [(0, 32), (32, 48)])
    for start, stop in ((0, 32), (32, 48)):
        own, old = advantages[:, start:stop], before[:, start:stop]
        torch.testing.assert_close(own.mean(), torch.tensor(0.0), atol=1e-5, rtol=0.0)
        torch.testing.assert_close(own.std(correction=0), torch.tensor(1.0))
        # an increasing straight line keeps what is better than what
        assert float(torch.corrcoef(torch.stack([own.flatten(), old.flatten()]))[0, 1]) > 0.9999


def test_a_robot_without_differences_stays_at_nothing() -> None:
    advantages = torch.full((4, 6, 1), 3.0)
    normalize_per_robot(advantages, [(0, 6)])
    assert torch.equal(advantages, torch.zeros(4, 6, 1))
