"""`two_legs` keeps bodies on two legs upright that nobody prepared, and that no training had."""

import numpy as np
import pytest

from polypod import bodies, bundled
from polypod.evaluation import evaluate_checkpoint
from polypod.new_robot import new_robot


@pytest.fixture(scope="module")
def strangers(tmp_path_factory):
    """Configs of ten drawn humanoids, as `polypod robot new` drafts them from their URDFs."""
    folder = tmp_path_factory.mktemp("strangers")
    bodies.generate(folder, 10, 95, ["humanoid"], "stranger", wide=True)
    urdfs = sorted(folder.glob("assets/robots/*/robot.urdf"))
    return [str(new_robot(urdf, folder / f"{urdf.parent.name}.toml").path) for urdf in urdfs]


def falls(policy, robots):
    found = evaluate_checkpoint(bundled.checkpoint(policy), robots, num_envs=4 * len(robots), seed=1, threads=2)
    return {name: result.fall_rate for name, result in found.robots.items()}


def test_strangers_stay_upright(strangers):
    rates = falls("two_legs", strangers)
    assert len(rates) == 10
    assert sum(rate == 0.0 for rate in rates.values()) >= 4, rates
    assert np.mean(list(rates.values())) <= 0.6


def test_they_fall_under_the_policy_of_the_library(strangers):
    """So these bodies are no easy ones."""
    assert min(falls("legged", strangers[:3]).values()) == 1.0
