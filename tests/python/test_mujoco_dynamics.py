"""At random states every robot has MuJoCo's masses, kinematics, inertia, bias forces and accelerations."""

import dataclasses

import pytest

from common import size
from polypod.accuracy.robot import load, names
from polypod.accuracy.statics import compare_statics

BOUND = 1e-4
"""Relative, in f32."""


@pytest.mark.parametrize("name", names())
def test_f32_agrees_to_one_in_ten_thousand(name: str) -> None:
    result = compare_statics(load(name), states=size(200, 2000))
    too_large = {
        field.name: value
        for field in dataclasses.fields(result)
        if isinstance(value := getattr(result, field.name), float) and not value < BOUND
    }
    assert not too_large


def test_f64_agrees_to_rounding() -> None:
    # what remains is no error of the formulas: inertias and poses are stated to ten digits in the URDF
    assert compare_statics(load("anymal_c"), states=20, dtype="float64").worst() < 1e-9
