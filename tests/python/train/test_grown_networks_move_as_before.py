"""A perceptron that is grown for other robots moves the joints that both have as before."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from polypod import _core
from polypod.networks.policies import NetworkPolicy, load_network
from polypod.networks.transfer import numbers_of
from polypod.runs import config, run_dir
from polypod.training import growth

GROUPS = {"actor": ["policy"], "critic": ["policy", "critic"]}
TASK, SETTINGS = "velocity_flat_teacher", "adapt_separate"
TASKS = [TASK, "velocity_flat_any_legged"]
"""The second one remembers five control steps, and describes each joint."""


def simulated(robot: str, task: str = TASK) -> _core.VecSim:
    return _core.VecSim(task, 16, robots=[robot], threads=1, seed=1)


def trained(folder: Path, robot: str, change=lambda manifest: None, task: str = TASK) -> Path:
    """A checkpoint with random networks for a robot, as a run leaves it."""
    folder.mkdir()
    settings, sim = config.load(SETTINGS), simulated(robot, task)
    run_dir.write_params(folder, sim, settings, [robot], [], "polypod train")
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    torch.manual_seed(3)
    state = {"iter": 7, "infos": {}}
    for network, outputs in (("actor", sim.num_actions), ("critic", 1)):
        width = len(numbers_of(sim, GROUPS[network]))
        layers = torch.nn.Sequential(
            torch.nn.Linear(width, 256),
            torch.nn.ELU(),
            torch.nn.Linear(256, 128),
            torch.nn.ELU(),
            torch.nn.Linear(128, 128),
            torch.nn.ELU(),
            torch.nn.Linear(128, outputs),
        )
        weights = {f"mlp.{key}": value for key, value in layers.state_dict().items()}
        variance = torch.rand(1, width) + 0.5
        weights |= {"obs_normalizer._mean": torch.randn(1, width), "obs_normalizer._var": variance}
        weights |= {"obs_normalizer._std": variance.sqrt(), "obs_normalizer.count": torch.tensor(900_000)}
        if network == "actor":
            weights["distribution.std_param"] = torch.full((outputs,), 0.1)
        state[f"{network}_state_dict"] = weights
    torch.save(state, folder / "model_7.pt")
    return folder / "model_7.pt"


def outputs(weights, seen) -> np.ndarray:
    """A perceptron in float32, as the networks of a training compute it."""
    x = (torch.from_numpy(seen) - weights["obs_normalizer._mean"]) / (weights["obs_normalizer._std"] + 1e-2)
    for layer in (0, 2, 4, 6):
        x = x @ weights[f"mlp.{layer}.weight"].T + weights[f"mlp.{layer}.bias"]
        x = x if layer == 6 else torch.nn.functional.elu(x)
    return x.numpy()


@pytest.mark.parametrize("task", TASKS)
def test_the_same_robot_has_the_same_networks_to_the_bit(tmp_path, task):
    checkpoint = trained(tmp_path / "run", "unitree_g1", task=task)
    grown = growth.grow(checkpoint, simulated("unitree_g1", task), ["unitree_g1"], config.load(SETTINGS))
    old = run_dir.load_checkpoint(checkpoint)
    for network in ("actor_state_dict", "critic_state_dict"):
        assert grown[network].keys() == old[network].keys()
        for key in old[network].keys() - {"distribution.std_param"}:
            assert torch.equal(grown[network][key], old[network][key]), key
    # it explores
    assert torch.equal(grown["actor_state_dict"]["distribution.std_param"], torch.full((29,), growth.LEAST_STD))


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(("old", "new"), [("berkeley_humanoid", "unitree_g1"), ("unitree_g1", "berkeley_humanoid")])
def test_shared_joints_move_as_before_and_new_ones_are_still(tmp_path, old, new, task):
    """Numbers that one robot alone has are at their mean, and add nothing."""
    # scales are said to be equal, so that actions are equal numbers
    checkpoint = trained(tmp_path / "run", old, lambda manifest: manifest.pop("robot_info"), task)
    sims = {"old": simulated(old, task), "new": simulated(new, task)}
    state = run_dir.load_checkpoint(checkpoint)
    grown = growth.grow(checkpoint, sims["new"], [new], config.load(SETTINGS))
    rows = np.random.default_rng(0)
    for network, groups in GROUPS.items():
        numbers = {which: numbers_of(sim, groups) for which, sim in sims.items()}
        weights = {"old": state[f"{network}_state_dict"], "new": grown[f"{network}_state_dict"]}
        shared = set(numbers["old"]) & set(numbers["new"])
        values = {number: rows.standard_normal() for number in shared}
        found = {}
        for which, of in numbers.items():
            mean = weights[which]["obs_normalizer._mean"][0].numpy()
            told = [values.get(number, mean[column]) for column, number in enumerate(of)]
            found[which] = outputs(weights[which], np.array([told], dtype=np.float32))[0]
        if network == "critic":
            assert found["new"] == pytest.approx(found["old"], rel=1e-4, abs=1e-5)
            continue
        before = dict(zip(sims["old"].canonical_joint_names, found["old"], strict=True))
        for slot, action in zip(sims["new"].canonical_joint_names, found["new"], strict=True):
            assert action == pytest.approx(before.get(slot, 0.0), rel=1e-4, abs=1e-5), slot
        assert len(set(before) & set(sims["new"].canonical_joint_names)) == 12


def test_new_numbers_deviate_like_those_of_their_term(tmp_path):
    """Joints that stand still after a reset do not have deviations of 0."""
    checkpoint, sim = trained(tmp_path / "run", "berkeley_humanoid"), simulated("unitree_g1")
    grown = growth.grow(checkpoint, sim, ["unitree_g1"], config.load(SETTINGS))["actor_state_dict"]
    deviations = grown["obs_normalizer._std"][0]
    assert torch.allclose(grown["obs_normalizer._var"][0], deviations**2)
    known = set(numbers_of(simulated("berkeley_humanoid"), ["policy"]))
    for term in ("joint_pos_rel", "joint_vel_rel", "last_action"):
        columns = {True: [], False: []}
        for column, number in enumerate(numbers_of(sim, ["policy"])):
            if number[1] == term:
                columns[number in known].append(column)
        assert len(columns[False]) == 17
        mean = float(deviations[columns[True]].mean())
        assert deviations[columns[False]].tolist() == pytest.approx([mean] * 17)


def test_actions_keep_their_size_in_rad(tmp_path):
    """Berkeley Humanoid's network said to have twice the action scale of the robot."""
    double = {"berkeley_humanoid": {"action_scale": 1.0}}
    checkpoint = trained(tmp_path / "run", "berkeley_humanoid", lambda manifest: manifest.update(robot_info=double))
    sim = simulated("berkeley_humanoid")
    own = json.loads(sim.robot_info())["berkeley_humanoid"]["action_scale"]
    grown = growth.grow(checkpoint, sim, ["berkeley_humanoid"], config.load(SETTINGS))["actor_state_dict"]
    old = run_dir.load_checkpoint(checkpoint)["actor_state_dict"]
    seen = np.random.default_rng(0).standard_normal((1, sim.num_obs)).astype(np.float32)
    told = seen.copy()
    told[:, [number[1] == "last_action" for number in numbers_of(sim, ["policy"])]] *= own / 1.0
    # the normaliser adds 0.01 to deviations of any scale
    assert outputs(grown, seen) * own == pytest.approx(outputs(old, told) * 1.0, rel=0.05, abs=0.01)


