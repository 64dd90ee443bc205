"""The bundled policies walk with the robots that they are said to walk with."""

import pytest

from polypod import bundled
from polypod.evaluation import evaluate_checkpoint

WALKS = {
    "flat": ["anymal_d", "anymal_c", "anymal_b", "unitree_a1", "unitree_go1", "unitree_go2", "unitree_b2", "spot"],
    "rough": ["anymal_c", "unitree_a1", "unitree_go1", "unitree_go2"],
    "legged": [
        "anymal_d",
        "unitree_b1",
        "unitree_b2",
        "solo12",
        "box_quadruped",
        "anymal_b_kinova",
        "unitree_h1",
        "unitree_g1",
        "cassie",
        "booster_t1",
        "limx_tron1",
        "phantomx",
    ],
}
"""Robots of each; of `legged` on two, four and six legs, with six to 29 joints."""


@pytest.mark.parametrize("name", WALKS)
def test_it_walks(name):
    robots = WALKS[name]
    found = evaluate_checkpoint(bundled.checkpoint(name), robots, num_envs=8 * len(robots), steps=400, threads=2)
    assert found.checkpoint["file"] == name
    for robot, result in found.robots.items():
        assert result.error_vel_xy < 0.5 * result.still_error_vel_xy, robot
        assert result.fall_rate <= 1 / 8, robot


def test_a_training_begins_with_one_by_its_name(cli, tmp_path):
    train = ("train", "--logger", "none", "--robots", "spot", "--num-envs", "64", "--max-iterations", "1")
    ended = cli(*train, "--init", "flat", "--train-config", "flat_finish", "--log-dir", str(tmp_path))
    assert ended.returncode == 0, ended.stderr
    assert len(list(tmp_path.rglob("model_1.pt"))) == 1


def test_all_are_known():
    assert set(WALKS) == set(bundled.NAMES)
