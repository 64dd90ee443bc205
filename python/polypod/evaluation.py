"""How well a policy walks: one full episode per env, deterministic, in the task's Play variant."""

import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from polypod import _core
from polypod.networks import build_actor
from polypod.training import run_dir

ENVS_PER_ROBOT = 64

Policy = Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]]
"""Observations [num_envs, num_obs] to actions [num_envs, num_actions]."""


FOLLOWS = 0.5, 0.2
"""An episode succeeds if the robot stays up and its planar velocity error, averaged over the episode, is at most this
share of a standing robot's, or this much (m/s)."""


@dataclasses.dataclass(frozen=True)
class TileResult:
    """One robot's episodes that began on tiles of one type and level."""

    level: int
    episodes: int
    success: float
    """Share of the episodes without a fall in which the robot followed its commands, see `FOLLOWS`."""
    fall_rate: float


@dataclasses.dataclass(frozen=True)
class RobotResult:
    """One robot's figures. Errors are time averages per env, averaged over envs; every env counts once."""

    episodes: int
    reward_per_s: float
    error_vel_xy: float
    """m/s, between commanded and actual planar velocity."""
    error_vel_yaw: float
    """rad/s, between commanded and actual yaw rate."""
    still_error_vel_xy: float
    """m/s, the same error for a robot that does not move."""
    still_error_vel_yaw: float
    """rad/s, likewise."""
    fall_rate: float
    """Share of the episodes that terminated before the time limit."""
    episode_length_s: float
    terrain: dict[str, list[TileResult]] = dataclasses.field(default_factory=dict)
    """By type of tile, easiest level first; empty where the ground is no generated terrain."""

    def success(self, kind: str | None = None, level: int | None = None) -> float:
        """Share of the successful episodes on tiles of a type and level, or of all; NaN without any."""
        tiles = [
            tile
            for name, tiles in self.terrain.items()
            for tile in tiles
            if kind in (None, name) and level in (None, tile.level)
        ]
        episodes = sum(tile.episodes for tile in tiles)
        return sum(tile.success * tile.episodes for tile in tiles) / episodes if episodes else float("nan")


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """The figures of all robots and what they were measured on."""

    task: str
    num_envs: int
    seed: int
    duration_s: float
    robots: dict[str, RobotResult]

    def as_dict(self) -> dict[str, Any]:
        """The same, for JSON."""
        return dataclasses.asdict(self)


def play_task(task: str) -> str:
    """The Play variant of a task: without noise, pushes and randomisation; the task itself where there is none."""
    by_any_name = {name: entry["name"] for entry in _core.tasks() for name in (entry["name"], *entry["aliases"])}
    full_name = by_any_name.get(task, task)
    variant = re.sub(r"-(v\d+)$", r"-Play-\1", full_name)
    return variant if variant in by_any_name else full_name


def load_network(checkpoint: dict[str, Any], model: dict[str, Any]) -> MLPModel:
    """Builds the actor of a checkpoint, ready for inference.

    Args:
        checkpoint: what `run_dir.load_checkpoint` returns.
        model: the manifest's `policy`: sizes and constructor arguments.

    Raises:
        ConfigError: when the weights do not fit the manifest, and for a network that is not known.
    """
    network = build_actor(model)
    try:
        network.load_state_dict(checkpoint["actor_state_dict"])
    except RuntimeError as error:
        raise _core.ConfigError(
            f"the checkpoint's weights do not fit its manifest: {str(error).splitlines()[-1].strip()}"
        ) from error
    network.eval()
    return network


