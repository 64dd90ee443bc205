"""Time and samples until all robots walk: `polypod bench --walk`."""

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from polypod.bench.learners import Options, heading, training
from polypod.bench.report import Progress
from polypod.drawing import pyplot_for, save
from polypod.evaluation import evaluate_checkpoint
from polypod.evaluation.walking import BOUNDS, Walking, walks
from polypod.training import run_dir

INTERVAL = 25
"""Iterations between evaluations."""
ENVS_PER_ROBOT = 64
_WORST = {
    "error_vel_xy": (max, "worst planar velocity error, m/s"),
    "turn_reached": (min, "least share of a pure turn"),
    "drift_xy": (max, "most drift when told to stop, m/s"),
    "fall_rate": (max, "most falls of a robot"),
}
"""Figures of the robot that has the worst one, as curves and pictures show them."""


def measure(options: Options, learner: str, seeds: Sequence[int], device: str, progress: Progress) -> dict[str, Any]:
    """Trains until every robot walks, for each seed.

    The deterministic policy is evaluated every `INTERVAL` iterations on `ENVS_PER_ROBOT` envs per robot, without noise,
    by the definition of `polypod.evaluation.walking`. The evaluations take none of the time.
    """
    runs = []
    for seed in seeds:
        with training(dataclasses.replace(options, seed=seed), learner, device) as runner:
            runs.append(_walk(runner, seed, options.threads, progress))
    return {
        **options.conditions(),
        "learner": learner,
        "device": device,
        "walks": BOUNDS,
        "runs": runs,
    }


def _walk(runner: Any, seed: int, threads: int | None, progress: Progress) -> dict[str, Any]:
    samples_per_iteration = runner.cfg["num_steps_per_env"] * runner.env.num_envs
    most = math.ceil(runner.cfg["max_iterations"] / INTERVAL)
    seconds, curve, walked = 0.0, [], False
    for turn in range(most):
        begin = time.perf_counter()
        runner.learn(INTERVAL, init_at_random_ep_len=turn == 0)
        seconds += time.perf_counter() - begin
        path = run_dir.checkpoint_path(Path(runner.run), runner.current_learning_iteration)
        robots = runner.env.unwrapped.sim.robots
        result = evaluate_checkpoint(path, num_envs=ENVS_PER_ROBOT * len(robots), threads=threads)
        path.unlink()
        found = [robot.walking for robot in result.robots.values() if robot.walking is not None]
        samples = samples_per_iteration * runner.current_learning_iteration
        point = _point(found)
        curve.append({"samples": samples, "seconds": seconds, **point})
        progress(
            f"seed {seed}: {samples / 1e6:.1f} million samples, {seconds:.0f} s, {point['walk']} of {len(found)} walk, "
            f"worst error {point['error_vel_xy']:.2f} m/s (standing still: {point['still_error_vel_xy']:.2f}), worst "
            f"yaw error {point['error_vel_yaw']:.2f} rad/s (standing still: {point['still_error_vel_yaw']:.2f}), least "
            f"turn {_turn(point)}, most falls {point['fall_rate']:.1%}"
        )
        walked = point["walk"] == len(found)
        if walked or runner.stopped_by is not None:
            break
    return {"seed": seed, "walked": walked, "samples": samples, "seconds": seconds, "curve": curve}


def _point(robots: Sequence[Walking]) -> dict[str, Any]:
    """A point of a curve: how many robots walk, and the worst figures; errors with standing still's of that robot.

    A figure that no robot has is None.
    """
    known = {key: [value for robot in robots if not math.isnan(value := getattr(robot, key))] for key in _WORST}
    by_error = max(robots, key=lambda robot: robot.error_vel_xy)
    by_yaw = max(robots, key=lambda robot: robot.error_vel_yaw)
    return {
        "walk": sum(map(walks, robots)),
        **{key: of(known[key]) if known[key] else None for key, (of, _) in _WORST.items()},
        "still_error_vel_xy": by_error.still_error_vel_xy,
        "error_vel_yaw": by_yaw.error_vel_yaw,
        "still_error_vel_yaw": by_yaw.still_error_vel_yaw,
    }


def _turn(point: Mapping[str, Any]) -> str:
    """The least share of a pure turn; a dash where no turn was measured."""
    return "-" if point["turn_reached"] is None else f"{point['turn_reached']:.0%}"


def table(result: Mapping[str, Any]) -> str:
    """The figures as Markdown."""
    lines = [
        *heading(result, f"learner {result['learner']} on {result['device']}"),
        "| seed | all robots walk | million samples | s | worst error (m/s) | still | worst yaw error (rad/s) | still "
        "| least turn | most falls |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for run in result["runs"]:
        walked = "yes" if run["walked"] else "no"
        last = run["curve"][-1]
        errors = [f"{last[f'{of}error_vel_{axis}']:.3f}" for axis in ("xy", "yaw") for of in ("", "still_")]
        cells = [*errors, _turn(last), f"{last['fall_rate']:.1%}"]
        spent = f"{run['samples'] / 1e6:.1f} | {run['seconds']:.0f}"
        lines.append(f"| {run['seed']} | {walked} | {spent} | {' | '.join(cells)} |")
    done = [run for run in result["runs"] if run["walked"]]
    if len(done) > 1:
        both = [[run["samples"] / 1e6 for run in done], [run["seconds"] for run in done]]
        cells = [f"{mean(values):.1f} ± {stdev(values):.1f}" for values in both]
        lines.append(f"| mean and deviation of {len(done)} | | {' | '.join(cells)}{' |' * 7}")
    return "\n".join(lines)


def picture(result: Mapping[str, Any], out: Path) -> None:
    """Plots the worst figures over samples. Raises ConfigError without matplotlib."""
    pyplot = pyplot_for("--plot")
    figure, axes = pyplot.subplots(1, len(_WORST), figsize=(5 * len(_WORST), 4), layout="constrained")
    for axis, (key, (_, label)) in zip(axes, _WORST.items(), strict=True):
        for run in result["runs"]:
            points = run["curve"]
            samples = [point["samples"] / 1e6 for point in points]
            values = [math.nan if point[key] is None else point[key] for point in points]
            axis.plot(samples, values, marker="o", label=f"seed {run['seed']}")
        axis.axhline(BOUNDS[key], color="grey", linestyle=":")
        axis.set(xlabel="million samples", ylabel=label, ylim=(0, None))
        axis.legend()
    save(figure, out, "--plot")
    pyplot.close(figure)
