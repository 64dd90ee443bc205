"""A picture of each env, for `render_mode="rgb_array"`."""

import dataclasses

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.render.raster import follow_one, render
from polypod.render.scene import Scene

SIZE = (640, 360)
"""Width and height, pixels."""


class Pictures:
    """Draws the robots of a simulator, each from nearby."""

    def __init__(self, sim: _core.VecSim, size: tuple[int, int] = SIZE) -> None:
        """Reads shapes and ground. Raises ConfigError where a package is missing."""
        self._scene, self._size = Scene(sim), size

    def draw(self) -> tuple[npt.NDArray[np.uint8], ...]:
        """One picture per env, uint8 [height, width, 3]."""
        frame = self._scene.frame()
        pictures = []
        for robot in frame.robots:
            alone = dataclasses.replace(frame, robots=[robot])
            camera = follow_one(self._scene, robot, self._size)
            pictures.append(np.asarray(render(self._scene, alone, camera, self._size), dtype=np.uint8))
        return tuple(pictures)
