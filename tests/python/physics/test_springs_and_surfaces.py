"""Springs of joints and surfaces of links: a robot against formulas and MuJoCo."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import polypod
from polypod import _core
from polypod.mujoco_model import robot as robots
from polypod.mujoco_model.reference import GRAVITY, Ground, Reference
from polypod.robustness import twins
from polypod.sim2sim import differences

HEAD = 'extends = "unitree_go2"\nname = "mine"\ntitle = "mine"\n'
LIMP = "stiffness = 0.0\ndamping = 0.0\narmature = 0.0\nfriction = 0.0\n"
FIRM = "[actuators.legs]\nstiffness = 400.0\ndamping = 10.0\neffort_limit = 1000.0\n"
"""Legs that hardly give way, so that feet alone touch the ground."""
STEPS = 1000


def written(tmp_path, text: str) -> str:
    """The path of a config of a Go2 with these tables."""
    path = tmp_path / "mine.toml"
    path.write_text(HEAD + text, encoding="utf-8")
    return str(path)


def reference(config: str, **options) -> Reference:
    """The same robot in MuJoCo."""
    sim = _core.VecSim(robots.TASK, 1, robots=[config], threads=1)
    return Reference.of(robots.of(sim, "mine", config), **options)


@pytest.mark.parametrize("dt", [0.005, 0.02])
def test_a_spring_swings_at_its_frequency_and_loses_nothing(tmp_path, dt):
    stiffness, rest, away = 12.0, -1.6, 0.2
    springs = f"joint_damping = 0.0\nspring_stiffness = {stiffness}\nspring_reference = {rest}\n"
    config = written(tmp_path, f"[actuators.legs]\n{LIMP}{springs}")
    sim = polypod.Simulation(
        config, dt=dt, ground=None, gravity=(0.0, 0.0, 0.0), fixed_base=True, threads=1, dtype="float64"
    )
    calf = next(index for index, name in enumerate(sim.joint_names) if "calf" in name)
    # nothing else moves
    sim.set_armature(np.where(np.arange(sim.num_joints) == calf, 0.0, 1e9))
    qpos = np.array(sim.default_qpos).reshape(-1)
    qpos[calf] = rest + away
    sim.set_state(qpos, np.zeros(sim.num_joints))
    inertia = sim.mass_matrix()[0, calf, calf]
    turn = 2.0 * math.atan(0.5 * dt * math.sqrt(stiffness / inertia))
    assert turn > 0.1
    for step in range(1, STEPS + 1):
        sim.step()
        # semi-implicit Euler's velocities lie between the positions
        expected = away * (math.cos(step * turn) - math.tan(0.5 * turn) * math.sin(step * turn))
        assert sim.qpos[0, calf] - rest == pytest.approx(expected, abs=1e-6 * away * step)


def test_springs_move_a_robot_as_in_mujoco(tmp_path):
    springs = "joint_damping = 0.2\nspring_stiffness = 3.0\nspring_reference = -1.3\n"
    config = written(tmp_path, f"[actuators.legs]\n{LIMP}{springs}")
    dt = 2e-4
    sim = polypod.Simulation(config, dt=dt, ground=None, fixed_base=True, threads=1, dtype="float64")
    theirs = reference(config, dt=dt, fixed_base=True)
    # within the limits of all joints
    start = np.array([-1.8 if "calf" in name else 0.5 for name in sim.joint_names])
    sim.set_state(start, np.zeros(sim.num_joints))
    theirs.set_state(start, np.zeros(sim.num_joints))
    steps = round(0.08 / dt)
    sim.step(n=steps)
    theirs.step(np.zeros(sim.num_joints), n=steps)
    moved = np.abs(theirs.qpos - start)
    assert moved.max() > 0.2
    assert np.abs(sim.qpos[0] - theirs.qpos).max() < 2e-3 * moved.max()


def stand(config: str, *, slope: float = 0.0, seconds: float = 1.0, **options):
    """Distances downhill and accelerations in the second half, and the two robots.

    From polypod and from MuJoCo.
    """
    normal = (math.sin(slope), 0.0, math.cos(slope))
    friction, dt = options.pop("friction", 0.8), 0.002
    sim = polypod.Simulation(config, dt=dt, friction=friction, ground_normal=normal, threads=1, **options)
    theirs = reference(config, dt=dt, ground=Ground(friction, normal))
    start = np.array(sim.default_qpos).reshape(-1)
    # lying along the slope as it stands on the level
    start[:3] = start[2] * np.array(normal)
    start[3:7] = [math.cos(slope / 2), 0.0, math.sin(slope / 2), 0.0]
    downhill = np.array([math.cos(slope), 0.0, -math.sin(slope)])
    targets = np.array(sim.default_qpos).reshape(-1)[7:]
    ways = []
    for each in (sim, theirs):
        each.set_state(start, np.zeros(6 + len(targets)))
        places, speeds = [], []
        for _ in range(2):
            each.step(targets=targets, n=round(0.5 * seconds / dt))
            places.append(np.array(each.qpos).reshape(-1)[:3] @ downhill)
            speeds.append(np.array(each.qvel).reshape(-1)[:3] @ downhill)
        ways.append((places[1] - places[0], 2.0 * (speeds[1] - speeds[0]) / seconds))
    return ways, sim, theirs


def test_feet_slide_at_the_factor_times_the_friction(tmp_path):
    config = written(tmp_path, FIRM + '[surfaces.feet]\nbodies = ["*_foot"]\nfriction = 0.25\n')
    (ours, theirs), _, _ = stand(config, slope=math.atan(0.15))
    assert abs(ours[0]) < 1e-3
    assert abs(theirs[0]) < 5e-3
    slope = math.atan(0.3)
    (ours, theirs), _, _ = stand(config, slope=slope)
    formula = GRAVITY * (math.sin(slope) - 0.2 * math.cos(slope))
    assert formula > 0.9
    assert ours[1] == pytest.approx(formula, rel=0.03)
    assert ours[1] == pytest.approx(theirs[1], rel=0.05)
    # on all of a robot's feet it is a robot of less friction
    (plain, _), _, _ = stand(written(tmp_path, FIRM), slope=slope, friction=0.2)
    assert ours == plain


def test_feet_resist_turning_as_the_whole_robot_would(tmp_path):
    def heading(config: str, **options) -> float:
        sim = polypod.Simulation(config, dt=0.002, friction=0.8, threads=1, **options)
        targets = np.array(sim.default_qpos).reshape(-1)[7:]
        sim.step(targets=targets, n=500)
        kicked = np.array(sim.qvel[0])
        kicked[5] += 2.0
        sim.set_state(np.array(sim.qpos[0]), kicked)
        sim.step(targets=targets, n=60)
        w, x, y, z = sim.qpos[0, 3:7]
        return math.atan2(w * z + x * y, 0.5 - (y * y + z * z))

    plain = written(tmp_path, "")
    free, whole = heading(plain), heading(plain, torsional_friction=0.05, rolling_friction=0.01)
    table = 'bodies = ["*_foot"]\ntorsional_friction = 0.05\nrolling_friction = 0.01\n'
    assert heading(written(tmp_path, f"[surfaces.feet]\n{table}")) == whole
    assert whole < 0.95 * free
    # the larger coefficient acts
    config = written(tmp_path, f"[surfaces.feet]\n{table}")
    assert heading(config, torsional_friction=0.03, rolling_friction=0.002) == whole


def test_mujoco_touches_the_ground_with_the_same_numbers(tmp_path):
    feet = 'bodies = ["F*_foot"]\nfriction = 1.5\ntorsional_friction = 0.02\nrolling_friction = 0.01\n'
    config = written(tmp_path, f"{FIRM}[surfaces.front]\n{feet}")
    _, _, model = stand(config)
    bodies = model.model.geom_bodyid
    contacts = [model.data.contact[index] for index in range(model.data.ncon)]
    touching = {}
    for contact in contacts:
        geom = contact.geom1 if bodies[contact.geom1] else contact.geom2
        name = model.model.body(bodies[geom]).name
        touching[name] = (int(contact.dim), *(round(float(number), 9) for number in contact.friction[[0, 2, 3]]))
    assert {name: numbers for name, numbers in touching.items() if "_foot" in name} == {
        "FL_foot": (6, 1.2, 0.02, 0.01),
        "FR_foot": (6, 1.2, 0.02, 0.01),
        # MuJoCo's least coefficient, which has no part in three directions
        "RL_foot": (3, 0.8, 1e-5, 1e-5),
        "RR_foot": (3, 0.8, 1e-5, 1e-5),
    }


def test_feet_with_a_margin_stand_off_the_ground(tmp_path):
    margin = 0.004
    (_, _), *bare = stand(written(tmp_path, FIRM))
    (_, _), *lifted = stand(
        written(tmp_path, f'{FIRM}[surfaces.feet]\nbodies = ["*_foot"]\ncontact_margin = {margin}\n')
    )
    for one, other in zip(lifted, bare, strict=True):
        rise = np.array(one.qpos).reshape(-1)[2] - np.array(other.qpos).reshape(-1)[2]
        assert rise == pytest.approx(margin, abs=1e-4)


def test_a_condition_of_friction_keeps_the_surfaces(tmp_path):
    feet = '[surfaces.feet]\nbodies = ["*_foot"]\nfriction = 0.5\n'
    own = reference(written(tmp_path, feet), dt=0.002, ground=Ground(0.8))
    twins.friction(0.6)(SimpleNamespace(reference=own), None)
    names = [own.model.body(body).name for body in own.model.geom_bodyid]
    assert sum(name.endswith("_foot") for name in names) == 4
    for name, friction in zip(names, own.model.geom_friction[:, 0], strict=True):
        assert friction == pytest.approx(0.3 if name.endswith("_foot") else 0.6)


def test_models_differ_in_springs_where_one_has_others(tmp_path):
    def twin(stiffness: float, rest: float) -> SimpleNamespace:
        springs = f"[actuators.legs]\nspring_stiffness = {stiffness}\nspring_reference = {rest}\n"
        config = written(tmp_path, springs)
        sim = _core.VecSim(robots.TASK, 1, robots=[config], threads=1)
        robot = robots.of(sim, "mine", config)
        return SimpleNamespace(robot=robot, reference=Reference.of(robot, dt=0.002))

    def found(one: SimpleNamespace, other: SimpleNamespace) -> list[differences.Item]:
        own = other.reference
        joints = [own.model.joint(name).id for name in other.robot.joint_names]
        same = SimpleNamespace(signs=np.ones(len(joints)), offsets=np.zeros(len(joints)))
        model = SimpleNamespace(model=own.model, q=own.q, v=own.v, joints=joints, map=same)
        return differences._joints(one, model)

    mine, others, elsewhere = twin(3.0, 0.5), twin(7.0, 0.5), twin(3.0, 0.7)
    assert not found(mine, mine)
    (item,) = found(mine, others)
    assert (item.name, item.ours, item.theirs) == ("joint springs", "3 N m/rad", "7 N m/rad")
    (item,) = found(mine, elsewhere)
    item.change(mine)
    assert not found(mine, elsewhere)


def test_the_engine_avian_refuses_surfaces_that_resist_turning(tmp_path):
    config = written(tmp_path, '[surfaces.feet]\nbodies = ["*_foot"]\nrolling_friction = 0.01\n')
    with pytest.raises(_core.ConfigError, match=r"\[surfaces\].*rolling_friction.*engine avian.*articulated"):
        polypod.Simulation(config, engine="avian", threads=1)
