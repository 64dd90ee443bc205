"""Pictures without a display or a graphics card: flat polygons from far to near, by Pillow."""

import functools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from polypod import rotations
from polypod.arrays import Array
from polypod.extras import package
from polypod.render import relief
from polypod.render.camera import NEAR, Camera, Lens
from polypod.render.mesh import Mesh, lit
from polypod.render.scene import Frame, RobotFrame, Scene, arrow

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
    "torso": (104, 132, 172),
    "arm": (196, 128, 62),
    "head": (142, 152, 166),
    "other": (120, 128, 140),
}
"""Colours of a robot's bodies, by group; `color_of` has the others."""
LIGHT = np.array([0.35, 0.45, 0.82])
"""Direction of the light, of unit length."""
SUPERSAMPLING = 2
TITLE = 15
"""Height of a title's letters, pixels."""
TILE = 1.0
"""Side of a tile of the ground, m."""
TILES_SHOWN = 22
"""Number of tiles in each direction from the middle of the picture."""
CLOSE_UP = 3.1
"""Extent of the picture of a robot that is followed on terrain, in lengths of its reach."""
CLOSE_UP_FROM = (0.67, 0.74, 0.50)
"""Direction from which it is seen; 0.5 is the least rise over the distance."""
FORCE_LENGTH = 0.35
"""Length of the arrow of a force that equals the robot's weight, m."""


def color_of(group: str) -> Color:
    """Colour of a group of bodies. A robot may have groups that are drawn like `other`."""
    return COLORS.get(group, COLORS["other"])


def follow(scene: Scene, frame: Frame, size: tuple[int, int]) -> Camera:
    """A camera that looks at all robots from their front left, as near as shows them all."""
    places = np.array([robot.position[0] for robot in frame.robots])
    middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
    # wide enough for the whole row and a robot's length on either side
    across = float(np.ptp(scene.places[:, 1])) + 1.5
    aspect = size[0] / size[1]
    distance = 0.55 * across / (aspect * np.tan(np.radians(0.5 * Camera.field_of_view))) + 0.8
    return _camera((float(middle[0]), float(middle[1]), 0.3), distance, (0.92, 0.20, 0.36))


def follow_one(scene: Scene, robot: RobotFrame, size: tuple[int, int]) -> Camera:
    """A camera that looks at one robot from its front left and above, over any ground."""
    wide = min(1.0, size[0] / size[1])
    distance = 0.5 * CLOSE_UP * scene.reach[robot.name] / (wide * np.tan(np.radians(0.5 * Camera.field_of_view)))
    x, y, z = (float(value) for value in robot.position[0])
    if scene.ground is None:
        return _camera((x, y, z), distance, CLOSE_UP_FROM)
    # the mean around each point of the line of sight, so that the picture does not jump at a step
    sight = np.linspace(0.0, 1.0, 7)[:, None] * distance * np.array(CLOSE_UP_FROM[:2])
    offsets = np.linspace(-0.6, 0.6, 7)
    around = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), axis=-1).reshape(-1, 2)
    heights = scene.ground.heights(np.array([x, y]) + sight[:, None, :] + around).mean(axis=1)
    z = float(heights[0]) + 0.3
    rise = max(CLOSE_UP_FROM[2], float(((heights[1:] + 0.3 - z) / np.linalg.norm(sight[1:], axis=1)).max()) + 0.1)
    return _camera((x, y, z), distance, (*CLOSE_UP_FROM[:2], rise))


