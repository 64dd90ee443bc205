"""Commands and pushes of the episodes, the same in every simulator."""

import dataclasses
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from polypod.evaluation.walking import BOX, LEAST_RANGE, SEGMENT_S, SIDE, STOP, TURN, Ranges, Schedule, kinds_of

Commands = Callable[[Ranges, int, int, float, int], Schedule | None]
"""Function of a robot's command box, envs, control steps, length of a control step (s) and a seed.
Returns the commands of the envs, or None where the box has no such commands."""

TURN_RATE = 0.6
"""Rate of pure turns, rad/s, or the largest of the box."""
SIDE_SPEED = 0.5
"""Speed of pure side-steps, m/s, or the largest of the box."""
SHORT_S = 2.0
"""Time between two commands that change often, s."""
PUSH_SPEED = 0.5
"""Largest velocity along world x and y that a push adds, m/s: the flat task's own."""
PUSH_EVERY_S = 5.0
"""Time between two pushes, s; the first comes after half of it, in the middle of a command."""


def walking(ranges: Ranges, num_envs: int, steps: int, step_dt: float, seed: int) -> Schedule:
    """The commands of the definition of walking."""
    return Schedule.draw(ranges, num_envs, steps, step_dt, seed)


def every_2s(ranges: Ranges, num_envs: int, steps: int, step_dt: float, seed: int) -> Schedule:
    """Commands of the kinds of `walking`, each for `SHORT_S`."""
    per_segment = max(1, round(SHORT_S / step_dt))
    segments = -(-steps // per_segment)
    longer = Schedule.draw(ranges, num_envs, segments * max(1, round(SEGMENT_S / step_dt)), step_dt, seed)
    return dataclasses.replace(longer, steps_per_segment=per_segment, steps=steps)


def turns(ranges: Ranges, num_envs: int, steps: int, step_dt: float, seed: int) -> Schedule | None:
    """Pure turns to the left and to the right in turn."""
    return _to_both_sides(ranges, num_envs, steps, step_dt, TURN, 2, TURN_RATE)


def side_steps(ranges: Ranges, num_envs: int, steps: int, step_dt: float, seed: int) -> Schedule | None:
    """Pure side-steps to the left and to the right in turn."""
    return _to_both_sides(ranges, num_envs, steps, step_dt, SIDE, 1, SIDE_SPEED)


def stops(ranges: Ranges, num_envs: int, steps: int, step_dt: float, seed: int) -> Schedule:
    """A draw from the whole box and a stop in turn."""
    drawn = Schedule.draw(ranges, num_envs, steps, step_dt, seed)
    low, high = (np.array([ranges[key][end] for key in ("lin_vel_x", "lin_vel_y", "ang_vel_z")]) for end in (0, 1))
    commands, kinds = np.zeros_like(drawn.commands), np.full_like(drawn.kinds, STOP)
    for env in range(num_envs):
        draws = np.random.default_rng((seed, env)).random((len(commands), 3))
        commands[::2, env] = (low + (high - low) * draws)[::2]
    kinds[::2] = BOX
    return dataclasses.replace(drawn, commands=commands, kinds=kinds)


def _to_both_sides(
    ranges: Ranges, num_envs: int, steps: int, step_dt: float, kind: str, axis: int, speed: float
) -> Schedule | None:
    if kind not in kinds_of(ranges):
        return None
    low, high = ranges[("lin_vel_x", "lin_vel_y", "ang_vel_z")[axis]]
    left, right = min(speed, high), max(-speed, low)
    # a box may have one direction alone
    left, right = (left if left >= LEAST_RANGE else right), (right if right <= -LEAST_RANGE else left)
    per_segment = max(1, round(SEGMENT_S / step_dt))
    segments = max(1, -(-steps // per_segment))
    is_left = (np.arange(segments)[:, None] + np.arange(num_envs)) % 2 == 0
    commands = np.zeros((segments, num_envs, 3), dtype=np.float32)
    commands[..., axis] = np.where(is_left, left, right)
    return Schedule(commands, np.full((segments, num_envs), kind, dtype="U4"), per_segment, steps)


@dataclasses.dataclass(frozen=True)
class Pushes:
    """Velocities that are added to the bases of some envs."""

    first: int
    """Control step of the first push."""
    every: int
    """Control steps between two pushes."""
    velocities: npt.NDArray[np.float32]
    """Velocities that the pushes add, m/s, world axes, [pushes, envs, 3]."""

    @classmethod
    def draw(cls, num_envs: int, steps: int, step_dt: float, seed: int) -> "Pushes":
        """Draws the pushes of one robot's envs; an env's depend on the seed and its index alone."""
        every = max(1, round(PUSH_EVERY_S / step_dt))
        count = -(-steps // every)
        velocities = np.zeros((count, num_envs, 3), dtype=np.float32)
        for env in range(num_envs):
            draws = np.random.default_rng((seed, env, 1)).uniform(-PUSH_SPEED, PUSH_SPEED, size=(count, 2))
            velocities[:, env, :2] = draws
        return cls(every // 2, every, velocities)

    def at(self, step: int) -> npt.NDArray[np.float32] | None:
        """Velocities that are added before a control step, [envs, 3]; None for no push."""
        number, since = divmod(step - self.first, self.every)
        return self.velocities[number] if since == 0 and 0 <= number < len(self.velocities) else None


def description_factors(num_envs: int, size: int, error: float, seed: int) -> npt.NDArray[np.float32]:
    """Factors of the numbers that describe one robot, [envs, size].

    An env's depend on the seed and its index alone.
    """
    rows = [np.random.default_rng((seed, env, 2)).uniform(1.0 - error, 1.0 + error, size) for env in range(num_envs)]
    return np.array(rows, dtype=np.float32).reshape(num_envs, size)
