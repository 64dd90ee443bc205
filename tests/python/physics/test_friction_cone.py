"""Contacts stick inside the friction cone and slide on it, as in formulas and MuJoCo."""

import math

import pytest

from common import some
from lab.accuracy.bounds import exceeded
from lab.accuracy.friction import SLIDES, SLOPES, compare_slide, compare_slope
from polypod.accuracy.standing import compare_slope_rest
from polypod.mujoco_model.robot import load, names

CORE = ("anymal_c", "box_quadruped", "phantomx", "spot", "unitree_a1", "unitree_go2w")
"""Robots of the core tier; the extended tier takes all that stand."""


@pytest.mark.parametrize(("friction", "speed", "direction"), SLIDES)
def test_a_pushed_block_stops_after_v_squared_over_two_mu_g(friction: float, speed: float, direction: float) -> None:
    slide = compare_slide(friction, speed, direction=direction)
    # the steps' own error is v dt / 2: the block moves with the velocity of the end of the step
    tolerance = 0.002 * slide.formula + 0.5 * speed * slide.dt
    assert slide.distance == pytest.approx(slide.formula, abs=tolerance)
    assert slide.distance == pytest.approx(slide.mujoco, abs=tolerance)
    assert slide.sideways < 1e-3 * slide.formula
    assert not exceeded(slide)


@pytest.mark.parametrize(("friction", "degrees"), SLOPES)
def test_a_block_on_a_slope_holds_or_slides_as_coulomb_says(friction: float, degrees: float) -> None:
    assert not exceeded(compare_slope(friction, math.radians(degrees)))


@pytest.mark.parametrize("uphill", ["front", "left"])
@pytest.mark.parametrize("name", some(names(standing=True), CORE))
def test_a_robot_at_rest_on_a_slope_does_not_creep(name: str, uphill: str) -> None:
    rest = compare_slope_rest(load(name), uphill)
    assert not exceeded(rest)
    # soft contacts creep, but nothing rolls or slides away
    assert rest.mujoco_creep < 0.01
