"""Trainings end when their robots walk.

Measurements come at intervals, change nothing, and the best policy stays.
"""

import dataclasses
import json
import time
from types import SimpleNamespace

import pytest
import torch

from polypod.evaluation import evaluate_checkpoint
from polypod.evaluation.walking import Walking, shortfall, walks
from polypod.runs import run_dir
from polypod.runs.engines import ON_THE_CPU, on_the_cpu
from polypod.training import goal as goals
from polypod.training import session
from polypod.training.goal import UntilWalks
from polypod.training.workers import Workers

TINY = ["sim.episode_length_s=1.0"]
FIGURES = Walking(
    episodes=64,
    duration_s=20.0,
    kinds=("box", "turn", "side", "stop"),
    error_vel_xy=0.1,
    still_error_vel_xy=0.46,
    error_vel_yaw=0.1,
    still_error_vel_yaw=0.37,
    fall_rate=0.0,
    turn_reached=0.9,
    side_reached=0.9,
    drift_xy=0.01,
    drift_yaw=0.01,
)


def options(tmp_path, **changes):
    return session.Options(
        robots=["unitree_go1"],
        num_envs=16,
        max_iterations=4,
        logger="none",
        device="cpu",
        threads=1,
        log_dir=tmp_path,
        overrides=[*TINY, "train.run.num_steps_per_env=4", "train.run.save_interval=1000"],
        **changes,
    )


def measured(monkeypatch, figures):
    """Lets measurements of checkpoints that are there give these figures, one after the other."""
    given = iter(figures)

    def measure(self, path, seed):
        assert path.is_file()
        return {"unitree_go1": next(given)}

    monkeypatch.setattr(UntilWalks, "_measure", measure)


def bad(error):
    return dataclasses.replace(FIGURES, error_vel_xy=error)


def test_the_shortfall_is_0_where_a_robot_walks_and_grows_with_what_it_misses():
    assert walks(FIGURES)
    assert shortfall(FIGURES) == 0.0
    assert shortfall(bad(0.23 + 0.115)) == pytest.approx(0.5)
    changes = [{"fall_rate": 1.0}, {"turn_reached": 0.0}, {"drift_xy": 0.1}, {"drift_yaw": 0.2}, {"error_vel_xy": 2.0}]
    changes += [{"error_vel_yaw": 0.37}, {"turn_reached": float("nan")}, {"drift_xy": float("nan")}]
    for change in changes:
        assert shortfall(dataclasses.replace(FIGURES, **change)) == pytest.approx(1.0), change
    assert shortfall(dataclasses.replace(FIGURES, fall_rate=0.3)) < shortfall(
        dataclasses.replace(FIGURES, fall_rate=0.6)
    )


def test_it_ends_when_the_robot_walks_with_a_second_seed_too(tmp_path, monkeypatch):
    # does not walk; walks with one seed alone; walks with both
    measured(monkeypatch, [bad(0.4), FIGURES, bad(0.3), FIGURES, FIGURES])
    goal = UntilWalks(1)
    _run, runner = session.train_with(options(tmp_path), Workers.alone(), goal=goal)
    assert goal.walked
    assert runner.current_learning_iteration == 3
    assert [point.samples for point in goal.points] == [64, 128, 192]
    assert [point.seconds for point in goal.points] == sorted(point.seconds for point in goal.points)
    assert goals.rank(goal.best.robots, ["unitree_go1"]) == (1, 0.0)


def test_the_best_checkpoint_stays_and_the_others_go_with_their_sums(tmp_path, monkeypatch):
    measured(monkeypatch, [bad(0.4), bad(0.3), bad(0.35), bad(0.45)])
    goal = UntilWalks(1)
    run, _ = session.train_with(options(tmp_path), Workers.alone(), goal=goal)
    assert not goal.walked
    assert goal.best.checkpoint == run / "model_2.pt"
    # the last one is what a resumed run goes on from
    assert sorted(path.name for path in run.glob("model_*.pt")) == ["model_2.pt", "model_4.pt"]
    assert set(json.loads((run / "manifest.json").read_text())["checkpoints"]) == {"model_2.pt", "model_4.pt"}


