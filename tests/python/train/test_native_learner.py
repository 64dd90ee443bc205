"""The native learner in trainings: what it writes, what it goes on from, what it refuses."""

import json

import numpy as np
import pytest
import torch

import polypod
from common import TINY
from polypod.runs import config, run_dir
from polypod.training import session
from polypod.training.workers import Workers
from same_bits import equal


def train(log_dir, learner, **options):
    """Trains without a table of curves; returns the last checkpoint's path."""
    choices = session.Options(log_dir=log_dir, device="cpu", logger="none", learner=learner, **options)
    assert session.train(choices) == 0
    return run_dir.find_checkpoint(log_dir, "latest")


def test_threads_do_not_change_a_checkpoint(tmp_path):
    one, two = (train(tmp_path / str(n), "native", max_iterations=2, threads=n, **TINY) for n in (1, 2))
    assert equal(one, two)


@pytest.mark.parametrize(("first", "second"), [("native", "rsl_rl"), ("rsl_rl", "native")])
def test_a_run_goes_on_with_the_other_learner(first, second, tmp_path):
    half = run_dir.load_checkpoint(train(tmp_path, first, max_iterations=2, **TINY))
    resumed = run_dir.load_checkpoint(train(tmp_path, second, max_iterations=1, resume="latest"))
    assert (half["iter"], resumed["iter"]) == (2, 3)
    steps = [state["optimizer_state_dict"]["state"][0]["step"] for state in (half, resumed)]
    assert steps[1] == 1.5 * steps[0] > 0
    for network in ("actor_state_dict", "critic_state_dict"):
        for name, weights in half[network].items():
            change = (resumed[network][name].float() - weights.float()).norm()
            assert change <= 0.5 * weights.float().norm() + 0.5 or name.endswith("count"), (network, name)


def test_auto_is_native_where_the_native_learner_knows_the_networks():
    flat, urma, critic = (config.load(name) for name in ("flat", "flat_joints", "flat_asymmetric"))
    for known in (flat, urma, critic):
        assert known.with_learner_resolved(None, "cpu").run.learner == "native"
        assert known.with_learner_resolved("rsl_rl", "cpu").run.learner == "rsl_rl"
    assert flat.with_learner_resolved(None, "cuda").run.learner == "native"
    for of_cpu, said in ((urma, "perceptrons alone on a GPU"), (critic, "group policy alone on a GPU")):
        assert of_cpu.with_learner_resolved(None, "cuda").run.learner == "rsl_rl"
        with pytest.raises(polypod.ConfigError, match=said):
            of_cpu.with_learner_resolved("native", "cuda")
    recurrent = config.load(
        "flat",
        [f"actor.{key}" for key in ("class_name=RNNModel", "rnn_type=gru", "rnn_hidden_dim=8", "rnn_num_layers=1")],
    )
    assert recurrent.with_learner_resolved(None).run.learner == "rsl_rl"
    with pytest.raises(polypod.ConfigError, match=r"networks of joints, and \[actor\] is a RNNModel"):
        recurrent.with_learner_resolved("native")


def test_what_a_learner_lacks_is_refused():
    flat = config.load("flat")
    alternate = config.parse(flat.as_dict() | {"run": flat.as_dict()["run"] | {"symmetry": "alternate"}}, "test")
    assert alternate.with_learner_resolved("native").native_options()["symmetry"] == "alternate"
    assert alternate.with_learner_resolved("rsl_rl").run.symmetry == "alternate"
    explores = config.parse(alternate.as_dict() | {"rnd": {"weight": 1.0}}, "test")
    with pytest.raises(polypod.ConfigError, match="alternate"):
        explores.with_learner_resolved("rsl_rl")
    with pytest.raises(polypod.ConfigError, match="symmetry"):
        config.parse(flat.as_dict() | {"run": flat.as_dict()["run"] | {"symmetry": "both"}}, "test")


SHRINKING = [
    *("train.actor.init_std=0.002", "train.algorithm.learning_rate=0.003", "train.algorithm.schedule=fixed"),
    *("train.algorithm.entropy_coef=0", "train.run.num_steps_per_env=8"),
]
"""Deviations so small that the optimiser's steps, of the size of the rate, lead below 0."""


