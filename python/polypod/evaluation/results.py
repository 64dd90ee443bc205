"""The figures of an evaluation, from sums over episodes."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod.arrays import Array
from polypod.descriptions import Distance
from polypod.evaluation.rising import Rising
from polypod.evaluation.walking import Walking
from polypod.provenance import Measured

FOLLOWS = 0.5, 0.2
"""An episode succeeds if the robot stays up and its planar velocity error, averaged over the
episode, is at most this share of a standing robot's, or this much (m/s)."""


@dataclasses.dataclass(frozen=True)
class TileResult:
    """One robot's episodes that began on tiles of one type and level."""

    level: int
    episodes: int
    success: float
    """Share of the episodes without a fall in which the robot followed its commands, see
    `FOLLOWS`."""
    fall_rate: float
    power: float = math.nan
    """W, as of a robot. This figure and the next two are NaN in files of builds without them."""
    foot_slip: float = math.nan
    """m/s, as of a robot."""
    stumbles: float = math.nan
    """Share of the feet's contacts, as of a robot."""


@dataclasses.dataclass(frozen=True)
class CommandResult:
    """One robot's episodes with one command of the grid."""

    command: tuple[float, float, float]
    """Forward and left velocity, m/s, and yaw rate, rad/s."""
    episodes: int
    error_vel_xy: float
    error_vel_yaw: float
    fall_rate: float
    power: float


@dataclasses.dataclass(frozen=True)
class RobotResult:
    """One robot's figures.

    Errors and power are time averages per episode, averaged over episodes.
    """

    episodes: int
    reward_per_s: float
    error_vel_xy: float
    """m/s, between commanded and actual planar velocity."""
    error_vel_yaw: float
    """rad/s, between commanded and actual yaw rate."""
    still_error_vel_xy: float
    """m/s, the same error for a robot that does not move."""
    still_error_vel_yaw: float
    """rad/s, the yaw rate error for a robot that does not move."""
    fall_rate: float
    """Share of the episodes that terminated before the time limit."""
    success_rate: float
    """Share of the episodes without a fall in which the robot followed its commands, see
    `FOLLOWS`."""
    tracking_reward: float
    """Share of the reference's tracking reward, exp(-error^2 / 0.25) of the planar velocity and
    half as much of the yaw rate, that the robot earned in the time of a whole episode: 1 for
    perfect following, nothing after a fall."""
    episode_length_s: float
    power: float
    """W, mechanical, of all joints: see `measures.joint_power`."""
    cost_of_transport: float
    """Energy of all episodes over weight times planar distance; the weight is that of the robot
    without random masses. NaN for a robot that has not moved or has no weight."""
    foot_slip: float
    """m/s, mean planar speed of the feet while they are in contact; NaN for one that never is."""
    stumbles: float = math.nan
    """Share of the feet's contacts in which a foot has met a wall, see `measures.stumbles`; NaN for
    feet that touch nothing."""
    robot_class: str = ""
    """Humanoid, biped, quadruped, hexapod; empty in files of builds that did not write it."""
    terrain: dict[str, list[TileResult]] = dataclasses.field(default_factory=dict)
    """Results by type of tile, easiest level first; empty without a generated terrain."""
    commands: list[CommandResult] = dataclasses.field(default_factory=list)
    """Results by command; empty without a grid of commands."""
    walking: Walking | None = None
    """Figures of the definition of walking; None where the commands were not those of its
    schedule."""
    rising: Rising | None = None
    """Figures of getting up; None where the task does not reward it."""

    def success(self, kind: str | None = None, level: int | None = None) -> float:
        """Share of successful episodes on tiles of a type and level, or of all; NaN without any."""
        return self.on_tiles("success", kind, level)

    def on_tiles(self, figure: str, kind: str | None = None, level: int | None = None) -> float:
        """Mean over the episodes of a figure of `TileResult`, on tiles of a type and level."""
        tiles = [
            (getattr(tile, figure), tile.episodes)
            for name, tiles in self.terrain.items()
            for tile in tiles
            if kind in (None, name) and level in (None, tile.level)
        ]
        known = [(value, episodes) for value, episodes in tiles if not math.isnan(value)]
        episodes = sum(count for _, count in known)
        return sum(value * count for value, count in known) / episodes if episodes else math.nan


FIGURES = tuple(field.name for field in dataclasses.fields(RobotResult) if field.type is float)
"""Names of the numbers that describe a robot."""


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """The figures of all robots and what they were measured on."""

    task: str
    num_envs: int
    episodes: int
    """Number of episodes that each env counts."""
    steps: int | None
    """Control steps per episode; None: a whole one."""
    seed: int
    overrides: list[str]
    """Changes to the task, on top of the training's own."""
    duration_s: float
    randomized: bool
    """Whether there was any noise, push or randomisation."""
    grid: tuple[int, int, int] | None
    """Commands along each axis, where each episode held one; None: see `commands`."""
    robots: dict[str, RobotResult]
    checkpoint: dict[str, Any] | None = None
    """Origin of the policy: file, iteration, and the task, robots and seed of its training."""
    measured: Measured | None = None
    """Date, machine and commit; None in files of builds that did not write it."""
    disturbances: list[str] = dataclasses.field(default_factory=list)
    """Keys of the noise, the pushes and the randomisation that were on, see
    `polypod._core.disturbances`."""
    distances: dict[str, Distance] = dataclasses.field(default_factory=dict)
    """Distance from the training bodies, by robot that the policy was not trained on."""
    commands: str = "task"
    """Source of the commands: "walking" for the schedule of `polypod.evaluation.walking`, "grid",
    or "task" for commands as the task draws them. Files of builds that did not write it hold the
    latter two."""

    def as_dict(self) -> dict[str, Any]:
        """Returns the figures for JSON: None stands for a number that is not finite."""
        content: dict[str, Any] = finite(dataclasses.asdict(self))
        return content

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "Evaluation":
        """Reads the result of `as_dict`. Raises KeyError or TypeError for anything else."""
        robots = {name: _robot_from(robot) for name, robot in content["robots"].items()}
        grid = tuple(content["grid"]) if content["grid"] is not None else None
        commands = content.get("commands", "task" if grid is None else "grid")
        distances = {name: Distance(**entry) for name, entry in content.get("distances", {}).items()}
        return cls(**{**content, "grid": grid, "commands": commands, "robots": robots, "distances": distances})