def test_a_deadline_ends_it_after_one_more_measurement(tmp_path, monkeypatch):
    measured(monkeypatch, [bad(0.4)])
    goal = UntilWalks(100, deadline=time.monotonic())
    _, runner = session.train_with(options(tmp_path), Workers.alone(), goal=goal)
    assert runner.current_learning_iteration == len(goal.points) == 1


def goal_that_is_told(stats, **arguments):
    """A goal whose training has these figures of the robot, iteration by iteration."""

    class Told(UntilWalks):
        def ends(self, runner, is_last):
            runner.stats_of_robots = {"unitree_go1": stats[runner.current_learning_iteration - 1]}
            return super().ends(runner, is_last)

    return Told(1, **arguments)


def test_a_robot_that_only_stands_is_not_measured(tmp_path, monkeypatch):
    """But for the last time: the figures of the training's episodes say enough."""
    measured(monkeypatch, [bad(0.4), bad(0.3)])
    stats = [{"command_xy": 0.4, "fall_rate": 0.13, "error_vel_xy": error} for error in (0.33, 0.41, 0.2, 0.41)]
    lines = []
    goal = goal_that_is_told(stats, only_promising=True, tell=lines.append)
    session.train_with(options(tmp_path), Workers.alone(), goal=goal)
    assert [point.iterations for point in goal.points] == [3, 4]
    assert len(lines) == 2
    assert lines[0].startswith("iteration 1, 0.00 million samples")
    assert lines[0].endswith("unitree_go1 follows no better than standing still, and falls in 13% of the episodes")
    # without figures it is measured
    measured(monkeypatch, [bad(0.4)] * 4)
    goal = UntilWalks(1, only_promising=True, tell=lines.append)
    session.train_with(options(tmp_path / "other"), Workers.alone(), goal=goal)
    assert len(goal.points) == 4


def test_a_robot_that_mostly_falls_is_not_measured(tmp_path, monkeypatch):
    measured(monkeypatch, [bad(0.4), bad(0.3)])
    stats = [{"command_xy": 0.4, "fall_rate": falls, "error_vel_xy": 0.2} for falls in (0.51, 0.49, 1.0, 1.0)]
    lines = []
    goal = goal_that_is_told(stats, only_promising=True, tell=lines.append)
    session.train_with(options(tmp_path), Workers.alone(), goal=goal)
    assert [point.iterations for point in goal.points] == [2, 4]
    assert [line.rpartition(": ")[2] for line in lines] == [
        "unitree_go1 falls in 51% of the episodes",
        "unitree_go1 falls in 100% of the episodes",
    ]


@pytest.mark.parametrize(("count", "left", "then"), [(16, 2, 1), (16, 1, 1), (2000, 2, 2), (2000, 1, 3)])
def test_torchs_threads_suit_a_measurement(tmp_path, monkeypatch, count, left, then):
    """Perceptrons of few robots get one; a training on a GPU leaves one, which is few for many."""
    seen = []

    def evaluate(path, **arguments):
        seen.append(torch.get_num_threads())
        return SimpleNamespace(robots={"unitree_go1": SimpleNamespace(walking=FIGURES)})

    monkeypatch.setattr(goals, "evaluate_checkpoint", evaluate)
    threads = torch.get_num_threads()
    of_run = dataclasses.replace(options(tmp_path), threads=None)
    torch.set_num_threads(left)
    try:
        goal = UntilWalks(1, confirm=False, envs_per_robot=count, threads=3)
        session.train_with(of_run, Workers.alone(), goal=goal)
        assert torch.get_num_threads() == left
    finally:
        torch.set_num_threads(threads)
    assert seen == [then]


