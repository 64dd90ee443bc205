"""Contacts stick inside the cone of friction and slide on it: a block against the formulas and MuJoCo."""

import math

import pytest

from polypod.accuracy.friction import compare_slide, compare_slope
from polypod.accuracy.report import SLIDES, SLOPES
from polypod.accuracy.robot import load, names
from polypod.accuracy.standing import compare_slope_rest


@pytest.mark.parametrize(("friction", "speed", "direction"), SLIDES)
def test_a_pushed_block_stops_after_v_squared_over_two_mu_g(friction: float, speed: float, direction: float) -> None:
    slide = compare_slide(friction, speed, direction=direction)
    # the steps' own error is v dt / 2: the block moves with the velocity of the end of the step
    tolerance = 0.002 * slide.formula + 0.5 * speed * slide.dt
    assert slide.distance == pytest.approx(slide.formula, abs=tolerance)
    assert slide.distance == pytest.approx(slide.mujoco, abs=tolerance)
    assert slide.sideways < 1e-3 * slide.formula


@pytest.mark.parametrize(("friction", "degrees"), SLOPES)
def test_a_block_on_a_slope_holds_or_slides_as_coulomb_says(friction: float, degrees: float) -> None:
    slope = compare_slope(friction, math.radians(degrees))
    if math.tan(slope.angle) < friction:
        assert abs(slope.distance) < 1e-5
    else:
        # 2 dt / t of a second's fall are the step's; the rest is f32
        assert slope.acceleration == pytest.approx(slope.formula, rel=0.005, abs=0.003)


@pytest.mark.parametrize("uphill", ["front", "left"])
@pytest.mark.parametrize("name", names("velocity_flat"))
def test_a_robot_at_rest_on_a_slope_does_not_creep(name: str, uphill: str) -> None:
    assert compare_slope_rest(load(name), uphill).creep < 1e-3
