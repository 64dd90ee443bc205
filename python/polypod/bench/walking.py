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
from polypod.evaluation import evaluate_checkpoint, walks
from polypod.evaluation.results import TURNS, WALKS
from polypod.training import run_dir

INTERVAL = 25
"""Iterations between evaluations."""
ENVS_PER_ROBOT = 64


def measure(options: Options, learner: str, seeds: Sequence[int], device: str, progress: Progress) -> dict[str, Any]:
    """Trains until every robot walks, for each seed.

    The deterministic policy is evaluated every `INTERVAL` iterations on `ENVS_PER_ROBOT` envs per robot, without noise.
    The evaluations take none of the time.
    """
    runs = []
    for seed in seeds:
        with training(dataclasses.replace(options, seed=seed), learner, device) as runner:
            runs.append(_walk(runner, seed, options.threads, progress))
    return {
        **options.conditions(),
        "learner": learner,
        "device": device,
        "walks": {**WALKS, "error_vel_yaw_of_still": TURNS[0], "error_vel_yaw": TURNS[1]},
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
        found = list(result.robots.values())
        worst = {key: max(getattr(robot, key) for robot in found) for key in WALKS}
        slowest = max(found, key=lambda robot: robot.error_vel_yaw / max(robot.still_error_vel_yaw, 1e-9))
        turning = {key: getattr(slowest, key) for key in ("error_vel_yaw", "still_error_vel_yaw")}
        samples = samples_per_iteration * runner.current_learning_iteration
        curve.append({"samples": samples, "seconds": seconds, **worst, **turning})
        progress(
            f"seed {seed}: {samples / 1e6:.1f} million samples, {seconds:.0f} s, worst error "
            f"{worst['error_vel_xy']:.2f} m/s, most falls {worst['fall_rate']:.1%}, worst yaw error "
            f"{turning['error_vel_yaw']:.2f} rad/s (standing still: {turning['still_error_vel_yaw']:.2f})"
        )
        walked = all(walks(robot) for robot in found)
        if walked or runner.stopped_by is not None:
            break
    return {"seed": seed, "walked": walked, "samples": samples, "seconds": seconds, "curve": curve}


def table(result: Mapping[str, Any]) -> str:
    """The figures as Markdown."""
    lines = [
        *heading(result, f"learner {result['learner']} on {result['device']}"),
        "| seed | all robots walk | million samples | s | worst yaw error (rad/s) | still (rad/s) |",
        "|---|---|---|---|---|---|",
    ]
    for run in result["runs"]:
        walked = "yes" if run["walked"] else "no"
        last = run["curve"][-1]
        yaw = f"{last['error_vel_yaw']:.3f} | {last['still_error_vel_yaw']:.3f}"
        lines.append(f"| {run['seed']} | {walked} | {run['samples'] / 1e6:.1f} | {run['seconds']:.0f} | {yaw} |")
    done = [run for run in result["runs"] if run["walked"]]
    if len(done) > 1:
        both = [[run["samples"] / 1e6 for run in done], [run["seconds"] for run in done]]
        cells = [f"{mean(values):.1f} ± {stdev(values):.1f}" for values in both]
        lines.append(f"| mean and deviation of {len(done)} | | {' | '.join(cells)} | | |")
    return "\n".join(lines)


def picture(result: Mapping[str, Any], out: Path) -> None:
    """Plots worst error and most falls over samples. Raises ConfigError without matplotlib."""
    pyplot = pyplot_for("--plot")
    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained")
    labels = {"error_vel_xy": "worst planar velocity error, m/s", "fall_rate": "most falls of a robot"}
    for axis, (key, bound) in zip(axes, WALKS.items(), strict=True):
        for run in result["runs"]:
            points = run["curve"]
            samples = [point["samples"] / 1e6 for point in points]
            axis.plot(samples, [point[key] for point in points], marker="o", label=f"seed {run['seed']}")
        axis.axhline(bound, color="grey", linestyle=":")
        axis.set(xlabel="million samples", ylabel=labels[key], ylim=(0, None))
        axis.legend()
    save(figure, out, "--plot")
    pyplot.close(figure)
