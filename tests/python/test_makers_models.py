"""A policy plays on somebody else's MuJoCo model of its robot, and what was mapped and added is said."""

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import polypod
import polypod.cli
from common import FLAT_POLICY
from polypod import _core
from polypod.accuracy import robot as accuracy_robot
from polypod.accuracy.reference import Ground, Reference
from polypod.sim2sim import Physics, mapping, mjcf, on_model, skeleton
from polypod.sim2sim.maker import Choices, Model

mujoco = pytest.importorskip("mujoco")

OFFSETS = {"FR_thigh_joint": 0.4, "RL_calf_joint": -1.2, "FL_hip_joint": 0.05}
FLIPPED = ("FL_thigh_joint", "FR_calf_joint", "RR_hip_joint")
SHORT = on_model.Options(episodes=2, phases="forward=0.5,stop", phase_s=0.2, actuators="policy", differences=False)


def robot_of(name):
    return accuracy_robot.of(_core.VecSim(accuracy_robot.TASK, 1, robots=[name], threads=1), name, name)


def twin_as_mjcf(name, ground=True, physics=None):
    """The text of polypod's own twin of a robot as MJCF."""
    physics = physics or Physics()
    plane = Ground(physics.friction) if ground else None
    reference = Reference.of(robot_of(name), dt=physics.dt, integrator=physics.integrator, ground=plane)
    spec = reference.spec
    for joint in spec.joints:
        joint.solref_friction = [2.0 * physics.dt, 1.0]
        joint.solimp_friction = [0.9999, 0.9999, 0.001, 0.5, 2.0]
    if not ground:
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 1
    return spec.to_xml()


@pytest.fixture(scope="module")
def a1():
    return twin_as_mjcf("unitree_a1")


def written(tmp_path, text, name="model.xml"):
    file = tmp_path / name
    file.write_text(text, encoding="utf-8")
    return file


def altered(text, *, seed=1, rename=True, turn=None):
    """The model with its limbs in another order, other names, flipped axes and other zeros."""
    tree = ElementTree.fromstring(text)
    random = np.random.default_rng(seed)
    for joint in tree.iter("joint"):
        name = joint.get("name")
        if name in FLIPPED:
            axis = [-float(number) for number in joint.get("axis", "0 0 1").split()]
            joint.set("axis", " ".join(map(str, axis)))
            if joint.get("range"):
                low, high = joint.get("range").split()
                joint.set("range", f"{-float(high)} {-float(low)}")
    for body in tree.iter("body"):
        for joint in body.findall("joint"):
            angle = OFFSETS.get(joint.get("name"))
            if angle is None:
                continue
            turned, own, product = np.zeros(4), np.fromstring(body.get("quat", "1 0 0 0"), sep=" "), np.zeros(4)
            axis = np.fromstring(joint.get("axis", "0 0 1"), sep=" ")
            mujoco.mju_axisAngle2Quat(turned, axis / np.linalg.norm(axis), angle)
            mujoco.mju_mulQuat(product, own, turned)
            body.set("quat", " ".join(repr(float(number)) for number in product))
            if joint.get("range"):
                low, high = (float(number) - angle for number in joint.get("range").split())
                joint.set("range", f"{low!r} {high!r}")
    base = tree.find("worldbody/body")
    limbs = base.findall("body")
    for limb in limbs:
        base.remove(limb)
    for index in random.permutation(len(limbs)):
        base.append(limbs[index])
    names = {}
    if rename:
        joints = [joint for joint in tree.iter("joint") if joint.get("axis") is not None]
        for number, joint in enumerate(joints):
            names[joint.get("name")] = f"q{number}"
            joint.set("name", f"q{number}")
    if tree.find("actuator") is not None:
        tree.remove(tree.find("actuator"))
    if turn is not None:
        for child in list(base):
            if child.tag in ("body", "inertial", "geom", "site"):
                place = turn @ np.fromstring(child.get("pos", "0 0 0"), sep=" ")
                own, product = np.fromstring(child.get("quat", "1 0 0 0"), sep=" "), np.zeros(4)
                mujoco.mju_mulQuat(product, mapping.quaternion_of(turn), own)
                child.set("pos", " ".join(repr(float(number)) for number in place))
                child.set("quat", " ".join(repr(float(number)) for number in product))
    return ElementTree.tostring(tree, encoding="unicode"), names


