"""Episodes of several commands one after the other, and figures for each command."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.arrays import Array
from polypod.evaluation.walking import BOX, SIDE, STOP, TURN, Schedule

DEFAULT = "forward=0.8,turn=0.6,left=0.5,stop"
"""Speeds in m/s, turns in rad/s."""
SETTLE_S = 1.0
"""Time after a command from which the mean motion is taken, s."""
STOP_S = 2.0
"""Time after a stop from which it is taken, s."""
FASTEST = 20.0
"""Largest speed of a phase, m/s or rad/s."""
_DIRECTIONS = {
    "forward": (0, 1.0),
    "back": (0, -1.0),
    "left": (1, 1.0),
    "right": (1, -1.0),
    "turn": (2, 1.0),
    "stop": (0, 0.0),
}


@dataclasses.dataclass(frozen=True)
class Phase:
    """One command."""

    name: str
    command: tuple[float, float, float]
    """Forward and left velocity, m/s, and yaw rate, rad/s."""

    @property
    def kind(self) -> str:
        """Kind of segment, see `polypod.evaluation.walking`."""
        x, y, turn = self.command
        if x == y == turn == 0.0:
            return STOP
        return TURN if x == y == 0.0 else SIDE if x == turn == 0.0 else BOX


def parse(text: str) -> tuple[Phase, ...]:
    """Phases of a text such as `DEFAULT`. Raises ConfigError."""
    phases = []
    for entry in text.split(","):
        name, equals, value = (part.strip() for part in entry.partition("="))
        if name not in _DIRECTIONS:
            raise _core.ConfigError(
                f"--phases: there is no phase {name[:80]!r}; write some of {', '.join(_DIRECTIONS)}, such as {DEFAULT}"
            )
        axis, sign = _DIRECTIONS[name]
        if sign == 0.0:
            if equals:
                raise _core.ConfigError(f"--phases: {entry.strip()[:80]}: a stop has no speed")
            phases.append(Phase(name, (0.0, 0.0, 0.0)))
            continue
        try:
            speed = float(value)
        except ValueError:
            speed = math.nan
        if not 0.0 < abs(speed) <= FASTEST:
            raise _core.ConfigError(
                f"--phases: {entry.strip()[:80]}: give a speed up to {FASTEST:g}, such as {name}=0.5"
            )
        command = [0.0, 0.0, 0.0]
        command[axis] = sign * speed
        phases.append(Phase(f"{name} {speed:g}", (command[0], command[1], command[2])))
    return tuple(phases)


def schedule(phases: Sequence[Phase], rounds: int, seconds: float, num_envs: int, step_dt: float) -> Schedule:
    """The phases, `rounds` times, each for `seconds`, in every env."""
    per_phase = max(1, round(seconds / step_dt))
    commands = np.array([phase.command for phase in phases] * rounds, dtype=np.float32)
    kinds = np.array([phase.kind for phase in phases] * rounds, dtype="U4")
    return Schedule(
        np.repeat(commands[:, None], num_envs, axis=1),
        np.repeat(kinds[:, None], num_envs, axis=1),
        per_phase,
        per_phase * len(commands),
    )


@dataclasses.dataclass(frozen=True)
class PhaseFigures:
    """One robot in one phase, over all rounds and episodes, until it falls."""

    phase: str
    command: tuple[float, float, float]
    error_vel_xy: float
    """Mean planar velocity error, m/s."""
    error_vel_yaw: float
    """Mean yaw rate error, rad/s."""
    velocity: tuple[float, float, float]
    """Mean forward and left velocity, m/s, and yaw rate, rad/s, from `SETTLE_S` (`STOP_S`) after
    the command on."""
    reached: float
    """Share of the asked motion that this is; NaN of a stop."""
    drift: float
    """Length of the mean planar velocity of a stop, m/s; NaN of other phases."""
    falls: float
    """Share of the episodes with a fall in this phase."""
    saturated: float
    """Share of the physics steps and joints in which an actuator was at its limit; NaN where that
    is not measured."""
    worst_joint: str
    """The joint that was at its limit most often."""
    worst_saturated: float
    """Share of the physics steps in which it was."""


class PhaseRecord:
    """Measures a simulation of the phases."""

    def __init__(self, phases: Sequence[Phase], plan: Schedule, step_dt: float, joints: Sequence[str]) -> None:
        """Begins an episode; `plan` is the schedule of the phases."""
        self._phases, self._plan, self._joints = phases, plan, joints
        self._num_envs = plan.commands.shape[1]
        self._step_dt = step_dt
        self._active = np.ones(self._num_envs, dtype=np.bool_)
        count = len(phases)
        self._steps = np.zeros((count, self._num_envs))
        self._errors = np.zeros((count, self._num_envs, 2))
        self._settled = np.zeros((count, self._num_envs))
        self._motion = np.zeros((count, self._num_envs, 3))
        self._falls = np.zeros((count, self._num_envs))
        self._saturated = np.zeros((count, len(joints)))
        self._watched = np.zeros(count)
        self._step = 0

    def see(
        self, velocity: npt.NDArray[np.float32], yaw_rate: npt.NDArray[np.float32], fell: npt.NDArray[np.bool_]
    ) -> None:
        """Adds a control step of polypod."""
        self.add(velocity.astype(np.float64), yaw_rate.astype(np.float64), fell)

    def add(
        self,
        velocity: Array,
        yaw_rate: Array,
        fell: npt.NDArray[np.bool_],
        saturated: Array | None = None,
        watched: Array | None = None,
    ) -> None:
        """Adds a control step.

        The last two are counts of its physics steps, [envs, joints] and [envs].
        """
        segment, since = divmod(self._step, self._plan.steps_per_segment)
        phase = segment % len(self._phases)
        command = np.array(self._phases[phase].command)
        motion = np.column_stack([velocity, yaw_rate]).astype(np.float64)
        active = self._active & np.isfinite(motion).all(axis=1)
        self._steps[phase] += active
        errors = [np.linalg.norm(command[:2] - motion[:, :2], axis=1), np.abs(command[2] - motion[:, 2])]
        self._errors[phase] += np.where(active[:, None], np.column_stack(errors), 0.0)
        is_stop = self._phases[phase].kind == STOP
        if since * self._step_dt >= (STOP_S if is_stop else SETTLE_S):
            self._settled[phase] += active
            self._motion[phase] += np.where(active[:, None], motion, 0.0)
        if saturated is not None and watched is not None:
            self._saturated[phase] += saturated[self._active].sum(axis=0)
            self._watched[phase] += watched[self._active].sum()
        falls = self._active & (np.asarray(fell, dtype=np.bool_) | ~np.isfinite(motion).all(axis=1))
        self._falls[phase] += falls
        self._active &= ~falls
        self._step += 1

    def figures(self) -> list[PhaseFigures]:
        """The figures of all phases."""
        found = []
        for index, phase in enumerate(self._phases):
            steps, settled = self._steps[index].sum(), self._settled[index].sum()
            errors = self._errors[index].sum(axis=0) / steps if steps else np.full(2, np.nan)
            mean = self._motion[index].sum(axis=0) / settled if settled else np.full(3, np.nan)
            command = np.array(phase.command)
            is_stop = phase.kind == STOP
            share = self._saturated[index] / self._watched[index] if self._watched[index] else None
            worst = None if share is None else int(share.argmax())
            found.append(
                PhaseFigures(
                    phase=phase.name,
                    command=phase.command,
                    error_vel_xy=float(errors[0]),
                    error_vel_yaw=float(errors[1]),
                    velocity=(float(mean[0]), float(mean[1]), float(mean[2])),
                    reached=math.nan if is_stop else float(mean @ command / (command @ command)),
                    drift=float(np.linalg.norm(mean[:2])) if is_stop else math.nan,
                    falls=float(self._falls[index].sum() / self._num_envs),
                    saturated=math.nan if share is None else float(share.mean()),
                    worst_joint="" if worst is None else self._joints[worst],
                    worst_saturated=math.nan if share is None or worst is None else float(share[worst]),
                )
            )
        return found
