"""Figures of the battery and their bounds."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from polypod.evaluation import walking
from polypod.evaluation.results import finite
from polypod.evaluation.walking import Record, Walking
from polypod.provenance import Measured
from polypod.robustness.conditions import Bound


@dataclasses.dataclass(frozen=True)
class Cell:
    """One robot in one condition and simulator. A figure that was not measured is NaN.

    Errors, `turn_reached`, `side_reached` and drifts are those of
    `polypod.evaluation.walking.Walking`.
    """

    episodes: int
    fall_rate: float
    """Share of the episodes with a fall."""
    kept: float
    """Share of an episode until a fall, mean over the episodes."""
    error_vel_xy: float
    still_error_vel_xy: float
    error_vel_yaw: float
    still_error_vel_yaw: float
    turn_error: float
    """Error of the yaw rate in pure turns, mean over their time, rad/s."""
    turn_reached: float
    side_reached: float
    drift_xy: float
    drift_yaw: float
    faults: tuple[str, ...]
    """Bounds that the robot does not keep to, with its figures; empty if it keeps to all."""


FIGURES = tuple(field.name for field in dataclasses.fields(Cell) if field.type is float)
"""Names of the numbers of `Cell`."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One condition in one simulator."""

    condition: str
    varies: str
    simulator: str
    """`polypod`, or `mujoco` with the dimension of its contacts: `mujoco-3`, `mujoco-4`,
    `mujoco-6`. For a maker's model `model`, with contacts as its file has them, or with their
    dimension."""
    robots: dict[str, Cell]
    not_applicable: dict[str, str]
    """Reasons for missing figures, by robot."""

    @property
    def worst(self) -> str | None:
        """The robot farthest from its bounds.

        One with a fault comes before one without, then by falls and turns.
        """

        def badness(name: str) -> tuple[float, ...]:
            cell = self.robots[name]
            turn = 0.0 if math.isnan(cell.turn_error) else cell.turn_error
            return (float(bool(cell.faults)), cell.fall_rate, 1.0 - cell.kept, turn, cell.error_vel_xy)

        return max(self.robots, key=badness, default=None)

    @property
    def is_within(self) -> bool:
        """Whether all robots with figures keep to their bounds."""
        return not any(cell.faults for cell in self.robots.values())


@dataclasses.dataclass(frozen=True)
class Battery:
    """The battery of one policy."""

    checkpoint: dict[str, Any]
    """File of the checkpoint as commands show it, and the file's SHA-256."""
    command: str
    """The command line that measures the same again."""
    task: str
    seed: int
    duration_s: float
    """Length of an episode, s."""
    envs: dict[str, int]
    """Envs per robot and condition, by simulator: `polypod`, `mujoco`."""
    robots: list[str]
    rows: list[Row]
    measured: Measured

    @property
    def is_within(self) -> bool:
        """Whether every row is within the bounds, and one has figures."""
        return all(row.is_within for row in self.rows) and any(row.robots for row in self.rows)

    def as_dict(self) -> dict[str, Any]:
        """Returns the results for JSON."""
        content: dict[str, Any] = finite({**dataclasses.asdict(self), "is_within": self.is_within})
        return content

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "Battery":
        """Reads `as_dict`. Raises KeyError or TypeError for anything else."""
        fields = {key: value for key, value in content.items() if key != "is_within"}
        rows = [Row(**{**row, "robots": _cells(row["robots"])}) for row in content["rows"]]
        return cls(**{**fields, "rows": rows})


def _cells(content: Mapping[str, Mapping[str, Any]]) -> dict[str, Cell]:
    return {name: Cell(**{**_numbers(cell), "faults": tuple(cell["faults"])}) for name, cell in content.items()}


def _numbers(cell: Mapping[str, Any]) -> dict[str, Any]:
    """The cell with NaN in the place of figures that JSON has no word for."""
    return {key: math.nan if value is None and key in FIGURES else value for key, value in cell.items()}


def cell(record: Record, envs: slice, bound: Bound, *, whole: bool) -> Cell:
    """Figures of one robot's envs.

    Args:
        record: what the simulation did.
        envs: those of the robot.
        bound: the robot's bound.
        whole: whether the episodes are whole ones, of which nothing that `bound` names may be
            missing.
    """
    figures = walking.figures([record], envs)
    turns = figures.by_kind.get(walking.TURN)
    kept = float(record.steps[envs].mean() / record.schedule.steps)
    turn_error = math.nan if turns is None else turns.error_vel_yaw
    return Cell(
        episodes=figures.episodes,
        fall_rate=figures.fall_rate,
        kept=kept,
        error_vel_xy=figures.error_vel_xy,
        still_error_vel_xy=figures.still_error_vel_xy,
        error_vel_yaw=figures.error_vel_yaw,
        still_error_vel_yaw=figures.still_error_vel_yaw,
        turn_error=turn_error,
        turn_reached=figures.turn_reached,
        side_reached=figures.side_reached,
        drift_xy=figures.drift_xy,
        drift_yaw=figures.drift_yaw,
        faults=tuple(_faults(figures, kept, turn_error, bound, whole)),
    )


def _faults(figures: Walking, kept: float, turn_error: float, bound: Bound, whole: bool) -> list[str]:
    found = []
    if figures.fall_rate > bound.falls:
        found.append(f"falls in {figures.fall_rate:.1%} of the episodes, {bound.falls:.0%} allowed")
    if bound.kept is not None and kept < bound.kept:
        found.append(f"keeps {kept:.0%} of the episode, {bound.kept:.0%} wanted")
    if bound.turn_error is not None and not turn_error <= bound.turn_error:
        found.append(f"turns with an error of {turn_error:.3f} rad/s, {bound.turn_error:g} allowed")
    if bound.walks:
        clauses = walking.faults(figures, whole)
        # the battery has a bound for falls that is at least as narrow
        found += [text for clause, text in clauses.items() if clause != "falls"]
    return found
