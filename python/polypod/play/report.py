"""Report on the robots that were watched."""

from polypod.play.player import Player
from polypod.tables import Rows, console_of_output


def show(player: Player) -> None:
    """Prints a line per robot."""
    console = console_of_output()
    console.print(
        f"{player.sim.task_name}, {player.time:.4g} s (mean errors in m/s and rad/s; "
        "still: of a robot that stands still)",
        markup=False,
        soft_wrap=True,
    )
    table = Rows("robot", "err xy", "still", "err yaw", "still", "falls")
    for robot, tally in player.tallies.items():
        errors = (tally.error_vel_xy, tally.still_error_vel_xy, tally.error_vel_yaw, tally.still_error_vel_yaw)
        table.add_row(robot, *(f"{error:.3f}" for error in errors), str(tally.falls))
    table.print(console)
    for robot, distance in player.distances.items():
        console.print(f"  {robot}: its description is {distance}", markup=False, soft_wrap=True)
