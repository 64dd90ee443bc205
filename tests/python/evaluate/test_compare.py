"""Two policies on the same seeds: differences have intervals, and chance makes none better."""

import dataclasses
import json

import numpy as np
import pytest

from common import FLAT_POLICY
from polypod import ConfigError
from polypod.cli import main
from polypod.evaluation import evaluate_checkpoint
from polypod.evaluation.comparison import ALL, BETTER, compare, compare_checkpoints
from polypod.evaluation.results import FIGURES
from polypod.evaluation.seeds import WALKING

ROBOTS = ["unitree_go2", "spot"]
T_975 = 3.182446
"""97.5th percentile of Student's t with 3 degrees of freedom, as statistical tables print it."""
SHORT = {"num_envs": 4, "steps": 40, "robots": ROBOTS, "threads": 1}


@pytest.fixture(scope="module")
def evaluations():
    return [evaluate_checkpoint(FLAT_POLICY, seed=seed, **SHORT) for seed in range(4)]


def changed(evaluation, robot, **figures):
    """The same evaluation, with other figures of a robot."""
    result = evaluation.robots[robot]
    walking = {key: value for key, value in figures.items() if key in WALKING}
    others = {key: value for key, value in figures.items() if key not in WALKING}
    result = dataclasses.replace(result, walking=dataclasses.replace(result.walking, **walking), **others)
    return dataclasses.replace(evaluation, robots=evaluation.robots | {robot: result})


def test_a_policy_does_not_differ_from_itself(tmp_path, capsys):
    line = ["compare", str(FLAT_POLICY), "flat", "--robots", ",".join(ROBOTS), "--num-envs", "4", "--steps", "20"]
    assert main([*line, "--num-seeds", "3", "--json", str(tmp_path / "same.json")]) == 0
    assert "no difference is seen with 3 seeds" in capsys.readouterr().out
    (found,) = json.loads((tmp_path / "same.json").read_text())["comparisons"]
    assert found["seeds"] == [0, 1, 2]
    assert list(found["robots"]) == [*ROBOTS, ALL]
    for figures in found["robots"].values():
        assert {"error_vel_xy", "power", "fall_rate"} <= set(figures)
        for of_figure in figures.values():
            change = of_figure["change"]
            assert (change["mean"], change["low"], change["high"], of_figure["better"]) == (0.0, 0.0, 0.0, None)


def test_differences_are_those_of_a_paired_t_test(evaluations):
    rng = np.random.default_rng(0)
    worse = rng.normal(0.05, 0.01, len(evaluations))
    other = [
        changed(each, "spot", error_vel_xy=each.robots["spot"].error_vel_xy + more)
        for each, more in zip(evaluations, worse, strict=True)
    ]
    found = compare(evaluations, other)
    ours = [each.robots["spot"].error_vel_xy for each in evaluations]
    theirs = [each.robots["spot"].error_vel_xy for each in other]
    steps = np.subtract(theirs, ours)
    reach = T_975 * np.std(steps, ddof=1) / np.sqrt(4)
    figure = found.robots["spot"]["error_vel_xy"]
    assert figure.change.low == pytest.approx(np.mean(steps) - reach, rel=1e-5)
    assert figure.change.high == pytest.approx(np.mean(steps) + reach, rel=1e-5)
    assert (figure.first, figure.second) == (pytest.approx(np.mean(ours)), pytest.approx(np.mean(theirs)))
    # less of an error is better: the first policy
    assert figure.better == "first"
    assert found.robots["unitree_go2"]["error_vel_xy"].better is None
    assert found.robots[ALL]["error_vel_xy"].change.mean == pytest.approx(np.mean(worse) / 2)


@pytest.mark.parametrize(("figure", "more"), [("turn_reached", 0.1), ("tracking_reward", 0.1), ("power", -1.0)])
def test_each_figure_has_its_better_side(evaluations, figure, more):
    base = [changed(each, "spot", turn_reached=0.8) for each in evaluations]

    def value(each):
        result = each.robots["spot"]
        return getattr(result.walking if figure in WALKING else result, figure)

    # not the same at all seeds: an interval of no width would show nothing
    steps = more * np.array([1.0, 1.1, 0.9, 1.0])
    other = [changed(each, "spot", **{figure: value(each) + step}) for each, step in zip(base, steps, strict=True)]
    assert compare(base, other).robots["spot"][figure].better == "second"
    assert compare(other, base).robots["spot"][figure].better == "first"


def test_small_and_mixed_differences_are_none(evaluations):
    steps = [0.1, -0.1, 0.05, -0.06]
    other = [
        changed(each, "spot", power=each.robots["spot"].power + step)
        for each, step in zip(evaluations, steps, strict=True)
    ]
    assert compare(evaluations, other).robots["spot"]["power"].better is None


def test_figures_are_those_of_an_evaluation():
    assert set(BETTER) <= {*FIGURES, *WALKING}
    # errors of a standing robot are no merit of a policy
    assert {*FIGURES, *WALKING} - set(BETTER) == {"still_error_vel_xy", "still_error_vel_yaw"}


def test_unlike_evaluations_are_refused(evaluations):
    with pytest.raises(ConfigError, match="2 seeds have no interval; take 3 at least"):
        compare(evaluations[:2], evaluations[:2])
    with pytest.raises(ConfigError, match="differ in seed: 0 and 1"):
        compare(evaluations[:3], evaluations[1:])
    other = [dataclasses.replace(each, robots={"spot": each.robots["spot"]}) for each in evaluations]
    with pytest.raises(ConfigError, match="differ in robots: unitree_go2, spot and spot"):
        compare(evaluations, other)
    with pytest.raises(ConfigError, match="differ in commands"):
        compare(evaluations, [dataclasses.replace(each, commands="task") for each in evaluations])


def test_several_episodes_take_several_seeds():
    (found,) = compare_checkpoints([FLAT_POLICY, FLAT_POLICY], 3, seed=5, episodes=2, **(SHORT | {"steps": 5}))
    assert [each.seed for each in found.first] == [5, 7, 9]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (["flat"], "two policies or more, not 1"),
        (["flat", "flat", "--num-seeds", "2"], "--num-seeds 2 must be from 3"),
        (["flat", "flat", "--robots", "unitree_g1", "--num-seeds", "3"], "unitree_g1"),
    ],
)
def test_bad_comparisons_are_refused(line, said, capsys):
    assert main(["compare", *line, "--num-envs", "2", "--steps", "2"]) == 2
    assert said in capsys.readouterr().err
