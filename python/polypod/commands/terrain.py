"""`polypod terrain`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from polypod import _core
from polypod.commands.arguments import Name, Overrides, arg, check_names


@dataclasses.dataclass(frozen=True)
class Terrain:
    """Save a picture or the mesh of a task's ground, or make heights of yours a task's ground."""

    out: Path
    """A .png (shaded map), .stl (triangles) or .npz (heights); with --heights a .toml, the task."""
    task: Name = None
    """Name or alias of the task. Default: velocity_rough; with --heights velocity_flat, which the
    new task extends."""
    set: Overrides = ()
    """Changes the task's configuration, e.g. --set scene.terrain.seed=1. May be repeated."""
    heights: Annotated[Path | None, arg(metavar="FILE")] = None
    """A grey .png, x to the right and y upwards, or a .npy of [x, y] with heights in m. Every env
    has them around its origin; heights below 0 are holes in the ground."""
    range: Annotated[tuple[float, float] | None, arg(metavar="LOW HIGH")] = None
    """Heights of black and of white, m."""
    cell: Annotated[float, arg(metavar="M")] = 0.05
    """Distance of neighbouring heights, m."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        if self.heights is None:
            if self.range is not None:
                raise _core.ConfigError("--range scales a picture of --heights; name one")
            from polypod import terrain

            print(terrain.save(self.task or "velocity_rough", self.out, self.set))
            return 0
        if self.set:
            raise _core.ConfigError("--set changes no task of --heights; write the keys into the task's file")
        from polypod import height_fields

        task = self.task or "velocity_flat"
        check_names(task, None)
        heights = height_fields.read(self.heights, self.range)
        height_fields.write_task(self.out, heights, self.cell, task)
        x, y = (self.cell * (count - 1) for count in heights.shape)
        print(
            f"{self.out}: {x:.2f} x {y:.2f} m, heights from {heights.min():.3f} to {heights.max():.3f} m; "
            f"polypod play --checkpoint flat --task {self.out} walks on it"
        )
        return 0
