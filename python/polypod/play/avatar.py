"""One robot in the browser.

All that belongs to a robot hangs on the node of its base. The page moves nodes when it draws; what
is new about a node otherwise, such as the length of an arrow, it shows one picture later. So
nothing that moves with a robot can be drawn away from it, however seldom the page draws.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import rotations
from polypod.arrays import Array
from polypod.extras import package
from polypod.play.looks import Look, Model
from polypod.render.mesh import joined
from polypod.render.raster import COMMAND, FORCE, FORCE_LENGTH, Color
from polypod.render.scene import Contact, RobotFrame

VELOCITY: Color = (58, 110, 214)
"""Colour of the arrow of the measured velocity; the commanded one is green, as in films."""
ARROW = 0.6
"""Length of an arrow per velocity, m per m/s."""
LEAST = 0.02
"""Shorter arrows are not shown, m."""
CLOSE = 0.01
"""An arrow is redrawn where its length changes by more than this, m."""
POINT = 0.02
"""Size of a point of a height scan, m."""
NAME_HEIGHT = 0.09
"""Height of a robot's name above it, m."""
_FONT = 44
"""Pixels."""
_NONE = np.array([[[0.0, 0.0, 0.0], [1e-4, 0.0, 0.0]]], dtype=np.float32)


class Avatar:
    """Nodes of one robot below a node of the scene."""

    def __init__(self, scene: Any, root: str, robot: RobotFrame, looks: Sequence[Look | Model], color: Color) -> None:
        """Adds the nodes.

        Args:
            scene: viser's, of a server.
            root: name of the robot's node.
            robot: as it begins.
            looks: what it looks like.
            color: colour that tells it from others.
        """
        self._scene, self.root = scene, root
        self._base = scene.add_frame(root, show_axes=False)
        self._links = [
            scene.add_frame(f"{root}/{link}", show_axes=False) if link else self._base
            for link in range(len(robot.position))
        ]
        models = [look for look in looks if isinstance(look, Model)]
        pieces = _joined([look for look in looks if isinstance(look, Look)])
        for model in models:
            scene.add_glb(f"{self._node(model.link)}/model", model.glb)
        for number, look in enumerate(pieces):
            scene.add_mesh_simple(
                f"{self._node(look.link)}/look{number}",
                look.mesh.vertices.astype(np.float32),
                look.mesh.triangles(),
                color=look.color,
                flat_shading=not look.smooth,
            )
        tops = [model.top for model in models if model.link == 0]
        top = max([*tops, *(float(look.mesh.vertices[:, 2].max()) for look in pieces if look.link == 0)], default=0.1)
        # level with the world, at the base
        self._level = scene.add_frame(f"{root}/level", show_axes=False)
        self._name = _plate(scene, f"{root}/level/name", robot.name, color, top + 0.32)
        self._command = _Arrow(scene, f"{root}/level/command", COMMAND, (0.0, 0.0, top + 0.2))
        self._velocity = _Arrow(scene, f"{root}/level/velocity", VELOCITY, (0.0, 0.0, top + 0.12))
        self._forces: dict[int, _Arrow] = {}
        self._scan: Any = None
        self.shows_forces = self.shows_velocity = self.shows_scan = True

    def _node(self, link: int) -> str:
        return f"{self.root}/{link}" if link else self.root

    def show_base(self, robot: RobotFrame) -> None:
        """Moves the robot as a whole."""
        self._base.position, self._base.wxyz = robot.position[0], robot.quaternion[0]

    def show(self, robot: RobotFrame, face: float, scan: npt.NDArray[np.float32] | None = None) -> None:
        """Moves all parts to where they are on the robot.

        Args:
            robot: as it is now.
            face: angle on the ground to where the name is looked at from, rad.
            scan: [rays, 3], where its height scanner sees the ground, m; None: it has none.
        """
        base, back = robot.position[0], rotations.inverse(robot.quaternion[0])
        places = (robot.position[1:] - base) @ rotations.matrix(back).T
        turned = rotations.product(back, robot.quaternion[1:])
        for handle, place, quaternion in zip(self._links[1:], places, turned, strict=True):
            handle.position, handle.wxyz = place, quaternion
        self._level.wxyz = back
        self._name.wxyz = _facing(face)
        heading = rotations.heading(robot.quaternion[0])
        self._command.point(_level(robot.command, heading))
        self._velocity.point(_level(robot.velocity, heading) if self.shows_velocity else np.zeros(3))
        self._show_forces(robot.contacts if self.shows_forces else [], robot)
        self._show_scan(scan if self.shows_scan else None, base)

    def show_name(self, visible: bool) -> None:
        """Shows or hides the name."""
        self._name.visible = visible

    def _show_forces(self, contacts: list[Contact], robot: RobotFrame) -> None:
        touching = set()
        for contact in contacts:
            touching.add(contact.body)
            arrow = self._forces.get(contact.body)
            if arrow is None:
                parent = self._node(contact.link)
                place = (float(contact.center[0]), float(contact.center[1]), float(contact.center[2]))
                arrow = self._forces[contact.body] = _Arrow(self._scene, f"{parent}/force{contact.body}", FORCE, place)
            back = rotations.inverse(robot.quaternion[contact.link])
            arrow.point(rotations.matrix(back) @ (FORCE_LENGTH * contact.force / robot.weight))
        for body, arrow in self._forces.items():
            if body not in touching:
                arrow.point(np.zeros(3))

    def _show_scan(self, points: npt.NDArray[np.float32] | None, base: Array) -> None:
        if points is None or not len(points):
            if self._scan is not None:
                self._scan.visible = False
            return
        # a point is a disc that looks at the camera: half of it would be in the ground
        around = (points - base + [0.0, 0.0, 0.5 * POINT]).astype(np.float32)
        if self._scan is None:
            colors = np.tile(np.array([[232, 90, 40]], dtype=np.uint8), (len(points), 1))
            name = f"{self.root}/level/scan"
            self._scan = self._scene.add_point_cloud(
                name, around, colors, point_size=POINT, point_shape="circle", precision="float32"
            )
        self._scan.points, self._scan.visible = around, True


