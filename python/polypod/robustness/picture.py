"""A picture of a battery: robots by conditions, coloured by falls and by the errors of turns."""

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt

from polypod.drawing import pyplot_for, save
from polypod.robustness.results import Battery

TURN_TOP = 0.6
"""rad/s, of the darkest turn error: that of a robot that does not turn."""
_FLAG = "--picture"


def draw(battery: Battery, out: Path) -> None:
    """Writes the picture.

    Raises ConfigError without matplotlib, or where the file cannot be written.
    """
    pyplot = pyplot_for(_FLAG)
    rows, robots = len(battery.rows), len(battery.robots)
    size = (5.5 + 0.9 * robots, 2.4 + 0.22 * rows)
    figure, axes = pyplot.subplots(1, 2, figsize=size, sharey=True, layout="constrained")
    panels = (
        ("falls, % of the episodes", 100.0 * values(battery, "fall_rate"), 100.0, "Reds", "{:.0f}"),
        ("yaw rate error in pure turns, rad/s", values(battery, "turn_error"), TURN_TOP, "Blues", "{:.2f}"),
    )
    marked = np.array(
        [[_misses(battery, row, robot) for robot in range(robots)] for row in range(rows)], dtype=np.bool_
    )
    for axis, (title, numbers, top, colors, text) in zip(axes, panels, strict=True):
        shades = pyplot.get_cmap(colors).with_extremes(bad="0.88")
        axis.imshow(np.ma.masked_invalid(numbers), vmin=0.0, vmax=top, cmap=shades, aspect="auto")
        axis.set_title(title, fontsize=9)
        axis.set_xticks(range(robots), battery.robots, rotation=60, ha="right", fontsize=7)
        for (row, robot), number in np.ndenumerate(numbers):
            if not math.isnan(number):
                color = "white" if number > 0.6 * top else "black"
                weight = "bold" if marked[row, robot] else "normal"
                axis.text(
                    robot, row, text.format(number), ha="center", va="center", fontsize=6, color=color, weight=weight
                )
    axes[0].set_yticks(range(rows), [f"{row.condition}, {row.simulator}" for row in battery.rows], fontsize=7)
    figure.suptitle(
        f"{battery.checkpoint['file']}: bold misses a bound, grey is not applicable or not measured", fontsize=9
    )
    save(figure, out)
    pyplot.close(figure)


def values(battery: Battery, key: str) -> npt.NDArray[np.float64]:
    """Values of a figure of `Cell`, [rows, robots]; NaN where it was not measured."""
    return np.array(
        [
            [getattr(row.robots[name], key) if name in row.robots else math.nan for name in battery.robots]
            for row in battery.rows
        ],
        dtype=np.float64,
    ).reshape(len(battery.rows), len(battery.robots))


def _misses(battery: Battery, row: int, robot: int) -> bool:
    cell = battery.rows[row].robots.get(battery.robots[robot])
    return cell is not None and bool(cell.faults)
