"""Contacts resist turning and rolling as Coulomb's law says.

Bodies against formulas and MuJoCo's condim 4 and 6.
"""

import math

import numpy as np
import pytest

import polypod
from polypod.mujoco_model.reference import GRAVITY, Ground, Reference

MASS, RADIUS = 2.0, 0.1
DT = 0.001
"""Physics step, s."""
SHAPES = {
    # solid bodies; the moment of inertia about the axis of a wheel is k m r^2
    "sphere": ('<sphere radius="0.1"/>', 0.4, (0.4, 0.4, 0.4)),
    "capsule": ('<capsule radius="0.1" length="0.3"/>', 0.5, (1.5, 0.5, 1.5)),
    "disc": ('<cylinder radius="0.1" length="0.04"/>', 0.5, (0.3, 0.3, 0.5)),
}
"""Geometry, k of the axis about which it turns, and inertias about x, y, z over m r^2."""


def body(shape, tmp_path):
    """Writes the URDF of a body; a capsule lies along y, a disc on its face."""
    geometry, _, inertia = SHAPES[shape]
    ixx, iyy, izz = (k * MASS * RADIUS**2 for k in inertia)
    turned = '<origin rpy="1.5707963267948966 0 0"/>' if shape == "capsule" else ""
    urdf = f"""<robot name="{shape}">
      <mujoco><compiler inertiafromgeom="false"/></mujoco>
      <link name="{shape}">
        <inertial><mass value="{MASS}"/>
          <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial>
        <collision>{turned}<geometry>{geometry}</geometry></collision>
      </link>
    </robot>"""
    path = tmp_path / f"{shape}.urdf"
    path.write_text(urdf, encoding="utf-8")
    return path, urdf


def run(shape, tmp_path, velocity, seconds, *, sliding=0.8, torsional=0.0, rolling=0.0, slope=0.0, dtype="float32"):
    """Final positions and velocities of a body that starts with `velocity` [6].

    From polypod and from MuJoCo.
    """
    path, urdf = body(shape, tmp_path)
    normal = (math.sin(slope), 0.0, math.cos(slope))
    height = 0.02 if shape == "disc" else RADIUS
    start = np.array([*(height * np.array(normal)), math.cos(slope / 2), 0.0, math.sin(slope / 2), 0.0])
    friction = {"torsional_friction": torsional, "rolling_friction": rolling}
    sim = polypod.Simulation(
        str(path), dt=DT, friction=sliding, ground_normal=normal, threads=1, dtype=dtype, **friction
    )
    # on MuJoCo's stiffest contacts a single body hops, and its normal force with it
    reference = Reference(urdf, dt=DT, ground=Ground(sliding, normal, soft=True, **friction))
    for each in (sim, reference):
        each.set_state(start, np.array(velocity))
        each.step(n=round(seconds / DT))
    return (np.array(sim.qpos[0]), np.array(sim.qvel[0])), (reference.qpos, reference.qvel)


@pytest.mark.parametrize("shape", ["sphere", "disc"])
def test_a_spinning_body_slows_by_the_coefficient_times_its_weight(shape, tmp_path):
    torsional, rate, seconds = 0.01, 20.0, 0.5
    # a disc's rim would be braked by sliding friction
    (_, ours), (_, theirs) = run(shape, tmp_path, [0, 0, 0, 0, 0, rate], seconds, sliding=0.0, torsional=torsional)
    _, k, _ = SHAPES[shape]
    formula = rate - torsional * GRAVITY * seconds / (k * RADIUS**2)
    assert 0.2 * rate < formula < 0.6 * rate
    # the first step, before there is a normal impulse, is all that is missing
    assert ours[5] == pytest.approx(formula, abs=2.0 * (rate - formula) * DT / seconds)
    # MuJoCo's body still moves up and down by millimetres a second: its normal impulse is not quite
    # its weight's
    assert theirs[5] == pytest.approx(formula, abs=0.01 * (rate - formula))
    (_, free), _ = run(shape, tmp_path, [0, 0, 0, 0, 0, rate], seconds, sliding=0.0)
    assert free[5] == pytest.approx(rate, rel=1e-4)
    # in the end it stands still
    (_, ours), (_, theirs) = run(shape, tmp_path, [0, 0, 0, 0, 0, rate], 2.0, sliding=0.0, torsional=torsional)
    assert abs(ours[5]) < 1e-5
    # soft contacts let MuJoCo's disc rock
    assert abs(theirs[5]) < 0.002 * rate


