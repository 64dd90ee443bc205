"""The two engines agree on standing and responses, and `lab.accuracy` reports it."""

import dataclasses

import numpy as np
import pytest

from common import size, some
from lab.accuracy import engines
from polypod import _core
from polypod.accuracy import motion
from polypod.accuracy.standing import stands
from polypod.mujoco_model import robot

ROBOT = "unitree_go2"
CORE = ("anymal_b", "anymal_b_kinova", "box_quadruped", "phantomx", "spot", "unitree_a1", "unitree_go2w")
"""Robots of the core tier; the extended tier takes all that stand."""


@pytest.fixture(scope="module")
def both() -> engines.Engines:
    with pytest.MonkeyPatch.context() as patch:
        # the answers of MuJoCo's RK4 differ in the fifth digit
        patch.setattr(motion, "CONVERGED", size(2.0, 1.0) * motion.CONVERGED)
        return engines.compare_engines(robot.load(ROBOT))


def test_both_engines_stand_alike(both: engines.Engines) -> None:
    for engine in (both.articulated, both.avian):
        assert engine.force == pytest.approx(1.0, abs=2e-3)
        assert engine.height > 0.8 * robot.load(ROBOT).base_height
    assert both.avian.height == pytest.approx(both.articulated.height, abs=1e-3)
    assert both.avian.pitch == pytest.approx(both.articulated.pitch, abs=2e-3)
    assert both.torque_difference < 0.03
    assert np.abs(both.articulated.torque).max() > 1.0


def test_joints_do_not_come_apart(both: engines.Engines) -> None:
    assert both.articulated.drift == 0.0
    assert 0.0 < both.avian.drift < 1e-3


def test_both_engines_answer_a_jump_like_mujoco(both: engines.Engines) -> None:
    for engine in (both.articulated, both.avian):
        assert 0.0 < engine.response_rms < engine.response_max < 5e-3


def test_the_largest_step_is_the_last_at_which_it_stands(both: engines.Engines) -> None:
    for engine in (both.articulated, both.avian):
        assert engine.largest_step >= 0.005
        place = engines.STEPS.index(engine.largest_step)
        for larger in engines.STEPS[place + 1 : place + 2]:
            assert not stands(robot.load(ROBOT), larger, engine.engine)


def test_a_robot_without_gains_does_not_stand() -> None:
    limp = robot.load(ROBOT).with_gains(0.02)
    assert not any(stands(limp, 0.005, engine) for engine in ("articulated", "avian"))


def test_the_articulated_engine_is_the_faster_one(both: engines.Engines) -> None:
    assert both.articulated.steps_per_second > 5.0 * both.avian.steps_per_second > 0.0


def test_torques_are_compared_with_the_largest() -> None:
    torque = np.array([1.0, -10.0])
    one = engines.Engine("articulated", 0.3, 0.0, 1.0, torque, torque, 0.0, 0.0, 0.0, 0.0, 0.0)
    other = dataclasses.replace(one, torque=np.array([1.5, -10.0]), frictionless_torque=np.array([1.1, -10.0]))
    both = engines.Engines("any", one, other)
    assert both.torque_difference == pytest.approx(0.01)
    assert both.torque_difference_with_friction == pytest.approx(0.05)


@pytest.mark.parametrize("name", some(robot.names(standing=True), CORE))
def test_torques_agree_where_they_are_determined(name: str) -> None:
    """Within 3 %, without dry friction: a joint at rest may hold any torque within its friction."""
    known = robot.load(name)
    articulated, avian = (engines.frictionless_torque(known, engine) for engine in engines.SPEED_STEPS)
    largest = np.abs(articulated).max()
    # joints carry the robot: a thousandth of the moment of its weight at 1 m, or more
    assert largest > 1e-3 * _core.EARTH_GRAVITY * _core.Simulation(name, threads=1).total_mass
    assert np.abs(avian - articulated).max() < 0.03 * largest