@pytest.mark.parametrize("task", TASKS)
def test_robots_of_the_training_need_not_be_here(tmp_path, task):
    """Their configs are files of another machine, and changes name them."""
    away = {"robot_sources": ["/elsewhere/walker.toml"], "overrides": ["robot_overrides.walker.reward_set=two_legs"]}
    here = trained(tmp_path / "here", "unitree_g1", task=task)
    elsewhere = trained(tmp_path / "elsewhere", "unitree_g1", lambda manifest: manifest.update(away), task)
    settings = config.load(SETTINGS)
    states = [growth.grow(file, simulated("bolt", task), ["bolt"], settings) for file in (here, elsewhere)]
    for network in ("actor_state_dict", "critic_state_dict"):
        assert all(torch.equal(states[0][network][key], states[1][network][key]) for key in states[0][network])


def test_a_network_of_another_kind_is_named(tmp_path):
    settings = config.load(SETTINGS)
    other = {"task": "velocity_flat_any_legged"}
    checkpoint = trained(tmp_path / "other", "unitree_g1", lambda manifest: manifest.update(other))
    with pytest.raises(_core.ConfigError, match=r"its actor is no perceptron of .* velocity_flat_any_legged"):
        growth.grow(checkpoint, simulated("bolt"), ["bolt"], settings)
    checkpoint = trained(tmp_path / "broken", "unitree_g1")
    state = torch.load(checkpoint, weights_only=True)
    del state["actor_state_dict"]["distribution.std_param"]
    torch.save(state, checkpoint)
    with pytest.raises(_core.ConfigError, match="its actor is no perceptron"):
        growth.grow(checkpoint, simulated("bolt"), ["bolt"], settings)


def test_a_grown_policy_acts(tmp_path):
    """`load_network` reads it with the manifest of the new robot."""
    checkpoint, sim = trained(tmp_path / "run", "berkeley_humanoid"), simulated("unitree_g1")
    grown = growth.grow(checkpoint, sim, ["unitree_g1"], config.load(SETTINGS))
    run_dir.write_params(tmp_path, sim, config.load(SETTINGS), ["unitree_g1"], [], "polypod adapt")
    policy = json.loads((tmp_path / "manifest.json").read_text())["policy"]
    sim.reset()
    actions = NetworkPolicy(load_network(grown, policy), sim.num_obs)(np.asarray(sim.observation))
    legs = [slot.split("_", 1)[1].startswith(("HIP", "KNEE", "ANKLE")) for slot in sim.canonical_joint_names]
    assert np.abs(actions[:, legs]).min() > 0.0
    assert np.abs(actions[:, np.logical_not(legs)]).max() == 0.0