@pytest.mark.parametrize("torsional", [0.0, 0.02])
@pytest.mark.parametrize("shape", ["sphere", "capsule"])
def test_a_rolling_body_slows_by_the_coefficient_over_its_radius(shape, torsional, tmp_path):
    rolling, speed, seconds = 0.004, 1.0, 2.0
    _, k, _ = SHAPES[shape]
    velocity = [speed, 0, 0, 0, speed / RADIUS, 0]
    friction = {"rolling": rolling, "torsional": torsional}
    (position, ours), (where, theirs) = run(shape, tmp_path, velocity, seconds, **friction)
    rate = rolling * GRAVITY / (RADIUS * (1.0 + k))
    formula = speed - rate * seconds
    assert 0.3 * speed < formula < 0.6 * speed
    assert ours[0] == pytest.approx(formula, abs=2.0 * rate * DT)
    assert ours[4] == pytest.approx(formula / RADIUS, abs=2.0 * rate * DT / RADIUS)
    # the cone of MuJoCo shares the normal force with the friction that turns the wheel: a few per
    # mille
    assert theirs[0] == pytest.approx(formula, rel=0.01)
    # both are semi-implicit Euler's
    way = speed * seconds - 0.5 * rate * seconds**2
    assert position[0] == pytest.approx(way, abs=2.0 * speed * DT)
    assert where[0] == pytest.approx(way, rel=0.01)
    (_, free), _ = run(shape, tmp_path, velocity, seconds, torsional=torsional)
    # single precision rounds by 6e-8 in each of 2000 steps
    assert free[0] == pytest.approx(speed, rel=5e-4)
    # in the end it lies still
    (_, ours), _ = run(shape, tmp_path, velocity, 6.0, **friction)
    assert np.abs(ours).max() < 1e-5


@pytest.mark.parametrize("share", [0.9, 1.5])
def test_a_ball_on_a_slope_lies_below_the_coefficient_over_its_radius(share, tmp_path):
    rolling = 0.01
    slope = math.atan(share * rolling / RADIUS)
    (position, _), (where, _) = run("sphere", tmp_path, np.zeros(6), 1.0, rolling=rolling, slope=slope)
    _, k, _ = SHAPES["sphere"]

    def rate_with(left):
        return GRAVITY * (math.sin(slope) - left * rolling / RADIUS * math.cos(slope)) / (1.0 + k)

    downhill = np.array([math.cos(slope), 0.0, -math.sin(slope)])
    start = RADIUS * np.array([math.sin(slope), 0.0, math.cos(slope)])
    ours, theirs = ((p[:3] - start) @ downhill for p in (position, where))
    if share < 1.0:
        # sweeps close in on the friction that holds it within a few steps
        assert abs(ours) < 1e-4
        assert abs(theirs) < 1e-3
    else:
        assert ours == pytest.approx(0.5 * rate_with(1.0), rel=0.01)
        # MuJoCo's cone takes from rolling friction what holds the point of contact
        used = (math.tan(slope) - rate_with(1.0) / (GRAVITY * math.cos(slope))) / 0.8
        assert theirs == pytest.approx(0.5 * rate_with(math.sqrt(1.0 - used**2)), rel=0.01)


def test_double_precision_has_them_too(tmp_path):
    velocity = [1.0, 0, 0, 0, 10.0, 20.0]
    friction = {"torsional": 0.01, "rolling": 0.004}
    (_, single), _ = run("sphere", tmp_path, velocity, 0.5, **friction)
    (_, double), _ = run("sphere", tmp_path, velocity, 0.5, dtype="float64", **friction)
    assert single == pytest.approx(double, abs=1e-3)


def test_a_kicked_robot_turns_less():
    def turned(**friction):
        sim = polypod.Simulation("unitree_go2", dt=0.002, friction=0.8, threads=1, **friction)
        sim.step(targets=sim.default_qpos[7:], n=500)
        kicked = np.array(sim.qvel[0])
        kicked[5] += 2.0
        sim.set_state(np.array(sim.qpos[0]), kicked)
        most, start = 0.0, heading(sim)
        for _ in range(100):
            sim.step(targets=sim.default_qpos[7:], n=2)
            most = max(most, abs(heading(sim) - start))
        return most

    def heading(sim):
        w, x, y, z = sim.qpos[0, 3:7]
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    free, held = turned(), turned(torsional_friction=0.05)
    assert held < 0.95 * free


@pytest.mark.parametrize("name", ["torsional_friction", "rolling_friction"])
def test_wrong_coefficients_are_refused(name):
    for value in (-0.1, math.nan, math.inf):
        with pytest.raises(polypod.ConfigError, match=name):
            polypod.Simulation("unitree_go2", **{name: value})
    with pytest.raises(polypod.ConfigError, match=f"{name}: the engine avian"):
        polypod.Simulation("unitree_go2", engine="avian", **{name: 0.01})


def test_a_snapshot_goes_on_exactly(tmp_path):
    path, _ = body("capsule", tmp_path)
    sim = polypod.Simulation(str(path), num_envs=3, torsional_friction=0.01, rolling_friction=0.02, threads=1)
    state = np.array([0, 0, RADIUS, 1, 0, 0, 0])
    sim.set_state(state, np.array([1.0, 0.2, 0, 0, 10.0, 5.0]))
    sim.step(n=40)
    snapshot = sim.snapshot()
    sim.step(n=40)
    there = np.array(sim.qpos), np.array(sim.qvel)
    sim.restore(snapshot)
    sim.step(n=40)
    assert np.array_equal(sim.qpos, there[0])
    assert np.array_equal(sim.qvel, there[1])
