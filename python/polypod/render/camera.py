"""Place of a picture's camera, and places of things in the picture."""

import dataclasses

import numpy as np
import numpy.typing as npt

from polypod.arrays import Array

NEAR = 0.1
"""Points nearer to the camera are not drawn, m."""


@dataclasses.dataclass(frozen=True)
class Camera:
    """Place from which a picture is taken."""

    position: tuple[float, float, float]
    """Position of the camera, m."""
    target: tuple[float, float, float]
    """Point in the middle of the picture, m."""
    field_of_view: float = 32.0
    """Angle from the upper to the lower edge, degrees."""

    def view(self) -> Array:
        """Axes of the camera in the world, [3, 3]: rows are right, down and forward."""
        forward = np.subtract(self.target, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])


class Lens:
    """A camera and the size of its picture."""

    def __init__(self, camera: Camera, pixels: tuple[int, int]) -> None:
        """Makes the lens of a picture with this width and height, pixels."""
        self.pixels = pixels
        self.origin = np.array(camera.position)
        self.view = camera.view()
        self.focal = 0.5 * pixels[1] / float(np.tan(np.radians(0.5 * camera.field_of_view)))

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels [..., 2] and depths [...] of points [..., 3]."""
        seen = (points - self.origin) @ self.view.T
        depth = seen[..., 2]
        scale = self.focal / np.maximum(depth, NEAR)
        return seen[..., :2] * scale[..., None] + 0.5 * np.array(self.pixels), depth

    def rays(self, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp]) -> npt.NDArray[np.float32]:
        """Vectors through the middles of pixels at depth one, camera axes, [n, 3]."""
        rays = np.ones((len(rows), 3), dtype=np.float32)
        rays[:, 0] = (columns + (0.5 - 0.5 * self.pixels[0])) / self.focal
        rays[:, 1] = (rows + (0.5 - 0.5 * self.pixels[1])) / self.focal
        return rays
