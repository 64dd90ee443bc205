"""`polypod compare`."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

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

if TYPE_CHECKING:
    from polypod.evaluation.comparison import Comparison

SHOWN = {
    "error_vel_xy": ("planar error, m/s", ".3f"),
    "error_vel_yaw": ("yaw error, rad/s", ".3f"),
    "fall_rate": ("falls, share of episodes", ".3f"),
    "turn_reached": ("pure turns, share reached", ".3f"),
    "tracking_reward": ("tracking reward, share", ".3f"),
    "power": ("power, W", ".1f"),
}
"""Figures of the table, with heading and format; the file of --json has all."""
MOST_SEEDS = 1000


@dataclasses.dataclass(frozen=True)
class Compare:
    """Say which of two policies is better, and by how much.

    Both walk on the same seeds: each env has the same body, start and commands under both. The
    difference of each figure has an interval over the seeds.
    """

    checkpoints: tyro.conf.Positional[Annotated[tuple[Path, ...], arg(metavar="FILE FILE [FILE ...]")]]
    """Policies as `polypod eval` takes them. Each one is compared with the first."""
    num_seeds: Annotated[int, arg(metavar="N")] = 8
    """Number of seeds, 3 or more."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write all figures to this file."""
    markdown: bool = False
    """Print the tables as Markdown."""
    num_envs: Count = None
    """Number of envs. Default: 64 per robot."""
    episodes: int = 1
    """Episodes per env and seed."""
    steps: Count = None
    """Control steps per episode. Default: 20 s, or a whole one."""
    commands: Literal["walking", "task"] = "walking"
    """Commands of the episodes: those that walking is judged by, or as the task draws them."""
    randomized: bool = False
    """Keep the noise, the pushes and the randomisation of the training."""
    robots: Robots = None
    """Names of the robots, with commas between. Default: those of the first policy that all others
    know."""
    task: Name = None
    """Name or alias of the task, for all. Default: each policy's own."""
    seed: int = 0
    """The first seed."""
    threads: Count = None
    """Threads of the simulator and the policies. Default: one per core."""
    set: Overrides = ()
    """Changes the task's configuration. May be repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        robots = names(self.robots)
        check_names(self.task, robots)
        from polypod import runs
        from polypod.evaluation.comparison import LEAST_SEEDS, compare_checkpoints
        from polypod.policy import load
        from polypod.progress import Progress

        threads = torch_threads(self.threads)
        if len(self.checkpoints) < 2:
            raise _core.ConfigError(f"compare takes two policies or more, not {len(self.checkpoints)}")
        if not LEAST_SEEDS <= self.num_seeds <= MOST_SEEDS:
            raise _core.ConfigError(f"--num-seeds {self.num_seeds} must be from {LEAST_SEEDS} to {MOST_SEEDS}")
        checkpoints = [runs.resolve(checkpoint) for checkpoint in self.checkpoints]
        if robots is None:
            (first, *others) = (load(checkpoint, self.task).manifest for checkpoint in checkpoints)
            known = zip(first["robots"], first["robot_sources"], strict=True)
            robots = [source for name, source in known if all(name in other["robots"] for other in others)]
            if not robots:
                raise _core.ConfigError("the policies have no robot in common; name some with --robots")
        total = len(checkpoints) * self.num_seeds
        with Progress(len(_BAR)) as progress:
            comparisons = compare_checkpoints(
                checkpoints,
                self.num_seeds,
                seed=self.seed,
                progress=lambda done: progress(_BAR, done, total),
                task=self.task,
                robots=robots,
                num_envs=self.num_envs,
                episodes=self.episodes,
                steps=self.steps,
                threads=threads,
                overrides=list(self.set),
                commands=self.commands,
                randomized=self.randomized,
            )
        shown = [str(checkpoint) for checkpoint in self.checkpoints]
        for other, comparison in zip(shown[1:], comparisons, strict=True):
            self._print(shown[0], other, comparison)
        write_json(self.json, {"comparisons": [comparison.as_dict() for comparison in comparisons]})
        return 0

    def _print(self, first: str, second: str, comparison: "Comparison") -> None:
        """Prints a table per figure, and which policy is better in how many rows."""
        from polypod.tables import Rows, console_of_output
        from polypod.text import markdown_table

        console = console_of_output()

        def say(line: str) -> None:
            console.print(line, markup=False)

        ours, theirs = comparison.first[0], comparison.second[0]
        envs = f"{len(comparison.first)} seeds of {ours.num_envs} envs, {ours.duration_s:g} s"
        say(f"A is {first}, B is {second}: {envs}; B - A with its 95 % interval")
        if ours.task != theirs.task:
            say(f"A walks in {ours.task}, B in {theirs.task}; --task gives both the same one")
        head = ("A", "B", "B - A", "from", "to", "better")
        for figure, (heading, form) in SHOWN.items():
            rows = []
            for robot, figures in comparison.robots.items():
                if (found := figures.get(figure)) is not None:
                    change = (found.change.mean, found.change.low, found.change.high)
                    numbers = [f"{found.first:{form}}", f"{found.second:{form}}", *(f"{x:+{form}}" for x in change)]
                    rows.append([robot, *numbers, _NAMES[found.better]])
            if not rows:
                continue
            if self.markdown:
                say("\n" + markdown_table([heading, *head], rows))
                continue
            lines = Rows(heading, *head)
            for robot, *cells in rows:
                lines.add_row(robot, *cells)
            say("")
            lines.print(console)
        say("")
        say(_verdict(comparison))


_BAR = "evaluations"
_NAMES = {"first": "A", "second": "B", None: "-"}


def _verdict(comparison: "Comparison") -> str:
    """Says how many differences the shown figures have, and how many chance alone brings."""
    shown: Sequence[str | None] = [
        found.better for figures in comparison.robots.values() for figure, found in figures.items() if figure in SHOWN
    ]
    a, b = shown.count("first"), shown.count("second")
    chance = 0.05 * len(shown)
    seeds = len(comparison.first)
    if not a and not b:
        return f"no difference is seen with {seeds} seeds in {len(shown)} rows"
    return f"of {len(shown)} rows A is better in {a}, B in {b}; chance alone makes some {chance:.0f} differ"
