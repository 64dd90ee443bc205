"""How the robots did that were watched."""

import sys

from rich.console import Console

from polypod.play.player import Player
from polypod.training.report import table_of


def show(player: Player) -> None:
    """Prints a line per robot."""
    console = Console(width=None if sys.stdout.isatty() else 120, highlight=False)
    console.print(
        f"{player.sim.task_name}, {player.time:.4g} s (mean errors in m/s and rad/s)", markup=False, soft_wrap=True
    )
    table = table_of("robot", "err xy", "err yaw", "falls")
    for robot, tally in player.tallies.items():
        table.add_row(robot, f"{tally.error_vel_xy:.3f}", f"{tally.error_vel_yaw:.3f}", str(tally.falls))
    console.print(table)
