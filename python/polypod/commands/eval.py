"""`polypod eval`."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from polypod import _core
from polypod.commands.arguments import (
    Count,
    Name,
    Overrides,
    Robots,
    arg,
    check_names,
    names,
    torch_threads,
    write_json,
)


@dataclasses.dataclass(frozen=True)
class Eval:
    """Measure a trained policy and say which robots walk.

    No noise, no pushes, one full episode per env.
    """

    checkpoint: Annotated[tuple[Path, ...], arg(metavar="FILE [FILE ...]")]
    """A model_<n>.pt next to its manifest.json, a policy as ONNX, the name of a run or the end of
    it, or a bundled policy: flat, rough, legged, quadruped or two_legs. For several, the seeds of
    one training, also the mean and its interval."""
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
    """Commands of the episodes: those that walking is judged by, new ones every 5 s with turns,
    side-steps and stops; or as the task draws them."""
    grid: Annotated[tuple[int, int, int] | None, arg(metavar="NX NY NW")] = None
    """Let each episode hold one command of a grid of this many forward and left velocities and yaw
    rates."""
    gate: bool = False
    """Measure the published gate of nanoG1: falls and score over six commands, smoothness of a walk
    ahead. The exit code is 3 where a robot does not pass."""
    randomized: bool = False
    """Keep the noise, the pushes and the randomisation of the training."""
    robots: Robots = None
    """Names of the robots, with commas between; also robots that the policy was not trained on.
    Default: the run's."""
    task: Name = None
    """Name or alias of the task. Default: the run's."""
    terms: Annotated[Path | None, arg(metavar="FILE")] = None
    """Python file of terms that the run began with; the file is run, see docs/write-a-term.md. Its
    curricula, startup and interval events are on with --randomized alone."""
    seed: int = 0
    """Seed of every random stream."""
    threads: Count = None
    """Threads of the simulator and the policy. Default: one per core."""
    set: Overrides = ()
    """Changes the task's configuration, on top of the run's own changes. May be repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        check_names(self.task, names(self.robots))
        from polypod import runs
        from polypod.evaluation import evaluate_checkpoints, plot, summarize
        from polypod.training.report import Reporter

        threads = torch_threads(self.threads)
        if not self.checkpoint:
            raise _core.ConfigError("--checkpoint names no file; pass one model_<n>.pt or more")
        checkpoints = [runs.resolve(checkpoint) for checkpoint in self.checkpoint]
        if self.gate:
            return self._gate(checkpoints, threads)
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
            terms=self.terms,
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

    def _gate(self, checkpoints: Sequence[Path], threads: int | None) -> int:
        """Measures the gate of nanoG1."""
        from polypod.evaluation import gate, gate_of_checkpoint
        from polypod.evaluation.results import finite
        from polypod.tables import Rows, console_of_output

        (checkpoint, *others) = checkpoints
        given = {
            "several checkpoints": others,
            "--terms": self.terms,
            "--num-envs": self.num_envs,
            "--steps": self.steps,
            "--grid": self.grid,
            "--randomized": self.randomized or None,
            "--episodes": self.episodes if self.episodes != 1 else None,
            "--plot": self.plot,
        }
        if unfit := [name for name, value in given.items() if value]:
            raise _core.ConfigError(f"--gate has commands, envs and times of its own; leave out {', '.join(unfit)}")
        robots = names(self.robots)
        found = gate_of_checkpoint(
            checkpoint, robots, task=self.task, seed=self.seed, threads=threads, overrides=list(self.set)
        )
        console = console_of_output()
        table = Rows("robot", *gate.BOUNDS, "passes")
        table.add_row("bound", *(f"{bound:g}" for bound in gate.BOUNDS.values()), "")
        for robot, figures in found.items():
            cells = [f"{getattr(figures, name):.3g}" for name in gate.BOUNDS]
            table.add_row(robot, *cells, "yes" if figures.passes else "no")
        table.print(console)
        passing = sum(figures.passes for figures in found.values())
        console.print(f"{passing} of {len(found)} pass nanoG1's gate", markup=False)
        rows = {robot: {**dataclasses.asdict(of), "passes": of.passes} for robot, of in found.items()}
        write_json(self.json, finite({"bounds": gate.BOUNDS, "robots": rows}))
        return 0 if passing == len(found) else 3
