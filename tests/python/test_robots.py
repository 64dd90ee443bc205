"""Every env holds one robot, robots hold contiguous and fair shares, and joints map one to one."""

import numpy as np
import pytest

import polypod


@pytest.mark.parametrize("num_envs", [3, 8, 10])
def test_shares_are_contiguous_and_fair(make, num_envs):
    env = make(num_envs=num_envs, robots=["spot", "unitree_a1", "anymal_c"])
    assert env.robots == ["spot", "unitree_a1", "anymal_c"]
    shares = [env.env_ids(robot) for robot in env.robots]
    np.testing.assert_array_equal(np.concatenate(shares), np.arange(num_envs))
    sizes = [share.size for share in shares]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] - sizes[-1] <= 1


def test_joint_maps_are_permutations(make):
    env = make(robots=None)
    assert len(env.canonical_joint_names) == 12
    assert env.canonical_joint_names[:5] == ["LF_HAA", "LH_HAA", "RF_HAA", "RH_HAA", "LF_HFE"]
    for robot in env.robots:
        joints = env.joint_map(robot)
        assert sorted(index for _, index in joints) == list(range(12))
        assert len({name for name, _ in joints}) == 12


def test_the_default_is_the_tasks_robots(make):
    for entry in polypod.tasks():
        if "velocity_flat" in entry["aliases"]:
            assert make(robots=None).robots == entry["robots"]
            assert len(entry["robots"]) == entry["num_robots"] == 8


def test_the_layout_adds_up(make):
    env = make(robots=None)
    assert sum(size for _, size in env.observation_layout) == env.single_observation_space.shape[0]
