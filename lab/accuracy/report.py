"""All comparisons of docs/accuracy.md."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar

from lab.accuracy.bounds import BOUNDS
from lab.accuracy.engines import Engines, compare_engines
from lab.accuracy.friction import SLIDES, SLOPES, Slide, Slope, compare_slide, compare_slope
from lab.accuracy.sweeps import Sweeps, compare_sweeps
from polypod.accuracy import report
from polypod.accuracy.bounds import Bound
from polypod.accuracy.report import Progress
from polypod.mujoco_model import robot


@dataclasses.dataclass(frozen=True)
class Report(report.Report):
    """The comparisons of `polypod accuracy`, and those of solver, engines and cone."""

    bounds: ClassVar[Sequence[Bound]] = BOUNDS

    sweeps: list[Sweeps] = dataclasses.field(default_factory=list)
    engines: list[Engines] = dataclasses.field(default_factory=list)
    slides: list[Slide] = dataclasses.field(default_factory=list)
    slopes: list[Slope] = dataclasses.field(default_factory=list)

    def results(self) -> list[Any]:
        """All comparisons."""
        return [*super().results(), *self.sweeps, *self.engines, *self.slides, *self.slopes]


def measure(names: Sequence[str] | None = None, progress: Progress = print) -> Report:
    """Runs every comparison for these robots, or all.

    Args:
        names: names, or paths of configs; None: all of the library.
        progress: told what comes next.

    Raises:
        UnknownNameError: for a name that no robot has.
        ConfigError: for a robot that cannot be compared.
    """
    of_robots = report.measure(names, progress)
    found = Report(**vars(of_robots))
    standing = {result.robot for result in found.standing}
    for each in (robot.load(name) for name in names or robot.names()):
        progress(f"{each.name}: sweeps, engines")
        found.sweeps.append(compare_sweeps(each))
        if each.name in standing:
            found.engines.append(compare_engines(each))
    progress("a block on planes and slopes")
    found.slides.extend(compare_slide(friction, speed, direction=angle) for friction, speed, angle in SLIDES)
    found.slopes.extend(compare_slope(friction, math.radians(angle)) for friction, angle in SLOPES)
    return found
