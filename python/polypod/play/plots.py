"""History of an env over the last seconds, for plots of velocities and of reward terms."""

import numpy as np
import numpy.typing as npt

from polypod.play.player import Player

SECONDS = 10.0
"""Length of the plots."""
AXES = ("forward (m/s)", "left (m/s)", "turn (rad/s)")


class History:
    """The last seconds of one env: a row per control step."""

    def __init__(self, player: Player, env: int) -> None:
        """Reads from the player's simulator."""
        self._sim = player.sim
        self._player = player
        self._env = env
        self.robot = next(
            robot for robot in player.sim.robots if player.sim.env_ids(robot)[0] <= env < player.sim.env_ids(robot)[1]
        )
        self._row = env - player.sim.env_ids(self.robot)[0]
        self.terms = player.sim.reward_terms(self.robot)
        """Names of the robot's reward terms."""
        self._length = round(SECONDS / player.step_dt)
        self.clear()

    def clear(self) -> None:
        """Forgets all rows and sums."""
        self._rows: list[npt.NDArray[np.float64]] = []
        self._sums = self._reward_sums()

    def add(self) -> None:
        """Takes the present state, once per control step."""
        command = self._sim.command[self._env]
        linear, angular = (self._sim.state(name)[self._env] for name in ("base_lin_vel", "base_ang_vel"))
        sums = self._reward_sums()
        # an episode that has just begun has no rewards yet
        grown = np.full(len(sums), np.nan) if self._sim.final_mask[self._env] else sums - self._sums
        self._sums = sums
        row = [[self._player.time], command, linear[:2], angular[2:], grown / self._player.step_dt]
        self._rows.append(np.concatenate(row).astype(np.float64))
        del self._rows[: -self._length]

    def velocities(self, axis: int) -> tuple[npt.NDArray[np.float64], ...]:
        """Time, s, command and velocity of an axis of `AXES`, [n] each."""
        rows = self._table()
        return rows[:, 0], rows[:, 1 + axis], rows[:, 4 + axis]

    def rewards(self) -> tuple[npt.NDArray[np.float64], ...]:
        """Time, s, and each reward term per second, [n] each."""
        rows = self._table()
        return (rows[:, 0], *rows[:, 7:].T)

    def _table(self) -> npt.NDArray[np.float64]:
        if not self._rows:
            return np.zeros((1, 7 + len(self.terms)))
        return np.stack(self._rows)

    def _reward_sums(self) -> npt.NDArray[np.float64]:
        return self._sim.reward_sums(self.robot)[self._row].astype(np.float64)