@pytest.mark.parametrize("engine", ["cuda", "auto"])
def test_the_cpu_measures_what_a_card_trained(tmp_path, engine):
    """No card steps a few hundred envs sooner than the CPU, and the bits are the same."""
    run, runner = session.train_with(options(tmp_path), Workers.alone())
    path = run_dir.checkpoint_path(run, runner.current_learning_iteration)
    before = evaluate_checkpoint(path, num_envs=2, steps=10, threads=1)
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["overrides"].append(f"physics.engine={engine}")
    (run / "manifest.json").write_text(json.dumps(manifest))
    after = evaluate_checkpoint(path, num_envs=2, steps=10, threads=1)
    assert after.robots == before.robots


def test_the_last_engine_that_is_named_counts():
    assert on_the_cpu(["physics.engine=avian", "a=1", "physics.engine=cuda"]) == ["a=1", ON_THE_CPU]
    later = ["physics.engine=auto", "physics.engine=avian"]
    assert on_the_cpu(later) == later
    assert on_the_cpu([]) == []


def test_a_measurement_of_the_last_checkpoint_is_its_evaluation(tmp_path, monkeypatch):
    made = []
    original = goals.evaluate_checkpoint

    def evaluate(checkpoint, **arguments):
        made.append((checkpoint, arguments.get("seed")))
        return original(checkpoint, **arguments | {"steps": 3})

    monkeypatch.setattr(goals, "evaluate_checkpoint", evaluate)
    goal = UntilWalks(3, threads=1)
    run, _ = session.train_with(options(tmp_path), Workers.alone(), goal=goal)
    assert made == [(run / f"model_{i}.pt", 0) for i in (3, 4)]
    last = goal.evaluation_of(run / "model_4.pt")
    assert last is not None
    assert last.robots["unitree_go1"].walking == goal.points[-1].robots["unitree_go1"]
    assert goal.evaluation_of(run / "model_3.pt") is None
    # fewer envs are no evaluation
    few = UntilWalks(3, envs_per_robot=2, threads=1)
    run, _ = session.train_with(options(tmp_path / "few"), Workers.alone(), goal=few)
    assert few.evaluation_of(run / "model_4.pt") is None


def test_robots_that_need_not_walk_end_nothing(tmp_path, monkeypatch):
    measured(monkeypatch, [FIGURES, FIGURES])
    goal = UntilWalks(1, ["unitree_go1"], confirm=True)
    session.train_with(options(tmp_path), Workers.alone(), goal=goal)
    assert goal.walked
    assert goal.confirmation == {"unitree_go1": FIGURES}


@pytest.mark.parametrize("learner", ["native", "rsl_rl"])
def test_measurements_change_no_bit_of_the_training(tmp_path, learner):
    weights = []
    for name in ("alone", "measured"):
        goal = None if name == "alone" else UntilWalks(1, envs_per_robot=2, threads=1)
        run, _runner = session.train_with(options(tmp_path / name, learner=learner), Workers.alone(), goal=goal)
        weights.append(run_dir.load_checkpoint(run_dir.checkpoint_path(run, 4))["actor_state_dict"])
    for key, value in weights[0].items():
        assert torch.equal(value, weights[1][key]), key


def test_train_says_whether_robots_walk_by_its_exit_code(cli, tmp_path, monkeypatch):
    flags = ("--num-envs", "16", "--robots", "unitree_go1", "--max-iterations", "2", "--logger", "none")
    flags += ("--set", TINY[0], "--set", "train.run.num_steps_per_env=4", "--threads", "1", "--until-walks", "1")
    done = cli("train", *flags)
    assert done.returncode == 3, done.stderr
    assert done.stdout.count("0 of 1 walk") == 3
    (run,) = tmp_path.glob("logs/rsl_rl/*/*")
    assert "--until-walks 1" in json.loads((run / "manifest.json").read_text())["command"]
    measured(monkeypatch, [FIGURES, FIGURES])
    done = cli("train", *flags)
    assert done.returncode == 0, done.stderr
    assert "iteration 1, 0.00 million samples" in done.stdout


def test_workers_are_refused(cli, monkeypatch):
    done = cli("train", "--until-walks", "5", "--ray", "nowhere:1")
    assert done.returncode == 2
    assert "--until-walks" in done.stderr
    done = cli("train", "--until-walks", "0")
    assert "--until-walks 0 must be at least 1" in done.stderr
