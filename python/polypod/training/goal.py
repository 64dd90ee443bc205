"""Trainings that end when their robots walk.

Used by `train --until-walks`, `adapt` and `lab.speed`.
"""

import contextlib
import dataclasses
import os
import time
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, Protocol

import torch

from polypod.evaluation import ENVS_PER_ROBOT, Evaluation, evaluate_checkpoint
from polypod.evaluation.walking import Walking, shortfall, walks, why_not
from polypod.runs import run_dir
from polypod.runs.schema import URMA
from polypod.tensors import torch_threads
from polypod.training.runner import Runner

SEED, CONFIRMING_SEED = 0, 1
"""Seeds of measurements that decide, and of those that confirm what was decided."""
STEPS, FALLS = 0.8, 0.5
"""A measurement promises nothing as long as a robot misses its commands, with the noise of the
training, by more than this share of a standing robot's error, or falls in more than this share of
its episodes."""
MOST_ON_ONE_THREAD, MOST_THREADS = 512, 8
"""Envs whose perceptron one thread of torch steps as fast as many, which wait for each other and
keep the simulator's threads from their cores; and threads that share larger batches."""


class Meter(Protocol):
    """Counts something between `resume` and `pause`."""

    def resume(self) -> None:
        """Counts from here on."""

    def pause(self) -> None:
        """Stands still from here on."""


@dataclasses.dataclass(frozen=True)
class Point:
    """A measurement of a training."""

    iterations: int
    samples: int
    seconds: float
    """Training time until then, without measurements."""
    robots: Mapping[str, Walking]
    checkpoint: Path


def rank(robots: Mapping[str, Walking], wanted: Collection[str]) -> tuple[int, float]:
    """The order of measurements by how well some robots walk, the best one last."""
    figures = [robots[robot] for robot in wanted]
    return sum(map(walks, figures)), -sum(map(shortfall, figures))


