"""The native learner computes what rsl_rl's PPO computes.

Values, returns, advantages, losses, gradients, weights.
"""

import dataclasses

import numpy as np
import pytest
import torch

import polypod
from common import ROOT
from polypod.networks import UrmaModel
from polypod.rsl_rl import VecEnv
from polypod.runs import config
from polypod.runs.schema import URMA
from polypod.training.advantages import normalize_per_robot
from polypod.training.native import NETWORKS, NativeRunner
from polypod.training.report import Reporter
from polypod.training.runner import Runner

ENVS, STEPS, UPDATES = 64, 24, 3
OF_BATCHES = ("order", "places", "batch_sizes")
TOLERANCE = 1e-4
"""Relative to the norm of what is compared."""

JOINTS = {"class_name": URMA, "joint_dim": 16, "num_heads": 12, "hidden_dims": [40, 24], "init_std": 1.0}
GROUPS = {"critic": ["policy", "critic"]}

VARIANTS = {
    "universal": {},
    "one_mini_batch": {"algorithm": {"num_learning_epochs": 1, "num_mini_batches": 1}},
    "surrogate_alone": {"algorithm": {"value_loss_coef": 0.0, "entropy_coef": 0.0}},
    "entropy": {"algorithm": {"entropy_coef": 0.5}},
    "free_value_loss": {"algorithm": {"use_clipped_value_loss": False}},
    "narrow_clip": {"algorithm": {"clip_param": 0.01, "schedule": "fixed"}},
    "small_gradients": {"algorithm": {"max_grad_norm": 0.01}},
    "adaptive_rate": {"algorithm": {"desired_kl": 1e-4}},
    "advantages_of_all": {"run": {"normalize_advantage_per_robot": False, "normalize_reward_per_robot": False}},
    "advantages_of_mini_batches": {
        "run": {"normalize_advantage_per_robot": False},
        "algorithm": {"normalize_advantage_per_mini_batch": True},
    },
    # few units: each number that enters one is a chance that roundings put it on the other side of
    # 0
    "relu": {"actor": {"activation": "relu", "hidden_dims": [10, 6]}},
    "two_widths": {"actor": {"hidden_dims": [40, 24]}},
    "one_hidden_layer": {"critic": {"hidden_dims": [7]}},
    "tanh": {"actor": {"activation": "tanh"}, "critic": {"activation": "tanh", "obs_normalization": False}},
    "mirror_images": {"run": {"symmetry": True}},
    "mirror_loss": {"run": {"symmetry": True}, "algorithm": {"mirror_loss_coef": 5.0}},
    # bodies with different joints in one batch, whose policies have no joints in common but for two
    # of the bodies
    "masked": {"actor": {"init_std": 1.5}},
    "masked_adaptive_rate": {"actor": {"init_std": 1.5}, "algorithm": {"desired_kl": 1e-4}},
    "masked_mirror_images": {"actor": {"init_std": 1.5}, "run": {"symmetry": True}},
    "masked_mirror_loss": {
        "actor": {"init_std": 1.5},
        "run": {"symmetry": True},
        "algorithm": {"mirror_loss_coef": 5.0},
    },
    "masked_entropy": {"actor": {"init_std": 1.5}, "algorithm": {"entropy_coef": 0.5}},
    # networks of joints, which see the joints of a body alone and learn one deviation per joint
    "joints": {"actor": JOINTS},
    "joints_without_statistics": {"actor": {**JOINTS, "obs_normalization": False, "joint_dim": 24, "num_heads": 5}},
    "joints_critic": {"actor": JOINTS, "critic": {**JOINTS, "activation": "tanh"}},
    "joints_mirror_images": {"actor": JOINTS, "run": {"symmetry": True}},
    "joints_mirror_loss": {"actor": JOINTS, "run": {"symmetry": True}, "algorithm": {"mirror_loss_coef": 5.0}},
    "masked_joints_mirror_loss": {
        "actor": {**JOINTS, "init_std": 1.5},
        "run": {"symmetry": True},
        "algorithm": {"mirror_loss_coef": 5.0},
    },
    "masked_joints": {"actor": {**JOINTS, "init_std": 1.5}, "critic": {**JOINTS, "joint_dim": 8}},
    "masked_joints_entropy": {"actor": {**JOINTS, "init_std": 1.5}, "algorithm": {"entropy_coef": 0.5}},
    "joints_of_legs": {"actor": {**JOINTS, "leg_heads": 7}, "critic": {**JOINTS, "leg_heads": 12}},
    "masked_joints_of_legs": {"actor": {**JOINTS, "init_std": 1.5, "leg_heads": 7}},
    # a critic that sees more than the policy, which remembers
    "groups": {"run": {"task": "velocity_flat_any_legged"}, "actor": JOINTS, "obs_groups": GROUPS},
    "masked_groups": {"run": {"task": "velocity_flat_any_legged"}, "actor": JOINTS, "obs_groups": GROUPS},
    "groups_of_perceptrons": {"run": {"task": "velocity_flat_asymmetric"}, "obs_groups": GROUPS},
}
BODIES = ROOT / "tests/data/bodies/configs/robots"
ROBOTS = {
    False: ["unitree_a1", "unitree_b2", "unitree_go2"],
    True: ["unitree_go2", *(str(BODIES / f"small_{kind}.toml") for kind in ("biped", "humanoid", "hexapod"))],
}
"""By whether robots lack some of the actions."""


