"""All comparisons, and the tables that the documentation shows of them."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path

from polypod import documents
from polypod.accuracy import reference, robot
from polypod.accuracy.engines import Engines, compare_engines, stands
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
"""Friction and angle (degrees) of the blocks on slopes; atan(0.5) is 26.57 and atan(0.8) 38.66 degrees."""


@dataclasses.dataclass(frozen=True)
class Report:
    """What was measured."""

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


def measure(names: Sequence[str] | None = None, progress: Progress = print) -> Report:
    """Runs every comparison for the robots named, or all; of standing for those that stand. Raises UnknownNameError."""
    robots = [robot.load(name) for name in names or robot.names()]
    report = Report(reference.version(), [], [], [], [], [], [], [], [], [])
    for each in robots:
        progress(f"{each.name}: identities, step responses, sweeps")
        report.statics.append(compare_statics(each))
        report.responses.append(compare_step_responses(each))
        report.sweeps.append(compare_sweeps(each))
        if not stands(each, "articulated", DT):
            progress(f"{each.name} falls in its default pose; a policy has to balance it")
            continue
        progress(f"{each.name}: drop, standing, slope, engines")
        report.drops.extend(compare_drop(each, gains=gains) for gains in (1.0, FIRM))
        report.standing.append(compare_standing(each))
        report.rests.extend(compare_slope_rest(each, uphill) for uphill in ("front", "left"))
        report.engines.append(compare_engines(each))
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
