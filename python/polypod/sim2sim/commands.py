"""The commands of an evaluation, sampled once and given to every simulator."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.arrays import Array
from polypod.evaluation.walking import Schedule
from polypod.observation import columns_of


@dataclasses.dataclass(frozen=True)
class Commands:
    """Commands of the envs, as the task samples them, with its heading controller."""

    linear: Array
    """Forward and left velocity, m/s, [draws, envs, 2]."""
    heading: Array
    """Heading to turn to, rad, [draws, envs]."""
    turning: Array
    """Yaw rate where no heading is held, rad/s, [draws, envs]."""
    holds_heading: npt.NDArray[np.bool_]
    """Whether the yaw rate follows the heading, [draws, envs]."""
    standing: npt.NDArray[np.bool_]
    """Whether the robot shall stand still, [draws, envs]."""
    steps_per_draw: int
    stiffness: float
    """Yaw rate per heading error, 1/s."""
    turn_range: Array
    """Least and greatest yaw rate of the heading controller, rad/s, [2, envs]."""

    @classmethod
    def draw(
        cls, config: Mapping[str, Any], ranges: Mapping[str, Array], steps: int, step_dt: float, seed: int
    ) -> "Commands":
        """Draws for `steps` control steps.

        Args:
            config: the task's `[commands.base_velocity]`.
            ranges: `lin_vel_x`, `lin_vel_y` (m/s) and `ang_vel_z` (rad/s) of each env, [2, envs].
            steps: number of control steps.
            step_dt: length of a control step, s.
            seed: of the draws.
        """
        random = np.random.default_rng(seed)
        steps_per_draw = max(1, round(config["resampling_time_s"] / step_dt))
        shape = (-(-steps // steps_per_draw), ranges["ang_vel_z"].shape[1])

        def uniform(key: str) -> Array:
            low, high = ranges[key] if key in ranges else config[key]
            return random.uniform(low, high, size=shape)

        holds = config["heading_command"] & (random.uniform(size=shape) < config["rel_heading_envs"])
        linear = np.stack([uniform("lin_vel_x"), uniform("lin_vel_y")], axis=-1)
        heading, turning = uniform("heading"), uniform("ang_vel_z")
        standing = random.uniform(size=shape) < config["rel_standing_envs"]
        turns, sideways = config["rel_turning_envs"], config["rel_sideways_envs"]
        kind = random.uniform(size=shape)
        on_the_spot, to_the_side = kind < turns, (kind >= turns) & (kind < turns + sideways)
        linear[on_the_spot] = 0.0
        linear[to_the_side, 0] = 0.0
        turning[to_the_side] = 0.0
        return cls(
            linear=linear,
            heading=heading,
            turning=turning,
            holds_heading=holds & ~on_the_spot & ~to_the_side,
            standing=standing,
            steps_per_draw=steps_per_draw,
            stiffness=config["heading_control_stiffness"],
            turn_range=ranges["ang_vel_z"],
        )

    @classmethod
    def of(cls, schedule: Schedule) -> "Commands":
        """The commands of a schedule: velocities and yaw rates, no headings."""
        commands = schedule.commands.astype(np.float64)
        shape = commands.shape[:2]
        no = np.zeros(shape, dtype=np.bool_)
        return cls(
            linear=commands[..., :2],
            heading=np.zeros(shape),
            turning=commands[..., 2],
            holds_heading=no,
            standing=no,
            steps_per_draw=schedule.steps_per_segment,
            stiffness=0.0,
            turn_range=np.zeros((2, shape[1])),
        )

    def at(self, step: int, heading: Array) -> npt.NDArray[np.float32]:
        """Commanded velocity in a control step, [envs, 3]; `heading` [envs] is in rad."""
        draw = step // self.steps_per_draw
        error = (self.heading[draw] - heading + np.pi) % (2.0 * np.pi) - np.pi
        turning = np.where(
            self.holds_heading[draw], np.clip(self.stiffness * error, *self.turn_range), self.turning[draw]
        )
        command = np.column_stack([self.linear[draw], turning])
        command[self.standing[draw]] = 0.0
        return command.astype(np.float32)


class Commanded:
    """Envs that observe the commands given here, and no others."""

    def __init__(self, sim: _core.VecSim) -> None:
        """Begins an episode. Raises ConfigError for a task that observes no commands."""
        self._sim = sim
        self._columns, self._width = columns_of(sim, "velocity_command")
        self._given: npt.NDArray[np.float32] | None = None

    def observation(self, commands: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Gives commands [envs, 3]; returns the observation with them, [envs, numbers].

        The newest are the last of a history, which begins full of the first ones.
        """
        self._sim.set_command(commands)
        observation = self._sim.observation.copy()
        if self._given is None:
            self._given = np.tile(commands, (self._columns.stop - self._columns.start) // self._width)
        else:
            self._given = np.concatenate([self._given[:, self._width :], commands], axis=1)
        observation[:, self._columns] = self._given
        return observation
