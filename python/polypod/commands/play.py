"""`polypod play`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from polypod.commands.arguments import (
    Count,
    Name,
    Overrides,
    RobotNames,
    Velocity,
    arg,
    check_names,
    names,
    options_of,
    thread_count,
)


@dataclasses.dataclass(frozen=True)
class Play:
    """Watch a policy in the browser, record it, or film it without a display.

    Needs the extra play.
    """

    checkpoint: Annotated[Path | None, arg(metavar="FILE")] = None
    """A model_<n>.pt next to its manifest.json, a policy as ONNX, the name of a run or the end of
    it, or a bundled policy: flat, rough, legged, quadruped or two_legs. Default: flat."""
    robots: RobotNames = None
    """Names of the robots, with commas between. Default: the run's."""
    command: Velocity = None
    """Forward and left velocity (m/s) and yaw rate (rad/s) for all robots. Default: drawn from the
    task's ranges."""
    task: Name = None
    """Name or alias of the task. Default: the run's."""
    num_envs: int = 1
    """Envs per robot."""
    seconds: Annotated[float | None, arg(metavar="S")] = None
    """Simulated time. Default: without end in the browser, else 10 s."""
    warm_up: Annotated[float, arg(metavar="S")] = 0.0
    """Simulated time before anything is shown, s."""
    record: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write a recording: .html opens in any browser, .viser in viser's client."""
    video: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write a film: .gif, .webp or .mp4."""
    fps: int = 25
    """Frames of the film per second."""
    size: Annotated[tuple[int, int], arg(metavar="WIDTH HEIGHT")] = (640, 360)
    """Width and height of the film, pixels."""
    headless: bool = False
    """Print the table of results alone, without browser or file."""
    host: str = "127.0.0.1"
    """Address of the page. With 0.0.0.0 other machines reach it, and anyone who does steers."""
    port: int = 8080
    """Port of the browser's page; 0 takes a free one."""
    meshes: bool = False
    """Show the makers' meshes, which the package robot_descriptions downloads once; needs the extra
    meshes."""
    terms: Annotated[Path | None, arg(metavar="FILE")] = None
    """Python file of terms that the run began with; the file is run."""
    seed: int = 0
    """Seed of every random stream."""
    threads: Count = None
    """Threads of the simulator. Default: one per core."""
    set: Overrides = ()
    """Changes the task's configuration, on top of the run's own changes. May be repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        check_names(self.task, names(self.robots))
        from polypod import runs
        from polypod.play import session
        from polypod.play.report import show

        player = session.play(
            options_of(
                session.Options,
                self,
                checkpoint=runs.resolve(self.checkpoint),
                robots=names(self.robots),
                envs_per_robot=self.num_envs,
                threads=thread_count(self.threads, "--threads"),
                overrides=list(self.set),
            )
        )
        show(player)
        for file in (self.record, self.video):
            if file is not None:
                print(file)
        return 0
