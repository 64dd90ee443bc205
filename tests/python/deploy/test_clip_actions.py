"""`[run] clip_actions` limits what robots act with, in training and wherever the policy goes."""

import json

import numpy as np
import onnxruntime
import pytest
import torch

import polypod
from common import SHORT
from polypod import _core, policy
from polypod.export import export_checkpoint
from polypod.rsl_rl import VecEnv
from polypod.runs import config, run_dir
from polypod.training import session
from polypod.training.graph_runner import GraphRunner
from polypod.training.native import NativeRunner
from polypod.training.report import Reporter
from polypod.training.runner import Runner

LIMIT = 0.25
SIZES = ["run.num_envs=8", "run.num_steps_per_env=8", "actor.hidden_dims=[16]", "critic.hidden_dims=[16]"]
ROBOTS = ["spot", "unitree_go2"]


def last_actions(sim) -> np.ndarray:
    """The term `last_action` of the observation, [num_envs, slots]."""
    start = 0
    for term, size in sim.observation_layout:
        if term == "last_action":
            return sim.observation[:, start : start + size]
        start += size
    raise AssertionError("the task has the term")


@pytest.mark.parametrize("kind", [NativeRunner, Runner, GraphRunner])
def test_robots_act_and_see_within_the_limit(kind, tmp_path):
    """The samples hold the actions as they were drawn, which the policy's density is of."""
    learner = "native" if kind is NativeRunner else "rsl_rl"
    seen = {}
    for limit in (None, LIMIT):
        changes = [*SIZES, f"run.learner={learner}", "actor.init_std=1.0"]
        made_of = config.load("flat", changes + ([] if limit is None else [f"run.clip_actions={limit}"]))
        torch.manual_seed(3)
        env = polypod.make(made_of.run.task, 8, robots=ROBOTS, seed=11, threads=1)
        adapter = VecEnv(env, log_extras=False, clip_actions=made_of.run.clip_actions)
        folder = tmp_path / str(limit)
        folder.mkdir()
        run_dir.write_params(folder, env.sim, made_of, None, [], "a test")
        runner = kind(adapter, made_of, folder, "cpu", Reporter(quiet=True))
        runner.alg.train_mode()
        runner._collect(adapter.get_observations())
        seen[limit] = last_actions(env.sim).copy()
        loss = runner._update(adapter.get_observations())
        assert np.isfinite(list(loss.values())).all()
        if kind is Runner and limit is not None:
            assert runner.alg.storage.actions.abs().max() > 2 * LIMIT
    assert np.abs(seen[None]).max() > 2 * LIMIT
    assert np.abs(seen[LIMIT]).max() == np.float32(LIMIT)
    assert (np.abs(seen[LIMIT]) < LIMIT).any()


def train(folder, *overrides, **arguments):
    options = session.Options(
        log_dir=folder,
        device="cpu",
        logger="none",
        seed=5,
        **{"robots": ROBOTS, "max_iterations": 1, "overrides": [*SHORT, *overrides], **arguments},
    )
    assert session.train(options) == 0
    return run_dir.find_checkpoint(folder, "latest")


RECURRENT = ("class_name=RNNModel", "rnn_type=gru", "rnn_hidden_dim=8", "rnn_num_layers=1")


@pytest.mark.parametrize("actor", [(), RECURRENT], ids=["perceptron", "recurrent"])
def test_a_policy_takes_its_limit_along(actor, tmp_path):
    """Into `load`, exported graphs and the loops around them; its weights are the same without."""
    limit = 0.01
    sizes = ["train.run.num_envs=8", "train.run.num_steps_per_env=8", "train.critic.hidden_dims=[16]"]
    sizes += [f"train.actor.{key}" for key in ("hidden_dims=[16]", *actor)]
    path = train(tmp_path, *sizes, f"train.run.clip_actions={limit}")
    manifest = run_dir.read_manifest(path)
    assert manifest["policy"]["clip_actions"] == limit
    loaded = policy.load(path)
    observations = np.random.default_rng(0).normal(0.0, 3.0, (32, 48)).astype(np.float32)
    actions = loaded.act(observations)
    assert np.abs(actions).max() == np.float32(limit)
    free = {key: value for key, value in manifest["policy"].items() if key != "clip_actions"}
    plain = policy.load_network(run_dir.load_checkpoint(path), free)
    unclipped = policy.NetworkPolicy(plain, 48)(observations)
    assert np.abs(unclipped).max() > 2 * limit
    assert np.array_equal(actions, np.clip(unclipped, -np.float32(limit), np.float32(limit)))

    out = tmp_path / "exported"
    assert export_checkpoint(path, out, robots=["spot"]).difference <= 1e-5
    session_of = onnxruntime.InferenceSession(str(out / "policy.onnx"))
    states = {entry.name: np.zeros((1, 32, 8), np.float32) for entry in session_of.get_inputs()[1:]}
    found = session_of.run(["actions"], {"obs": observations, **states})[0]
    assert np.abs(found - actions).max() <= 1e-6
    folded = onnxruntime.InferenceSession(str(out / "policy_spot.onnx"))
    rng = np.random.default_rng(1)
    feed = {
        entry.name: np.zeros([d if isinstance(d, int) else 1 for d in entry.shape], np.float32)
        if entry.name.endswith("_in")
        else rng.normal(0.0, 3.0, [d if isinstance(d, int) else 1 for d in entry.shape]).astype(np.float32)
        for entry in folded.get_inputs()
    }
    targets, acted = folded.run(["joint_pos_target", "actions"], feed)
    assert np.abs(acted).max() == np.float32(limit)
    info = manifest["robot_info"]["spot"]
    moved = np.abs(targets[0] - np.array(info["default_pose"]))
    assert moved.max() <= limit * info["action_scale"] + 1e-6
    again = policy.load(out / "policy.onnx")
    assert np.abs(again.act(observations) - actions).max() <= 1e-6


def test_without_a_limit_nothing_is_written(tmp_path):
    sizes = ["train.run.num_envs=8", "train.run.num_steps_per_env=8", "train.actor.hidden_dims=[16]"]
    manifest = json.loads((train(tmp_path, *sizes).parent / "manifest.json").read_text())
    assert "clip_actions" not in manifest["policy"]
    assert "clip_actions" not in manifest["train_config"]["run"]


@pytest.mark.parametrize("limit", ["0.0", "-1.0", "inf", "nan", "2e6"])
def test_limits_that_are_none_are_refused(limit):
    with pytest.raises(polypod.ConfigError, match=r"\[run\] clip_actions = .* must be above 0"):
        config.load("flat", [f"run.clip_actions={limit}"])


def test_the_native_learner_refuses_them_too():
    env = polypod.make("velocity_flat", 8, robots=["spot"], threads=1)
    options = json.dumps(config.load("flat", SIZES).native_options(env.sim))
    learner = _core.Learner(env.sim, options)
    for limit in (0.0, -1.0, float("nan")):
        with pytest.raises(polypod.ConfigError, match="clip_actions"):
            learner.collect(env.sim, 0, limit)
