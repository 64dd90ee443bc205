"""`polypod bench`."""

import dataclasses
import functools
import sys
from pathlib import Path
from typing import Annotated, Literal

from polypod import _core
from polypod.commands.arguments import Count, Robots, arg, names, positive, thread_count, write_json
from polypod.extras import package

NUM_ENVS = 4096


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure the speed of the physics, with MuJoCo's in the same run, or of trainings."""

    learner: bool = False
    """Measure instead the time of each part of a training iteration, for every learner."""
    walk: bool = False
    """Measure instead the time and the samples until all robots walk."""
    workers: Annotated[str | None, arg(metavar="N,N,N")] = None
    """Measure trainings with these numbers of workers instead, which share the same cores: for
    example 1,2,4."""
    kinds: Annotated[str | None, arg(metavar="ROBOT,ROBOT")] = None
    """Measure instead a batch of these kinds of bodies and the same kinds one by one; `all`:
    sixteen kinds with two, four and six legs."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of --workers: workers on the CPU's cores, or on the machine's GPUs."""
    train_config: str = "quick"
    """Train config of --learner, --walk and --workers."""
    robots: Robots = None
    """Robots of --walk, with commas between. Default: those of the train config's task."""
    seeds: int = 3
    """Trainings of --walk, each with the next seed."""
    quick: bool = False
    """Only the main figures, in less than a minute."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    plot: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also plot the physics next to MuJoCo's and how the speed scales (.png, .svg, .pdf)."""
    robot: str = "unitree_a1"
    """Robot whose physics is compared."""
    num_envs: Count = None
    """Number of envs, but where it is varied. Default: 4096; of trainings, the train config's."""
    threads: int = 1
    """Threads of the physics figures, polypod's and MuJoCo's."""
    step_threads: Count = None
    """Threads of the whole control steps. Default: one per core."""
    largest: int = 65536
    """Largest number of envs of the scaling."""
    seed: Count = None
    """Seed of every random stream; the first of --walk. Default: 0; of trainings, 42."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        trains = self.learner or self.walk or self.workers is not None
        if (trains or self.kinds is not None) and self.robot != type(self).robot:
            raise _core.ConfigError(
                "--robot is the robot of the physics figures; trainings take the robots of --train-config, and --kinds "
                "names its own: leave it out"
            )
        if trains:
            return self._train()
        if self.kinds is not None:
            return self._kinds()
        if self.robots is not None:
            raise _core.ConfigError("--robots are those of --walk; --robot is that of the physics figures")
        from polypod import bench

        for value, flag in (
            (self.num_envs, "--num-envs"),
            (self.largest, "--largest"),
        ):
            positive(value, flag)
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
        if self.plot is not None:
            bench.picture(result, self.plot)
        return 0

    def _kinds(self) -> int:
        """Measures what it costs to mix kinds of bodies."""
        from polypod.bench import kinds

        robots = kinds.KINDS if self.kinds == "all" else names(self.kinds) or ()
        result = kinds.measure(
            robots,
            positive(self.num_envs, "--num-envs") or NUM_ENVS,
            thread_count(self.step_threads, "--step-threads"),
            self.seed or 0,
            functools.partial(print, file=sys.stderr, flush=True),
        )
        print(kinds.table(result))
        write_json(self.json, result)
        return 0

    def _train(self) -> int:
        """Measures trainings."""
        torch = package("torch", "the measurement of trainings", "train")
        from polypod.bench import learners, walking
        from polypod.training.session import DEFAULT_SEED

        threads = thread_count(self.step_threads, "--step-threads")
        num_envs, seed = positive(self.num_envs, "--num-envs"), DEFAULT_SEED if self.seed is None else self.seed
        is_walk = self.walk and self.workers is None and not self.learner
        train_config = self.train_config or ("quick" if is_walk else "flat_universal")
        robots = names(self.robots)
        if robots is not None and not is_walk:
            raise _core.ConfigError("--robots are those of --walk; leave it out, or measure --walk")
        options = learners.Options(train_config, num_envs, threads, seed, robots)
        progress = functools.partial(print, file=sys.stderr, flush=True)
        if self.workers is not None:
            from polypod.bench import workers

            result = workers.measure(options, _counts(self.workers), progress, self.device)
            print(workers.table(result))
        elif self.learner:
            result = learners.measure(options, progress)
            print(learners.table(result))
        else:
            positive(self.seeds, "--seeds")
            device = learners.CUDA if torch.cuda.is_available() else "cpu"
            result = walking.measure(options, "auto", range(seed, seed + self.seeds), device, progress)
            print(walking.table(result))
        write_json(self.json, result)
        if self.plot is not None and self.walk:
            walking.picture(result, self.plot)
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
