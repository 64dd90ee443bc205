"""Comparisons of both simulators, whatever the policy is asked for."""

import dataclasses
from typing import Any, Generic, Protocol, TypeVar

from polypod.evaluation.results import finite
from polypod.provenance import Measured
from polypod.sim2sim.twin import Physics


class Both(Protocol):
    """One robot in both simulators, a dataclass."""

    @property
    def transfers(self) -> bool:
        """Whether the policy follows its commands in MuJoCo."""


Robot = TypeVar("Robot", bound=Both)


@dataclasses.dataclass(frozen=True)
class Compared(Generic[Robot]):
    """All robots, and what they were measured on."""

    command: str
    """The command line that compares the same again."""
    task: str
    envs_per_robot: int
    seed: int
    duration_s: float
    mujoco_version: str
    physics: Physics
    robots: dict[str, Robot]
    measured: Measured
    finer: dict[str, float] = dataclasses.field(default_factory=dict)
    """MuJoCo's physics steps, s, of robots that have finer ones, as their joints are light."""

    @property
    def transfers(self) -> bool:
        """Whether all robots do."""
        return all(robot.transfers for robot in self.robots.values())

    def judged(self, robot: Robot) -> dict[str, Any]:
        """Judgement of a robot by its figures, for JSON."""
        return {"transfers": robot.transfers}

    def as_dict(self) -> dict[str, Any]:
        """Returns the comparison for JSON."""
        whole = dataclasses.asdict(self)
        robots = {name: {**whole["robots"][name], **self.judged(robot)} for name, robot in self.robots.items()}
        content: dict[str, Any] = finite({**whole, "transfers": self.transfers, "robots": robots})
        return content
