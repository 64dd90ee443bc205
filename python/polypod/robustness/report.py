"""Report of `polypod robustness`: a table with a row per condition and simulator."""

import math
from collections.abc import Iterable

from polypod.robustness.results import Battery, Row
from polypod.tables import Rows, console_of_output, shown

COLUMNS = ("falls", "most", "of", "kept", "err xy", "still", "err yaw", "turn err", "turn", "drift", "within")
"""Columns of the table. `most` and `of` are of the worst robot, the others are means over the
robots."""


def show(battery: Battery) -> None:
    """Prints the table, the robots that miss a bound, and what was left out."""
    console = console_of_output()
    envs = ", ".join(f"{count} in {simulator}" for simulator, count in battery.envs.items())
    console.print(
        f"{battery.checkpoint['file']} in {battery.task}: {len(battery.robots)} robots, episodes of "
        f"{battery.duration_s:g} s, {envs} per robot and condition (errors in m/s and rad/s; still: planar error of a "
        "robot that stands still; turn: yaw rate of pure turns over the commanded one)",
        markup=False,
    )
    table = Rows("condition", "in", *COLUMNS)
    for row in battery.rows:
        table.add_row(row.condition, row.simulator, *figures(row))
    table.print(console)
    for row in battery.rows:
        for name, cell in row.robots.items():
            if cell.faults:
                console.print(f"{row.condition}, {row.simulator}: {name}: {'; '.join(cell.faults)}", markup=False)
    for row in battery.rows:
        for reason in dict.fromkeys(row.not_applicable.values()):
            names = [name for name, why in row.not_applicable.items() if why == reason]
            who = "" if len(names) == len(battery.robots) else f" for {', '.join(names)}"
            console.print(f"{row.condition}, {row.simulator}: not applicable{who}: {reason}", markup=False)
    if not any(row.robots for row in battery.rows):
        console.print("no condition applies, so no bound is kept to", markup=False)


def figures(row: Row) -> tuple[str, ...]:
    """The cells of a row of the table, see `COLUMNS`."""
    cells = list(row.robots.values())
    if not cells or row.worst is None:
        return (*(["-"] * (len(COLUMNS) - 1)), "not applicable")
    worst = row.robots[row.worst]
    return (
        f"{_mean(cell.fall_rate for cell in cells):.1%}",
        f"{worst.fall_rate:.1%}",
        row.worst,
        f"{_mean(cell.kept for cell in cells):.1%}",
        shown(_mean(cell.error_vel_xy for cell in cells), ".3f"),
        shown(_mean(cell.still_error_vel_xy for cell in cells), ".3f"),
        shown(_mean(cell.error_vel_yaw for cell in cells), ".3f"),
        shown(_mean(cell.turn_error for cell in cells), ".3f"),
        shown(_mean(cell.turn_reached for cell in cells), ".0%"),
        shown(_mean(cell.drift_xy for cell in cells), ".3f"),
        "yes" if row.is_within else f"no, {sum(bool(cell.faults) for cell in cells)} of {len(cells)} miss",
    )


def _mean(values: Iterable[float]) -> float:
    """The mean of those that were measured; NaN without one."""
    measured = [value for value in values if not math.isnan(value)]
    return sum(measured) / len(measured) if measured else math.nan