class UntilWalks:
    """Measures a training at intervals by `polypod.evaluation.walking`; ends it when robots walk.

    The deterministic policy is measured in the Play variant of the training's task. Measurements
    leave the training's random numbers alone. The best of the measured checkpoints stays.
    """

    def __init__(
        self,
        every: int,
        wanted: Collection[str] | None = None,
        *,
        say: Callable[[Point], None] = lambda point: None,
        deadline: float | None = None,
        confirm: bool = True,
        envs_per_robot: int = ENVS_PER_ROBOT,
        threads: int | None = None,
        meter: Meter | None = None,
        only_promising: bool = False,
        tell: Callable[[str], None] = lambda line: None,
        first: Point | None = None,
    ) -> None:
        """Begins.

        Args:
            every: iterations between two measurements.
            wanted: names of the robots that have to walk; None: all of the training.
            say: is told each measurement.
            deadline: of `time.monotonic`, after which one more measurement ends the training; None:
                there is none.
            confirm: whether robots have to walk with a second seed too, which selects nothing.
            envs_per_robot: number of envs of a measurement for each robot.
            threads: of a measurement; None: one per core.
            meter: of the training's energy, which stands still in measurements.
            only_promising: nothing is measured as long as the figures of the training say that a
                robot cannot walk (`STEPS`, `FALLS`), but for the last time.
            tell: is told why nothing is measured.
            first: what the training begins with, in its run's directory; it stays if no measurement
                is better.
        """
        self.every, self.wanted = every, None if wanted is None else tuple(wanted)
        self.best: Point | None = first
        self.points: list[Point] = []
        self.confirmation: Mapping[str, Walking] | None = None
        """Figures of the last second seed."""
        self.walked = False
        """Whether the robots walk after the best checkpoint."""
        self._say, self._deadline, self._confirm = say, deadline, confirm
        self._envs_per_robot, self._threads = envs_per_robot, threads
        self._meter = meter
        self._only_promising, self._tell = only_promising, tell
        self._measuring = 0.0
        self._evaluated: tuple[Path, Evaluation] | None = None
        self._began = time.perf_counter()

    def evaluation_of(self, checkpoint: Path) -> Evaluation | None:
        """The last measurement, where it was of this checkpoint with all that an evaluation has."""
        if self._evaluated is None or self._envs_per_robot != ENVS_PER_ROBOT:
            return None
        measured, evaluation = self._evaluated
        return evaluation if measured == checkpoint else None

    def begin(self) -> None:
        """Counts the seconds of the training from here on."""
        self._began, self._measuring = time.perf_counter(), 0.0
        if self._meter is not None:
            self._meter.resume()

    def ends(self, runner: Runner, is_last: bool) -> bool:
        """Measures the training if it is time to.

        Returns whether it has reached its goal or its deadline.
        """
        iterations = runner.current_learning_iteration
        is_late = self._deadline is not None and time.monotonic() >= self._deadline
        if iterations % self.every and not is_late and not is_last:
            return False
        samples = runner.config.run.num_steps_per_env * runner.env.num_envs * iterations
        if not is_late and not is_last and (why := self._cannot_walk(runner)) is not None:
            seconds = time.perf_counter() - self._began - self._measuring
            self._tell(f"iteration {iterations}, {_spent(samples, seconds)}: {why}")
            return False
        begin = time.perf_counter()
        if self._meter is not None:
            self._meter.pause()
        path = run_dir.checkpoint_path(runner.run, iterations)
        runner.try_to_save(path)
        # a full disk takes none, and the training goes on
        if path.is_file():
            seconds = begin - self._began - self._measuring
            self._add(Point(iterations, samples, seconds, self._measure(path, SEED), path), runner)
        self._measuring += time.perf_counter() - begin
        ends = self.walked or is_late
        if self._meter is not None and not (ends or is_last):
            self._meter.resume()
        return ends

    def _cannot_walk(self, runner: Runner) -> str | None:
        """Why a measurement is not worth its time: the robot that is farthest from walking."""
        if not self._only_promising:
            return None
        stats = runner.stats_of_robots
        errors = {
            name: of["error_vel_xy"] / of["command_xy"] for name, of in stats.items() if of.get("command_xy", 0.0) > 0.0
        }
        if not errors:
            return None
        name = max(errors, key=errors.__getitem__)
        if errors[name] > STEPS:
            falls = stats[name]["fall_rate"]
            return f"{name} follows no better than standing still, and falls in {falls:.0%} of the episodes"
        name = max(errors, key=lambda robot: stats[robot]["fall_rate"])
        falls = stats[name]["fall_rate"]
        return f"{name} falls in {falls:.0%} of the episodes" if falls > FALLS else None

    def _add(self, point: Point, runner: Runner) -> None:
        """Takes a measurement."""
        wanted = self.wanted or tuple(point.robots)
        self._keep(point, runner.config.run.save_interval)
        self.points.append(point)
        self._say(point)
        if all(walks(point.robots[robot]) for robot in wanted):
            self.walked = True
            if self._confirm:
                self.confirmation = self._measure(point.checkpoint, CONFIRMING_SEED)
                self.walked = all(walks(self.confirmation[robot]) for robot in wanted)

    def _measure(self, path: Path, seed: int) -> dict[str, Walking]:
        manifest = run_dir.read_manifest(path)
        num_envs = self._envs_per_robot * len(manifest["robots"])
        chosen = threads_of_a_measurement(manifest, self._threads, self._envs_per_robot)
        # weights are drawn before they are read from the checkpoint
        with torch.random.fork_rng(devices=[]), chosen:
            result = evaluate_checkpoint(path, num_envs=num_envs, seed=seed, threads=self._threads)
        if seed == SEED:
            self._evaluated = (path, result)
        return {name: robot.walking for name, robot in result.robots.items() if robot.walking is not None}

    def _keep(self, point: Point, save_interval: int) -> None:
        """Keeps the best checkpoint, of equals the last, and those of the training's interval."""
        wanted, leaves = self.wanted or tuple(point.robots), point
        # where all walk, the one before has failed with the second seed
        if self.best is None or rank(point.robots, wanted) >= rank(self.best.robots, wanted):
            self.best, leaves = point, self.best or point
        is_of_interval = leaves.iterations > 0 and leaves.iterations % save_interval == 0
        if leaves is not self.best and not is_of_interval:
            run_dir.remove_checkpoint(leaves.checkpoint)


def threads_of_a_measurement(
    manifest: Mapping[str, Any], threads: int | None, envs_per_robot: int = ENVS_PER_ROBOT
) -> contextlib.AbstractContextManager[None]:
    """Gives torch the threads that suit a measurement; a training on a GPU leaves it one.

    Args:
        manifest: the policy's.
        threads: of the training; None: one per core, `MOST_THREADS` at most.
        envs_per_robot: of the measurement.
    """
    num_envs = envs_per_robot * len(manifest["robots"])
    if manifest["policy"]["class_name"] != URMA and num_envs <= MOST_ON_ONE_THREAD:
        return torch_threads(1)
    if torch.get_num_threads() > 1:
        return contextlib.nullcontext()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return torch_threads(threads or min(cores, MOST_THREADS))


def progress_line(point: Point, wanted: Collection[str] | None = None) -> str:
    """A measurement in a line: how many robots walk, and the figures of the worst one."""
    figures = {robot: point.robots[robot] for robot in wanted or point.robots}
    walking = sum(map(walks, figures.values()))
    name = max(figures, key=lambda robot: shortfall(figures[robot]))
    spent = _spent(point.samples, point.seconds)
    reasons = why_not(figures[name])
    farthest = f"; {name}: {'; '.join(reasons)}" if reasons else ""
    return f"iteration {point.iterations}, {spent}: {walking} of {len(figures)} walk{farthest}"


def _spent(samples: int, seconds: float) -> str:
    return f"{samples / 1e6:.2f} million samples, {seconds:.0f} s"
