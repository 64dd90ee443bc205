"""In motion every robot does what it does in MuJoCo: steps of a target, drops, standing."""

import math

import numpy as np
import pytest

import polypod
from common import size
from polypod.accuracy import motion, standing
from polypod.accuracy.motion import compare_step_responses
from polypod.accuracy.reference import Reference
from polypod.accuracy.robot import load, names
from polypod.accuracy.standing import FIRM, compare_drop, compare_standing

HEIGHT = 0.005
"""m."""
PITCH = math.radians(0.5)


@pytest.fixture(autouse=True)
def converged(monkeypatch: pytest.MonkeyPatch) -> None:
    """The core tier takes twice the steps of the converged references.

    MuJoCo's RK4 answers then differ in the fifth digit. The landings differ by less than a third of the bounds.
    """
    monkeypatch.setattr(motion, "CONVERGED", size(2.0, 1.0) * motion.CONVERGED)
    monkeypatch.setattr(standing, "CONVERGED", size(2.0, 1.0) * standing.CONVERGED)


@pytest.mark.parametrize("name", names("velocity_flat"))
def test_step_responses_converge_to_mujocos_and_are_as_close_at_5_ms(name: str) -> None:
    response = compare_step_responses(load(name))
    assert response.fine < 1e-3
    assert response.coarse <= response.mujoco_coarse


@pytest.mark.parametrize("name", names("velocity_flat"))
def test_a_dropped_robot_comes_to_rest_where_mujocos_does(name: str) -> None:
    drop = compare_drop(load(name))
    assert drop.height_error < HEIGHT
    assert drop.pitch_error < PITCH
    # at the tasks' step; on gains this soft, some end in a crouch that depends on the step, in MuJoCo as well
    crouches = name in ("unitree_a1", "unitree_go1", "unitree_go2")
    assert drop.coarse_height_error < (0.008 if crouches else HEIGHT)
    assert drop.coarse_pitch_error < (math.radians(4.0) if crouches else PITCH)


@pytest.mark.parametrize("name", names("velocity_flat"))
def test_at_the_tasks_step_a_robot_with_firm_legs_stands_where_mujocos_does(name: str) -> None:
    drop = compare_drop(load(name), gains=FIRM)
    assert max(drop.height_error, drop.coarse_height_error) < HEIGHT
    assert max(drop.pitch_error, drop.coarse_pitch_error) < PITCH


@pytest.mark.parametrize("name", names("velocity_flat"))
def test_standing_feet_carry_what_mujocos_carry(name: str) -> None:
    found = compare_standing(load(name))
    assert len(found.normal) == 4
    assert found.normal_error < 0.02
    assert found.normal.sum() == pytest.approx(found.weight, rel=1e-3)


WHIP = (
    # base, then joints
    "-0.0708 1.8151 0.3726 -0.2274 0.2840 -0.7643 0.5324 "
    "0.4880 -0.2220 0.3956 0.2800 -1.3433 0.0373 0.2752 1.5009 -2.9261 1.3932 0.3151 0.0538",
    "-0.1582 0.1839 0.0717 -3.6725 1.6081 -0.5938 "
    "4.9563 -1.2143 -0.7896 -34.3731 -5.4181 -0.2919 -1.5497 -2.4518 -0.0123 0.8939 7.6482 12.4916",
)
"""qpos and qvel of an ANYmal B, a leg of which is about to whip through: the worst of an hour of random targets."""


@pytest.mark.parametrize(("dt", "least", "most"), [(0.005, 0.04, 0.07), (0.0005, 0.002, 0.006)])
def test_a_whipping_leg_wins_the_energy_that_mujocos_euler_wins(dt: float, least: float, most: float) -> None:
    robot = load("anymal_b")
    qpos, qvel = (np.array(values.split(), dtype=float) for values in WHIP)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    sim, meter = (polypod.Simulation("anymal_b", ground=None, self_collision=False, dt=dt) for _ in range(2))
    reference = Reference(robot.urdf, joint_names=robot.joint_names, dt=dt)
    reference.set_state(qpos, qvel)
    sim.set_state(qpos[None], qvel[None])
    heights = []
    for _ in range(round(0.06 / dt)):
        # MuJoCo's state is weighed by the same scales
        meter.set_state(reference.qpos[None], reference.qvel[None])
        heights.append([(kinetic + potential)[0] for kinetic, potential in (sim.energy(), meter.energy())])
        reference.step()
        sim.step()
    height = np.array(heights) / (sim.total_mass * 9.81)
    ours, mujocos = (height - np.minimum.accumulate(height, axis=0)).max(axis=0)
    assert least < mujocos < most
    assert ours == pytest.approx(mujocos, rel=0.03)
