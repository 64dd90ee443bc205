"""A simulation in the browser, by viser: live, or recorded into a file without a browser."""

import contextlib
import logging
import socket
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.arrays import Array
from polypod.extras import package
from polypod.files import write_bytes
from polypod.play import descriptions, looks
from polypod.play.avatar import Avatar
from polypod.play.gate import Gate, open_server, wake_safely
from polypod.play.looks import Look, Model
from polypod.play.player import Player
from polypod.render.ground import Ground
from polypod.render.mesh import floor
from polypod.render.raster import OBSTACLE, Color
from polypod.render.scene import Frame

HOST = "127.0.0.1"
WORLD = "/world"
"""The node that all of the simulation hangs on. It moves against what is followed, and cameras stay
where they are."""
GROUP = "all robots"
NOTHING = "nothing"
PLANE = (214, 218, 222)
FLOOR = 100.0
"""Half the side of a plane with pits, m; one without is infinite."""
FOLLOW = 0.1
"""Share of its distance by which the view comes nearer to what it follows, per shown frame."""
FIELD_OF_VIEW = 0.75
"""Vertical field of view of the opening shot, rad."""
DIMMED = 0.5
"""Share of the terrain's brightness in films that it has on the page."""
LONGEST_NOTICE = 1000
"""Letters of a notice."""
_ANY = ("0.0.0.0", "::")
"""All addresses of this machine."""
_JUMP = 1.5
"""A robot that is farther from where it was than this, m, has begun a new episode."""
_MESSAGES = 1 << 16
"""Most messages that viser is to send at once: more than a frame has."""
_SKY = ((176, 202, 228), (238, 242, 246))
"""Upper and lower edge of the background."""


