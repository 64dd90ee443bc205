"""Robots and ground of a simulator, frame by frame, with all that a picture of them needs."""

import dataclasses
import json
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.compat import tomllib
from polypod.play import mesh
from polypod.play.ground import Ground
from polypod.play.mesh import Array, Mesh


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


class Scene:
    """What is seen of a simulator: shapes, ground, obstacles, and where everything is at the present time."""

    def __init__(self, sim: _core.VecSim, spacing: float | None = None) -> None:
        """Reads the shapes.

        Args:
            sim: whose robots are shown.
            spacing: between robots that stand side by side on flat ground, m; None: the task's, with which no obstacle
                of an env is within another.
        """
        self.sim = sim
        self.time = 0.0
        """Since the scene was made, s; whoever steps the simulator counts it."""
        config = tomllib.loads(sim.resolved_config())["task"]
        self.obstacles: list[Mesh] = [
            part for description in config["scene"].get("obstacles", []) for part in mesh.obstacle(description)
        ]
        """Meshes of the scene; see `obstacle_places`."""
        terrain = sim.terrain() if "terrain" in config["scene"] else None
        self.ground = None if terrain is None else Ground(terrain)
        """The generated terrain on which all robots are; None without."""
        self._shared = self.ground is not None or config["scene"].get("placement") == "global"
        self.step_dt = sim.step_dt
        shapes, infos = json.loads(sim.robot_shapes()), json.loads(sim.robot_info())
        self.parts = {robot: _parts(shapes[robot]) for robot in sim.robots}
        self._weights = {robot: infos[robot]["mass"] * 9.81 for robot in sim.robots}
        self.reach = {robot: _reach(sim.link_pose(robot)[0]) for robot in sim.robots}
        """From the base to the link that is farthest from it as the robot begins, m."""
        if spacing is None or self.obstacles:
            spacing = config["sim"]["env_spacing"]
        row = np.arange(sim.num_envs) - 0.5 * (sim.num_envs - 1)
        self.places = np.column_stack([np.zeros_like(row), -spacing * row, np.zeros_like(row)])
        """[envs, 3], of the envs' origins, m, in a row across the direction of the walk; their heights are zero."""

    def obstacle_places(self, frame: Frame) -> list[Array]:
        """Where the obstacles stand: once in a world that all envs share, else around each env's origin, m."""
        if not self.obstacles:
            return []
        return [np.zeros(3)] if self._shared else [robot.place for robot in frame.robots]

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
