"""Report of `polypod sim2sim`: a table with both simulators side by side."""

import math
from collections.abc import Mapping

from rich.console import Console

from polypod.evaluation import rising
from polypod.sim2sim.on_rising import RisingComparison
from polypod.sim2sim.run import Comparison, Figures
from polypod.sim2sim.twin import Physics
from polypod.tables import Rows, console_of_output, shown


def show(comparison: Comparison) -> None:
    """Prints the figures."""
    console = console_of_output()
    console.print(
        f"{comparison.task}: {comparison.envs_per_robot} envs per robot, {comparison.duration_s:g} s; "
        f"{_stepped(comparison.mujoco_version, comparison.physics)} (errors in m/s and rad/s; "
        "still: of a robot that stands still; turn: share of a pure turn; drift: when told to stop)",
        markup=False,
    )
    columns = ("err xy", "MuJoCo", "still", "err yaw", "MuJoCo", "still", "turn", "MuJoCo", "drift", "MuJoCo")
    table = Rows("robot", *columns, "falls", "MuJoCo", "success", "MuJoCo", "transfers")
    for name, robot in comparison.robots.items():
        ours, theirs = robot.polypod, robot.mujoco
        table.add_row(
            name,
            f"{ours.error_vel_xy:.3f}",
            f"{theirs.error_vel_xy:.3f}",
            f"{ours.still_error_vel_xy:.3f}",
            f"{ours.error_vel_yaw:.3f}",
            f"{theirs.error_vel_yaw:.3f}",
            f"{ours.still_error_vel_yaw:.3f}",
            *(_known(figures, "turn_reached", ".0%") for figures in (ours, theirs)),
            *(_known(figures, "drift_xy", ".3f") for figures in (ours, theirs)),
            f"{ours.fall_rate:.1%}",
            f"{theirs.fall_rate:.1%}",
            *(shown(figures.success_rate, ".0%") for figures in (ours, theirs)),
            "yes" if robot.transfers else "no",
        )
    table.print(console)
    _show_finer(console, comparison.finer)
    for name, robot in comparison.robots.items():
        if robot.why_not:
            console.print(f"  {name} in MuJoCo: {'; '.join(robot.why_not)}", markup=False)
    for name, distance in comparison.distances.items():
        console.print(f"  {name}: its description is {distance}", markup=False)
    if not all(robot.is_whole for robot in comparison.robots.values()):
        console.print(
            "judged by what these commands and steps hold of the definition of walking; omit --command, --commands and "
            "--steps for all of it",
            markup=False,
        )


def show_rising(comparison: RisingComparison) -> None:
    """Prints who gets up."""
    console = console_of_output()
    console.print(
        f"{comparison.task}: {comparison.envs_per_robot} envs per robot, {comparison.duration_s:g} s; "
        f"{_stepped(comparison.mujoco_version, comparison.physics)} (up: within {math.degrees(rising.TILT):.0f} "
        f"degrees of the direction that the task rewards, at {rising.HEIGHT:.0%} of its height)",
        markup=False,
    )
    up, held = f"up within {rising.WITHIN_S:g} s", "held by 95 %"
    table = Rows("robot", up, "MuJoCo", "after", "MuJoCo", held, "MuJoCo", "transfers")
    for name, robot in comparison.robots.items():
        both = robot.polypod, robot.mujoco
        rates = (f"{figures.rate:.1%}" for figures in both)
        after = (shown(figures.time_s, ".1f") for figures in both)
        times = (f"{figures.least_held_s:.1f} s" for figures in both)
        table.add_row(name, *rates, *after, *times, "yes" if robot.transfers else "no")
    table.print(console)
    _show_finer(console, comparison.finer)


def _stepped(version: str, physics: Physics) -> str:
    """Says how MuJoCo steps."""
    soft = ", soft contact" if physics.soft_contact else ""
    return f"MuJoCo {version}, {physics.integrator} at {1e3 * physics.dt:g} ms, friction {physics.friction:g}{soft}"


def _show_finer(console: Console, finer: Mapping[str, float]) -> None:
    """Says which robots have finer steps."""
    for dt in sorted(set(finer.values())):
        robots = ", ".join(name for name, own in finer.items() if own == dt)
        steps = f"steps of {1e3 * dt:.3g} ms, as their joints are light; --dt gives others"
        console.print(f"  {robots} in MuJoCo: {steps}", markup=False)


def _known(figures: Figures, key: str, form: str) -> str:
    """A figure of walking; a dash where it was not measured."""
    return shown(math.nan if figures.walking is None else getattr(figures.walking, key), form)