def train_config(changes, masked=False):
    base = config.load("flat_universal").as_dict()
    if masked:
        base["run"]["task"] = "velocity_flat"
    if changes.get("actor", {}).get("class_name") == URMA:
        base["run"]["task"] = "velocity_flat_joints"
    base["run"] |= {"num_envs": ENVS, "num_steps_per_env": STEPS, "learner": "native"}
    base["actor"]["init_std"] = 2.0  # robots fall within a second
    # each sample and epoch is a chance that roundings put a ratio on the other side of the clip's
    # edge
    base["algorithm"]["num_learning_epochs"] = 2
    for section, values in changes.items():
        base[section] |= {key: value for key, value in values.items() if section != "critic" or key != "init_std"}
    return config.parse(base, "test")


def runners(train_config, tmp_path, masked):
    """The native learner and rsl_rl with the same networks, each with a separate env."""
    made = []
    for kind in ("native", "rsl_rl"):
        torch.manual_seed(3)
        env = polypod.make(
            train_config.run.task,
            ENVS,
            robots=ROBOTS[masked],
            seed=11,
            overrides=["sim.episode_length_s=0.8"],
        )
        adapter, folder = VecEnv(env, log_extras=False), tmp_path / kind
        folder.mkdir()
        if kind == "native":
            made.append(NativeRunner(adapter, train_config, folder, "cpu", Reporter()))
        else:
            made.append(Runner(adapter, train_config, folder, "cpu", Reporter()))
    return made


def assert_near(found, expected, what, tolerance=TOLERANCE):
    found, expected = (np.asarray(x, dtype=np.float64).ravel() for x in (found, expected))
    error = np.linalg.norm(found - expected)
    assert error <= tolerance * np.linalg.norm(expected) + 1e-7, f"{what}: {error} of {np.linalg.norm(expected)}"


def of_signals(gradients):
    """Where gradients are more than roundings, which Adam brings to the size of the others.

    Numbers that a robot's joints share differ by roundings from their mean, and so do the weights
    of such differences.
    """
    return gradients > 1e-3 * gradients.max()


