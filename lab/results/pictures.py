"""The pictures of a folder of results: curves per robot over samples, and maps of evaluations."""

import dataclasses
import re
from pathlib import Path

from lab.results.runs import Results, mean_curve, smoothed
from lab.results.tables import SMOOTHING, condition_of
from polypod.drawing import pyplot_for, save
from polypod.evaluation import Evaluation, summarize
from polypod.evaluation.plot import picture

CURVES = {
    "error_vel_xy": "velocity error (m/s)",
}
"""TensorBoard's `Metrics/<robot>/...` that are drawn, and their labels. `tensorboard` shows the
others."""
_COLUMNS = 4


def draw(results: Results, folder: Path) -> list[Path]:
    """Draws each of `CURVES` that a run has, and the evaluations over a grid or over tiles.

    Returns:
        The files.

    Raises:
        ConfigError: without matplotlib, where a file cannot be written, and for curves without a
            manifest.
    """
    return _draw_curves(results, folder) + _draw_maps(results, folder)


def _draw_maps(results: Results, folder: Path) -> list[Path]:
    files = []
    for group, runs in results.groups.items():
        alike: dict[object, list[tuple[str, Evaluation]]] = {}
        for run in runs:
            for name, each in run.evaluations.items():
                if each.grid is not None or any(robot.terrain for robot in each.robots.values()):
                    alike.setdefault(condition_of(each), []).append((name, each))
        for found in alike.values():
            stem = re.sub(r"[^0-9A-Za-z]+", "_", f"{group}_{found[0][0]}")
            files.append(folder / f"{stem}.png")
            picture(summarize(_one_robot_each([each for _, each in found])), files[-1])
    return files


def _one_robot_each(evaluations: list[Evaluation]) -> list[Evaluation]:
    """Evaluations of policies for one robot each, as if it were one policy's.

    Others as they are.
    """
    robots = {name: result for each in evaluations for name, result in each.robots.items()}
    if len(robots) == len(evaluations):
        return [dataclasses.replace(evaluations[0], robots=robots)]
    return [each for each in evaluations if list(each.robots) == list(evaluations[0].robots)]


def _draw_curves(results: Results, folder: Path) -> list[Path]:
    files = []
    for metric, label in CURVES.items():
        robots = list(
            dict.fromkeys(
                robot for run in results.runs for robot in run.robots if f"Metrics/{robot}/{metric}" in run.curves
            )
        )
        if not robots:
            continue
        out = folder / f"curves_{metric}.png"
        _draw(results, metric, label, robots, out)
        files.append(out)
    return files


def _draw(results: Results, metric: str, label: str, robots: list[str], out: Path) -> None:
    pyplot = pyplot_for("drawing curves")
    columns = min(_COLUMNS, len(robots))
    rows = -(-len(robots) // columns)
    figure, axes = pyplot.subplots(
        rows, columns, figsize=(3.6 * columns, 2.9 * rows), layout="constrained", squeeze=False, sharey=True
    )
    colors = pyplot.get_cmap("tab10").colors
    handles = {}
    for axis in axes.flat[len(robots) :]:
        axis.set_axis_off()
    for axis, robot in zip(axes.flat, robots, strict=False):
        for place, (group, runs) in enumerate(results.groups.items()):
            tag = f"Metrics/{robot}/{metric}"
            own = [run for run in runs if tag in run.curves and robot in run.robots]
            if not own:
                continue
            curves = [smoothed(run.curves[tag], SMOOTHING) for run in own]
            scales = [run.samples_per_iteration / 1e6 for run in own]
            samples, mean, low, high = mean_curve(curves, scales)
            color = colors[place % len(colors)]
            (handles[group],) = axis.plot(samples, mean, color=color, linewidth=1.3)
            axis.fill_between(samples, low, high, color=color, alpha=0.2, linewidth=0.0)
        axis.set_title(robot, fontsize=9)
        axis.set_ylim(0.0, None)
        axis.grid(alpha=0.3)
    for axis in axes[-1]:
        axis.set_xlabel("million samples, all robots")
    for row in axes:
        row[0].set_ylabel(label)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(len(handles), 5))
    save(figure, out)
    pyplot.close(figure)
