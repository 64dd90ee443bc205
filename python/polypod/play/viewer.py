"""A frame in the browser, by viser: live, or recorded into a file without a browser."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.extras import package
from polypod.files import write_bytes
from polypod.play.ground import Ground
from polypod.play.player import Player
from polypod.play.raster import COLORS, COMMAND, FORCE, FORCE_LENGTH, OBSTACLE
from polypod.play.scene import Frame, RobotFrame

Array = npt.NDArray[np.float64]

FOLLOW = 0.1
"""Share of its distance by which a camera that follows a robot comes nearer to where it should be, per shown frame."""
_JUMP = 1.5
"""A robot that is farther from where it was than this, m, has begun a new episode."""
_NO_ROBOT = "no robot"
_HIDDEN = np.array([[[0.0, 0.0, -10.0], [0.0, 0.0, -10.001]]], dtype=np.float32)
"""An arrow below the ground, where there is nothing to show."""


class Viewer:
    """The scene of a player; robots are made of their collision shapes."""

    def __init__(self, player: Player, port: int = 8080, host: str = "127.0.0.1") -> None:
        """Opens the server; the next free port is taken where `port` is not.

        Raises:
            ConfigError: where viser is missing or no port is free.
        """
        viser = package("viser", "the viewer", "play")
        self.player = player
        try:
            self._server = viser.ViserServer(host=host, port=port, verbose=False)
        except OSError as error:
            raise _core.ConfigError(f"--port {port} cannot be opened: {error.strerror}; choose another") from error
        self._recording: Any = None
        self._links: dict[tuple[int, int], Any] = {}
        self._arrows: list[tuple[Any, Any]] = []
        self._shown = player.frame()
        self._followed: int | None = None
        self._target = np.zeros(3)
        self._build(self._shown)
        self._server.on_client_connect(self._welcome)

    @property
    def url(self) -> str:
        """Where the scene is to be seen."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def show(self, frame: Frame) -> None:
        """Moves everything to where it is in a frame."""
        self._shown = frame
        with self._server.atomic():
            for index, robot in enumerate(frame.robots):
                for link, (position, quaternion) in enumerate(zip(robot.position, robot.quaternion, strict=True)):
                    handle = self._links[index, link]
                    handle.position, handle.wxyz = position, quaternion
                forces, command = self._arrows[index]
                lines = [[point, point + FORCE_LENGTH * force / robot.weight] for point, force in robot.forces]
                forces.points = np.array(lines, dtype=np.float32) if lines else _HIDDEN
                command.points = _command_arrow(robot.position[0], robot.quaternion[0], robot.command)
            self._move_cameras()

    def record(self) -> None:
        """Keeps all frames from now on; a `tick` between two sets their distance in time."""
        self._recording = self._server.get_scene_serializer()

    def tick(self, seconds: float) -> None:
        """Lets time pass in the recording."""
        if self._recording is not None:
            self._recording.insert_sleep(seconds)

    def write(self, path: Path) -> None:
        """Writes the recording: `.html` by itself, `.viser` for viser's client. Raises ConfigError where that fails."""
        recording, self._recording = self._recording, None
        data = recording.as_html().encode() if path.suffix == ".html" else recording.serialize()
        try:
            write_bytes(path, data)
        except OSError as error:
            raise _core.ConfigError(f"cannot write {path}: {error.strerror}; choose another --record") from error

    def controls(self) -> tuple[Any, Any]:
        """Adds a pause box and sliders for a command of one's own; returns the pause box and the box that uses them.

        A list of the robots moves the camera to one and lets it follow; on terrain, where robots are far apart, it
        begins with the first.
        """
        gui = self._server.gui
        pause = gui.add_checkbox("pause", initial_value=False)
        own = gui.add_checkbox("own command", initial_value=False)
        names = (("forward (m/s)", 1.0), ("left (m/s)", 1.0), ("turn (rad/s)", 1.0))
        sliders = [gui.add_slider(name, min=-most, max=most, step=0.05, initial_value=0.0) for name, most in names]

        def use(_: Any) -> None:
            if own.value:
                self.player.command([slider.value for slider in sliders])
            else:
                self.player.sim.set_command(None)

        for handle in (own, *sliders):
            handle.on_update(use)
        robots = [f"{index}: {robot.name}" for index, robot in enumerate(self._shown.robots)]
        followed = gui.add_dropdown("follow", [_NO_ROBOT, *robots])

        def follow(_: Any) -> None:
            self.follow(None if followed.value == _NO_ROBOT else robots.index(followed.value))

        if self.player.ground is not None:
            followed.value = robots[0]
            follow(None)
        followed.on_update(follow)
        return pause, own

    def follow(self, index: int | None) -> None:
        """Moves all cameras beside a robot of the frame, and with it from now on; None: lets them be."""
        self._followed = index
        if index is None:
            return
        self._target = self._shown.robots[index].position[0].copy()
        for client in self._server.get_clients().values():
            client.camera.position, client.camera.look_at = _beside(self._target)

    def _welcome(self, client: Any) -> None:
        """A new page begins where the others are."""
        if self._followed is not None:
            client.camera.position, client.camera.look_at = _beside(self._target)

    def _move_cameras(self) -> None:
        """Lets cameras go with the robot that they follow, as they are turned."""
        if self._followed is None:
            return
        ahead = self._shown.robots[self._followed].position[0] - self._target
        step = ahead if np.linalg.norm(ahead) > _JUMP else FOLLOW * ahead
        self._target = self._target + step
        for client in self._server.get_clients().values():
            # what it looks at moves along
            client.camera.position = client.camera.position + step

    def close(self) -> None:
        """Ends the server."""
        self._server.stop()

    def _build(self, frame: Frame) -> None:
        scene = self._server.scene
        scene.set_up_direction("+z")
        camera = self._server.initial_camera
        if self.player.ground is None:
            scene.add_grid("/ground", infinite_grid=True, cell_size=0.5, section_size=1.0)
            camera.position, camera.look_at = _in_front(frame.robots)
        else:
            scene.add_glb("/ground", terrain_glb(self.player.ground), cast_shadow=False)
            camera.position, camera.look_at = _beside(frame.robots[0].position[0])
        for at, place in enumerate(self.player.obstacle_places(frame)):
            for number, obstacle in enumerate(self.player.obstacles):
                vertices = (obstacle.vertices + place).astype(np.float32)
                scene.add_mesh_simple(
                    f"/obstacles/{at}_{number}", vertices, obstacle.triangles(), color=OBSTACLE, flat_shading=True
                )
        for index, robot in enumerate(frame.robots):
            root = f"/{index}_{robot.name}"
            for link in range(len(robot.position)):
                name = f"{root}/{link}"
                self._links[index, link] = scene.add_frame(name, show_axes=False)
            for number, part in enumerate(self.player.parts[robot.name]):
                scene.add_mesh_simple(
                    f"{root}/{part.link}/{number}",
                    part.mesh.vertices.astype(np.float32),
                    part.mesh.triangles(),
                    color=COLORS[part.group],
                    flat_shading=True,
                )
            scene.add_label(f"{root}/0/label", robot.name, position=(0.0, 0.0, 0.5))
            forces = scene.add_arrows(f"{root}_forces", _HIDDEN, colors=FORCE)
            command = scene.add_arrows(f"{root}_command", _HIDDEN, colors=COMMAND)
            self._arrows.append((forces, command))
        self.show(frame)


