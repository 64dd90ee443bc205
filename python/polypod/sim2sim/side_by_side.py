"""A film of polypod's robot above and the robot of a maker's model below, under the same commands.

Both are drawn with the shapes of polypod's robot, at the angles that the map gives.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from polypod import _core
from polypod.arrays import Array
from polypod.extras import package
from polypod.play.player import SPACING
from polypod.render.film import Film
from polypod.render.raster import follow, render, titled
from polypod.render.scene import Scene, replay
from polypod.sim2sim.phases import PhaseFigures

if TYPE_CHECKING:
    from PIL.Image import Image

FPS = 12
SIZE = (640, 480)
"""Width and height of each picture, pixels."""


class SideBySide:
    """Collects the states of the first env of each simulator."""

    def __init__(self, path: Path) -> None:
        """Nothing is written before `close`.

        Raises ConfigError for another kind of file than a film.
        """
        self._film = Film(path, FPS, SIZE)
        self._states: dict[str, list[Array]] = {"polypod": [], "model": []}

    def watch(self, simulator: str, qpos: Array) -> None:
        """Takes positions [envs, 7 + joints] after a control step."""
        self._states[simulator].append(qpos[0].copy())

    def close(self, task: str, robot: str, model: str, phases: Sequence[PhaseFigures], seconds: float) -> None:
        """Draws and writes the film.

        Args:
            task: name of the task.
            robot: name or path of the config.
            model: name of the model's file.
            phases: in order; empty without.
            seconds: length of a phase, s.
        """
        sim = _core.VecSim(task, 1, robots=[robot], threads=1)
        scene = Scene(sim, SPACING)
        (name,) = sim.robots
        steps = min(len(states) for states in self._states.values())
        frames = {
            simulator: replay(scene, [robot], {name: states[:steps]}) for simulator, states in self._states.items()
        }
        half, shot = (SIZE[0], SIZE[1] // 2), 0
        image = package("PIL.Image", "drawing pictures", "play")
        for step in range(steps):
            if step * scene.step_dt * FPS < shot - 1e-6:
                continue
            shot += 1
            phase = phases[int(step * scene.step_dt / seconds + 1e-6) % len(phases)] if phases else None
            command = np.array((0.0, 0.0, 0.0) if phase is None else phase.command)
            whole: Image = image.new("RGB", SIZE)
            titles = ("polypod" if phase is None else f"polypod, {phase.phase}", model)
            for row, (simulator, title) in enumerate(zip(("polypod", "model"), titles, strict=True)):
                frame = frames[simulator][step]
                robots = [dataclasses.replace(shown, command=command) for shown in frame.robots]
                frame = dataclasses.replace(frame, robots=robots)
                shown = render(scene, frame, follow(scene, frame, half), half)
                whole.paste(titled(shown, title), (0, row * half[1]))
            self._film.add(whole)
        self._film.close()