class Viewer:
    """The page of a player."""

    def __init__(
        self, player: Player, port: int = 8080, host: str = HOST, *, meshes: bool = False, columns: int | None = None
    ) -> None:
        """Opens the server; the next free port is taken where `port` is not.

        Args:
            player: the simulation that is shown.
            port: 0 takes a free one.
            host: address that the page is served at.
            meshes: show the makers' meshes of the package robot_descriptions, which downloads them
                once.
            columns: robots side by side in a row of the opening shot. None: as the player has them.

        Raises:
            ConfigError: where a package is missing or the address cannot be opened.
        """
        package("viser", "the viewer", "play")
        if meshes:
            descriptions.check()
        self._meshes = meshes
        _check_host(host)
        # a health check or a scanner is no error of the server's, and would get a traceback each
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        self.gate = Gate(host)
        try:
            self._server = open_server(self.gate, host, port)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise _core.ConfigError(f"--host {host} --port {port} cannot be opened: {reason}; choose others") from error
        with contextlib.suppress(AttributeError):
            sockets = self._server._websock_server
            wake_safely(sockets.get_message_buffer())
            sockets.on_client_connect(lambda connection: wake_safely(connection.get_message_buffer()))
            # a frame is to reach a page as one piece; by default viser cuts it into pieces of 128
            # messages
            sockets.get_message_buffer().max_window_size = _MESSAGES
        self._recording: Any = None
        self._world: Any = None
        self._avatars: list[Avatar] = []
        self._target = np.zeros(3)
        self._face = 0.0
        self.followed: int | str = GROUP
        """Index of the robot that is followed, `GROUP` or `NOTHING`."""
        self.shows_names = self.shows_forces = self.shows_velocity = True
        self.shows_scan = False
        self.warnings: list[str] = []
        """Reasons why a requested thing is not shown."""
        self._set_the_stage()
        self.open(player, columns)
        self._server.on_client_connect(self._welcome)
        self.gate.open()

    @property
    def url(self) -> str:
        """Address of the page on this machine."""
        host = self._server.get_host()
        return _url("localhost" if host in _ANY else host, self._server.get_port())

    @property
    def public_url(self) -> str | None:
        """Address of the page for other machines; None: they do not see it."""
        if not self.gate.is_public:
            return None
        host = self._server.get_host()
        return _url(_own_address(host) if host in _ANY else host, self._server.get_port())

    @property
    def gui(self) -> Any:
        """Viser's panel."""
        return self._server.gui

    @property
    def frame(self) -> Frame:
        """The shown frame."""
        return self._shown

    def open(self, player: Player, columns: int | None = None) -> None:
        """Shows another player in place of the present one."""
        self.player = player
        if columns is not None and player.alone:
            player.stand(columns)
        frame = player.frame()
        self._shown = frame
        with self._server.atomic():
            if self._world is not None:
                self._world.remove()
            self._build(frame)
            self.follow(GROUP if player.alone else 0)

    def show(self, frame: Frame) -> None:
        """Moves everything to where it is in a frame."""
        self._shown = frame
        self._turn_names()
        self._first_shot = self._opening()
        scan = self.player.sim.height_scan() if self.shows_scan else None
        with self._server.atomic():
            # a page that gets a frame in pieces gets the robots' places first
            self._go_along()
            for avatar, robot in zip(self._avatars, frame.robots, strict=True):
                avatar.show_base(robot)
            for index, (avatar, robot) in enumerate(zip(self._avatars, frame.robots, strict=True)):
                avatar.shows_forces, avatar.shows_velocity = self.shows_forces, self.shows_velocity
                avatar.show(robot, self._face, self._hits(scan, index))

    def show_names(self, visible: bool) -> None:
        """Shows or hides the robots' names."""
        self.shows_names = visible
        for avatar in self._avatars:
            avatar.show_name(visible)

    def follow(self, what: int | str) -> None:
        """Lets the view follow a robot of the frame, `GROUP` or `NOTHING`.

        Begins with the opening shot of it.
        """
        self.followed = what
        if what == NOTHING:
            return
        self._target = self._middle()
        self._world.position = -self._target
        self._first_shot = position, target = self._opening()
        camera = self._server.initial_camera
        camera.position, camera.look_at, camera.fov = position, target, FIELD_OF_VIEW
        for client in self._server.get_clients().values():
            client.camera.position, client.camera.look_at = position, target

    def record(self) -> None:
        """Keeps all frames from now on; a `tick` between two sets their distance in time."""
        self._recording = self._server.get_scene_serializer()

    def tick(self, seconds: float) -> None:
        """Lets time pass in the recording."""
        if self._recording is not None:
            self._recording.insert_sleep(seconds)

    def write(self, path: Path) -> None:
        """Writes the recording: `.html` by itself, `.viser` for viser's client.

        Raises ConfigError where that fails.
        """
        recording, self._recording = self._recording, None
        data = recording.as_html().encode() if path.suffix == ".html" else recording.serialize()
        try:
            write_bytes(path, data)
        except OSError as error:
            raise _core.ConfigError(f"cannot write {path}: {error.strerror}; choose another --record") from error

    def tell(self, title: str, body: str) -> None:
        """Shows a notice on all pages."""
        for client in list(self._server.get_clients().values()):
            client.add_notification(title, body[:LONGEST_NOTICE], auto_close_seconds=8.0)

    def close(self) -> None:
        """Ends the server."""
        self._server.stop()

    def _set_the_stage(self) -> None:
        scene = self._server.scene
        scene.set_up_direction("+z")
        share = np.linspace(0.0, 1.0, 256)[:, None, None]
        top, bottom = (np.array(color, dtype=np.float64) for color in _SKY)
        sky = np.broadcast_to((1.0 - share) * top + share * bottom, (256, 2, 3))
        scene.set_background_image(sky.astype(np.uint8), format="png")

    def _build(self, frame: Frame) -> None:
        scene = self._server.scene
        self._world = scene.add_frame(WORLD, show_axes=False)
        ground = f"{WORLD}/ground"
        openings = self.player.openings(frame)
        if openings:
            plane = floor(openings, FLOOR)
            scene.add_mesh_simple(
                ground, plane.vertices.astype(np.float32), plane.triangles(), color=PLANE, flat_shading=True
            )
        elif self.player.ground is None:
            scene.add_grid(
                ground,
                infinite_grid=True,
                cell_size=0.5,
                section_size=1.0,
                section_color=(176, 182, 190),
                cell_color=(198, 203, 209),
                fade_distance=60.0,
                plane_color=PLANE,
                plane_opacity=1.0,
                shadow_opacity=0.35,
            )
        else:
            scene.add_glb(ground, terrain_glb(self.player.ground), cast_shadow=False)
        for at, place in enumerate(self.player.obstacle_places(frame)):
            for number, obstacle in enumerate(self.player.obstacles):
                vertices = (obstacle.vertices + place).astype(np.float32)
                name = f"{WORLD}/obstacles/{at}_{number}"
                scene.add_mesh_simple(name, vertices, obstacle.triangles(), color=OBSTACLE, flat_shading=True)
        self._avatars = []
        known: dict[str, list[Look | Model]] = {}
        colors = {robot: looks.accent(place) for place, robot in enumerate(self.player.sim.robots)}
        for index, robot in enumerate(frame.robots):
            if robot.name not in known:
                known[robot.name] = self._looks(robot.name, colors[robot.name])
            root = f"{WORLD}/{index}_{robot.name}"
            self._avatars.append(Avatar(scene, root, robot, known[robot.name], colors[robot.name]))
        self.show_names(self.shows_names)
        self.show(frame)

    def _looks(self, robot: str, color: Color) -> list[Look | Model]:
        outline = self.player.outlines[robot]
        if self._meshes:
            try:
                return [*descriptions.models(robot, outline["links"], self.player.rest(robot))]
            except _core.ConfigError as error:
                self.warnings.append(f"{robot} is shown by its collision shapes: {error}")
        return [*looks.of_shapes(outline, color)]

    def _hits(self, scan: npt.NDArray[np.float32] | None, index: int) -> npt.NDArray[np.float32] | None:
        """Points of the ground that a robot's height scanner sees, as the robot is drawn."""
        if scan is None:
            return None
        return scan[index] if self.player.shared else scan[index] + self._shown.robots[index].place.astype(np.float32)

    def _middle(self) -> Array:
        """Point that the view follows, m."""
        robots = self._shown.robots
        if isinstance(self.followed, int):
            return robots[min(self.followed, len(robots) - 1)].position[0].copy()
        middle: Array = np.mean([robot.position[0] for robot in robots], axis=0)
        return middle

    def _go_along(self) -> None:
        """Moves the world against what is followed."""
        if self.followed == NOTHING:
            return
        ahead = self._middle() - self._target
        self._target = self._target + (ahead if np.linalg.norm(ahead) > _JUMP else FOLLOW * ahead)
        self._world.position = -self._target

    def _opening(self) -> tuple[Array, Array]:
        """Position and target of a camera that sees what is followed, m.

        The target is at the origin.
        """
        if isinstance(self.followed, int):
            reach = self.player.reach[self._shown.robots[min(self.followed, len(self._shown.robots) - 1)].name]
            direction, radius = np.array([0.72, 0.58, 0.42]), 2.0 * reach
        else:
            places = np.stack([robot.position[0] for robot in self._shown.robots]) - self._middle()
            reach = max(self.player.reach.values())
            radius = float(np.linalg.norm(places, axis=1).max()) + reach
            direction = np.array([0.86, 0.34, 0.44])
        direction = direction / np.linalg.norm(direction)
        distance = 1.05 * radius / np.sin(0.5 * FIELD_OF_VIEW)
        # the panel hides the right quarter of a page
        right = 0.14 * distance * np.array([-direction[1], direction[0], 0.0])
        return distance * direction + right, right

    def _turn_names(self) -> None:
        """Lets names look at the camera of the page that was opened last."""
        position, target = self._server.initial_camera.position, np.zeros(3)
        clients = list(self._server.get_clients().values())
        if clients:
            camera = clients[-1].camera
            # a page that has just been opened has not told of its camera yet
            with contextlib.suppress(AssertionError, AttributeError):
                position, target = np.asarray(camera.position), np.asarray(camera.look_at)
        back = np.asarray(position)[:2] - target[:2]
        if np.linalg.norm(back) > 1e-3:
            self._face = float(np.arctan2(back[1], back[0]))

    def _welcome(self, client: Any) -> None:
        """A new page begins with what is followed in its middle.

        viser calls this in its own thread, while another player may be opened: the shot is computed
        elsewhere.
        """
        with contextlib.suppress(AssertionError):
            client.camera.position, client.camera.look_at = self._first_shot


