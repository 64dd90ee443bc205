"""Pictures of a frame without a display or a graphics card: flat polygons from far to near, drawn by Pillow."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from polypod.extras import package
from polypod.play.mesh import Array, Mesh
from polypod.play.player import Frame, Player, arrow

if TYPE_CHECKING:
    from PIL.Image import Image

Color = tuple[int, int, int]

SKY: Color = (225, 232, 240)
GROUND: tuple[Color, Color] = ((206, 211, 217), (192, 198, 205))
SHADOW: Color = (150, 157, 166)
OBSTACLE: Color = (170, 150, 120)
FORCE: Color = (214, 60, 60)
COMMAND: Color = (32, 140, 72)
TEXT: Color = (40, 46, 54)
COLORS: dict[str, Color] = {
    "base": (86, 116, 160),
    "hip": (66, 76, 92),
    "thigh": (224, 148, 62),
    "shank": (92, 100, 112),
    "foot": (44, 48, 54),
    "other": (120, 128, 140),
}
"""Of a robot's bodies, by group."""
LIGHT = np.array([0.35, 0.45, 0.82])
"""Where light comes from; of unit length."""
SUPERSAMPLING = 2
TILE = 1.0
"""Of the ground, m."""
TILES_SHOWN = 22
"""In each direction from the middle of the picture."""
FORCE_LENGTH = 0.35
"""Of an arrow for a force like the robot's weight, m."""
NEAR = 0.1
"""What is nearer to the camera is not drawn, m."""


@dataclasses.dataclass(frozen=True)
class Camera:
    """Where a picture is taken from."""

    position: tuple[float, float, float]
    """m."""
    target: tuple[float, float, float]
    """In the middle of the picture, m."""
    field_of_view: float = 32.0
    """From the upper to the lower edge, degrees."""

    def view(self) -> Array:
        """[3, 3], rows are the camera's right, down and forward axes in the world."""
        forward = np.subtract(self.target, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])


def follow(player: Player, frame: Frame, size: tuple[int, int]) -> Camera:
    """A camera that looks at all robots from their front left, as near as shows them all."""
    places = np.array([robot.position[0] for robot in frame.robots])
    middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
    # wide enough for the whole row and a robot's length on either side
    across = float(np.ptp(player.places[:, 1])) + 1.5
    aspect = size[0] / size[1]
    distance = 0.55 * across / (aspect * np.tan(np.radians(0.5 * Camera.field_of_view))) + 0.8
    target = (float(middle[0]), float(middle[1]), 0.3)
    direction = np.array([0.92, 0.20, 0.36])
    position = np.array(target) + distance * direction / np.linalg.norm(direction)
    return Camera((float(position[0]), float(position[1]), float(position[2])), target)


def render(player: Player, frame: Frame, camera: Camera, size: tuple[int, int] = (640, 360)) -> "Image":
    """The picture of a frame, RGB.

    Raises:
        ConfigError: where Pillow is missing.
    """
    canvas = _Canvas(camera, size)
    _draw_ground(canvas, camera)
    solids: list[tuple[Mesh, Color]] = []
    for robot in frame.robots:
        solids += [(part.moved(robot.place, (1.0, 0.0, 0.0, 0.0)), OBSTACLE) for part in player.obstacles]
        for part in player.parts[robot.name]:
            placed = part.mesh.moved(robot.position[part.link], robot.quaternion[part.link])
            solids.append((placed, COLORS[part.group]))
    for solid, _ in solids:
        canvas.shadow(solid)
    for solid, color in solids:
        canvas.solid(solid, color)
    for robot in frame.robots:
        for point, force in robot.forces:
            canvas.line(point, point + FORCE_LENGTH * force / robot.weight, FORCE)
        top = robot.position[0] + np.array([0.0, 0.0, 0.35])
        if np.linalg.norm(robot.command[:2]) > 1e-3:
            heading = _heading(robot.quaternion[0])
            direction = 0.6 * np.array([*(heading @ robot.command[:2]), 0.0])
            canvas.flat(arrow(top, direction, 0.06), COMMAND)
    canvas.flush()
    for robot in frame.robots:
        canvas.text(robot.position[0] - np.array([0.0, 0.0, robot.position[0][2]]), robot.name)
    return canvas.image()


