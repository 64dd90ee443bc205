"""Every robot moves as in MuJoCo, within the bounds that the front page shows."""

import numpy as np
import pytest

import polypod
from common import size, some
from polypod.accuracy import motion, standing
from polypod.accuracy.bounds import exceeded
from polypod.accuracy.motion import compare_step_responses, mujoco_tracks, polypod_tracks
from polypod.accuracy.standing import FIRM, compare_drop, compare_standing
from polypod.mujoco_model.reference import Reference
from polypod.mujoco_model.robot import load, names

CORE = ("anymal_b_kinova", "box_quadruped", "phantomx", "spot", "unitree_g1", "unitree_go2", "unitree_go2w")
"""Robots of the core tier: a speed limit that binds, no abduction, six legs, dry friction, a waist
that gives way, the usual quadruped, held wheels. The extended tier takes all robots of the
library."""

JUMPS = motion.jumps


@pytest.fixture(autouse=True)
def converged(monkeypatch: pytest.MonkeyPatch) -> None:
    """The core tier takes fewer jumps, and twice the steps of the converged references.

    MuJoCo's RK4 answers then differ in the fifth digit. The landings differ by less than a third of
    the bounds.
    """
    monkeypatch.setattr(motion, "CONVERGED", size(2.0, 1.0) * motion.CONVERGED)
    monkeypatch.setattr(standing, "CONVERGED", size(2.0, 1.0) * standing.CONVERGED)
    monkeypatch.setattr(motion, "jumps", lambda robot: JUMPS(robot)[size(2, 0) :: size(5, 1)])


@pytest.mark.parametrize("name", some(names(), CORE))
def test_step_responses_converge_to_mujocos_and_are_as_close_at_5_ms(name: str) -> None:
    assert not exceeded(compare_step_responses(load(name)))


@pytest.mark.parametrize("name", some(names(standing=True), CORE))
def test_a_dropped_robot_comes_to_rest_where_mujocos_does(name: str) -> None:
    assert not exceeded(compare_drop(load(name)))


@pytest.mark.parametrize("name", some(names(standing=True), CORE))
def test_at_the_tasks_step_a_robot_with_firm_legs_stands_where_mujocos_does(name: str) -> None:
    assert not exceeded(compare_drop(load(name), gains=FIRM))


@pytest.mark.parametrize("name", some(names(standing=True), CORE))
def test_standing_feet_carry_what_mujocos_carry(name: str) -> None:
    found = compare_standing(load(name))
    assert len(found.normal) in (4, 6)
    assert not exceeded(found)


def test_a_joint_at_its_speed_limit_turns_at_that_speed() -> None:
    """Against the formula: a target far away is approached at the limit, in both simulators."""
    robot = load("anymal_b_kinova")
    joint = int(np.argmin(robot.actuators.speed_limit))
    limit = robot.actuators.speed_limit[joint]
    assert limit == pytest.approx(0.628319)
    target = robot.default_position + np.eye(robot.num_joints)[[joint]]
    ours = polypod_tracks(robot, target, motion.FINE)
    mujocos = mujoco_tracks(robot, target, motion.FINE, "implicitfast")
    # `f32` rounds the angle of 4.7 rad by up to 8e-4 of a step's way; MuJoCo's rows give way a
    # little
    for track, tolerance in ((ours, 8e-4), (mujocos, 5e-3)):
        speed = np.diff(track[0, 20:120, joint]) / motion.COARSE
        assert speed == pytest.approx(np.full(speed.shape, limit), rel=tolerance)
    assert np.abs(ours - mujocos).max() < 1e-3


WHIP = (
    # base, then joints
    "-0.0708 1.8151 0.3726 -0.2274 0.2840 -0.7643 0.5324 "
    "0.4880 -0.2220 0.3956 0.2800 -1.3433 0.0373 0.2752 1.5009 -2.9261 1.3932 0.3151 0.0538",
    "-0.1582 0.1839 0.0717 -3.6725 1.6081 -0.5938 "
    "4.9563 -1.2143 -0.7896 -34.3731 -5.4181 -0.2919 -1.5497 -2.4518 -0.0123 0.8939 7.6482 12.4916",
)
"""qpos and qvel of an ANYmal B, a leg of which is about to whip through: the worst of an hour of
random targets."""


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
