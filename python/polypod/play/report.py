"""How the robots did that were watched."""

from polypod.play.player import Player
from polypod.tables import Rows, console_of_output


def show(player: Player) -> None:
    """Prints a line per robot."""
    console = console_of_output()
    console.print(
        f"{player.sim.task_name}, {player.time:.4g} s (mean errors in m/s and rad/s)", markup=False, soft_wrap=True
    )
    table = Rows("robot", "err xy", "err yaw", "falls")
    for robot, tally in player.tallies.items():
        table.add_row(robot, f"{tally.error_vel_xy:.3f}", f"{tally.error_vel_yaw:.3f}", str(tally.falls))
    table.print(console)
