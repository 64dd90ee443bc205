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
    """File to write: a .png (shaded map), .stl (triangles) or .npz (heights); with --heights a
    .toml, the task."""
    task: Name = None
    """Name or alias of the task. Default: velocity_rough; with --heights alone velocity_flat, which
    the new task extends."""
    set: Overrides = ()
    """Changes the task's configuration, e.g. --set scene.terrain.seed=1. May be repeated."""
    heights: Annotated[tuple[Path, ...], arg(metavar="FILE [FILE ...]")] = ()
    """File with heights: a grey .png, x to the right and y upwards, or a .npy of [x, y] in m. Every
    env has them around its origin; heights below 0 are holes in the ground."""
    tiles: bool = False
    """Make tiles of a terrain with levels of the files of --heights, the easiest first."""
    scale: Annotated[tuple[float, float] | None, arg(metavar="LOW HIGH")] = None
    """Factors of the heights of --tiles at the easiest and the hardest level. Default: 1."""
    platform: Annotated[float, arg(metavar="M")] = 1.0
    """Edge length of the level square in the middle of --tiles, where robots begin, m."""
    range: Annotated[tuple[float, float] | None, arg(metavar="LOW HIGH")] = None
    """Heights of black and of white, m."""
    cell: Annotated[float, arg(metavar="M")] = 0.05
    """Distance of neighbouring heights, m."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        if not self.heights:
            if self.range is not None or self.tiles:
                given = "--tiles" if self.tiles else "--range"
                raise _core.ConfigError(f"{given} is of pictures and arrays; name them with --heights")
            from polypod import terrain

            print(terrain.save(self.task or "velocity_rough", self.out, self.set))
            return 0
        if self.set:
            raise _core.ConfigError("--set changes no task of --heights; write the keys into the task's file")
        from polypod import height_fields

        if len(self.heights) > 1 and not self.tiles:
            raise _core.ConfigError("--heights: several files are levels of tiles; add --tiles, or name one")
        if self.scale is not None and not self.tiles:
            raise _core.ConfigError("--scale is of tiles; add --tiles")
        task = self.task or ("velocity_rough" if self.tiles else "velocity_flat")
        check_names(task, None)
        # with one kind of file, a range that it does not take is a mistake
        is_mixed = len({path.suffix.lower() for path in self.heights}) > 1
        spans = [None if is_mixed and path.suffix.lower() != ".png" else self.range for path in self.heights]
        fields = [height_fields.read(path, span) for path, span in zip(self.heights, spans, strict=True)]
        if self.tiles:
            height_fields.write_tiles(self.out, fields, self.cell, task, self.scale, self.platform)
        else:
            height_fields.write_task(self.out, fields[0], self.cell, task)
        x, y = (self.cell * (count - 1) for count in fields[0].shape)
        low, high = min(field.min() for field in fields), max(field.max() for field in fields)
        print(
            f"{self.out}: {x:.2f} x {y:.2f} m, heights from {low:.3f} to {high:.3f} m; "
            f"polypod play --checkpoint {'rough' if self.tiles else 'flat'} --task {self.out} walks on it"
        )
        return 0
