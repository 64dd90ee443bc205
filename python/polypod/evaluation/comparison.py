"""Two policies on the same seeds: paired differences and their intervals."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from polypod import _core
from polypod.evaluation.checkpoints import evaluate_checkpoint
from polypod.evaluation.results import Evaluation, finite
from polypod.evaluation.seeds import CONFIDENCE, WALKING, Interval, check_alike, interval

LEAST_SEEDS = 3
"""Fewest seeds: an interval over two is wider than any difference."""

BETTER = {
    "reward_per_s": 1,
    "error_vel_xy": -1,
    "error_vel_yaw": -1,
    "fall_rate": -1,
    "success_rate": 1,
    "tracking_reward": 1,
    "episode_length_s": 1,
    "power": -1,
    "cost_of_transport": -1,
    "foot_slip": -1,
    "stumbles": -1,
    "turn_reached": 1,
    "side_reached": 1,
    "drift_xy": -1,
    "drift_yaw": -1,
}
"""Direction by figure: 1 where a larger one is better, -1 where a smaller one is."""

ALL = "all robots"
"""Name of the mean over the robots."""


@dataclasses.dataclass(frozen=True)
class Difference:
    """One figure of one robot, of two policies on the same seeds."""

    first: float
    """Mean of the first policy over the seeds."""
    second: float
    """Mean of the second policy."""
    change: Interval
    """Second less first, seed by seed: mean and Student's t interval."""
    better: str | None
    """"first" or "second"; None where the interval holds zero or there is none."""


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A policy against another one."""

    first: list[Evaluation]
    """The first policy's, one evaluation per seed."""
    second: list[Evaluation]
    """The second policy's, in the same order."""
    robots: dict[str, dict[str, Difference]]
    """Differences by robot and figure; `ALL` has the mean over the robots."""

    def as_dict(self) -> dict[str, Any]:
        """Returns the comparison for JSON: None stands for a number that is not finite."""
        robots = {
            robot: {name: dataclasses.asdict(difference) for name, difference in figures.items()}
            for robot, figures in self.robots.items()
        }
        content: dict[str, Any] = finite(
            {
                "interval": f"Student's t over the seeds of paired differences, {CONFIDENCE:.0%}",
                "seeds": [evaluation.seed for evaluation in self.first],
                "checkpoints": [self.first[0].checkpoint, self.second[0].checkpoint],
                "tasks": [self.first[0].task, self.second[0].task],
                "robots": robots,
            }
        )
        return content


def compare(first: Sequence[Evaluation], second: Sequence[Evaluation]) -> Comparison:
    """Compares two policies, each evaluated once per seed, seed by seed.

    Raises:
        ConfigError: for fewer than `LEAST_SEEDS` seeds, and for evaluations of other robots, seeds
            or conditions.
    """
    if min(len(first), len(second)) < LEAST_SEEDS:
        raise _core.ConfigError(f"{min(len(first), len(second))} seeds have no interval; take {LEAST_SEEDS} at least")
    for ours, theirs in zip(first, second, strict=True):
        check_alike(ours, theirs, "seed", "num_envs", "episodes")
    names = list(first[0].robots)
    robots = {name: _differences(first, second, [name]) for name in names}
    if len(names) > 1:
        robots[ALL] = _differences(first, second, names)
    return Comparison(list(first), list(second), robots)


def compare_checkpoints(
    checkpoints: Sequence[Path],
    num_seeds: int,
    seed: int = 0,
    progress: Callable[[int], object] = lambda done: None,
    **arguments: Any,
) -> list[Comparison]:
    """Compares each checkpoint with the first one on `num_seeds` seeds.

    Args:
        checkpoints: files as `evaluate_checkpoint` takes them.
        num_seeds: number of seeds.
        seed: the first one.
        progress: called after each evaluation with the number of those that are done.
        **arguments: those of `evaluate_checkpoint`, the same for all.

    Raises:
        ConfigError: see `compare` and `evaluate`.
    """
    episodes = arguments.get("episodes", 1)
    # an evaluation of several episodes takes as many seeds
    seeds = [seed + k * episodes for k in range(num_seeds)]
    evaluations: list[list[Evaluation]] = []
    for checkpoint in checkpoints:
        evaluations.append([])
        for of_seed in seeds:
            evaluations[-1].append(evaluate_checkpoint(checkpoint, seed=of_seed, **arguments))
            progress(sum(map(len, evaluations)))
    return [compare(evaluations[0], others) for others in evaluations[1:]]


def _differences(
    first: Sequence[Evaluation], second: Sequence[Evaluation], names: Sequence[str]
) -> dict[str, Difference]:
    """The figures of some robots together, one after the other."""
    found = {}
    for figure in BETTER:
        ours, theirs = ([_mean(each, names, figure) for each in side] for side in (first, second))
        if any(map(math.isnan, (*ours, *theirs))):
            continue
        change = interval([b - a for a, b in zip(ours, theirs, strict=True)])
        found[figure] = Difference(
            first=sum(ours) / len(ours),
            second=sum(theirs) / len(theirs),
            change=change,
            better=_better(change, BETTER[figure]),
        )
    return found


def _mean(evaluation: Evaluation, names: Sequence[str], figure: str) -> float:
    """A figure, averaged over robots; NaN where one of them has none."""
    values = []
    for name in names:
        result = evaluation.robots[name]
        source = result.walking if figure in WALKING else result
        values.append(math.nan if source is None else float(getattr(source, figure)))
    return sum(values) / len(values)


def _better(change: Interval, direction: int) -> str | None:
    if change.low <= 0.0 <= change.high:
        return None
    return "second" if change.mean * direction > 0.0 else "first"
