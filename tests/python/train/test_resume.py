"""Training that was interrupted and resumed equals training that never stopped, bit for bit."""

import pytest
import torch

import polypod
import polypod.evaluation
from common import TINY
from polypod.runs import run_dir
from polypod.training import session


def train(log_dir, **options):
    """Trains without the evaluation's table in the output; returns the last checkpoint's path."""
    assert session.train(session.Options(log_dir=log_dir, device="cpu", logger="none", **options)) == 0
    return run_dir.find_checkpoint(log_dir, "latest")


def differences(first, second, where=""):
    """The places where two nested states are not equal to the last bit."""
    if isinstance(first, dict) and isinstance(second, dict) and first.keys() == second.keys():
        return [place for key in first for place in differences(first[key], second[key], f"{where}/{key}")]
    if isinstance(first, list) and isinstance(second, list) and len(first) == len(second):
        pairs = enumerate(zip(first, second, strict=True))
        return [place for i, (a, b) in pairs for place in differences(a, b, f"{where}/{i}")]
    if isinstance(first, torch.Tensor) and isinstance(second, torch.Tensor):
        return [] if torch.equal(first, second) else [where]
    return [] if first == second else [where]


def test_four_iterations_equal_two_and_two(tmp_path):
    whole = train(tmp_path / "whole", max_iterations=4, **TINY)
    half = train(tmp_path / "halves", max_iterations=2, **TINY)
    resumed = train(tmp_path / "halves", max_iterations=2, resume=str(half))
    assert (half.name, resumed.name) == ("model_2.pt", "model_4.pt")
    assert half.parent == resumed.parent
    expected, found = run_dir.load_checkpoint(whole), run_dir.load_checkpoint(resumed)
    for state in (expected, found):
        del state["infos"]["logger"]["time"]  # the wall clock's
    assert differences(expected, found) == []
    assert differences(expected, run_dir.load_checkpoint(half)) != []


def on(engine, options):
    """The options with an engine."""
    return {**options, "overrides": [*options["overrides"], f"physics.engine={engine}"]}


@pytest.mark.cuda
def test_a_run_goes_on_with_the_engine_that_has_the_same_bits(tmp_path):
    described = polypod._core.cuda()
    if described.startswith("not used: "):
        pytest.skip(described)
    whole = train(tmp_path / "whole", max_iterations=2, **TINY)
    half = train(tmp_path / "halves", max_iterations=1, **on("cuda", TINY))
    resumed = train(tmp_path / "halves", max_iterations=1, resume=str(half), overrides=["physics.engine=articulated"])
    expected, found = (run_dir.load_checkpoint(path)["actor_state_dict"] for path in (whole, resumed))
    assert differences(expected, found) == []


def test_a_resumed_run_may_name_its_engine_alone(tmp_path):
    half = train(tmp_path, max_iterations=1, **TINY)
    with pytest.raises(polypod.ConfigError, match="leave out --set"):
        train(tmp_path, max_iterations=1, resume=str(half), overrides=["sim.episode_length_s=2.0"])
    resumed = train(tmp_path, max_iterations=1, resume=str(half), overrides=["physics.engine=articulated"])
    assert resumed.name == "model_2.pt"


def test_the_same_seed_trains_the_same_policy(trained_run, tmp_path):
    first = run_dir.load_checkpoint(trained_run)
    second = run_dir.load_checkpoint(train(tmp_path, max_iterations=1, **TINY))
    assert differences(first["actor_state_dict"], second["actor_state_dict"]) == []


def test_evaluation_is_deterministic(trained_run):
    first, second = (polypod.evaluation.evaluate_checkpoint(trained_run, num_envs=32, steps=40) for _ in range(2))
    assert first == second


def test_a_run_may_begin_with_another_runs_networks(trained_run, tmp_path):
    first = trained_run
    # a learning rate of zero would leave them as they are; one iteration leaves them near
    second = train(tmp_path / "second", max_iterations=1, init=first, **{**TINY, "seed": 6})
    fresh = train(tmp_path / "fresh", max_iterations=1, **{**TINY, "seed": 6})
    weights = [run_dir.load_checkpoint(path)["actor_state_dict"]["mlp.0.weight"] for path in (first, second, fresh)]
    assert (weights[0] - weights[1]).abs().mean() < 0.1 * (weights[0] - weights[2]).abs().mean()
    assert second.parent != first.parent
    assert second.name == "model_1.pt"


def test_networks_that_do_not_fit_are_refused(trained_run, tmp_path):
    other = {**TINY, "task": "velocity_flat_universal"}
    with pytest.raises(polypod.ConfigError, match="--init"):
        train(tmp_path, max_iterations=1, init=trained_run, **other)
    with pytest.raises(polypod.ConfigError, match="--init"):
        train(tmp_path, resume=str(trained_run), init=trained_run)
