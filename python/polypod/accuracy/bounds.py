"""Largest deviations of a robot from MuJoCo that `polypod accuracy` accepts, each with its reason.

The tests assert these bounds for every robot of the library, docs/accuracy.md shows them, and the
command fails where a figure exceeds one.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from polypod.accuracy.file import FileResult
from polypod.accuracy.motion import StepResponse
from polypod.accuracy.standing import FIRM, Drop, SlopeRest, Standing
from polypod.accuracy.statics import StaticsResult


@dataclasses.dataclass(frozen=True)
class Bound:
    """Largest value of one figure of a comparison."""

    quantity: str
    measured: str
    """Way in which the quantity is compared."""
    result: type
    """Comparisons that have the figure."""
    figure: Callable[[Any], float | None]
    """Finds the figure in a comparison; None where the bound does not apply to it."""
    most: float
    """Largest figure that is accepted, SI units."""
    reason: str
    """Origin of `most`."""
    unit: str = ""
    """Unit of the tables."""
    scale: float = 1.0
    """Factor from SI units to that unit."""
    digits: str = ".2f"
    """Format of a figure in that unit."""
    front_page: bool = True
    """Whether README.md shows it."""

    def figures(self, result: Any) -> Iterable[tuple[str, float]]:
        """The figure of a comparison, with the name of the robot or case.

        None where the bound does not apply.
        """
        figure = self.figure(result) if isinstance(result, self.result) else None
        return [] if figure is None else [(result.case, figure)]

    def holds(self, figure: float) -> bool:
        """Whether a figure is a number within the bound."""
        return figure <= self.most

    def text(self, figure: float) -> str:
        """A figure in the tables' unit."""
        return f"{self.scale * figure:{self.digits}}{self.unit}"

    @property
    def limit(self) -> str:
        """The bound in the tables' unit."""
        most = f"{self.scale * self.most:{'.0e' if 'e' in self.digits else '.6g'}}"
        return f"{most.replace('e-0', 'e-')}{self.unit}"


def _of(dtype: str) -> Callable[[FileResult], float | None]:
    return lambda result: result.worst() if result.dtype == dtype else None


def _if_firm(figure: Callable[[Drop], float]) -> Callable[[Drop], float | None]:
    return lambda drop: figure(drop) if drop.gains >= FIRM else None


def _unless_firm(figure: Callable[[Drop], float]) -> Callable[[Drop], float | None]:
    return lambda drop: None if drop.gains >= FIRM else figure(drop)


MILLI, DEGREES, PERCENT = 1e3, math.degrees(1.0), 100.0

BOUNDS: tuple[Bound, ...] = (
    Bound(
        "the robot and MuJoCo's model of its MJCF file",
        "relative error in `f64`",
        FileResult,
        _of("float64"),
        most=1e-6,
        digits=".1e",
        reason="numbers of files have six digits and more, and both simulators round by 1e-16",
        front_page=False,
    ),
    Bound(
        "the robot and MuJoCo's model of its MJCF file",
        "relative error in `f32`",
        FileResult,
        _of("float32"),
        most=1e-4,
        digits=".1e",
        reason="as for the identities",
        front_page=False,
    ),
    Bound(
        "inertia, bias forces, kinematics, forward dynamics",
        "relative error in `f32`",
        StaticsResult,
        lambda r: r.worst(),
        most=1e-4,
        digits=".1e",
        reason="`f32` rounds by 6e-8, and forces on light links are differences of numbers a thousand times larger",
    ),
    Bound(
        "step responses, 0.5 ms",
        "deviation",
        StepResponse,
        lambda r: r.fine,
        most=1e-3,
        unit=" mrad",
        scale=MILLI,
        reason="a hundredth of the jump; of first order, half a step at the 4 rad/s that jumps reach",
    ),
    Bound(
        "step responses, 5 ms",
        "share of MuJoCo's own deviation",
        StepResponse,
        lambda r: r.coarse / r.mujoco_coarse,
        most=1.0,
        reason="`implicitfast` is of the same order at the same step",
    ),
    Bound(
        "height after a drop from 0.3 m",
        "difference, same step",
        Drop,
        lambda r: r.height_error,
        most=5e-3,
        unit=" mm",
        scale=MILLI,
        digits=".1f",
        reason="feet slide as they land; MuJoCo's own answers at two steps differ as much",
    ),
    Bound(
        "pitch after the drop",
        "difference, same step",
        Drop,
        lambda r: r.pitch_error,
        most=math.radians(0.5),
        unit=" degrees",
        scale=DEGREES,
        reason="5 mm between front and hind feet 0.6 m apart",
    ),
    Bound(
        "height after the drop, firm legs",
        "polypod at 5 ms",
        Drop,
        _if_firm(lambda r: r.coarse_height_error),
        most=5e-3,
        unit=" mm",
        scale=MILLI,
        digits=".1f",
        reason="as at the same step",
        front_page=False,
    ),
    Bound(
        "pitch after the drop, firm legs",
        "polypod at 5 ms",
        Drop,
        _if_firm(lambda r: r.coarse_pitch_error),
        most=math.radians(0.5),
        unit=" degrees",
        scale=DEGREES,
        reason="as at the same step",
        front_page=False,
    ),
    Bound(
        "height after the drop, gains of the training",
        "polypod at 5 ms",
        Drop,
        _unless_firm(lambda r: r.coarse_height_error),
        most=8e-3,
        unit=" mm",
        scale=MILLI,
        digits=".1f",
        reason="a deep crouch depends on the step: MuJoCo's own answers at 2.5 ms differ by 5.4 mm",
        front_page=False,
    ),
    Bound(
        "pitch after the drop, gains of the training",
        "polypod at 5 ms",
        Drop,
        _unless_firm(lambda r: r.coarse_pitch_error),
        most=math.radians(4.0),
        unit=" degrees",
        scale=DEGREES,
        reason="of first order: MuJoCo's own answers at 2.5 ms differ by 1.8 degrees",
        front_page=False,
    ),
    Bound(
        "normal force on a standing foot",
        "difference",
        Standing,
        lambda r: r.normal_error,
        most=0.02,
        unit=" %",
        scale=PERCENT,
        reason="legs are springs, and dry friction (0.2 to 1 N m on Spot and A1) leaves open where they rest",
    ),
    Bound(
        "weight of a standing robot",
        "difference of the feet's sum",
        Standing,
        lambda r: abs(r.normal.sum() / r.weight - 1.0),
        most=1e-3,
        unit=" %",
        scale=PERCENT,
        digits=".3f",
        reason="what is left of swaying after 10 s accelerates the robot by less than 0.01 m/s^2",
        front_page=False,
    ),
    Bound(
        "creep on a slope of 20 degrees",
        "in 10 s",
        SlopeRest,
        lambda r: r.creep,
        most=1e-3,
        unit=" mm",
        scale=MILLI,
        reason="the solver ends its sweeps at changes below 0.5 mm/s; at rest they average out",
    ),
)


def exceeded(*results: Any, bounds: Sequence[Bound] = BOUNDS) -> list[str]:
    """Names the figures of these comparisons that exceed one of the bounds, in words."""
    return [
        f"{name}: {bound.quantity}, {bound.measured}: {bound.text(figure)} exceeds {bound.limit}"
        for bound in bounds
        for result in results
        for name, figure in bound.figures(result)
        if not bound.holds(figure)
    ]
