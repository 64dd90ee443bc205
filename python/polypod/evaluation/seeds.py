"""Several trainings that differ in their seeds: means and confidence intervals."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from polypod import _core
from polypod.evaluation import walking
from polypod.evaluation.results import FIGURES, Evaluation, finite

WALKING = tuple(name for name in walking.FIGURES if name not in FIGURES)
"""Names of the figures of walking that a robot has in addition to `results.FIGURES`."""

CONFIDENCE = 0.95
"""Confidence of an interval: the share of intervals, computed like this, that hold the true
mean."""


@dataclasses.dataclass(frozen=True)
class Interval:
    """A mean over seeds with Student's t interval.

    `low` and `high` are NaN for one seed, which has no interval.
    """

    mean: float
    low: float
    high: float
    seeds: int


@dataclasses.dataclass(frozen=True)
class Summary:
    """Several evaluations as one: per robot an interval for each of `results.FIGURES`.

    Evaluations with the schedule of walking have each figure of `WALKING` too.
    """

    evaluations: list[Evaluation]
    robots: dict[str, dict[str, Interval]]

    def as_dict(self) -> dict[str, Any]:
        """Returns the summary for JSON."""
        robots = {
            robot: {key: dataclasses.asdict(interval) for key, interval in figures.items()}
            for robot, figures in self.robots.items()
        }
        content: dict[str, Any] = finite(
            {
                "interval": f"Student's t over the seeds, {CONFIDENCE:.0%}",
                "robots": robots,
                "evaluations": [evaluation.as_dict() for evaluation in self.evaluations],
            }
        )
        return content


def summarize(evaluations: Sequence[Evaluation]) -> Summary:
    """Mean and interval of every figure of every robot.

    Raises:
        ConfigError: for none, and for evaluations of different tasks, robots or conditions.
    """
    if not evaluations:
        raise _core.ConfigError("there is no evaluation to summarise")
    first = evaluations[0]
    for other in evaluations[1:]:
        check_alike(first, other, "task")
    robots = {}
    for robot in first.robots:
        results = [each.robots[robot] for each in evaluations]
        walks = [result.walking for result in results if result.walking is not None]
        robots[robot] = {key: interval([getattr(result, key) for result in results]) for key in FIGURES}
        if len(walks) == len(results):
            robots[robot] |= {key: interval([getattr(figures, key) for figures in walks]) for key in WALKING}
    return Summary(list(evaluations), robots)


def check_alike(first: Evaluation, other: Evaluation, *more: str) -> None:
    """Raises ConfigError for evaluations of other robots or conditions, or that differ in more."""
    for key in (*more, "robots", "duration_s", "randomized", "grid", "commands"):
        ours, theirs = (getattr(each, key) for each in (first, other))
        if key == "robots":
            ours, theirs = ", ".join(ours), ", ".join(theirs)
        if ours != theirs:
            raise _core.ConfigError(f"evaluations to compare differ in {key}: {ours} and {theirs}")


def interval(values: Sequence[float], confidence: float = CONFIDENCE) -> Interval:
    """Mean of independent values, one per seed, with Student's t interval."""
    count = len(values)
    mean = float(np.mean(values))
    if count < 2:
        return Interval(mean, math.nan, math.nan, count)
    reach = t_quantile(0.5 + 0.5 * confidence, count - 1) * float(np.std(values, ddof=1)) / math.sqrt(count)
    return Interval(mean, mean - reach, mean + reach, count)


@functools.cache
def t_quantile(probability: float, degrees: int) -> float:
    """Quantile of Student's t distribution, for probabilities from a half to one.

    With t = sqrt(degrees) tan(a) the distribution function is the integral of cos(a)^(degrees - 1),
    over its total (Abramowitz and Stegun 26.7.1); it is integrated and inverted numerically, to
    1e-6.
    """
    angles = np.linspace(0.0, 0.5 * math.pi, 200_001)
    density = np.cos(angles) ** (degrees - 1)
    area = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    angle = float(np.interp(2.0 * probability - 1.0, area / area[-1], angles))
    return math.sqrt(degrees) * math.tan(angle)
