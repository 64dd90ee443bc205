"""Bounds of docs/accuracy.md: robots as in `polypod accuracy`, solver, engines and cone."""

from typing import Any

from lab.accuracy.engines import Engines
from lab.accuracy.friction import Slide, Slope
from lab.accuracy.sweeps import MANY, USUAL, Sweeps
from polypod.accuracy import bounds
from polypod.accuracy.bounds import MILLI, PERCENT, Bound


def _error_of_sliding(slope: Slope) -> float | None:
    return abs(slope.acceleration - slope.formula) if slope.formula > 0.0 else None


def _way_below_the_cone(slope: Slope) -> float | None:
    return abs(slope.distance) if slope.formula == 0.0 else None


BOUNDS: tuple[Bound, ...] = (
    *bounds.BOUNDS,
    Bound(
        "torques of the two engines, standing",
        "difference, without dry friction",
        Engines,
        lambda r: r.torque_difference,
        most=0.03,
        unit=" %",
        scale=PERCENT,
        reason="gains times the legs' deflection, some 0.1 rad: feet that rest 1 mm apart change it by 3 %",
        front_page=False,
    ),
    Bound(
        f"error of the contact solver, {USUAL} sweeps",
        "velocity of the base",
        Sweeps,
        lambda r: r.left[USUAL],
        most=0.025,
        unit=" mm/s",
        scale=MILLI,
        digits=".1f",
        reason="a fortieth of a walk at 1 m/s, and a quarter of what the step of 5 ms costs the lightest robots",
        front_page=False,
    ),
    Bound(
        f"error of the contact solver, {MANY} sweeps",
        "share of the step's error",
        Sweeps,
        lambda r: r.left[MANY] / r.step,
        most=0.7,
        reason="sweeps converge to less than the physics step leaves",
        front_page=False,
    ),
    Bound(
        "distance in which a block stops",
        "error against the formula",
        Slide,
        lambda r: abs(r.distance / r.formula - 1.0),
        most=0.01,
        unit=" %",
        scale=PERCENT,
        reason="half a step's way, `v dt / 2`, is 0.8 % of the shortest distance",
    ),
    Bound(
        "acceleration of a block that slides down a slope",
        "error against the formula",
        Slope,
        _error_of_sliding,
        most=3e-3,
        unit=" m/s^2",
        digits=".4f",
        reason="steps move the block `a dt / t` too fast, 2.4 mm/s^2 on the steepest slope",
        front_page=False,
    ),
    Bound(
        "way of a block that holds on a slope",
        "in 1 s",
        Slope,
        _way_below_the_cone,
        most=1e-5,
        unit=" mm",
        scale=MILLI,
        digits=".4f",
        reason="`g dt^2`, the way of one step of free fall",
        front_page=False,
    ),
)


def exceeded(*results: Any) -> list[str]:
    """Names the figures of these comparisons that exceed a bound, in words."""
    return bounds.exceeded(*results, bounds=BOUNDS)