def _url(host: str, port: int) -> str:
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _own_address(host: str) -> str:
    """An address at which other machines reach this one: its way to the internet, or its name."""
    family, target = (socket.AF_INET6, "2001:db8::1") if host == "::" else (socket.AF_INET, "192.0.2.1")
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            # no packet is sent: the system chooses the address that one would be sent from
            probe.connect((target, 9))
            address: str = probe.getsockname()[0]
            return address
    except OSError:
        return socket.gethostname()


def _check_host(host: str) -> None:
    """Raises ConfigError for an address of another machine: viser's thread would end silently."""
    try:
        family, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no name"
        raise _core.ConfigError(
            f"--host {host!r} cannot be opened: {reason}; use an address of this machine, or 0.0.0.0 for all"
        ) from error


def terrain_glb(ground: Ground) -> bytes:
    """The terrain's own triangles as binary glTF, coloured by height."""
    trimesh = package("trimesh", "the viewer", "play")
    # glTF's colours of vertices are linear; the page's light would make light ground white
    colors = DIMMED * (ground.colors(ground.vertices[:, 2]) / 255.0) ** 2.2
    rgba = np.full((len(colors), 4), 255, dtype=np.uint8)
    rgba[:, :3] = np.rint(255.0 * colors)
    # without normals, viewers shade flat
    mesh = trimesh.Trimesh(ground.vertices, ground.triangles, vertex_colors=rgba, process=False)

    def matt(tree: dict[str, Any]) -> None:
        """The default material of glTF is a metal, and walls must be visible from both sides."""
        tree["materials"] = [
            {"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}
        ]
        for part in tree["meshes"]:
            for primitive in part["primitives"]:
                primitive["material"] = 0

    data: bytes = mesh.export(file_type="glb", tree_postprocessor=matt)
    return data
