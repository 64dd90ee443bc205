"""`polypod film`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from polypod.commands.arguments import (
    Count,
    Name,
    Overrides,
    RobotNames,
    arg,
    check_names,
    names,
    options_of,
    thread_count,
)


@dataclasses.dataclass(frozen=True)
class FilmOf:
    """Film a policy without a display: a walk, a training, a push, or a comparison with MuJoCo.

    Needs the extra play.

    `polypod play --video` films other scenes, such as rough ground.
    """

    story: Annotated[Literal["walk", "training", "push", "mujoco"], tyro.conf.Positional]
    """walk: side by side, also robots that the policy never saw. training: a run from its untrained
    network to its last checkpoint. push: robots are pushed from the side. mujoco: the same policy
    in both simulators; needs the extras export and bench."""
    out: Annotated[Path, tyro.conf.Positional]
    """The film: .gif, .webp or .mp4."""
    checkpoint: Annotated[Path | None, arg(metavar="FILE")] = None
    """A model_<n>.pt next to its manifest.json, a policy as ONNX, the name of a run or the end of
    it, or a bundled policy: flat, rough, legged, quadruped or two_legs. For a training also the
    folder of its run. Default: flat."""
    robots: RobotNames = None
    """Names of the robots, with commas between. Default: the run's."""
    command: Annotated[tuple[float, float, float], arg(metavar="VX VY WZ")] = (0.6, 0.0, 0.0)
    """Forward and left velocity (m/s) and yaw rate (rad/s) for all robots."""
    task: Name = None
    """Name or alias of the task. Default: the run's."""
    seconds: Annotated[float, arg(metavar="S")] = 4.0
    """Length of the film; of a training, of each of its parts. Simulated time."""
    parts: int = 6
    """Parts of the film of a training: the untrained network, and checkpoints of the run."""
    push: Annotated[float, arg(metavar="V")] = 1.0
    """Velocity that a push adds, m/s."""
    warm_up: Annotated[float, arg(metavar="S")] = 1.5
    """Simulated time before the film begins, s."""
    fps: int = 12
    """Frames per second."""
    size: Annotated[tuple[int, int], arg(metavar="WIDTH HEIGHT")] = (640, 300)
    """Width and height, pixels."""
    seed: int = 0
    """Seed of every random stream."""
    threads: Count = None
    """Threads of the simulator. Default: one per core."""
    set: Overrides = ()
    """Changes the task's configuration, on top of the run's own changes. May be repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        check_names(self.task, names(self.robots))
        from polypod import films, runs

        films.tell(
            self.story,
            options_of(
                films.Options,
                self,
                checkpoint=runs.resolve(self.checkpoint),
                robots=names(self.robots),
                threads=thread_count(self.threads, "--threads"),
                overrides=list(self.set),
            ),
        )
        print(self.out)
        return 0