def model_of(file, name="unitree_a1", given=None, **choices):
    return Model(mjcf.read(str(file)), file.name, robot_of(name), given, Choices(**choices))


def sensed(file, given=None):
    """The robots of a short play in their initial states."""
    stage = on_model.Stage(FLAT_POLICY, "unitree_a1", SHORT)
    robots = stage.maker_of(model_of(file, given=given, actuators="policy"))
    robots.reset(*stage.start(robots.reference))
    return robots


def test_the_own_twin_as_mjcf_does_what_sim2sim_does(tmp_path, a1):
    """Through the whole player: mapped, with the policy's actuators, on its own ground."""
    stage = on_model.Stage(FLAT_POLICY, "unitree_a1", SHORT)
    twin = stage.twin_of()
    twin.reset(*stage.episode.start[stage.name])
    model = model_of(written(tmp_path, a1), actuators="policy")
    assert model.notes == []
    robots = stage.maker_of(model)
    robots.reset(*stage.start(model))
    np.testing.assert_allclose(robots.qpos, twin.qpos, rtol=0.0, atol=1e-12)
    for step in range(15):
        command = stage.schedule.at(step)
        ours, theirs = (each.step(command, np.ones(2, dtype=np.bool_)) for each in (twin, robots))
        # MJCF is written with a dozen digits
        np.testing.assert_allclose(theirs.velocity, ours.velocity, rtol=0.0, atol=1e-4)
        np.testing.assert_allclose(robots.qpos, twin.qpos, rtol=0.0, atol=1e-5)
    assert np.abs(twin.qvel).max() > 0.1


def test_joints_of_the_same_names_are_paired_by_name(tmp_path, a1):
    model = model_of(written(tmp_path, a1))
    assert {pair.how for pair in model.map.pairs} == {"name"}
    assert [pair.ours for pair in model.map.pairs] == [pair.theirs for pair in model.map.pairs]
    assert model.map.frame_how == "equal"
    assert max(pair.apart for pair in model.map.pairs) < 1e-6


@pytest.mark.parametrize("rename", [True, False])
def test_joints_are_found_by_geometry(tmp_path, a1, rename):
    """Permuted, renamed, flipped and with other zeros: the same robot."""
    text, names = altered(a1, rename=rename)
    model = model_of(written(tmp_path, text))
    for pair in model.map.pairs:
        assert pair.theirs == names.get(pair.ours, pair.ours)
        assert pair.how == ("geometry" if rename else "name")
        assert pair.sign == (-1.0 if pair.ours in FLIPPED else 1.0)
        # MuJoCo writes MJCF with few digits
        assert pair.offset == pytest.approx(OFFSETS.get(pair.ours, 0.0), abs=1e-6)
        assert pair.apart < 1e-6
        assert pair.tilt < 1e-6


def lines_of(file, model=None):
    """The joints of a file."""
    compiled = model or mjcf.read(str(file)).spec.compile()
    root = compiled.body("base").id
    return skeleton.skeleton(compiled, root, skeleton.joints_below(compiled, root))


def test_the_geometric_map_is_exact_between_files_of_the_same_numbers(tmp_path, a1):
    plain, (text, names) = lines_of(written(tmp_path, a1)), altered(a1)
    found = mapping.find(plain, lines_of(written(tmp_path, text, "altered.xml")), mapping.Given(), "altered.xml")
    for pair in found.pairs:
        assert (pair.theirs, pair.sign) == (names[pair.ours], -1.0 if pair.ours in FLIPPED else 1.0)
        assert pair.offset == pytest.approx(OFFSETS.get(pair.ours, 0.0), abs=1e-9)