class _Arrow:
    """An arrow that is turned by moving its node; only its length is new to the page."""

    def __init__(self, scene: Any, name: str, color: Color, position: tuple[float, float, float]) -> None:
        self._handle = scene.add_arrows(
            name,
            _NONE,
            colors=_strong(color),
            position=position,
            visible=False,
            shaft_radius=0.014,
            head_radius=0.035,
            head_length=0.08,
        )
        self._length, self._visible = 0.0, False

    def point(self, direction: Array) -> None:
        """Shows a vector in the frame of the node above, m."""
        length = float(np.linalg.norm(direction))
        visible = length > LEAST
        if visible:
            self._handle.wxyz = rotations.x_axis_to(direction)
            if abs(length - self._length) > CLOSE or not self._visible:
                self._handle.points = np.array([[[0.0, 0.0, 0.0], [length, 0.0, 0.0]]], dtype=np.float32)
                self._length = length
        if visible != self._visible:
            self._handle.visible = self._visible = visible


def _strong(color: Color) -> Color:
    """Light of the page's surroundings makes colours paler."""
    red, green, blue = ((channel / 255.0) ** 1.8 * 255.0 for channel in color)
    return round(red), round(green), round(blue)


def _level(velocity: Array, heading: Array) -> Array:
    """A forward and a left velocity as an arrow on the ground, m."""
    forward, left = ARROW * velocity[:2]
    cosine, sine = np.cos(heading), np.sin(heading)
    return np.array([forward * cosine - left * sine, forward * sine + left * cosine, 0.0])


def _facing(angle: float) -> Array:
    """The turn of an upright picture whose face looks to where `angle` on the ground points."""
    cosine, sine = np.cos(angle), np.sin(angle)
    # columns: the picture's right, down and back
    return rotations.of_axes(np.array([[-sine, 0.0, -cosine], [cosine, 0.0, -sine], [0.0, -1.0, 0.0]]))


def _plate(scene: Any, name: str, text: str, color: Color, height: float) -> Any:
    """A picture of a name: a label of viser's is drawn where the robot was one picture ago."""
    image, draw, fonts = (package(f"PIL.{part}", "the viewer", "play") for part in ("Image", "ImageDraw", "ImageFont"))
    font = fonts.load_default(_FONT)
    left, top, right, bottom = font.getbbox(text)
    size = (round(right - left) + _FONT, round(bottom - top) + _FONT // 2)
    picture = image.new("RGBA", size, (0, 0, 0, 0))
    pen = draw.Draw(picture)
    pen.rounded_rectangle((0, 0, size[0] - 1, size[1] - 1), radius=size[1] // 3, fill=(28, 32, 38, 225))
    pen.rectangle((0, size[1] - 7, size[0] - 1, size[1] - 1), fill=(*color, 255))
    pen.text((0.5 * size[0], 0.5 * size[1] - 2), text, fill=(255, 255, 255, 255), font=font, anchor="mm")
    return scene.add_image(
        name,
        np.asarray(picture),
        NAME_HEIGHT * size[0] / size[1],
        NAME_HEIGHT,
        format="png",
        position=(0.0, 0.0, height),
        cast_shadow=False,
        receive_shadow=False,
    )


def _joined(looks: Sequence[Look]) -> list[Look]:
    """Pieces of one link, colour and shading as one: the page then has fewer things to draw."""
    groups: dict[tuple[int, Color, bool], list[Look]] = {}
    for look in looks:
        groups.setdefault((look.link, look.color, look.smooth), []).append(look)
    return [
        Look(link, joined([look.mesh for look in group]), color, smooth)
        for (link, color, smooth), group in groups.items()
    ]