def load_policy(checkpoint: dict[str, Any], model: dict[str, Any]) -> Policy:
    """The deterministic policy of a checkpoint; arguments and errors are those of `load_network`."""
    network = load_network(checkpoint, model)

    def policy(observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        with torch.inference_mode():
            batch = TensorDict({"policy": torch.from_numpy(observations)}, batch_size=[len(observations)])
            return network(batch).numpy()

    return policy


def evaluate(
    policy: Policy,
    task: str,
    robots: Sequence[str] | None = None,
    num_envs: int | None = None,
    episodes: int = 1,
    steps: int | None = None,
    seed: int = 0,
    threads: int | None = None,
    overrides: Sequence[str] = (),
) -> Evaluation:
    """Runs a policy in a task's Play variant.

    Args:
        policy: see `Policy`.
        task: name or alias of the task, or of its Play variant.
        robots: names of the robots; None: those of the task.
        num_envs: number of envs; None: `ENVS_PER_ROBOT` per robot.
        episodes: full episodes per env.
        steps: control steps per episode, when a whole one is too long; an env that still stands then has not fallen.
        seed: of the first episode; each further one takes the next.
        threads: worker threads; None: one per core.
        overrides: `key=value` pairs for the task's configuration.

    Raises:
        ConfigError: for an unknown task or robot, and for a task without the observation terms that errors need.
    """
    for name, count in (("num_envs", num_envs), ("episodes", episodes), ("steps", steps)):
        if count is not None and count < 1:
            raise _core.ConfigError(f"{name} = {count} must be at least 1")
    name = play_task(task)
    named = list(robots) if robots is not None else None
    if num_envs is None:
        num_envs = ENVS_PER_ROBOT * len(named or _core.robots())
    sim = _core.VecSim(name, num_envs, robots=named, seed=seed, threads=threads, overrides=list(overrides))
    length = min(steps or sim.max_episode_length, sim.max_episode_length)
    runs = []
    for episode in range(episodes):
        sim.reset(seed + episode)
        levels, kinds = sim.terrain_tiles()
        runs.append({**_episode(sim, policy, length), "level": levels.astype(np.float64)})
    figures = {key: np.stack([run[key] for run in runs]) for key in runs[0]}
    results = {robot: _result(figures, slice(*sim.env_ids(robot)), sim.step_dt, kinds) for robot in sim.robots}
    return Evaluation(sim.task_name, sim.num_envs, seed, length * sim.step_dt, results)


def _episode(sim: _core.VecSim, policy: Policy, length: int) -> dict[str, npt.NDArray[np.float64]]:
    """Sums over each env's first episode: `steps`, `reward`, `fell` and the errors, all [num_envs]."""
    velocity, turn, command = (_columns(sim, term) for term in ("base_lin_vel", "base_ang_vel", "velocity_commands"))
    keys = ("steps", "reward", "fell", "xy", "yaw", "still_xy", "still_yaw")
    sums = {key: np.zeros(sim.num_envs) for key in keys}
    running = np.ones(sim.num_envs, dtype=np.bool_)
    for _ in range(length):
        sim.step(policy(sim.observation))
        # An env that has just ended shows its next episode already; what belongs to this one is its final observation.
        observed = np.where(sim.final_mask[:, None], sim.final_obs, sim.observation)
        wanted = observed[:, command]
        errors = {
            "steps": np.ones(sim.num_envs),
            "reward": sim.reward,
            "fell": sim.terminated,
            "xy": np.linalg.norm(wanted[:, :2] - observed[:, velocity][:, :2], axis=1),
            "yaw": np.abs(wanted[:, 2] - observed[:, turn][:, 2]),
            "still_xy": np.linalg.norm(wanted[:, :2], axis=1),
            "still_yaw": np.abs(wanted[:, 2]),
        }
        for key, value in errors.items():
            sums[key] += np.where(running, value, 0.0)
        running &= ~(sim.terminated | sim.truncated)
        if not running.any():
            break
    return sums


def _columns(sim: _core.VecSim, term: str) -> slice:
    start = 0
    for name, size in sim.observation_layout:
        if name == term:
            return slice(start, start + size)
        start += size
    raise _core.ConfigError(f"task {sim.task_name} does not observe {term!r}, which an evaluation reads; add the term")


def _tiles(of_robot: dict[str, npt.NDArray[np.float64]], kinds: Sequence[str]) -> dict[str, list[TileResult]]:
    """By type and level; `kinds` are the types of the robot's envs."""
    fell = of_robot["fell"] > 0
    share, slack = FOLLOWS
    allowed = np.maximum(share * of_robot["still_xy"], slack * of_robot["steps"])
    success = ~fell & (of_robot["xy"] <= allowed)
    result: dict[str, list[TileResult]] = {}
    for kind in dict.fromkeys(kinds):
        on_kind = np.broadcast_to(np.array([kind == other for other in kinds]), fell.shape)
        for level in np.unique(of_robot["level"][on_kind]):
            here = on_kind & (of_robot["level"] == level)
            tile = TileResult(int(level), int(here.sum()), float(success[here].mean()), float(fell[here].mean()))
            result.setdefault(kind, []).append(tile)
    return result


def _result(
    figures: dict[str, npt.NDArray[np.float64]], envs: slice, step_dt: float, kinds: Sequence[str]
) -> RobotResult:
    """`figures` are sums per episode and env, [episodes, num_envs]; `kinds` the types of the envs' tiles, if any."""
    of_robot = {key: value[:, envs] for key, value in figures.items()}
    steps = of_robot["steps"]

    def time_average(key: str) -> float:
        return float(np.mean(of_robot[key] / steps))

    return RobotResult(
        episodes=steps.size,
        reward_per_s=float(of_robot["reward"].sum() / (steps.sum() * step_dt)),
        error_vel_xy=time_average("xy"),
        error_vel_yaw=time_average("yaw"),
        still_error_vel_xy=time_average("still_xy"),
        still_error_vel_yaw=time_average("still_yaw"),
        fall_rate=float(of_robot["fell"].mean()),
        episode_length_s=float(steps.mean() * step_dt),
        terrain=_tiles(of_robot, kinds[envs]),
    )


def evaluate_checkpoint(checkpoint: Path, robots: Sequence[str] | None = None, **arguments: Any) -> Evaluation:
    """`evaluate` for a checkpoint; task, robots and overrides come from its manifest unless given."""
    state, manifest = run_dir.load_checkpoint(checkpoint), run_dir.read_manifest(checkpoint)
    overrides = [*manifest["overrides"], *arguments.pop("overrides", ())]
    return evaluate(
        load_policy(state, manifest["policy"]),
        arguments.pop("task", None) or manifest["task"],
        manifest["robot_sources"] if robots is None else robots,
        overrides=overrides,
        **arguments,
    )
