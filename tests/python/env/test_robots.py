"""Every env holds one robot, robots hold contiguous and fair shares, and joints map one to one."""

import json

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


def test_links_and_contact_bodies_have_names(make):
    """As many as there are rows of poses and forces, in their order.

    Feet that are fixed to shanks are bodies.
    """
    env = make(robots=["unitree_go2", "anymal_d"])
    for robot in env.robots:
        links, bodies = env.sim.link_names(robot), env.sim.contact_body_names(robot)
        assert len(links) == env.sim.link_pose(robot)[0].shape[1]
        assert len(bodies) == env.sim.contact_forces(robot).shape[1]
        alone = polypod.Simulation(robot)
        assert links == alone.link_names
        shapes = json.loads(env.sim.robot_shapes())[robot]
        assert bodies == [body["name"] for body in shapes["bodies"]]
    assert env.sim.link_names("unitree_go2")[0] == "base"
    assert "FL_foot" in env.sim.contact_body_names("unitree_go2")
    assert "FL_foot" not in env.sim.link_names("unitree_go2")
    with pytest.raises(polypod.UnknownNameError, match="unitree_go2"):
        env.sim.link_names("spot")
    with pytest.raises(polypod.UnknownNameError, match="unitree_go2"):
        env.sim.contact_body_names("spot")
