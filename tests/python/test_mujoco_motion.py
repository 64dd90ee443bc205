"""In motion every robot does what it does in MuJoCo: steps of a target, drops, standing."""

import math

import pytest

from polypod.accuracy.motion import compare_step_responses
from polypod.accuracy.robot import load, names
from polypod.accuracy.standing import compare_drop, compare_standing


@pytest.mark.parametrize("name", names())
def test_step_responses_converge_to_mujocos_and_are_as_close_at_5_ms(name: str) -> None:
    response = compare_step_responses(load(name))
    assert response.fine < 1e-3
    assert response.coarse <= response.mujoco_coarse


@pytest.mark.parametrize("name", names())
def test_a_dropped_robot_comes_to_stand_where_mujocos_does(name: str) -> None:
    drop = compare_drop(load(name))
    assert abs(drop.height - drop.mujoco_height) < 0.005
    assert abs(drop.pitch - drop.mujoco_pitch) < math.radians(0.5)


@pytest.mark.parametrize("name", names())
def test_standing_feet_carry_what_mujocos_carry(name: str) -> None:
    standing = compare_standing(load(name))
    assert len(standing.normal) == 4
    assert standing.normal_error < 0.02
    assert standing.normal.sum() == pytest.approx(standing.weight, rel=1e-3)
