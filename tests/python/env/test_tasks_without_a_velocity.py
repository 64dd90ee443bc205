"""A task that commands no velocity is evaluated; what needs a velocity refuses it by name."""

import json

import numpy as np
import pytest

import polypod
from polypod import _core
from polypod.evaluation import evaluate


def still(observation):
    return np.zeros((len(observation), 12), dtype=np.float32)


def test_it_is_evaluated_with_its_own_commands():
    found = evaluate(still, "getup_flat", ["unitree_go1"], num_envs=2, steps=5)
    assert found.commands == "task"
    with pytest.raises(polypod.ConfigError, match=r"Getup-Flat-Play-v0: grid: .* \(`base_velocity`\)"):
        evaluate(still, "getup_flat", ["unitree_go1"], num_envs=2, steps=5, grid=(1, 1, 1))


def test_setting_a_velocity_is_refused_by_name():
    sim = _core.VecSim("getup_flat", 2, robots=["unitree_go1"], threads=1)
    with pytest.raises(
        polypod.ConfigError, match=r"Getup-Flat-v0 gives none, and no velocity command \(`base_velocity`\)"
    ):
        sim.set_command(np.zeros((2, 3), dtype=np.float32))
    sim.set_command(None)
    assert list(sim.command_ranges()["unitree_go1"].values()) == [[0.0, 0.0]] * 3


def test_terms_of_commands_are_mirrored():
    """A mirror changes the signs of headings and rolls, and swaps the clocks of feet."""
    changes = [
        "commands.pose={roll=[-0.3, 0.3]}",
        "commands.heading={}",
        "commands.gait={frequency=[2.0, 2.0]}",
        'observations.policy=[{term="pose_commands"},{term="heading_commands"},{term="clock_inputs"}]',
    ]
    sim = _core.VecSim("velocity_flat", 1, robots=["unitree_go1"], threads=1, overrides=changes)
    kinds = {term["term"]: term["kind"] for term in json.loads(sim.observation_terms())}
    assert kinds == {"pose_commands": "vector", "heading_commands": "odd", "clock_inputs": "per_foot"}
    index, sign = zip(*sim.observation_mirror("unitree_go1"), strict=True)
    assert sign == (1, -1, 1, -1, 1, 1, 1, 1)
    assert index == (0, 1, 2, 3, 6, 7, 4, 5)
