"""Whether robots get up and stay up, in tasks that reward `upright` and `torso_height`.

A robot is up while the direction of the base that the task wants to point up is within `TILT` of
the vertical and the base is at least at `HEIGHT` of the height that the task wants.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, simulated
from polypod.arrays import Array
from polypod.evaluation.walking import numbers_of

TILT = math.radians(20.0)
"""Largest angle of a base that is up from the direction wanted, rad."""
HEIGHT = 0.9
"""Least height of a base that is up, as a share of the height wanted."""
WITHIN_S = 4.0
"""Time in which a robot must get up, s."""
ENOUGH = 0.9
"""Share of the episodes in which a robot that gets up must do so."""
BEFORE_THE_END_S = 1.0
"""Least time that a robot must have been up at the end of its episode, s."""


@dataclasses.dataclass(frozen=True)
class Rising:
    """Figures of one robot that gets up."""

    rate: float
    """Share of the episodes in which it is up within `WITHIN_S` and from then to the end."""
    time_s: float
    """Mean time until it is up to the end, of the episodes in which it is; NaN without any."""
    held_s: float
    """Mean of the longest uninterrupted time up, s."""
    least_held_s: float
    """5th percentile of the same: 95 of 100 episodes hold longer."""

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "Rising":
        """Reads the result of `dataclasses.asdict`; None stands for NaN."""
        return cls(**numbers_of(cls, content))


@dataclasses.dataclass(frozen=True)
class Goal:
    """State in which a robot is up."""

    up: Array
    """Unit vector in base axes that is to point up, [3]."""
    height: float
    """Height of the base that the task wants, m."""


def least_height(share: float, info: Mapping[str, Any]) -> float:
    """Height of a base at a share of its height, m: `MorphologyModel::least_height`.

    Args:
        share: of the height in the default pose.
        info: of the robot, see `VecSim.robot_info`.
    """
    height: float = info["base_height"]
    hips = height + float(info.get("hip_height", 0.0))
    return share * height if height >= 0.5 * hips else height - (1.0 - share) * hips


def goals(sim: _core.VecSim, configs: Mapping[str, Any]) -> dict[str, Goal]:
    """Goals of robots rewarded for `upright` and `torso_height`; `configs` are resolved."""
    infos, found = simulated.robots(sim), {}
    for robot in sim.robots:
        rewards = configs["task"].get("rewards", {}).get(configs["robots"][robot]["reward_set"], {})
        terms = {term.get("term", name): term for name, term in rewards.items() if term.get("enabled", True)}
        if "upright" not in terms or "torso_height" not in terms:
            continue
        up = np.array(terms["upright"].get("up") or (0.0, 0.0, 1.0), dtype=np.float64)
        torso = terms["torso_height"]
        height = torso.get("target_height") or least_height(torso.get("target_share", 1.0), infos[robot])
        found[robot] = Goal(up / np.linalg.norm(up), float(height))
    return found


def is_up(goal: Goal, gravity: Array, height: Array) -> npt.NDArray[np.bool_]:
    """Whether robots are up, [n].

    Args:
        goal: of the robot.
        gravity: [n, 3], unit vectors of gravity, base axes.
        height: [n], of the base above the ground, m.
    """
    up: npt.NDArray[np.bool_] = (-gravity @ goal.up >= math.cos(TILT)) & (height >= HEIGHT * goal.height)
    return up


class Uptime:
    """Counts how long envs are up, over the control steps of one episode per env."""

    def __init__(self, num_envs: int, step_dt: float) -> None:
        """Begins the episodes."""
        self._dt = step_dt
        self._steps = 0
        self._since = np.zeros(num_envs, dtype=np.int64)
        self._longest = np.zeros(num_envs, dtype=np.int64)

    def add(self, up: npt.NDArray[np.bool_]) -> None:
        """Sees a control step; `up` are the envs that run and are up."""
        self._steps += 1
        self._since = np.where(up, self._since + 1, 0)
        self._longest = np.maximum(self._longest, self._since)

    def episodes(self) -> dict[str, Array]:
        """Times by env, s, [num_envs]: `up`, from which it is up to the end; `held`."""
        since = self._since * self._dt
        is_late = since < BEFORE_THE_END_S - 1e-9
        return {"up": np.where(is_late, np.inf, self._steps * self._dt - since), "held": self._longest * self._dt}


class Record:
    """Control steps of one episode per env of a simulator."""

    def __init__(self, sim: _core.VecSim, found: Mapping[str, Goal]) -> None:
        """Begins the episodes."""
        self._sim, self._goals = sim, found
        self._uptime = Uptime(sim.num_envs, sim.step_dt)

    def add(self, running: npt.NDArray[np.bool_]) -> None:
        """Sees a control step; `running` are the envs that it has not ended by a failure."""
        gravity, height = self._sim.state("projected_gravity"), self._sim.state("base_height")[:, 0]
        up = np.zeros(self._sim.num_envs, dtype=np.bool_)
        for robot, goal in self._goals.items():
            mine = slice(*self._sim.env_ids(robot))
            up[mine] = is_up(goal, gravity[mine].astype(np.float64), height[mine].astype(np.float64))
        self._uptime.add(up & running)

    def episodes(self) -> dict[str, Array]:
        """See `Uptime.episodes`."""
        return self._uptime.episodes()


def rising(up: Array, held: Array) -> Rising:
    """Figures of the episodes of one robot, see `Record.episodes`."""
    reached = up[np.isfinite(up)]
    return Rising(
        rate=float((up <= WITHIN_S + 1e-9).mean()),
        time_s=float(reached.mean()) if reached.size else math.nan,
        held_s=float(held.mean()),
        least_held_s=float(np.quantile(held, 0.05)),
    )
