"""`polypod bench`."""

import dataclasses
import functools
import sys
from pathlib import Path
from typing import Annotated

from polypod.commands.arguments import Count, arg, checked_threads, positive, write_json


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure the speed, physics beside MuJoCo in the same run."""

    quick: bool = False
    """Only the main figures, in less than a minute."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    plot: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also plot how the speed scales (.png, .svg, .pdf)."""
    robot: str = "unitree_a1"
    """Whose physics is compared."""
    num_envs: int = 4096
    """Number of envs, but where it is varied."""
    threads: int = 1
    """Threads of the physics figures, polypod's and MuJoCo's."""
    step_threads: Count = None
    """Threads of the whole control steps. Default: one per core."""
    largest: int = 65536
    """Number of envs that the scaling goes up to."""
    seed: int = 0
    """Of every random stream."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        from polypod import bench

        for value, flag in (
            (self.num_envs, "--num-envs"),
            (self.largest, "--largest"),
        ):
            positive(value, flag)
        checked_threads(self.threads, "--threads")
        options = bench.Options(
            robot=self.robot,
            num_envs=self.num_envs,
            threads=self.threads,
            step_threads=checked_threads(self.step_threads, "--step-threads"),
            seed=self.seed,
            quick=self.quick,
            largest=self.largest,
        )
        result = bench.measure(options, functools.partial(print, file=sys.stderr, flush=True))
        print(bench.table(result))
        write_json(self.json, result)
        if self.plot is not None:
            bench.picture(result, self.plot)
        return 0