class _Canvas:
    """Collects polygons in the world and draws them from far to near."""

    def __init__(self, camera: Camera, size: tuple[int, int]) -> None:
        purpose = "drawing pictures"
        image, draw = package("PIL.Image", purpose, "play"), package("PIL.ImageDraw", purpose, "play")
        self._size = size
        self._pixels = (SUPERSAMPLING * size[0], SUPERSAMPLING * size[1])
        self._image: Image = image.new("RGB", self._pixels, SKY)
        self._draw = draw.Draw(self._image)
        self._resampling = image.Resampling.BOX
        self._origin = np.array(camera.position)
        self._view = camera.view()
        self._focal = 0.5 * self._pixels[1] / np.tan(np.radians(0.5 * camera.field_of_view))
        self._queue: list[tuple[float, list[tuple[float, float]], Color, int]] = []

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels [..., 2] and depths [...] of points [..., 3]."""
        seen = (points - self._origin) @ self._view.T
        depth = seen[..., 2]
        scale = self._focal / np.maximum(depth, NEAR)
        middle = 0.5 * np.array(self._pixels)
        return seen[..., :2] * scale[..., None] + middle, depth

    def flat(self, outline: Array, color: Color, *, at_once: bool = False) -> None:
        """A flat polygon [n, 3] that is seen from both sides."""
        pixels, depth = self.project(outline)
        if depth.min() <= NEAR:
            return
        points = [(x, y) for x, y in pixels.tolist()]
        if at_once:
            self._draw.polygon(points, fill=color)
        else:
            self._queue.append((float(depth.mean()), points, color, 0))

    def shadow(self, solid: Mesh) -> None:
        """What a solid keeps from the ground, drawn at once."""
        points = solid.vertices - np.outer(solid.vertices[:, 2] / LIGHT[2], LIGHT)
        corners = points[solid.faces]
        first, second = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
        # the faces that look at the light
        lit = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] > 0.0
        for outline in corners[lit]:
            self.flat(outline, SHADOW, at_once=True)

    def solid(self, solid: Mesh, color: Color) -> None:
        """The faces of a solid that look at the camera."""
        corners = solid.vertices[solid.faces]
        # of the diagonals; a triangle, which repeats its last corner, keeps its sense
        normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        lengths = np.linalg.norm(normals, axis=1)
        centers = corners.mean(axis=1)
        facing = (lengths > 1e-12) & (np.einsum("ij,ij->i", normals, self._origin - centers) > 0.0)
        if not facing.any():
            return
        brightness = 0.62 + 0.38 * np.clip(normals[facing] @ LIGHT / lengths[facing], -0.6, 1.0)
        pixels, depths = self.project(corners[facing])
        distances = np.linalg.norm(centers[facing] - self._origin, axis=1)
        shades = np.clip(np.outer(brightness, color), 0, 255).astype(int)
        for outline, depth, distance, shade in zip(pixels, depths, distances, shades, strict=True):
            if depth.min() > NEAR:
                points = [(x, y) for x, y in outline.tolist()]
                self._queue.append((float(distance), points, (int(shade[0]), int(shade[1]), int(shade[2])), 0))

    def line(self, start: Array, end: Array, color: Color) -> None:
        """A line, as thick as an eighth of a foot."""
        pixels, depth = self.project(np.stack([start, end]))
        if depth.min() > NEAR:
            points = [(x, y) for x, y in pixels.tolist()]
            # in front of what it acts on
            self._queue.append((float(depth.mean()) - 0.3, points, color, 2 * SUPERSAMPLING))

    def flush(self) -> None:
        """Draws what was collected."""
        for _, points, color, width in sorted(self._queue, key=lambda entry: -entry[0]):
            if width:
                self._draw.line(points, fill=color, width=width)
            else:
                self._draw.polygon(points, fill=color)
        self._queue.clear()

    def text(self, at: Array, text: str) -> None:
        """A label below a point."""
        pixels, depth = self.project(at)
        if depth > NEAR:
            x, y = pixels.tolist()
            self._draw.text((x, y + 14 * SUPERSAMPLING), text, fill=TEXT, font=_font(), anchor="mm")

    def image(self) -> "Image":
        return self._image.resize(self._size, self._resampling)


@functools.cache
def _font() -> Any:
    return package("PIL.ImageFont", "drawing pictures", "play").load_default(11 * SUPERSAMPLING)


def _draw_ground(canvas: _Canvas, camera: Camera) -> None:
    """Tiles around the camera's target."""
    x, y = (TILE * round(value / TILE) for value in camera.target[:2])
    for i in range(-TILES_SHOWN, TILES_SHOWN):
        for j in range(-TILES_SHOWN, TILES_SHOWN):
            left, front = x + TILE * i, y + TILE * j
            corners = [(left, front), (left + TILE, front), (left + TILE, front + TILE), (left, front + TILE)]
            even = (round(left / TILE) + round(front / TILE)) % 2
            canvas.flat(np.array([(a, b, 0.0) for a, b in corners]), GROUND[even], at_once=True)


def _heading(quaternion: Sequence[float] | npt.NDArray[np.float64]) -> Array:
    """[2, 2], turns the base's forward and left into the world's x and y."""
    w, x, y, z = quaternion
    angle = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