def _robot_from(content: Mapping[str, Any]) -> RobotResult:
    numbers = {key: math.nan for key in FIGURES if content.get(key) is None}
    terrain = {kind: [_tile_from(tile) for tile in tiles] for kind, tiles in content["terrain"].items()}
    commands = [CommandResult(**{**entry, "command": tuple(entry["command"])}) for entry in content["commands"]]
    walking = Walking.from_dict(content["walking"]) if content.get("walking") is not None else None
    rising = Rising.from_dict(content["rising"]) if content.get("rising") is not None else None
    nested = {"terrain": terrain, "commands": commands, "walking": walking, "rising": rising}
    return RobotResult(**{**content, **numbers, **nested})


def _tile_from(content: Mapping[str, Any]) -> TileResult:
    figures: dict[str, Any] = {key: math.nan if value is None else value for key, value in content.items()}
    return TileResult(**figures)


def finite(content: Any) -> Any:
    """The same nested lists and dictionaries, with None for numbers that JSON cannot hold."""
    if isinstance(content, dict):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def robot_result(
    sums: Mapping[str, Array], length: int, step_dt: float, weight: float, kinds: Sequence[str]
) -> RobotResult:
    """One robot's figures.

    Args:
        sums: of `measures.of_step` over each episode, [episodes, envs]; with `level`, and `command`
            [episodes, envs, 3] where the commands are those of a grid.
        length: control steps that an episode may last.
        step_dt: length of a control step, s.
        weight: of the robot, N.
        kinds: types of the envs' tiles; empty without generated terrain.
    """
    steps = sums["steps"]

    def time_average(key: str) -> float:
        return float(np.mean(sums[key] / steps))

    success = succeeds(sums)
    carried = weight * float(sums["speed"].sum() * step_dt)
    return RobotResult(
        episodes=steps.size,
        reward_per_s=float(sums["reward"].sum() / (steps.sum() * step_dt)),
        error_vel_xy=time_average("xy"),
        error_vel_yaw=time_average("yaw"),
        still_error_vel_xy=time_average("still_xy"),
        still_error_vel_yaw=time_average("still_yaw"),
        fall_rate=float(sums["fell"].mean()),
        success_rate=float(success.mean()),
        tracking_reward=float(sums["tracking"].mean() / length),
        episode_length_s=float(steps.mean() * step_dt),
        power=time_average("power"),
        cost_of_transport=float(sums["power"].sum() * step_dt) / carried if carried > 0.0 else math.nan,
        foot_slip=_per_contact(sums, "slip"),
        stumbles=_per_contact(sums, "stumbles"),
        terrain=_tiles(sums, success, kinds),
        commands=_commands(sums) if "command" in sums else [],
    )


def _per_contact(sums: Mapping[str, Array], key: str, here: Any = ...) -> float:
    """A sum over all episodes, or those of a mask, divided by the contacts of their feet."""
    contact = float(sums["contact"][here].sum())
    return float(sums[key][here].sum()) / contact if contact > 0.0 else math.nan


def succeeds(sums: Mapping[str, Array]) -> npt.NDArray[np.bool_]:
    """Tells which episodes succeed, see `FOLLOWS`, by the sums fell, xy, still_xy and steps."""
    share, slack = FOLLOWS
    allowed = np.maximum(share * sums["still_xy"], slack * sums["steps"])
    success: npt.NDArray[np.bool_] = (sums["fell"] == 0) & (sums["xy"] <= allowed)
    return success


def _tiles(
    sums: Mapping[str, Array], success: npt.NDArray[np.bool_], kinds: Sequence[str]
) -> dict[str, list[TileResult]]:
    fell = sums["fell"] > 0
    result: dict[str, list[TileResult]] = {}
    for kind in dict.fromkeys(kinds):
        on_kind = np.broadcast_to(np.array([kind == other for other in kinds]), fell.shape)
        for level in np.unique(sums["level"][on_kind]):
            here = on_kind & (sums["level"] == level)
            tile = TileResult(
                level=int(level),
                episodes=int(here.sum()),
                success=float(success[here].mean()),
                fall_rate=float(fell[here].mean()),
                power=float(np.mean(sums["power"][here] / sums["steps"][here])),
                foot_slip=_per_contact(sums, "slip", here),
                stumbles=_per_contact(sums, "stumbles", here),
            )
            result.setdefault(kind, []).append(tile)
    return result


def _commands(sums: Mapping[str, Array]) -> list[CommandResult]:
    flat = {key: value.reshape(sums["steps"].size, -1) for key, value in sums.items()}
    results = []
    for command in np.unique(flat["command"], axis=0):
        here = (flat["command"] == command).all(axis=1)
        average = {key: float(np.mean(flat[key][here] / flat["steps"][here])) for key in ("xy", "yaw", "power")}
        vx, vy, yaw_rate = (float(x) for x in command)
        results.append(
            CommandResult(
                command=(vx, vy, yaw_rate),
                episodes=int(here.sum()),
                error_vel_xy=average["xy"],
                error_vel_yaw=average["yaw"],
                fall_rate=float(flat["fell"][here].mean()),
                power=average["power"],
            )
        )
    return results
