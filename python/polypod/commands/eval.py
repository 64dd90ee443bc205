"""`polypod eval`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from polypod import _core
from polypod.commands.arguments import Count, Name, Overrides, Robots, arg, check_names, names, thread_count, write_json


@dataclasses.dataclass(frozen=True)
class Eval:
    """Measure a trained policy and say which robots walk: no noise, no pushes, one full episode per env."""

    checkpoint: Annotated[tuple[Path, ...], arg(metavar="FILE [FILE ...]")]
    """A model_<n>.pt beside its manifest.json, a policy as ONNX, the name of a run or the end of it, or a bundled
    policy: flat, rough, legged or quadruped. Of several, the seeds of one training, the mean and its interval too."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    plot: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also draw them (.png, .svg, .pdf); needs the extra bench."""
    num_envs: Count = None
    """Number of envs. Default: 64 per robot."""
    episodes: int = 1
    """Episodes per env."""
    steps: Count = None
    """Control steps per episode. Default: 20 s, or a whole one."""
    commands: Literal["walking", "task"] = "walking"
    """Commands that walking is judged by, new ones every 5 s, turns, side-steps and stops among them; or commands as
    the task draws them."""
    grid: Annotated[tuple[int, int, int] | None, arg(metavar="NX NY NW")] = None
    """Instead, let each episode hold one command of this many forward and left velocities and yaw rates."""
    randomized: bool = False
    """With the noise, the pushes and the randomisation of the training."""
    robots: Robots = None
    """Names of the robots, with commas between; also robots that the policy was not trained on. Default: the run's."""
    task: Name = None
    """Name or alias of the task. Default: the run's."""
    seed: int = 0
    """Seed of every random stream."""
    threads: Count = None
    """Threads of the simulator and the policy. Default: one per core."""
    set: Overrides = ()
    """Changes the task's configuration, on top of the run's own changes. May be repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        check_names(self.task, names(self.robots))
        import torch

        from polypod import bundled
        from polypod.evaluation import evaluate_checkpoints, plot, summarize
        from polypod.training.report import Reporter

        threads = thread_count(self.threads, "--threads")
        if threads is not None:
            torch.set_num_threads(threads)
        if not self.checkpoint:
            raise _core.ConfigError("--checkpoint names no file; pass one model_<n>.pt or more")
        checkpoints = [bundled.resolve(checkpoint) for checkpoint in self.checkpoint]
        evaluations = evaluate_checkpoints(
            checkpoints,
            task=self.task,
            robots=names(self.robots),
            num_envs=self.num_envs,
            episodes=self.episodes,
            steps=self.steps,
            seed=self.seed,
            threads=threads,
            overrides=list(self.set),
            grid=self.grid,
            commands=self.commands,
            randomized=self.randomized,
        )
        summary = summarize(evaluations)
        reporter = Reporter()
        for checkpoint, evaluation in zip(checkpoints, evaluations, strict=True):
            if len(evaluations) > 1:
                reporter.message(str(checkpoint))
            reporter.evaluation(evaluation)
        if len(evaluations) > 1:
            reporter.summary(summary)
        write_json(self.json, summary.as_dict() if len(evaluations) > 1 else evaluations[0].as_dict())
        if self.plot is not None:
            plot.picture(summary, self.plot)
        return 0
