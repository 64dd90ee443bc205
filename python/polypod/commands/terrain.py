"""`polypod terrain`."""

import dataclasses
from pathlib import Path

from polypod.commands.arguments import Overrides


@dataclasses.dataclass(frozen=True)
class Terrain:
    """Save a picture or the mesh of a task's ground."""

    out: Path
    """A .png (shaded map), .stl (triangles) or .npz (heights)."""
    task: str = "velocity_rough"
    """Name or alias of the task."""
    set: Overrides = ()
    """Changes the task's configuration, e.g. --set scene.terrain.seed=1. May be repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        from polypod import terrain

        print(terrain.save(self.task, self.out, self.set))
        return 0
