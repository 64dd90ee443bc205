"""All comparisons of robots with MuJoCo's models of their files."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar

from polypod.accuracy.bounds import BOUNDS, Bound, exceeded
from polypod.accuracy.file import FileResult, compare_file
from polypod.accuracy.motion import StepResponse, compare_step_responses
from polypod.accuracy.result import Result
from polypod.accuracy.standing import (
    FIRM,
    Drop,
    SlopeRest,
    Standing,
    compare_drop,
    compare_slope_rest,
    compare_standing,
    stands,
)
from polypod.accuracy.statics import StaticsResult, compare_statics
from polypod.mujoco_model import reference, robot

Progress = Callable[[str], None]
"""Is told what comes next."""


@dataclasses.dataclass(frozen=True)
class Report:
    """All comparisons."""

    bounds: ClassVar[Sequence[Bound]] = BOUNDS
    """Bounds of the figures."""

    mujoco: str
    """MuJoCo's version."""
    statics: list[StaticsResult] = dataclasses.field(default_factory=list)
    responses: list[StepResponse] = dataclasses.field(default_factory=list)
    drops: list[Drop] = dataclasses.field(default_factory=list)
    standing: list[Standing] = dataclasses.field(default_factory=list)
    rests: list[SlopeRest] = dataclasses.field(default_factory=list)
    fallen: list[str] = dataclasses.field(default_factory=list)
    """Robots that fall in their default pose, although their configs do not say so."""
    files: list[FileResult] = dataclasses.field(default_factory=list)
    """Results of robots that come from MJCF files."""
    origins: dict[str, Path] = dataclasses.field(default_factory=dict)
    """The MJCF files by robot."""

    def results(self) -> list[Result]:
        """All comparisons."""
        return [*self.files, *self.statics, *self.responses, *self.drops, *self.standing, *self.rests]

    def worst(self, bound: Bound) -> tuple[str, float] | None:
        """The largest figure of a bound, or one that is no number, with its owner; or None."""
        figures = [figure for result in self.results() for figure in bound.figures(result)]
        return max(figures, key=lambda figure: math.inf if math.isnan(figure[1]) else figure[1], default=None)

    def verdict(self) -> str:
        """One line on a report that keeps all bounds: its largest figure over the bound."""
        found = [(worst[1] / bound.most, bound, worst) for bound in self.bounds if (worst := self.worst(bound))]
        _, bound, (name, figure) = max(found, key=lambda entry: entry[0])
        return (
            f"{len(found)} of {len(found)} bounds are kept; the nearest is that of {bound.quantity}, {bound.measured}: "
            f"{bound.text(figure)} of {bound.limit} ({name})"
        )

    def broken(self) -> list[str]:
        """Names the figures that exceed their bounds, in words."""
        remedy = "let its config say why only a policy can balance it, in `needs_policy`, or give it gains that hold it"
        falls = [f"{name}: falls in its default pose; {remedy}" for name in self.fallen]
        return exceeded(*self.results(), bounds=self.bounds) + falls


def measure(names: Sequence[str] | None = None, progress: Progress = print) -> Report:
    """Runs every comparison for these robots, or all; of standing for those that stand.

    Args:
        names: names, or paths of configs; None: all of the library.
        progress: told what comes next.

    Raises:
        UnknownNameError: for a name that no robot has.
        ConfigError: for a robot that cannot be compared.
    """
    robots = [robot.load(name) for name in names or robot.names()]
    report = Report(reference.version())
    for each in robots:
        if each.origin is not None:
            progress(f"{each.name}: MuJoCo's model of the file, {each.origin.file}")
            report.origins[each.name] = each.origin.file
            report.files.extend(compare_file(each))
        progress(f"{each.name}: identities, step responses")
        report.statics.append(compare_statics(each))
        report.responses.append(compare_step_responses(each))
        if each.needs_policy:
            progress(f"{each.name} needs a policy to stand")
            continue
        if not stands(each):
            progress(f"{each.name} falls in its default pose")
            report.fallen.append(each.name)
            continue
        progress(f"{each.name}: drop, standing, slope")
        report.drops.extend(compare_drop(each, gains=gains) for gains in (1.0, FIRM))
        report.standing.append(compare_standing(each))
        report.rests.extend(compare_slope_rest(each, uphill) for uphill in ("front", "left"))
    return report