def terrain_glb(ground: Ground) -> bytes:
    """The terrain's own triangles as binary glTF, coloured by height."""
    trimesh = package("trimesh", "the viewer", "play")
    # glTF's colours of vertices are linear
    colors = (ground.colors(ground.vertices[:, 2]) / 255.0) ** 2.2
    rgba = np.full((len(colors), 4), 255, dtype=np.uint8)
    rgba[:, :3] = np.rint(255.0 * colors)
    # without normals, viewers shade flat
    mesh = trimesh.Trimesh(ground.vertices, ground.triangles, vertex_colors=rgba, process=False)

    def matt(tree: dict[str, Any]) -> None:
        """The default material of glTF is a metal, and walls are to be seen from both sides."""
        tree["materials"] = [
            {"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}
        ]
        for part in tree["meshes"]:
            for primitive in part["primitives"]:
                primitive["material"] = 0

    data: bytes = mesh.export(file_type="glb", tree_postprocessor=matt)
    return data


def _beside(at: Array) -> tuple[Array, Array]:
    """Position and target of a camera near a robot, m."""
    return at + np.array([2.6, 2.2, 1.6]), at


def _in_front(robots: list[RobotFrame]) -> tuple[Array, Array]:
    """Position and target of a camera that has a row of robots before it, m."""
    places = np.stack([robot.position[0] for robot in robots])
    middle, width = places.mean(axis=0), float(np.linalg.norm(np.ptp(places, axis=0)))
    return middle + np.array([2.5 + 0.5 * width, 0.0, 1.5 + 0.2 * width]), middle


def _command_arrow(
    position: npt.NDArray[np.float64], quaternion: npt.NDArray[np.float64], command: npt.NDArray[np.float64]
) -> npt.NDArray[np.float32]:
    """[1, 2, 3], above the base, along the commanded velocity."""
    w, x, y, z = quaternion
    angle = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
    forward, left = 0.6 * command[:2]
    along = np.array([forward * np.cos(angle) - left * np.sin(angle), forward * np.sin(angle) + left * np.cos(angle)])
    start = position + np.array([0.0, 0.0, 0.35])
    if np.linalg.norm(along) < 1e-3:
        return _HIDDEN
    return np.array([[start, start + np.array([*along, 0.0])]], dtype=np.float32)
