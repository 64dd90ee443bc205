"""All comparisons, and the tables that the documentation shows of them."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path

from polypod import documents
from polypod.accuracy import motion, reference, robot
from polypod.accuracy.bounds import BOUNDS, Bound, exceeded
from polypod.accuracy.engines import Engines, compare_engines, stands
from polypod.accuracy.file import FileResult, compare_file
from polypod.accuracy.friction import Slide, Slope, compare_slide, compare_slope
from polypod.accuracy.motion import StepResponse, compare_step_responses
from polypod.accuracy.standing import (
    DT,
    FIRM,
    Drop,
    SlopeRest,
    Standing,
    compare_drop,
    compare_slope_rest,
    compare_standing,
)
from polypod.accuracy.statics import StaticsResult, compare_statics
from polypod.accuracy.sweeps import Sweeps, compare_sweeps

Progress = Callable[[str], None]
"""Is told what comes next."""

MARK = "accuracy"
"""Name of the part of a document that holds the tables."""
BEGIN, END = documents.marks(MARK)

SLIDES = ((0.2, 1.0, 0.0), (0.5, 2.0, 0.0), (0.5, 2.0, 0.6), (0.8, 1.0, 0.0), (1.0, 3.0, math.pi / 4))
"""Friction, speed (m/s) and direction (rad) of the pushed blocks."""
SLOPES = ((0.3, 30.0), (0.5, 20.0), (0.5, 26.0), (0.5, 27.2), (0.8, 20.0), (0.8, 38.0), (0.8, 39.3), (0.8, 45.0))
"""Friction and angle (degrees) of the blocks on slopes; atan(0.5) is 26.57 and atan(0.8) 38.66
degrees."""


@dataclasses.dataclass(frozen=True)
class Report:
    """All comparisons."""

    mujoco: str
    """MuJoCo's version."""
    statics: list[StaticsResult]
    responses: list[StepResponse]
    drops: list[Drop]
    standing: list[Standing]
    rests: list[SlopeRest]
    sweeps: list[Sweeps]
    engines: list[Engines]
    slides: list[Slide]
    slopes: list[Slope]
    fallen: list[str]
    """Robots that fall in their default pose, although their configs do not say so."""
    files: list[FileResult] = dataclasses.field(default_factory=list)
    """Results of robots that come from MJCF files."""
    origins: dict[str, Path] = dataclasses.field(default_factory=dict)
    """The MJCF files by robot."""

    def results(self) -> list[object]:
        """All comparisons."""
        lists = (
            self.files,
            self.statics,
            self.responses,
            self.drops,
            self.standing,
            self.rests,
            self.sweeps,
            self.engines,
        )
        return [result for found in (*lists, self.slides, self.slopes) for result in found]

    def worst(self, bound: Bound) -> tuple[str, float] | None:
        """The largest figure of a bound, or one that is no number, with its owner; or None."""
        figures = [figure for result in self.results() for figure in bound.figures(result)]
        return max(figures, key=lambda figure: math.inf if math.isnan(figure[1]) else figure[1], default=None)

    def verdict(self) -> str:
        """One line on a report that keeps all bounds: its largest figure over the bound."""
        found = [(worst[1] / bound.most, bound, worst) for bound in BOUNDS if (worst := self.worst(bound)) is not None]
        _, bound, (name, figure) = max(found, key=lambda entry: entry[0])
        return (
            f"{len(found)} of {len(found)} bounds are kept; the nearest is that of {bound.quantity}, {bound.measured}: "
            f"{bound.text(figure)} of {bound.limit} ({name})"
        )

    def broken(self) -> list[str]:
        """Names the figures that exceed their bounds, in words."""
        remedy = "let its config say why only a policy can balance it, in `needs_policy`, or give it gains that hold it"
        return exceeded(*self.results()) + [f"{name}: falls in its default pose; {remedy}" for name in self.fallen]


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
    report = Report(reference.version(), [], [], [], [], [], [], [], [], [], [])
    for each in robots:
        if each.origin is not None:
            progress(f"{each.name}: MuJoCo's model of the file, {each.origin.file}")
            report.origins[each.name] = each.origin.file
            report.files.extend(compare_file(each))
        progress(f"{each.name}: identities, step responses, sweeps")
        converged = motion.converged_jumps(each)
        report.statics.append(compare_statics(each))
        report.responses.append(compare_step_responses(each, converged))
        report.sweeps.append(compare_sweeps(each))
        if each.needs_policy:
            progress(f"{each.name} needs a policy to stand")
            continue
        if not stands(each, "articulated", DT):
            progress(f"{each.name} falls in its default pose")
            report.fallen.append(each.name)
            continue
        progress(f"{each.name}: drop, standing, slope, engines")
        report.drops.extend(compare_drop(each, gains=gains) for gains in (1.0, FIRM))
        report.standing.append(compare_standing(each))
        report.rests.extend(compare_slope_rest(each, uphill) for uphill in ("front", "left"))
        report.engines.append(compare_engines(each, converged))
    progress("a block on planes and slopes")
    report.slides.extend(compare_slide(friction, speed, direction=angle) for friction, speed, angle in SLIDES)
    report.slopes.extend(compare_slope(friction, math.radians(angle)) for friction, angle in SLOPES)
    return report


def check_document(document: Path) -> None:
    """Raises ConfigError where `replace_block` would."""
    documents.check(document, MARK)


def replace_block(document: Path, text: str) -> None:
    """Puts `text` between the marks of a document. Raises ConfigError where it cannot."""
    documents.replace(document, MARK, text)