def store(reference, samples, last_observations):
    """Puts the native learner's samples into rsl_rl's storage as rsl_rl does.

    Then estimates advantages.
    """
    alg = reference.alg
    shape = {
        name: torch.from_numpy(array).view(STEPS, ENVS, -1) for name, array in samples.items() if name not in OF_BATCHES
    }
    groups = reference.env.unwrapped.sim.observation_groups
    last = reference.env.get_observations()
    for group in groups:
        last[group] = torch.from_numpy(last_observations[group].copy())
    for step in range(STEPS):
        observations = last.clone()
        for group, columns in groups.items():
            observations[group] = shape["observations"][step][:, slice(*columns)]
        alg.act(observations)
        assert_near(alg.transition.values, shape["values"][step], "values")
        assert_near(alg.transition.distribution_params[0], shape["means"][step], "means")
        actions = shape["actions"][step]
        log_probs = alg.actor.get_output_log_prob(actions)
        assert_near(log_probs, shape["log_probs"][step], "log-densities")
        alg.transition.actions, alg.transition.actions_log_prob = actions, log_probs
        rewards, ends = shape["rewards"][step].squeeze(1), shape["ends"][step].squeeze(1)
        dones = (ends > 0).long()
        if reference.reward_scale is not None:
            rewards = reference.reward_scale(rewards, dones)
        alg.process_env_step(last, rewards, dones, {"time_outs": (ends == 2).float()})
    alg.compute_returns(last)
    if reference.cfg["normalize_advantage_per_robot"]:
        normalize_per_robot(alg.storage.advantages, reference.blocks)
    assert_near(alg.storage.returns, shape["returns"], "returns")
    if not reference.cfg["algorithm"]["normalize_advantage_per_mini_batch"]:
        assert_near(alg.storage.advantages, shape["advantages"], "advantages")
    return {int(end): int((shape["ends"] == end).sum()) for end in (0, 1, 2)}


@pytest.mark.parametrize("variant", VARIANTS)
def test_updates_are_equal(variant, tmp_path, monkeypatch):
    masked = variant.startswith("masked")
    native, reference = runners(train_config(VARIANTS[variant], masked), tmp_path, masked)
    assert native.env.unwrapped.sim.action_mask.all() != masked
    sim, ends = native.env.unwrapped.sim, {0: 0, 1: 0, 2: 0}
    for update in range(UPDATES):
        native.current_learning_iteration = update
        native._collect(native.env.get_observations())
        samples = native._learner.rollout(sim)
        with torch.inference_mode():
            last = {group: sim.observation_of(group) for group in sim.observation_groups}
            for end, count in store(reference, samples, last).items():
                ends[end] += count
        order = torch.from_numpy(samples["order"].astype(np.int64))
        assert sorted(order.tolist()) == list(range(ENVS * STEPS))
        monkeypatch.setattr(torch, "randperm", lambda count, order=order, **_: order[:count])
        expected = reference.alg.update()
        found = native._update(native.env.get_observations())
        for name in ("value", "surrogate", "entropy"):
            # a surrogate loss is a sum of terms that cancel
            allowed = TOLERANCE * (abs(expected[name]) + (name == "surrogate"))
            assert abs(found[name] - expected[name]) <= allowed, (name, found, expected)
        assert native.alg.learning_rate == pytest.approx(reference.alg.learning_rate, rel=1e-12)
        native._give_to_rsl_rl()
        for network in NETWORKS:
            mine, theirs = (getattr(runner.alg, network) for runner in (native, reference))
            for (name, parameter), other in zip(mine.named_parameters(), theirs.parameters(), strict=True):
                place = f"{network} {name} after update {update}"
                state, expected_state = native.alg.optimizer.state[parameter], reference.alg.optimizer.state[other]
                is_known = of_signals(expected_state["exp_avg_sq"].sqrt()) if isinstance(mine, UrmaModel) else ...
                if name == "mlp.attention.bias":
                    continue  # a shift of all joints' attention changes no share: its derivatives are roundings
                assert_near(parameter.detach()[is_known], other.detach()[is_known], place)
                # observations that describe joints have three times the numbers, so sums are longer
                tolerance = TOLERANCE * (3 if isinstance(native.alg.actor, UrmaModel) else 1)
                gradients = f"gradients of {place}"
                assert_near(state["exp_avg"], expected_state["exp_avg"], gradients, tolerance)
                assert_near(state["exp_avg_sq"], expected_state["exp_avg_sq"], f"squared gradients of {place}")
                assert state["step"] == expected_state["step"]
            for name, buffer in mine.named_buffers():
                assert_near(buffer, theirs.get_buffer(name), f"{network} {name}")
    assert min(ends.values()) > 0, f"the rollouts hold no end of some kind: {ends}"


def test_variants_are_configs():
    for name, changes in VARIANTS.items():
        assert dataclasses.is_dataclass(train_config(changes)), name
