"""`polypod adapt`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from polypod import _core, runs
from polypod.commands.arguments import (
    Count,
    Locks,
    Name,
    Overrides,
    PackageDirs,
    arg,
    check_names,
    locked_joints,
    options_of,
    package_dirs,
    positive,
    torch_threads,
)

MAX_NEIGHBOURS = 1000


@dataclasses.dataclass(frozen=True)
class Adapt:
    """Let a bundled policy learn to walk with one robot, in minutes."""

    robot: Annotated[str, tyro.conf.Positional, arg(metavar="ROBOT")]
    """Name of a robot (`polypod list robots`), path of a robot's .toml, or a .urdf, .xacro, .xml
    (MJCF) or .zip, of which a config is drafted."""
    checkpoint: Annotated[Path | None, arg(metavar="FILE")] = None
    """Policy to begin with: a model_<n>.pt next to its manifest.json, the name of a run, or a
    bundled policy. Default: quadruped for four legs, legged for others."""
    neighbours: int = 0
    """Also train the N robots of the policy with the nearest descriptions, so that it keeps
    them."""
    max_minutes: float = 15.0
    """End after this many minutes, drafting and measuring included."""
    every: Count = None
    """Iterations between two measurements. Default: 10; of a separate network 20, from scratch
    60."""
    train_config: Name = None
    """Learner's settings: the name of a train config or the path of a .toml. Networks and task are
    the policy's. Default: adapt, with a GPU adapt_on_gpu; for a separate network adapt_separate,
    which also sets networks and task if it begins from scratch."""
    separate: Literal["auto", "always", "never"] = "auto"
    """Train a separate network in place of the policy: on two legs it begins with a bundled one,
    else from scratch. auto: where the policy falls before it ends a turn or a stop, the robot has
    two legs or a GPU is there, and neither --checkpoint nor --neighbours is given."""
    from_scratch: bool = False
    """Begin a separate network from scratch on two legs, too."""
    seed: Count = None
    """Seed of every random stream. Default: 42."""
    log_dir: Path = Path("logs")
    """Folder of runs: the run is written to LOG_DIR/rsl_rl/adapt/."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the learner; the simulator runs on the CPU."""
    threads: Count = None
    """Threads of the simulator, and of the learner on the CPU. Default: one per core."""
    package_dir: PackageDirs = ()
    """Folder of a ROS package in a file's `package://` names. May be repeated."""
    lock: Locks = ()
    """Holds a joint of a file at a position, rad or m: an arm, a wheel. May be repeated."""
    legs_alone: Literal["auto", "always", "never"] = "auto"
    """Hold all joints of a file but those of the legs, at their default pose. auto: of a robot with
    more than 30 joints, from scratch 26, that gets a separate network, which learns to walk sooner
    with fewer."""
    set: Overrides = ()
    """Changes the task's configuration, or with train. before the key the train config. May be
    repeated."""

    def run(self) -> int:
        """Runs the command.

        Returns its exit code: 0 if the robot walks, 3 if it does not within the time.
        """
        self._check()
        from polypod import adapt
        from polypod.training.session import NOT_WALKING

        options = options_of(
            adapt.Options,
            self,
            checkpoint=None if self.checkpoint is None else runs.resolve(self.checkpoint, self.log_dir),
            threads=torch_threads(self.threads),
            overrides=tuple(self.set),
            package_dirs=package_dirs(self.package_dir),
            locked_joints=locked_joints(self.lock),
        )
        reporter = adapt.Progress()
        result = adapt.adapt(options, reporter)
        adapt.table(result).print(reporter.console)
        reporter.message(adapt.verdict(result))
        if result.stopped_by is not None:
            return 128 + result.stopped_by
        return 0 if result.walks else NOT_WALKING

    def _check(self) -> None:
        """Refuses what does not exist before torch is imported."""
        from polypod.add.sources import is_description

        if not is_description(self.robot):
            check_names(None, [self.robot])
            flags = {"--package-dir": self.package_dir, "--lock": self.lock, "--legs-alone": self.legs_alone != "auto"}
            for flag, value in flags.items():
                if value:
                    raise _core.ConfigError(f"{flag} is of a URDF; leave it out, or pass the URDF of {self.robot[:80]}")
        if not 0 <= self.neighbours <= MAX_NEIGHBOURS:
            raise _core.ConfigError(f"--neighbours {self.neighbours} must be from 0 to {MAX_NEIGHBOURS}")
        if not 0.0 < self.max_minutes <= 1e6:
            raise _core.ConfigError(f"--max-minutes {self.max_minutes} must be greater than 0 and at most 1e6")
        positive(self.every, "--every")
