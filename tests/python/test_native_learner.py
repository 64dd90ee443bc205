"""The native learner in trainings: what it writes, what it goes on from, what it refuses."""

import json

import pytest
import torch

import polypod
from common import TINY
from polypod.training import config, run_dir, session
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


def test_auto_is_native_for_perceptrons():
    flat, urma = config.load("flat"), config.load("flat_joints")
    assert flat.with_learner_resolved(None).run.learner == "native"
    assert flat.with_learner_resolved("rsl_rl").run.learner == "rsl_rl"
    assert urma.with_learner_resolved(None).run.learner == "rsl_rl"
    with pytest.raises(polypod.ConfigError, match="perceptrons"):
        urma.with_learner_resolved("native")


def test_what_a_learner_lacks_is_refused():
    flat = config.load("flat")
    alternate = config.parse(flat.as_dict() | {"run": flat.as_dict()["run"] | {"symmetry": "alternate"}}, "test")
    assert alternate.with_learner_resolved("native").native_options()["symmetry"] == "alternate"
    with pytest.raises(polypod.ConfigError, match="alternate"):
        alternate.with_learner_resolved("rsl_rl")
    with pytest.raises(polypod.ConfigError, match="symmetry"):
        config.parse(flat.as_dict() | {"run": flat.as_dict()["run"] | {"symmetry": "both"}}, "test")


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
