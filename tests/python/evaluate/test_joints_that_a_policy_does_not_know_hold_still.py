"""A perceptron acts for robots with more joints than it knows: these hold their default pose."""

import numpy as np
import torch

from polypod import _core, bundled, policy
from polypod.evaluation import evaluate_checkpoint
from polypod.networks.transfer import numbers_of

TWO_LEGS = bundled.checkpoint("two_legs")


def simulation(robot, slots=()):
    return _core.VecSim("velocity_flat_two_legs_play", 16, robots=[robot], threads=1, slots=list(slots))


def test_legs_move_as_if_there_were_no_arms():
    whole = policy.load(TWO_LEGS, robots=["unitree_g1"])
    # its joints alone
    known = policy.load(TWO_LEGS, robots=["berkeley_humanoid"])
    assert known.manifest["canonical_joint_names"] != whole.manifest["canonical_joint_names"]
    sim = simulation("unitree_g1", known.joint_names)
    assert sim.canonical_joint_names == whole.joint_names
    place = {number: column for column, number in enumerate(numbers_of(sim, ["policy"]))}
    columns = [place[number] for number in numbers_of(sim, ["policy"], known.joint_names)]
    random = np.random.default_rng(0)
    observations = random.standard_normal((16, sim.num_obs)).astype(np.float32)
    actions = whole.act(observations)
    legs = [whole.joint_names.index(slot) for slot in known.joint_names]
    expected = known.act(observations[:, columns])
    np.testing.assert_allclose(actions[:, legs], expected, rtol=0.0, atol=1e-5)
    assert np.abs(expected).max() > 0.5
    above = np.delete(actions, legs, axis=1)
    assert above.shape[1] == 17
    assert not above.any()


def test_a_robot_whose_joints_it_knows_gets_the_network_as_it_is():
    state = torch.load(TWO_LEGS, weights_only=True)["actor_state_dict"]
    loaded = policy.load(TWO_LEGS, robots=["berkeley_humanoid"]).network.state_dict()
    assert loaded.keys() == state.keys()
    assert all(torch.equal(loaded[key], value.to(loaded[key].dtype)) for key, value in state.items())


def test_commands_take_robots_with_such_joints():
    robots = ["unitree_h1", "berkeley_humanoid"]
    for given in (robots, None):
        found = evaluate_checkpoint(TWO_LEGS, given, num_envs=10, steps=25, threads=1)
        assert set(robots) <= set(found.robots)
