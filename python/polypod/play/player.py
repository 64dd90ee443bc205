"""A policy in the simulator, frame by frame, with all that a picture of it needs."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.compat import tomllib
from polypod.evaluation import load_policy, play_task
from polypod.play import mesh
from polypod.play.ground import Ground
from polypod.play.mesh import Array, Mesh
from polypod.training import run_dir

SPACING = 1.2
"""Between robots that walk side by side, m."""
_ALIGNED = ("x", "y", "yaw")


@dataclasses.dataclass(frozen=True)
class Part:
    """A collision shape of a robot."""

    link: int
    group: str
    """base, hip, thigh, shank, foot or other."""
    mesh: Mesh
    """In the link's frame."""
    center: Array
    """Of the shape in the link's frame, m."""
    body: int
    """Its contact body."""


@dataclasses.dataclass(frozen=True)
class RobotFrame:
    """One robot at one time; world axes, SI units."""

    name: str
    place: Array
    """Of the env's origin, m."""
    position: Array
    """[links, 3], of the links, m."""
    quaternion: Array
    """[links, 4], w, x, y, z."""
    forces: list[tuple[Array, Array]]
    """Where contacts act, m, and with what force, N."""
    weight: float
    """N."""
    command: Array
    """[3], commanded forward and left velocity, m/s, and yaw rate, rad/s."""
    tile: str = ""
    """Type and level of its tile; empty without generated terrain."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """All robots at one time."""

    time: float
    """s."""
    robots: list[RobotFrame]


@dataclasses.dataclass
class Tally:
    """How a robot has done so far, over all its envs."""

    steps: int = 0
    falls: int = 0
    error_vel_xy: float = 0.0
    """m/s, mean."""
    error_vel_yaw: float = 0.0
    """rad/s, mean."""


class Player:
    """Steps a policy in the Play variant of its task, all robots side by side."""

    def __init__(
        self,
        checkpoint: Path,
        robots: Sequence[str] | None = None,
        command: Sequence[float] | None = None,
        *,
        task: str | None = None,
        envs_per_robot: int = 1,
        seed: int = 0,
        threads: int | None = None,
        overrides: Sequence[str] = (),
    ) -> None:
        """Loads the policy and begins the first episodes.

        Args:
            checkpoint: a `model_<n>.pt` beside its manifest.
            robots: names or paths of configs; None: those that the policy was trained on.
            command: forward and left velocity, m/s, and yaw rate, rad/s. The robots then begin side by side, looking
                along x. None: as the task draws it.
            task: name or alias of the task; None: that of the training.
            envs_per_robot: envs of each robot.
            seed: of every random stream.
            threads: of the simulator; None: one per core.
            overrides: `key=value` changes to the task, on top of the training's own.

        Raises:
            ConfigError: for a checkpoint, robot, task or override that cannot be used.
        """
        state, manifest = run_dir.load_checkpoint(checkpoint), run_dir.read_manifest(checkpoint)
        self._policy = load_policy(state, manifest["policy"])
        sources = list(manifest["robot_sources"] if robots is None else robots)
        name = play_task(task or manifest["task"])
        changes = [*manifest["overrides"], *overrides]
        arguments: dict[str, Any] = {"robots": sources, "seed": seed, "threads": threads}
        arguments["slots"] = manifest["canonical_joint_names"]
        self.sim = _core.VecSim(name, envs_per_robot * len(sources), overrides=changes, **arguments)
        defaults = _defaults(tomllib.loads(self.sim.resolved_config())["task"], aligned=command is not None)
        if defaults:
            changes = [*defaults, *changes]
            self.sim = _core.VecSim(name, envs_per_robot * len(sources), overrides=changes, **arguments)
        if self.sim.num_obs != manifest["policy"]["num_obs"]:
            raise _core.ConfigError(
                f"the policy takes observations of {manifest['policy']['num_obs']} numbers, and {self.sim.task_name} "
                f"gives {self.sim.num_obs}; play it in its own task, {manifest['task']}"
            )
        config = tomllib.loads(self.sim.resolved_config())["task"]
        self.obstacles: list[Mesh] = [
            part for description in config["scene"].get("obstacles", []) for part in mesh.obstacle(description)
        ]
        """Meshes of the scene; see `obstacle_places`."""
        terrain = self.sim.terrain() if "terrain" in config["scene"] else None
        self.ground = None if terrain is None else Ground(terrain)
        """The generated terrain on which all robots are; None without."""
        self._shared = self.ground is not None or config["scene"].get("placement") == "global"
        self.step_dt = self.sim.step_dt
        self.time = 0.0
        shapes, infos = json.loads(self.sim.robot_shapes()), json.loads(self.sim.robot_info())
        self.parts = {robot: _parts(shapes[robot]) for robot in self.sim.robots}
        self.tallies = {robot: Tally() for robot in self.sim.robots}
        self._com = {robot: np.array(shapes[robot]["base_com"]) for robot in self.sim.robots}
        self._weights = {robot: infos[robot]["mass"] * 9.81 for robot in self.sim.robots}
        self.reach = {robot: _reach(self.sim.link_pose(robot)[0]) for robot in self.sim.robots}
        """From the base to the link that is farthest from it as the robot begins, m."""
        # a row across the direction of the walk; with obstacles or random starts, wider
        spacing = SPACING if command is not None and not self.obstacles else config["sim"]["env_spacing"]
        row = np.arange(self.sim.num_envs) - 0.5 * (self.sim.num_envs - 1)
        self.places = np.column_stack([np.zeros_like(row), -spacing * row, np.zeros_like(row)])
        """[envs, 3], of the envs' origins, m; their heights are zero."""
        if command is not None:
            self.command(command)
            self.sim.reset()

    def obstacle_places(self, frame: Frame) -> list[Array]:
        """Where the obstacles stand: once in a world that all envs share, else around each env's origin, m."""
        if not self.obstacles:
            return []
        return [np.zeros(3)] if self._shared else [robot.place for robot in frame.robots]

    def command(self, command: Sequence[float]) -> None:
        """From now on all robots are to follow this: forward and left velocity, m/s, and yaw rate, rad/s."""
        self.sim.set_command(np.tile(np.asarray(command, dtype=np.float32), (self.sim.num_envs, 1)))

    def step(self) -> None:
        """One control step."""
        self.sim.step(self._policy(self.sim.observation))
        self.time += self.step_dt
        wanted, began = self.sim.command, self.sim.final_mask
        for robot, tally in self.tallies.items():
            first, last = self.sim.env_ids(robot)
            tally.falls += int(self.sim.terminated[first:last].sum())
            # an env that has just been reset shows its next episode already
            rows = np.flatnonzero(~began[first:last])
            if not len(rows):
                continue
            velocity, rate = self._base_velocity(robot)
            command = wanted[first:last][rows]
            tally.steps += len(rows)
            error = np.linalg.norm(command[:, :2] - velocity[rows, :2], axis=1)
            turn = np.abs(command[:, 2] - rate[rows, 2])
            tally.error_vel_xy += float((error - tally.error_vel_xy).sum()) / tally.steps
            tally.error_vel_yaw += float((turn - tally.error_vel_yaw).sum()) / tally.steps

    def frame(self) -> Frame:
        """The present state."""
        robots = []
        command = self.sim.command
        if self._shared:
            # a reset may have moved an env to another tile; heights are the world's already
            self.places = self.sim.env_origins() * [1.0, 1.0, 0.0]
        levels, types = self.sim.terrain_tiles()
        for name in self.sim.robots:
            position, quaternion = self.sim.link_pose(name)
            forces = self.sim.contact_forces(name)
            first, _ = self.sim.env_ids(name)
            for row in range(len(position)):
                place = self.places[first + row]
                robots.append(
                    RobotFrame(
                        name=name,
                        place=place,
                        position=position[row] + place,
                        quaternion=quaternion[row],
                        forces=self._contacts(name, position[row] + place, quaternion[row], forces[row]),
                        weight=self._weights[name],
                        command=command[first + row].astype(np.float64),
                        tile=f"{types[first + row]}, level {levels[first + row]}" if types else "",
                    )
                )
        return Frame(self.time, robots)

    def _contacts(self, name: str, position: Array, quaternion: Array, forces: Array) -> list[tuple[Array, Array]]:
        contacts, seen = [], set()
        for part in self.parts[name]:
            if part.body not in seen and np.linalg.norm(forces[part.body]) > 1.0:
                seen.add(part.body)
                at = mesh.rotation(quaternion[part.link]) @ part.center + position[part.link]
                contacts.append((at, forces[part.body]))
        return contacts

    def _base_velocity(self, robot: str) -> tuple[Array, Array]:
        """Of the base's centre of mass and about it, base axes, [envs, 3]."""
        qpos, qvel = self.sim.qpos(robot), self.sim.qvel(robot)
        velocity = np.stack([mesh.rotation(q[3:7]).T @ v[:3] for q, v in zip(qpos, qvel, strict=True)])
        return velocity + np.cross(qvel[:, 3:6], self._com[robot]), qvel[:, 3:6]


