"""Time and samples until all robots walk: `python -m lab.speed walk`."""

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from lab.speed import energy
from polypod.bench.learners import Options, heading, training
from polypod.bench.report import Progress
from polypod.drawing import pyplot_for, save
from polypod.evaluation.walking import BOUNDS, Walking, walks
from polypod.training.goal import Point, UntilWalks
from polypod.training.runner import Runner

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

    The deterministic policy is evaluated every `INTERVAL` iterations on `ENVS_PER_ROBOT` envs per
    robot, without noise, by the definition of `polypod.evaluation.walking`. Neither time nor energy
    counts the evaluations.
    """
    runs = []
    for seed in seeds:
        began = time.perf_counter()
        with training(dataclasses.replace(options, seed=seed), learner, device) as runner:
            runs.append(_walk(runner, seed, options, began, progress))
    return {
        **options.conditions(),
        "robots": options.robots,
        "learner": learner,
        "device": device,
        "walks": BOUNDS,
        "runs": runs,
    }


def _walk(runner: Runner, seed: int, options: Options, began: float, progress: Progress) -> dict[str, Any]:
    curve: list[dict[str, Any]] = []
    startup = time.perf_counter() - began
    meter = energy.Meter(gpus=runner.device != "cpu")

    def say(point: Point) -> None:
        figures = _point(list(point.robots.values()))
        curve.append({"samples": point.samples, "seconds": point.seconds, **figures})
        progress(
            f"seed {seed}: {point.samples / 1e6:.1f} million samples, {point.seconds:.0f} s, {figures['walk']} of "
            f"{len(point.robots)} walk, worst error {figures['error_vel_xy']:.2f} m/s (standing still: "
            f"{figures['still_error_vel_xy']:.2f}), worst yaw error {figures['error_vel_yaw']:.2f} rad/s (standing "
            f"still: {figures['still_error_vel_yaw']:.2f}), least turn {_turn(figures)}, most falls "
            f"{figures['fall_rate']:.1%}"
        )

    goal = UntilWalks(
        INTERVAL, say=say, confirm=False, envs_per_robot=ENVS_PER_ROBOT, threads=options.threads, meter=meter
    )
    most = math.ceil(runner.config.run.max_iterations / INTERVAL) * INTERVAL
    runner.goal = goal
    goal.begin()
    try:
        runner.learn(most, init_at_random_ep_len=True)
    finally:
        meter.pause()
    if not curve:
        raise KeyboardInterrupt  # before the first measurement
    return {
        "seed": seed,
        "walked": goal.walked,
        "samples": curve[-1]["samples"],
        "seconds": curve[-1]["seconds"],
        "startup_s": startup,
        "watt_hours": meter.watt_hours(),
        "curve": curve,
    }


def _point(robots: Sequence[Walking]) -> dict[str, Any]:
    """A point of a curve: how many robots walk, and the worst figures.

    Errors with standing still's of that robot.

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
    """The figures as Markdown; energy where the machine tells it in every run."""
    told = set.intersection(*(set(run["watt_hours"]) for run in result["runs"]))
    energy_ = f"| Wh, {' and '.join(sorted(told))} " if told else ""
    lines = [
        *heading(result, f"learner {result['learner']} on {result['device']}"),
        f"| seed | all robots walk | million samples | s | with start-up, s {energy_}| worst error (m/s) | still "
        "| worst yaw error (rad/s) | still | least turn | most falls |",
        "|---|---|---|---|---|---|---|---|---|---|---|" + "---|" * bool(told),
    ]
    forms = ("{:.1f}", "{:.0f}", "{:.0f}", *(("{:.2f}",) if told else ()))
    for run in result["runs"]:
        walked = "yes" if run["walked"] else "no"
        last = run["curve"][-1]
        errors = [f"{last[f'{of}error_vel_{axis}']:.3f}" for axis in ("xy", "yaw") for of in ("", "still_")]
        cells = [*errors, _turn(last), f"{last['fall_rate']:.1%}"]
        spent = " | ".join(form.format(value) for form, value in zip(forms, _spent(run), strict=False))
        lines.append(f"| {run['seed']} | {walked} | {spent} | {' | '.join(cells)} |")
    done = [run for run in result["runs"] if run["walked"]]
    if len(done) > 1:
        columns = list(zip(*(_spent(run)[: len(forms)] for run in done), strict=True))
        cells = [f"{mean(values):.1f} ± {stdev(values):.1f}" for values in columns]
        lines.append(f"| mean and deviation of {len(done)} | | {' | '.join(cells)}{' |' * 7}")
    return "\n".join(lines)


def _spent(run: Mapping[str, Any]) -> tuple[float, ...]:
    """Million samples, seconds, seconds with start-up, and watt-hours where they are known."""
    energy_ = [sum(run["watt_hours"].values())] if run["watt_hours"] else []
    return (run["samples"] / 1e6, run["seconds"], run["seconds"] + run["startup_s"], *energy_)


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
