"""Pictures of evaluations: bars per robot, and maps over the grid of commands or the tiles."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from polypod.drawing import pyplot_for, save
from polypod.evaluation.results import Evaluation
from polypod.evaluation.seeds import Summary

BARS = {
    "error_vel_xy": "velocity error (m/s)",
    "error_vel_yaw": "yaw rate error (rad/s)",
    "fall_rate": "falls per episode",
    "power": "power (W)",
    "cost_of_transport": "cost of transport",
    "foot_slip": "foot slip (m/s)",
}
"""Figures that are drawn as bars, and how they are called."""
_COLUMNS = 4


def picture(summary: Summary, out: Path) -> None:
    """Draws a summary.

    Raises ConfigError without matplotlib, or where the file cannot be written.
    """
    pyplot = pyplot_for("--plot")
    maps = _maps(summary.evaluations)
    bar_rows, map_rows = -(-len(BARS) // 3), -(-len(maps) // _COLUMNS)
    figure = pyplot.figure(figsize=(14, 3.2 * (bar_rows + map_rows)), layout="constrained")
    parts = figure.subfigures(2, 1, height_ratios=[bar_rows, map_rows]) if maps else [figure]
    _draw_bars(parts[0].subplots(bar_rows, 3), summary)
    if maps:
        _draw_maps(parts[1], maps, map_rows)
    first = summary.evaluations[0]
    conditions = "noise, pushes and randomisation" if first.randomized else "no noise, no pushes"
    seeds = len(summary.evaluations)
    whiskers = f"; {seeds} seeds, bars 95 % intervals" if seeds > 1 else ""
    figure.suptitle(f"{first.task}, {conditions}{whiskers}")
    save(figure, out)
    pyplot.close(figure)


def _draw_bars(axes: Any, summary: Summary) -> None:
    names = list(summary.robots)
    for axis, (key, label) in zip(axes.flat, BARS.items(), strict=False):
        intervals = [summary.robots[name][key] for name in names]
        means = [entry.mean for entry in intervals]
        reach = [entry.high - entry.mean if entry.seeds > 1 else 0.0 for entry in intervals]
        axis.bar(range(len(names)), means, yerr=reach if any(reach) else None, color="tab:blue", capsize=3)
        axis.set_xticks(range(len(names)), names, rotation=40, ha="right", fontsize=8)
        axis.set_ylabel(label)
        axis.set_ylim(0, None)
        axis.grid(axis="y", alpha=0.3)


def _draw_maps(part: Any, maps: dict[str, dict[str, Any]], rows: int) -> None:
    axes = part.subplots(rows, _COLUMNS, squeeze=False)
    top = max(float(np.nanmax(entry["values"])) for entry in maps.values())
    for axis in axes.flat[len(maps) :]:
        axis.set_axis_off()
    for axis, (name, entry) in zip(axes.flat, maps.items(), strict=False):
        image = axis.imshow(entry["values"], vmin=0.0, vmax=top, origin="lower", aspect="auto", cmap="viridis")
        axis.set_title(name, fontsize=9)
        axis.set_xticks(range(len(entry["x"])), entry["x"], fontsize=7)
        axis.set_yticks(range(len(entry["y"])), entry["y"], fontsize=7)
        axis.set(xlabel=entry["xlabel"], ylabel=entry["ylabel"])
    part.colorbar(image, ax=axes, label=next(iter(maps.values()))["label"])


def _maps(evaluations: Sequence[Evaluation]) -> dict[str, dict[str, Any]]:
    """A map per robot.

    The error over forward and left command, or success over types and levels of tiles.
    """
    maps = {}
    for name, robot in evaluations[0].robots.items():
        results = [evaluation.robots[name] for evaluation in evaluations]
        if robot.commands:
            maps[name] = _over_commands(results)
        elif robot.terrain:
            maps[name] = _over_tiles(results)
    return maps


def _over_commands(results: Sequence[Any]) -> dict[str, Any]:
    entries = [entry for result in results for entry in result.commands]
    along, across = (sorted({entry.command[axis] for entry in entries}) for axis in (0, 1))
    values = np.full((len(across), len(along)), np.nan)
    for i, left in enumerate(across):
        for j, forward in enumerate(along):
            here = [entry for entry in entries if entry.command[:2] == (forward, left)]
            if here:
                weights = [entry.episodes for entry in here]
                values[i, j] = np.average([entry.error_vel_xy for entry in here], weights=weights)
    return {
        "values": values,
        "x": [f"{value:g}" for value in along],
        "y": [f"{value:g}" for value in across],
        "xlabel": "forward (m/s)",
        "ylabel": "left (m/s)",
        "label": "velocity error (m/s), mean over yaw rates",
    }


def _over_tiles(results: Sequence[Any]) -> dict[str, Any]:
    kinds = list(dict.fromkeys(kind for result in results for kind in result.terrain))
    levels = sorted({tile.level for result in results for tiles in result.terrain.values() for tile in tiles})
    values = np.array(
        [[np.mean([result.success(kind, level) for result in results]) for level in levels] for kind in kinds]
    )
    return {
        "values": values,
        "x": [str(level) for level in levels],
        "y": kinds,
        "xlabel": "level",
        "ylabel": "",
        "label": "success",
    }