def _defaults(task: dict[str, Any], *, aligned: bool) -> list[str]:
    """What a player changes unless it is told otherwise: aligned starts, and each robot on a tile of its own."""
    start = task.get("events", {}).get("reset_base", {})
    changes = [f"events.reset_base.{key}=[0.0, 0.0]" for key in _ALIGNED if key in start] if aligned else []
    if "terrain" in task["scene"]:
        changes.append('scene.terrain.columns="contiguous"')
    return changes


def _reach(position: Array) -> float:
    """[envs, links, 3] of one robot."""
    return float(np.linalg.norm(position[0] - position[0, 0], axis=1).max())


def _parts(outline: dict[str, Any]) -> list[Part]:
    parts = []
    for body, description in enumerate(outline["bodies"]):
        for shape in description["shapes"]:
            center = np.array(shape["position"], dtype=np.float64)
            placed = mesh.shape(shape).moved(shape["position"], shape["quaternion"])
            parts.append(Part(description["link"], description["group"], placed, center, body))
    return parts


def arrow(start: Array, direction: Array, width: float) -> npt.NDArray[np.float64]:
    """[7, 3], a flat arrow that lies level, from `start` along `direction`, m."""
    length = float(np.linalg.norm(direction[:2]))
    along = np.array([*direction[:2], 0.0]) / max(length, 1e-9)
    across = np.array([-along[1], along[0], 0.0])
    neck = max(length - 2.0 * width, 0.0)
    outline = [(0.0, 0.5), (neck, 0.5), (neck, 1.2), (length, 0.0), (neck, -1.2), (neck, -0.5), (0.0, -0.5)]
    return np.array([start + a * along + b * width * across for a, b in outline])