@pytest.mark.parametrize("learner", ["native", "rsl_rl"])
def test_deviations_stay_positive(learner, tmp_path, capsys):
    means = {}
    options = session.Options(
        num_envs=64, robots=["unitree_go2"], max_iterations=4, learner=learner, logger="none", device="cpu", seed=1,
        log_dir=tmp_path, overrides=SHRINKING,
    )  # fmt: skip
    run, runner = session.train_with(
        options, Workers.alone(), lambda done, of: means.update({done: of["Policy/mean_std"]})
    )
    path = run_dir.latest_checkpoint(run)
    state = run_dir.load_checkpoint(path)
    deviations = state["actor_state_dict"]["distribution.std_param"]
    assert (deviations == 1e-6).any()
    assert (deviations >= 1e-6).all()
    # the curve says what the checkpoint holds
    assert means[4] == pytest.approx(float(deviations.mean()), rel=1e-6)
    runner.env.close()

    # a checkpoint from before there was a limit
    state["actor_state_dict"]["distribution.std_param"][:3] = -0.02
    torch.save(state, path)
    manifest = json.loads((run / "manifest.json").read_text())
    del manifest["checkpoints"]
    (run / "manifest.json").write_text(json.dumps(manifest))
    capsys.readouterr()
    assert session.train(session.Options(resume=str(path), max_iterations=1, logger="none", device="cpu")) == 0
    assert "3 of 12 deviations of the actions are out of the range" in capsys.readouterr().out
    after = run_dir.load_checkpoint(run_dir.latest_checkpoint(run))["actor_state_dict"]["distribution.std_param"]
    assert (after >= 1e-6).all()


def test_numbers_that_no_training_leaves_are_refused(make):
    learner = polypod._core.Learner(make().sim, json.dumps(config.load("flat_universal").native_options()))
    weights, first, second, steps = learner.network("actor")
    weights[0][:] = 0.02
    learner.set_network("actor", weights, first, second, steps)
    assert learner.action_std() == pytest.approx(np.full(12, 0.02))
    for wrong in (-0.02, np.nan, np.inf):
        weights[0][:6] = wrong
        with pytest.raises(polypod.ConfigError, match="deviations: number 0 is"):
            learner.set_network("actor", weights, first, second, steps)
    assert learner.action_std() == pytest.approx(np.full(12, 0.02))
    weights[0][:] = 0.0
    learner.set_network("actor", weights, first, second, steps)
    assert (learner.action_std() == np.float32(1e-6)).all()
    second[1][3] = -1.0
    with pytest.raises(polypod.ConfigError, match=r"second: number .* is -1"):
        learner.set_network("actor", weights, first, second, steps)
    mean, variance, count = learner.normalizer("actor")
    variance[2] = -1e-3
    with pytest.raises(polypod.ConfigError, match=r"variance: number 2 is -0\.001"):
        learner.set_normalizer("actor", mean, variance, count)
    returns, (count, mean, variance) = learner.reward_scale()
    with pytest.raises(polypod.ConfigError, match="variance: number 0 is -1"):
        learner.set_reward_scale(returns, count, mean, -variance)


def test_options_and_states_that_do_not_fit_are_refused(make):
    sim = make().sim
    with pytest.raises(ValueError, match="options"):
        polypod._core.Learner(sim, "{}")
    options = config.load("flat").native_options()
    learner = polypod._core.Learner(sim, json.dumps(options))
    weights, first, second, steps = learner.network("actor")
    assert steps == 0
    with pytest.raises(polypod.ConfigError, match="sizes"):
        learner.set_network("actor", weights[:-1], first, second, 0)
    with pytest.raises(ValueError, match="network"):
        learner.network("policy")
    with pytest.raises(polypod.ConfigError, match="learner"):
        learner.collect(make(num_envs=32).sim, 0)
    assert torch.equal(torch.from_numpy(weights[0]), torch.zeros(12))


@pytest.mark.parametrize("learner", ["native", "rsl_rl"])
def test_the_critic_learns_alone_at_first(learner, tmp_path):
    """Two iterations leave the actor as it was; then both learn, from an optimiser that is new."""
    begin = train(tmp_path / "begin", learner, max_iterations=2, **TINY)
    changes = [*TINY["overrides"], "train.algorithm.critic_warmup_iterations=2", "train.algorithm.learning_rate=2e-3"]
    options = {**TINY, "overrides": changes, "init": begin}
    warm = run_dir.load_checkpoint(train(tmp_path / "warm", learner, max_iterations=2, **options))
    before = run_dir.load_checkpoint(begin)
    for name, weights in before["actor_state_dict"].items():
        assert torch.equal(weights, warm["actor_state_dict"][name]) or "normalizer" in name, name
    assert not torch.equal(before["critic_state_dict"]["mlp.0.weight"], warm["critic_state_dict"]["mlp.0.weight"])
    groups = warm["optimizer_state_dict"]["param_groups"]
    assert groups[0]["lr"] == 2e-3, "the actor's divergence changes no rate meanwhile"
    moments = warm["optimizer_state_dict"]["state"]
    number = len([name for name in before["actor_state_dict"] if "normalizer" not in name])
    of_actor = [moments[index] for index in range(number) if index in moments]
    assert not any(state["exp_avg"].any() or state["step"] for state in of_actor)
    assert moments[max(moments)]["step"] > 0
    resumed = run_dir.load_checkpoint(train(tmp_path / "warm", learner, max_iterations=1, resume="latest"))
    assert not torch.equal(before["actor_state_dict"]["mlp.0.weight"], resumed["actor_state_dict"]["mlp.0.weight"])