def picture(scene: Scene, frame: Frame, size: tuple[int, int] = (640, 360)) -> "Image":
    """Draws a frame of a film.

    All robots in a row or, on terrain, each robot from nearby in a separate field.

    Raises:
        ConfigError: where Pillow is missing.
    """
    if scene.ground is None:
        return render(scene, frame, follow(scene, frame, size), size)
    image = package("PIL.Image", "drawing pictures", "play")
    whole: Image = image.new("RGB", size, TEXT)
    columns, rows = fields(len(frame.robots), size)
    # a line of one pixel between two fields
    field = ((size[0] + 1) // columns - 1, (size[1] + 1) // rows - 1)
    blank = image.new("RGB", field, SKY)
    for index in range(columns * rows):
        shown = blank
        if index < len(frame.robots):
            robot = frame.robots[index]
            shown = render(scene, frame, follow_one(scene, robot, field), field, caption=_caption(robot))
        whole.paste(shown, (index % columns * (field[0] + 1), index // columns * (field[1] + 1)))
    return whole


def fields(count: int, size: tuple[int, int]) -> tuple[int, int]:
    """Columns and rows that show `count` robots in fields of a good shape, few of them empty."""

    def loss(columns: int) -> float:
        rows = -(-count // columns)
        return abs(math.log(size[0] * rows / (columns * size[1]) / 1.2)) + 0.5 * (columns * rows / count - 1.0)

    best = min(range(1, count + 1), key=loss)
    return best, -(-count // best)


def titled(image: "Image", text: str) -> "Image":
    """The picture with a line of text in its upper left corner."""
    titled: Image = image.copy()
    pen = package("PIL.ImageDraw", "drawing pictures", "play").Draw(titled)
    font = package("PIL.ImageFont", "drawing pictures", "play").load_default(TITLE)
    pen.text((TITLE // 2, TITLE // 3), text, fill=TEXT, font=font, stroke_width=2, stroke_fill=SKY)
    return titled


def render(
    scene: Scene,
    frame: Frame,
    camera: Camera,
    size: tuple[int, int] = (640, 360),
    *,
    caption: str | None = None,
    arrows: Sequence[tuple[Array, Array]] = (),
) -> "Image":
    """The picture of a frame, RGB; on terrain of what is near the camera's target.

    `caption` stands in a corner in place of the names below the robots; `arrows` are starts and
    directions of red arrows, m.

    Raises:
        ConfigError: where Pillow is missing.
    """
    canvas = _Canvas(camera, size)
    robots = frame.robots
    solids: list[tuple[Mesh, Color]] = []
    if scene.ground is not None:
        away = [np.linalg.norm(robot.position[0][:2] - camera.target[:2]) for robot in robots]
        robots = [robot for robot, distance in zip(robots, away, strict=True) if distance < relief.RADIUS]
    sunk: list[Mesh] = []
    for place in scene.obstacle_places(frame):
        for obstacle in scene.obstacles:
            placed = obstacle.moved(place, (1.0, 0.0, 0.0, 0.0))
            if scene.ground is None:
                placed, below = placed.split()
                sunk.append(below)
            solids.append((placed, OBSTACLE))
    for robot in robots:
        for part in scene.parts[robot.name]:
            placed = part.mesh.moved(robot.position[part.link], robot.quaternion[part.link])
            solids.append((placed, color_of(part.group)))
    if scene.ground is None:
        _draw_ground(canvas, camera)
        for outline in scene.openings(frame):
            canvas.pit(outline, sunk, OBSTACLE)
        for solid, _ in solids:
            canvas.shadow(solid)
        for solid, color in solids:
            canvas.solid(solid, color)
    else:
        middles = [robot.position[0] for robot in robots]
        canvas.paint(relief.picture(canvas.lens, scene.ground, camera.target, solids, middles, LIGHT, SKY))
    for robot in robots:
        for point, force in robot.forces:
            canvas.line(point, point + FORCE_LENGTH * force / robot.weight, FORCE)
        top = robot.position[0] + np.array([0.0, 0.0, 0.35])
        if np.linalg.norm(robot.command[:2]) > 1e-3:
            heading = _heading(robot.quaternion[0])
            direction = 0.6 * np.array([*(heading @ robot.command[:2]), 0.0])
            canvas.flat(arrow(top, direction, 0.06), COMMAND)
    for start, direction in arrows:
        canvas.flat(arrow(start, direction, 0.12), FORCE)
    canvas.flush()
    if caption is not None:
        canvas.caption(caption)
        return canvas.image()
    for robot in robots:
        x, y, _ = robot.position[0]
        height = 0.0 if scene.ground is None else float(scene.ground.heights(np.array([x, y])))
        canvas.text(np.array([x, y, height]), robot.name)
    return canvas.image()


def _camera(target: tuple[float, float, float], distance: float, direction: tuple[float, float, float]) -> Camera:
    position = np.array(target) + distance * np.array(direction) / np.linalg.norm(direction)
    return Camera((float(position[0]), float(position[1]), float(position[2])), target)


def _caption(robot: RobotFrame) -> str:
    return f"{robot.name}\n{robot.tile}" if robot.tile else robot.name


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
        self.lens = Lens(camera, self._pixels)
        self._queue: list[tuple[float, list[float], Color, int]] = []
        self._new: Any = (image.fromarray, draw.Draw, image.new)

    def paint(self, pixels: npt.NDArray[np.uint8]) -> None:
        """Replaces all that was drawn; [height, width, 3]."""
        self._image = self._new[0](pixels)
        self._draw = self._new[1](self._image)

    def flat(self, outline: Array, color: Color) -> None:
        """A flat polygon [n, 3] that is seen from both sides."""
        pixels, depth = self.lens.project(outline)
        if depth.min() > NEAR:
            self._queue.append((float(depth.mean()), pixels.ravel().tolist(), color, 0))

    def fill(self, outlines: Array, colors: Sequence[Color]) -> None:
        """Draws polygons [n, 4, 3] with their colours at once, below all that is in the queue."""
        pixels, depths = self.lens.project(outlines)
        seen = np.flatnonzero(self._seen(pixels, depths))
        for index, points in zip(seen.tolist(), pixels[seen].reshape(-1, 8).tolist(), strict=True):
            self._draw.polygon(points, fill=colors[index])

    def _seen(self, pixels: Array, depths: Array, part: tuple[Array, Array] | None = None) -> npt.NDArray[np.bool_]:
        """Finds the polygons before the camera that may touch the picture, [n].

        Args:
            pixels: [n, corners, 2].
            depths: [n, corners], m.
            part: the least and the largest pixel of the part that counts; None: the picture.
        """
        low, high = (np.zeros(2), np.array(self._pixels)) if part is None else part
        # Pillow's outlines are up to a pixel larger
        near = (pixels.max(axis=1) >= low - 1.0) & (pixels.min(axis=1) <= high + 1.0)
        return (depths.min(axis=1) > NEAR) & near.all(axis=1)

    def pit(self, outline: Array, solids: Sequence[Mesh], color: Color) -> None:
        """Draws the solids below the ground that are seen through an opening [n, 3] in it."""
        pixels, depth = self.lens.project(outline)
        if not self._seen(pixels[None], depth[None])[0]:
            return
        above, self._image = self._image, self._new[2]("RGB", self._pixels, SHADOW)
        self._draw = self._new[1](self._image)
        for solid in solids:
            self.solid(solid, color, (pixels.min(axis=0), pixels.max(axis=0)))
        self.flush()
        opening = self._new[2]("1", self._pixels)
        self._new[1](opening).polygon(pixels.ravel().tolist(), fill=1)
        above.paste(self._image, mask=opening)
        self._image = above
        self._draw = self._new[1](self._image)

    def shadow(self, solid: Mesh) -> None:
        """Draws the shadow of a solid on the ground at once."""
        points = solid.vertices - np.outer(solid.vertices[:, 2] / LIGHT[2], LIGHT)
        corners = points[solid.faces]
        first, second = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
        # the faces that look at the light
        lit = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] > 0.0
        shadows = corners[lit]
        self.fill(shadows, [SHADOW] * len(shadows))

    def solid(self, solid: Mesh, color: Color, part: tuple[Array, Array] | None = None) -> None:
        """The faces of a solid that look at the camera, in a part of the picture; see `_seen`."""
        corners = solid.vertices[solid.faces]
        facing, brightness = lit(corners, self.lens.origin, LIGHT)
        if not facing.any():
            return
        corners = corners[facing]
        pixels, depths = self.lens.project(corners)
        seen = self._seen(pixels, depths, part)
        distances = np.linalg.norm(corners[seen].mean(axis=1) - self.lens.origin, axis=1)
        shades = np.clip(np.outer(brightness[seen], color), 0, 255).astype(int)
        faces = zip(distances.tolist(), pixels[seen].reshape(-1, 8).tolist(), shades.tolist(), strict=True)
        self._queue.extend((distance, points, (red, green, blue), 0) for distance, points, (red, green, blue) in faces)

    def line(self, start: Array, end: Array, color: Color) -> None:
        """A line, as thick as an eighth of a foot."""
        pixels, depth = self.lens.project(np.stack([start, end]))
        if depth.min() > NEAR:
            # in front of what it acts on
            self._queue.append((float(depth.mean()) - 0.3, pixels.ravel().tolist(), color, 2 * SUPERSAMPLING))

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
        pixels, depth = self.lens.project(at)
        if depth > NEAR:
            x, y = pixels.tolist()
            self._draw.text((x, y + 14 * SUPERSAMPLING), text, fill=TEXT, font=_font(), anchor="mm")

    def caption(self, text: str) -> None:
        """Lines in the upper left corner."""
        at = (5 * SUPERSAMPLING, 4 * SUPERSAMPLING)
        self._draw.text(at, text, fill=TEXT, font=_font(), stroke_width=SUPERSAMPLING, stroke_fill=SKY)

    def image(self) -> "Image":
        return self._image.resize(self._size, self._resampling)


@functools.cache
def _font() -> Any:
    return package("PIL.ImageFont", "drawing pictures", "play").load_default(11 * SUPERSAMPLING)


def _draw_ground(canvas: _Canvas, camera: Camera) -> None:
    """Tiles around the camera's target."""
    numbers = np.arange(-TILES_SHOWN, TILES_SHOWN)
    x, y = (TILE * (round(value / TILE) + numbers) for value in camera.target[:2])
    starts = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))], axis=-1).reshape(-1, 1, 3)
    corners = starts + TILE * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    odd = np.rint(starts[:, 0, :2] / TILE).astype(int).sum(axis=1) % 2
    canvas.fill(corners, [GROUND[number] for number in odd.tolist()])


def _heading(quaternion: Sequence[float] | npt.NDArray[np.float64]) -> Array:
    """Matrix that turns the base's forward and left into the world's x and y, [2, 2]."""
    angle = rotations.heading(quaternion)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
