"""`polypod bench`."""

import dataclasses
import functools
import sys
from pathlib import Path
from typing import Annotated, Literal

from polypod import _core
from polypod.commands.arguments import Count, arg, positive, thread_count, write_json
from polypod.extras import package

NUM_ENVS = 4096


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure the speed of the physics, with MuJoCo's in the same run, or of trainings."""

    learner: bool = False
    """Measure the time of each part of a training iteration, for every learner."""
    workers: Annotated[str | None, arg(metavar="N,N,N")] = None
    """Measure trainings with these numbers of workers, which share the same cores: for example
    1,2,4."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of --workers: workers on the CPU's cores, or on the machine's GPUs."""
    train_config: str = "quick"
    """Train config of --learner and --workers."""
    quick: bool = False
    """Measure the main figures alone, in less than a minute."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    robot: str = "unitree_a1"
    """Robot whose physics is compared."""
    num_envs: Count = None
    """Number of envs of measurements that do not vary it. Default: 4096; of trainings, the train
    config's."""
    threads: int = 1
    """Threads of the physics figures, polypod's and MuJoCo's."""
    step_threads: Count = None
    """Threads of the whole control steps. Default: one per core."""
    largest: int = 65536
    """Largest number of envs of the scaling."""
    seed: Count = None
    """Seed of every random stream. Default: 0; of trainings, 42."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        if self.learner or self.workers is not None:
            if self.robot != type(self).robot:
                raise _core.ConfigError(
                    "--robot is the robot of the physics figures; trainings take the robots of --train-config: leave "
                    "it out"
                )
            return self._train()
        from polypod import bench

        positive(self.num_envs, "--num-envs")
        positive(self.largest, "--largest")
        thread_count(self.threads, "--threads")
        options = bench.Options(
            robot=self.robot,
            num_envs=NUM_ENVS if self.num_envs is None else self.num_envs,
            threads=self.threads,
            step_threads=thread_count(self.step_threads, "--step-threads"),
            seed=self.seed or 0,
            quick=self.quick,
            largest=self.largest,
        )
        result = bench.measure(options, functools.partial(print, file=sys.stderr, flush=True))
        print(bench.table(result))
        write_json(self.json, result)
        return 0

    def _train(self) -> int:
        """Measures trainings."""
        package("torch", "the measurement of trainings", "train")
        from polypod.bench import learners
        from polypod.training.session import DEFAULT_SEED

        options = learners.Options(
            self.train_config,
            positive(self.num_envs, "--num-envs"),
            thread_count(self.step_threads, "--step-threads"),
            DEFAULT_SEED if self.seed is None else self.seed,
        )
        progress = functools.partial(print, file=sys.stderr, flush=True)
        if self.workers is not None:
            from polypod.bench import workers

            result = workers.measure(options, _counts(self.workers), progress, self.device)
            print(workers.table(result))
        else:
            result = learners.measure(options, progress)
            print(learners.table(result))
        write_json(self.json, result)
        return 0


def _counts(text: str) -> list[int]:
    """Numbers of workers. Raises ConfigError."""
    try:
        counts = [int(number) for number in text.split(",")]
    except ValueError as error:
        raise _core.ConfigError(f"--workers {text[:80]!r} is no list of numbers; write it like 1,2,4") from error
    for count in counts:
        positive(count, "--workers")
    return counts
