"""The bundled policies walk with the robots that they are said to walk with."""

from pathlib import Path

import numpy as np
import pytest

from polypod import bundled, robustness
from polypod.evaluation import evaluate_checkpoint, walking, why_not

WALKS = {
    "flat": ["anymal_d", "anymal_b", "unitree_go2"],
    "rough": ["anymal_c", "unitree_go1", "unitree_go2"],
    "legged": ["unitree_a1", "unitree_b1", "phantomx", "unitree_h1", "unitree_g1", "cassie", "booster_t1", "bolt"],
    "quadruped": ["unitree_go1", "unitree_b2", "solo12", "box_quadruped"],
}
"""Robots of each; of `legged` on two, four and six legs, of `quadruped` of 2.5 to 75 kg."""
FALLS_SHORT = {
    "flat": ("spot", {"drift", "yaw drift"}),
    "quadruped": ("spot", {"drift"}),
}
"""A robot that does not walk, and what it does not keep."""


@pytest.mark.parametrize("name", WALKS)
def test_it_walks(name):
    """Whole episodes by the whole definition; of eight each, in which one fall is too many."""
    robots = WALKS[name]
    found = evaluate_checkpoint(bundled.checkpoint(name), robots, num_envs=8 * len(robots), threads=2)
    assert found.checkpoint["file"] == name
    assert {robot: why_not(result.walking) for robot, result in found.robots.items()} == {name: [] for name in robots}


@pytest.mark.parametrize("name", FALLS_SHORT)
def test_a_robot_that_does_not_walk_is_found_out(name):
    robot, missed = FALLS_SHORT[name]
    found = evaluate_checkpoint(bundled.checkpoint(name), [robot], num_envs=16, threads=2)
    assert missed <= set(walking.faults(found.robots[robot].walking))


def test_legged_forgives_a_wrong_description():
    """Masses, lengths, gains and efforts wrong by up to 20 %, with which `quadruped` falls."""
    options = robustness.Options(("description_20",), ("polypod",), num_envs=8, steps=500, threads=2)
    robots = {"legged": ["unitree_a1", "spot", "unitree_h1", "cassie", "phantomx"], "quadruped": ["unitree_a1", "spot"]}
    falls = {}
    for policy, names in robots.items():
        (row,) = robustness.measure(Path(policy), names, options).rows
        falls[policy] = np.mean([result.fall_rate for result in row.robots.values()])
    assert falls["legged"] <= 0.1
    assert falls["quadruped"] >= 0.4


def test_a_training_begins_with_one_by_its_name(cli, tmp_path):
    train = ("train", "--logger", "none", "--robots", "spot", "--num-envs", "64", "--max-iterations", "1")
    ended = cli(*train, "--init", "flat", "--train-config", "flat_finish", "--log-dir", str(tmp_path))
    assert ended.returncode == 0, ended.stderr
    assert len(list(tmp_path.rglob("model_1.pt"))) == 1


def test_all_are_known():
    assert set(WALKS) == set(bundled.NAMES)
