"""Report of `polypod sim2sim`: a table with both simulators side by side."""

import math

from polypod.sim2sim.run import Comparison, Figures
from polypod.tables import Rows, console_of_output, shown


def show(comparison: Comparison) -> None:
    """Prints the figures."""
    console = console_of_output()
    physics = comparison.physics
    console.print(
        f"{comparison.task}: {comparison.envs_per_robot} envs per robot, {comparison.duration_s:g} s; "
        f"MuJoCo {comparison.mujoco_version}, {physics.integrator} at {1e3 * physics.dt:g} ms, "
        f"friction {physics.friction:g}{', soft contact' if physics.soft_contact else ''} (errors in m/s and rad/s; "
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


def _known(figures: Figures, key: str, form: str) -> str:
    """A figure of walking; a dash where it was not measured."""
    return shown(math.nan if figures.walking is None else getattr(figures.walking, key), form)
