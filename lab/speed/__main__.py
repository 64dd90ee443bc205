"""Measures the speed figures of the documentation: `python -m lab.speed scaling|kinds|walk`."""

import dataclasses
import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from polypod import _core, bench
from polypod.commands.arguments import Count, Robots, arg, names, positive, thread_count, write_json

NUM_ENVS = 4096
progress = functools.partial(print, file=sys.stderr, flush=True)


@dataclasses.dataclass(frozen=True)
class Scaling:
    """Measure the physics next to MuJoCo's, and control steps over envs, threads and robots."""

    num_envs: Count = NUM_ENVS
    """Number of envs, but where it is varied."""
    step_threads: Count = None
    """Threads of the control steps. Default: one per core."""
    largest: int = 65536
    """Largest number of envs of the scaling."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    plot: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also plot them (.png, .svg, .pdf)."""

    def run(self) -> None:
        """Measures and prints."""
        from lab.speed import scaling

        options = bench.Options(
            num_envs=positive(self.num_envs, "--num-envs") or NUM_ENVS,
            step_threads=thread_count(self.step_threads, "--step-threads"),
            largest=positive(self.largest, "--largest") or 1,
        )
        result = scaling.measure(options, progress)
        print(scaling.table(result))
        write_json(self.json, result)
        if self.plot is not None:
            scaling.picture(result, self.plot)


@dataclasses.dataclass(frozen=True)
class Kinds:
    """Measure a batch of several kinds of bodies, and the same kinds one by one."""

    robots: Robots = None
    """Robots, with commas between. Default: sixteen kinds with two, four and six legs."""
    num_envs: Count = NUM_ENVS
    """Number of envs of each batch."""
    step_threads: Count = None
    """Threads of the control steps. Default: one per core."""
    seed: int = 0
    """Seed of simulation and actions."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the figures to this file."""

    def run(self) -> None:
        """Measures and prints."""
        from lab.speed import kinds

        result = kinds.measure(
            names(self.robots) or kinds.KINDS,
            positive(self.num_envs, "--num-envs") or NUM_ENVS,
            thread_count(self.step_threads, "--step-threads"),
            self.seed,
            progress,
        )
        print(kinds.table(result))
        write_json(self.json, result)


@dataclasses.dataclass(frozen=True)
class Walk:
    """Measure the time and the samples until all robots walk."""

    train_config: str = "quick"
    """Name or file of the train config."""
    robots: Robots = None
    """Robots, with commas between. Default: those of the train config's task."""
    num_envs: Count = None
    """Number of envs. Default: the train config's."""
    seed: int = 42
    """Seed of the first training."""
    seeds: int = 3
    """Number of trainings, each with the next seed."""
    threads: Count = None
    """Threads of simulator and learner. Default: one per core."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    plot: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also plot the worst figures over samples (.png, .svg, .pdf)."""

    def run(self) -> None:
        """Measures and prints."""
        import torch

        from lab.speed import walking
        from polypod.bench import learners

        options = learners.Options(
            self.train_config,
            positive(self.num_envs, "--num-envs"),
            thread_count(self.threads, "--threads"),
            self.seed,
            names(self.robots),
        )
        positive(self.seeds, "--seeds")
        device = learners.CUDA if torch.cuda.is_available() else "cpu"
        result = walking.measure(options, "auto", range(self.seed, self.seed + self.seeds), device, progress)
        print(walking.table(result))
        write_json(self.json, result)
        if self.plot is not None:
            walking.picture(result, self.plot)


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 2 for bad input."""
    given: Scaling | Kinds | Walk = tyro.cli(
        Annotated[Scaling, tyro.conf.subcommand("scaling")]
        | Annotated[Kinds, tyro.conf.subcommand("kinds")]
        | Annotated[Walk, tyro.conf.subcommand("walk")],
        prog="python -m lab.speed",
        args=arguments,
    )
    try:
        given.run()
    except _core.PolypodError as error:
        print(f"lab.speed: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
