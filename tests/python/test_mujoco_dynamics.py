"""At random states every robot has MuJoCo's masses, kinematics, inertia, bias forces and accelerations."""

import pytest

from common import size
from polypod.accuracy.bounds import exceeded
from polypod.accuracy.robot import load, names
from polypod.accuracy.statics import compare_statics


@pytest.mark.parametrize("name", names())
def test_f32_agrees_within_the_bound(name: str) -> None:
    assert not exceeded(compare_statics(load(name), states=size(200, 2000)))


def test_f64_agrees_to_rounding() -> None:
    # what remains is no error of the formulas: inertias and poses are stated to ten digits in the URDF
    assert compare_statics(load("anymal_c"), states=20, dtype="float64").worst() < 1e-9
