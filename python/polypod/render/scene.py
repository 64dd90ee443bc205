"""Robots and ground of a simulator, frame by frame, with all that a picture of them needs."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, rotations, simulated
from polypod.arrays import Array
from polypod.render import mesh
from polypod.render.ground import Ground
from polypod.render.mesh import Mesh


@dataclasses.dataclass(frozen=True)
class Part:
    """A collision shape of a robot."""

    link: int
    group: str
    """base, hip, thigh, shank, foot or other."""
    mesh: Mesh
    """Mesh in the link's frame."""
    center: Array
    """Centre of the shape in the link's frame, m."""
    body: int
    """Contact body of the part."""


@dataclasses.dataclass(frozen=True)
class Contact:
    """A force on a contact body of a robot."""

    point: Array
    """Middle of the body, m."""
    force: Array
    """Net force, N."""
    body: int
    link: int
    center: Array
    """The same point in the link's frame, m."""


@dataclasses.dataclass(frozen=True)
class RobotFrame:
    """One robot at one time; world axes, SI units."""

    name: str
    place: Array
    """Position of the env's origin, m."""
    position: Array
    """Positions of the links, m, [links, 3]."""
    quaternion: Array
    """Orientations of the links, w, x, y, z, [links, 4]."""
    contacts: list[Contact]
    """Forces above 1 N."""
    weight: float
    """N; on Earth, where the task has no gravity."""
    command: Array
    """Commanded forward and left velocity, m/s, and yaw rate, rad/s, [3]."""
    velocity: Array
    """Actual velocities of the base's centre of mass in the same order, [3]."""
    tile: str = ""
    """Type and level of its tile; empty without generated terrain."""

    @property
    def forces(self) -> list[tuple[Array, Array]]:
        """Points of contact, m, with their forces, N."""
        return [(contact.point, contact.force) for contact in self.contacts]


@dataclasses.dataclass(frozen=True)
class Frame:
    """All robots at one time."""

    time: float
    """Simulated time, s."""
    robots: list[RobotFrame]