def map_file(tmp_path, names):
    """A map file of an altered model, with all signs and offsets."""
    lines = ["[joints]"]
    for ours, theirs in names.items():
        sign = -1 if ours in FLIPPED else 1
        lines.append(f'{ours} = {{ joint = "{theirs}", sign = {sign}, offset = {OFFSETS.get(ours, 0.0)!r} }}')
    return written(tmp_path, "\n".join(lines), "map.toml")


def test_a_mapped_model_equals_the_unmapped_one(tmp_path, a1):
    """States, sensors and a control step, to rounding."""
    text, names = altered(a1)
    given = mapping.Given.read(map_file(tmp_path, names))
    plain = sensed(written(tmp_path, a1))
    mapped = sensed(written(tmp_path, text, "altered.xml"), given)
    assert {pair.how for pair in mapped.reference.map.pairs} == {"map"}
    for name, numbers in plain.sensors().items():
        np.testing.assert_allclose(mapped.sensors()[name], numbers, rtol=0.0, atol=1e-9, err_msg=name)
    ours, theirs = plain.reference, mapped.reference
    # MuJoCo softens constraints by what they move where all joints are at zero, and zero is elsewhere
    theirs.model.dof_invweight0[theirs.v] = ours.model.dof_invweight0[ours.v]
    for body in range(ours.model.nbody):
        name = ours.model.body(body).name
        theirs.model.body_invweight0[theirs.model.body(name).id] = ours.model.body_invweight0[body]
    for robots in (plain, mapped):
        robots._targets[:] = robots.robot.default_position + 0.1
        for substep in range(robots.substeps):
            robots._physics_step(substep, np.arange(2), np.zeros(2, dtype=np.bool_))
    np.testing.assert_allclose(mapped.qpos, plain.qpos, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(mapped.qvel, plain.qvel, rtol=0.0, atol=1e-9)
    assert np.abs(plain.qvel).max() > 0.1


QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def test_a_base_frame_that_is_turned_is_found(tmp_path, a1):
    text, names = altered(a1, turn=QUARTER)
    file = written(tmp_path, text)
    model = model_of(file)
    np.testing.assert_allclose(model.map.turn, QUARTER.T, atol=1e-9)
    assert model.map.frame_how == "geometry"
    assert all(pair.theirs == names[pair.ours] for pair in model.map.pairs)
    plain = sensed(written(tmp_path, a1, "plain.xml"))
    given = mapping.Given(
        joints=names,
        signs={name: -1.0 for name in FLIPPED},
        offsets={name: OFFSETS.get(name, 0.0) for name in names},
        quaternion=tuple(mapping.quaternion_of(QUARTER.T)),
    )
    mapped = sensed(file, given)
    velocity = np.random.default_rng(0).normal(size=(2, 18))
    for robots in (plain, mapped):
        robots.reset(plain.qpos.copy(), velocity)
    for name, numbers in plain.sensors().items():
        np.testing.assert_allclose(mapped.sensors()[name], numbers, rtol=0.0, atol=1e-9, err_msg=name)


def test_a_map_with_two_answers_is_refused(tmp_path):
    """From the side, nobody sees which end of an ANYmal is its front; a map file says it."""
    text, names = altered(twin_as_mjcf("anymal_c"), turn=QUARTER)
    file = written(tmp_path, text)
    with pytest.raises(polypod.ConfigError, match=r"may be q\d+ or q\d+, both fit; say which in a --map FILE"):
        model_of(file, "anymal_c")
    given = mapping.Given(joints={"LF_HAA": names["LF_HAA"]})
    assert all(pair.theirs == names[pair.ours] for pair in model_of(file, "anymal_c", given).map.pairs)