class Scene:
    """Visible parts of a simulator: shapes, ground, obstacles, and their present poses."""

    def __init__(self, sim: _core.VecSim, spacing: float | None = None) -> None:
        """Reads the shapes.

        Args:
            sim: whose robots are shown.
            spacing: between robots that stand side by side on flat ground, m; None: the task's,
                with which no obstacle of an env is within another.
        """
        self.sim = sim
        self.time = 0.0
        """Time since the scene was made, s; the caller that steps the simulator counts it."""
        config = self.config = simulated.config(sim)["task"]
        """The task's part of `VecSim.resolved_config`."""
        self.obstacles: list[Mesh] = [
            part for description in config["scene"].get("obstacles", []) for part in mesh.obstacle(description)
        ]
        """Meshes of the scene; see `obstacle_places`."""
        entry = sim.terrain()
        self.pits = [] if entry is None else entry["pits"]
        """Rectangles about each of `obstacle_places` in which the plane is open, as
        `VecSim.terrain` has them."""
        terrain = entry if "terrain" in config["scene"] else None
        self.ground = None if terrain is None else Ground(terrain)
        """The generated terrain on which all robots are; None without."""
        self.shared = self.ground is not None or config["scene"].get("placement") == "global"
        """Whether all envs are in one world."""
        self.step_dt = sim.step_dt
        shapes, infos = simulated.shapes(sim), simulated.robots(sim)
        self.outlines = shapes
        """Entry of `VecSim.robot_shapes` by robot."""
        self.parts = {robot: _parts(shapes[robot]) for robot in sim.robots}
        # without gravity arrows are as long as on Earth
        free_fall = float(np.linalg.norm(sim.gravity)) or _core.EARTH_GRAVITY
        self._weights = {robot: infos[robot]["mass"] * free_fall for robot in sim.robots}
        self.reach = {robot: _reach(sim.link_pose(robot)[0]) for robot in sim.robots}
        """Distance from the base to the link that is farthest from it as the robot begins, m."""
        if spacing is None or self.obstacles:
            spacing = config["sim"]["env_spacing"]
        self.alone = not self.shared and not self.obstacles
        """Whether each env has a separate flat world, so that it can be drawn at any place."""
        self._spacing = spacing
        self.places = self.formation(sim.num_envs)
        """Places of the envs' origins, m, [envs, 3], in a row across the direction of the walk;
        their heights are zero."""

    def formation(self, columns: int) -> Array:
        """Places in rows of `columns` envs, [envs, 3], m: rows across x, in the envs' order."""
        count = self.sim.num_envs
        rows = -(-count // columns)
        row, column = np.divmod(np.arange(count), columns)
        # a last row that is not full stands in the middle
        wide = np.where(row < rows - 1, columns, count - columns * (rows - 1))
        across = 0.5 * (wide - 1) - column
        return self._spacing * np.column_stack([0.5 * (rows - 1) - row, across, np.zeros(count)])

    def obstacle_places(self, frame: Frame) -> list[Array]:
        """Places of the obstacles, m: once in a shared world, else around each env's origin."""
        if not self.obstacles:
            return []
        return [np.zeros(3)] if self.shared else [robot.place for robot in frame.robots]

    def openings(self, frame: Frame) -> list[Array]:
        """Outlines [4, 3] of the pits in the plane, m, counter-clockwise from above."""
        return [
            place + np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
            for place in self.obstacle_places(frame)
            for (x0, y0), (x1, y1) in self.pits
        ]

    def frame(self) -> Frame:
        """The present state."""
        robots = []
        command = self.sim.command
        linear, angular = self.sim.state("base_lin_vel"), self.sim.state("base_ang_vel")
        velocity = np.column_stack([linear[:, :2], angular[:, 2]]).astype(np.float64)
        if self.shared:
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
                        contacts=self._contacts(name, position[row] + place, quaternion[row], forces[row]),
                        weight=self._weights[name],
                        command=command[first + row].astype(np.float64),
                        velocity=velocity[first + row],
                        tile=f"{types[first + row]}, level {levels[first + row]}" if types else "",
                    )
                )
        return Frame(self.time, robots)

    def _contacts(self, name: str, position: Array, quaternion: Array, forces: Array) -> list[Contact]:
        contacts, seen = [], set()
        for part in self.parts[name]:
            if part.body not in seen and np.linalg.norm(forces[part.body]) > 1.0:
                seen.add(part.body)
                at = rotations.matrix(quaternion[part.link]) @ part.center + position[part.link]
                contacts.append(Contact(at, forces[part.body], part.body, part.link, part.center))
        return contacts


def _reach(position: Array) -> float:
    """Largest distance of a link from the base, m, for positions [envs, links, 3] of one robot."""
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
    """Corners of a flat arrow that lies level, m, [7, 3], from `start` along `direction`."""
    length = float(np.linalg.norm(direction[:2]))
    along = np.array([*direction[:2], 0.0]) / max(length, 1e-9)
    across = np.array([-along[1], along[0], 0.0])
    neck = max(length - 2.0 * width, 0.0)
    outline = [(0.0, 0.5), (neck, 0.5), (neck, 1.2), (length, 0.0), (neck, -1.2), (neck, -0.5), (0.0, -0.5)]
    return np.array([start + a * along + b * width * across for a, b in outline])


def replay(scene: Scene, sources: Sequence[str], states: Mapping[str, Sequence[Array]]) -> list[Frame]:
    """Frames of positions [7 + joints] of one env per robot, which were made from `sources`."""
    poses = {}
    for source, robot in zip(sources, scene.sim.robots, strict=True):
        rows = np.stack(states[robot])
        sim = _core.Simulation(source, num_envs=len(rows), ground=None, threads=1)
        sim.set_state(qpos=rows)
        poses[robot] = sim.link_pose()
    now = {robot.name: robot for robot in scene.frame().robots}
    frames = []
    for step in range(len(next(iter(states.values())))):
        robots: list[RobotFrame] = []
        for robot, (position, quaternion) in poses.items():
            still = now[robot]
            robots.append(
                dataclasses.replace(
                    still, position=position[step] + still.place, quaternion=quaternion[step], contacts=[]
                )
            )
        frames.append(Frame(step * scene.step_dt, robots))
    return frames
