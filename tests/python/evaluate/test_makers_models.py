"""A policy plays on a maker's MuJoCo model, and the report says what was mapped."""

import functools
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import polypod
import polypod.cli
from common import FLAT_POLICY, LEGGED_POLICY, ROOT
from polypod import _core, policy, robustness
from polypod.export.robot import interfaces
from polypod.mujoco_model import robot as model_robot
from polypod.mujoco_model.reference import Ground, Reference
from polypod.robustness import in_mujoco, in_polypod
from polypod.sim2sim import Physics, mapping, mjcf, on_model, skeleton, told
from polypod.sim2sim.maker import Choices, Model

mujoco = pytest.importorskip("mujoco")

OFFSETS = {"FR_thigh_joint": 0.4, "RL_calf_joint": -1.2, "FL_hip_joint": 0.05}
FLIPPED = ("FL_thigh_joint", "FR_calf_joint", "RR_hip_joint")
SHORT = on_model.Options(episodes=2, phases="forward=0.5,stop", phase_s=0.2, actuators="policy", differences=False)


@functools.cache
def robot_of(name):
    return model_robot.of(_core.VecSim(model_robot.TASK, 1, robots=[name], threads=1), name, name)


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


def test_the_robot_of_a_file_is_found_by_the_names_of_its_joints(tmp_path, a1):
    """The word joint in them does not count."""
    file = written(tmp_path, a1.replace("_joint", ""))
    assert on_model.guess(file, ["anymal_b", "unitree_a1"]) == "unitree_a1"


def test_a_urdf_is_a_model_too(tmp_path):
    """MuJoCo would merge its root link into the world, and leave four legs without a base."""
    file = written(tmp_path, robot_of("unitree_a1").urdf, "a1.urdf")
    model = model_of(file)
    assert {pair.how for pair in model.map.pairs} == {"name"}
    assert f"{model.root} has no free joint: one is added" in model.notes
    assert model.model.nv == 6 + 12
    assert on_model.guess(file, ["anymal_b", "unitree_a1"]) == "unitree_a1"


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
    # MuJoCo softens constraints by what they move where all joints are at zero, and zero is
    # elsewhere
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
        signs=dict.fromkeys(FLIPPED, -1.0),
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
    """From the side, nobody sees which end of this robot is its front; a map file says it."""
    text, names = altered(twin_as_mjcf("box_quadruped"), turn=QUARTER)
    file = written(tmp_path, text)
    with pytest.raises(polypod.ConfigError, match=r"may be q\d+ or q\d+, both fit; say which in a --map FILE"):
        model_of(file, "box_quadruped")
    given = mapping.Given(joints={"FL_HFE": names["FL_HFE"]})
    assert all(pair.theirs == names[pair.ours] for pair in model_of(file, "box_quadruped", given).map.pairs)


# Additions, omissions and refusals


BARE = """<mujoco model="bare">
  <worldbody>
    {ground}
    <body name="torso" pos="0 0 1">
      {free}
      <geom type="box" size="0.1 0.1 0.1" mass="1"/>
      {more}
    </body>
  </worldbody>
</mujoco>
"""


def edited(text, *, drop=(), add=""):
    """The model without elements of these tags, and with more in its world's base."""
    tree = ElementTree.fromstring(text)
    for parent in list(tree.iter()):
        for child in list(parent):
            if child.tag in drop or (child.tag == "geom" and child.get("type") == "plane" and "ground" in drop):
                parent.remove(child)
    if add:
        tree.find("worldbody/body").append(ElementTree.fromstring(add))
    return ElementTree.tostring(tree, encoding="unicode")


def test_ground_free_joint_and_actuators_are_added_and_said(tmp_path, a1):
    text = edited(a1, drop=("ground", "freejoint", "actuator"))
    assert "freejoint" not in text
    model = model_of(written(tmp_path, text.replace('type="free"', 'type="free" group="5"')), contact="stiff")
    joined = "\n".join(model.notes)
    assert "a plane with friction 1 is added" in joined
    assert "12 joints have no actuator: the policy's gains and limits drive them" in joined
    assert int(model.model.jnt_type[model.model.body_jntadr[model.model.body(model.root).id]]) == 0
    stage = on_model.Stage(FLAT_POLICY, "unitree_a1", SHORT)
    robots = stage.maker_of(model)
    robots.reset(*stage.start(model))
    for _ in range(20):
        seen = robots.step(np.zeros((2, 3), dtype=np.float32), np.ones(2, dtype=np.bool_))
    assert not seen.fell.any()
    assert (robots.qpos[:, 2] > 0.2).all()


def test_a_joint_that_the_policy_does_not_drive_is_held(tmp_path, a1):
    arm = (
        '<body name="arm" pos="0.1 0 0.1"><joint name="arm_joint" axis="0 1 0"/><geom size="0.02 0.1" type="capsule"/>'
    )
    arm += '<inertial mass="0.1" pos="0 0 0.1" diaginertia="1e-3 1e-3 1e-3"/></body>'
    model = model_of(written(tmp_path, edited(a1, add=arm)), actuators="policy")
    assert "the policy does not drive 1 joints: held arm_joint at 0" in model.notes
    stage = on_model.Stage(FLAT_POLICY, "unitree_a1", SHORT)
    robots = stage.maker_of(model)
    robots.reset(*stage.start(model))
    for _ in range(10):
        robots.step(np.zeros((2, 3), dtype=np.float32), np.ones(2, dtype=np.bool_))
    address = model.model.joint("arm_joint").qposadr[0]
    assert abs(robots._data[0].qpos[address]) < 0.02


def test_missing_meshes_are_left_out_unless_mass_is_theirs(tmp_path, a1):
    seen = '<geom type="mesh" mesh="gone" contype="0" conaffinity="0"/>'
    asset = '<asset><mesh name="gone" file="nowhere/gone.stl"/></asset>'
    text = edited(a1, add=seen).replace("<worldbody>", f"{asset}<worldbody>")
    assert "1 shapes that are only seen are left out" in model_of(written(tmp_path, text)).notes[0]
    heavy = f'<body name="heavy">{seen.replace("/>", " />")}</body>'
    text = edited(a1, add=heavy).replace("<worldbody>", f"{asset}<worldbody>")
    with pytest.raises(
        ValueError, match=r"body 'heavy' takes its mass from mesh 'gone', and nowhere/gone.stl is missing"
    ):
        mjcf.read(str(written(tmp_path, text)))


@pytest.mark.parametrize(
    ("actuator", "effort", "target"),
    [
        ('<position name="{joint}_a" joint="{joint}" kp="60" kv="1" forcerange="-20 20"/>', 20.0, 1.0),
        ('<motor name="{joint}_a" joint="{joint}" gear="2" ctrlrange="-7 7"/>', 7.0, 2.0),
    ],
)
def test_its_own_actuators_follow_the_policys_targets(tmp_path, a1, actuator, effort, target):
    """A position actuator keeps its gains.

    A motor gets the policy's torque, within its own limits.
    """
    robot = robot_of("unitree_a1")
    lines = "".join(actuator.format(joint=name) for name in robot.joint_names)
    text = edited(a1, drop=("actuator",)).replace("</mujoco>", f"<actuator>{lines}</actuator></mujoco>")
    model = model_of(written(tmp_path, text))
    assert not model.is_policys.any()
    np.testing.assert_allclose(np.abs(model.effort_ranges()), effort)
    stage = on_model.Stage(FLAT_POLICY, "unitree_a1", SHORT)
    robots = stage.maker_of(model)
    robots.reset(*stage.start(model))
    near = robot.default_position + 0.05
    no_limits = np.zeros((robots.num_envs, 12, 2))

    def drive(targets: np.ndarray) -> None:
        controls, forces = robots._inputs(np.tile(targets, (robots.num_envs, 1)), no_limits)
        robots._drive(robots._data[0], controls[0], forces[0])

    drive(near)
    np.testing.assert_allclose(robots._data[0].ctrl, target * near)
    mujoco.mj_forward(model.model, robots._data[0])
    angles, rates = robots.qpos[0, 7:], robots.qvel[0, 6:]
    stiffness = 60.0 if target == 1.0 else robot.actuators.stiffness
    damping = 1.0 if target == 1.0 else robot.actuators.damping
    torque = np.clip(stiffness * (near - angles) - damping * rates, -effort * target, effort * target)
    np.testing.assert_allclose(robots._data[0].qfrc_actuator[model.v[6:]], torque, atol=1e-9)
    drive(near + 100.0)
    mujoco.mj_forward(model.model, robots._data[0])
    robots._watch([0], no_limits)
    assert (robots.saturated[0] == 1.0).all()


@pytest.mark.parametrize(
    ("actuator", "gains"),
    [
        ('<position name="{joint}_a" joint="{joint}" kp="60" kv="1.5"/>', {"stiffness": 60.0, "damping": 1.5}),
        ('<position name="{joint}_a" joint="{joint}" kp="15" gear="2"/>', {"stiffness": 60.0}),
        ('<motor name="{joint}_a" joint="{joint}" gear="2" ctrlrange="-7 7"/>', {}),
    ],
)
def test_a_policy_of_descriptions_is_told_the_models_gains(tmp_path, a1, actuator, gains):
    """As if polypod's robot had them; damping of joints is no gain."""
    lines = "".join(actuator.format(joint=name) for name in robot_of("unitree_a1").joint_names)
    text = edited(a1, drop=("actuator",)).replace("</mujoco>", f"<actuator>{lines}</actuator></mujoco>")
    model = model_of(written(tmp_path, text))
    stage = on_model.Stage(LEGGED_POLICY, "unitree_a1", SHORT)
    interface, line = told.interface_on(model, stage.interface)
    config = ROOT / "configs/robots/unitree_a1.toml"
    content = config.read_text(encoding="utf-8").replace("assets/robots", str(ROOT / "assets/robots"))
    for key, value in {"stiffness": 25.0, "damping": 0.5}.items():
        content = content.replace(f"\n{key} = {value}", f"\n{key} = {gains.get(key, value)}")
    own = written(tmp_path, content, "unitree_a1.toml")
    (same,) = interfaces(policy.load(LEGGED_POLICY).manifest, [str(own)]).values()
    np.testing.assert_allclose(interface.constants[told.TERM], same.constants[told.TERM], rtol=1e-6)
    assert (interface is stage.interface) == (line is None) == (not gains)
    # all that drives it is the policy's
    unchanged = told.interface_on(model_of(written(tmp_path, text), actuators="policy"), stage.interface)
    assert unchanged == (stage.interface, None)
    # a policy that reads none
    flat = on_model.Stage(FLAT_POLICY, "unitree_a1", SHORT)
    assert told.interface_on(model, flat.interface) == (flat.interface, None)
    assert flat.told(model) == []
    assert stage.told(model) == ([] if line is None else [line])


@pytest.mark.parametrize(
    ("choices", "is_shorter"),
    [({}, True), ({"dt": 0.002}, False), ({"integrator": "implicitfast"}, False), ({"actuators": "motors"}, False)],
)
def test_the_policys_damping_shakes_no_light_joint(tmp_path, choices, is_shorter):
    """A file that leaves out the rotors has feet and hands too light for explicit steps of 2 ms."""
    text = twin_as_mjcf("unitree_g1", physics=Physics(dt=0.002, integrator="Euler"))
    file = written(tmp_path, re.sub(r' armature="[^"]*"', "", edited(text, drop=("actuator",))))
    model = model_of(file, "unitree_g1", **choices)
    assert (model.dt < 0.002) == is_shorter == any("light joints" in note for note in model.notes)
    data = model.data_of(np.array([0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, *np.zeros(29)]))
    speed = 0.01
    data.qvel[model.v[6:]] = speed
    model.model.actuator_forcerange[:] = [-1e3, 1e3]
    for _ in range(round(0.05 / model.dt)):
        data.ctrl[model.actuators] = data.qpos[model.q[7:]]
        mujoco.mj_step(model.model, data)
    grows = np.abs(data.qvel[model.v[6:]]).max() > 10.0 * speed
    assert grows == (choices == {"dt": 0.002})


def test_contacts_and_motors_are_as_asked(tmp_path, a1):
    text = a1.replace('type="plane"', 'type="plane" condim="6"')
    assert (model_of(written(tmp_path, text)).model.geom_condim == 6).any()
    plain = model_of(written(tmp_path, text), contact="condim3", actuators="motors", friction=0.3, dt=0.002)
    assert (plain.model.geom_condim == 3).all()
    assert (plain.model.geom_friction[:, 0] == 0.3).all()
    assert plain.dt == 0.002
    stiff = model_of(written(tmp_path, text), contact="stiff").model
    assert stiff.opt.impratio == 100.0
    assert (stiff.geom_solref[:, 0] == 2.0 * stiff.opt.timestep).all()


HOSTILE = {
    "no_xml": ("\x00\x01", "XML parse error"),
    "empty": ("", "empty"),
    "nothing": ("<mujoco/>", "no body of the model has more than 0"),
    "other": (BARE.format(ground="", free="<freejoint/>", more=""), "no body of the model has more than 0"),
    "nan": ('<mujoco><worldbody><geom size="nan"/></worldbody></mujoco>', "nan size"),
    "plugin": ('<mujoco><extension><plugin plugin="x.y"/></extension></mujoco>', "plugin x.y not found"),
    "itself": ('<mujoco><include file="itself.xml"/></mujoco>', "already included"),
    "memory": ('<mujoco><size memory="900G"/><worldbody><geom size="1"/></worldbody></mujoco>', "memory"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_in_one_line(tmp_path, name):
    text, message = HOSTILE[name]
    with pytest.raises(polypod.ConfigError, match=message) as refused:
        on_model.load_model(written(tmp_path, text, f"{name}.xml"), robot_of("unitree_a1"), None, Choices())
    assert "\n" not in str(refused.value)


def test_files_that_take_too_long_or_end_mujoco_are_refused(tmp_path, monkeypatch):
    """A few bytes may ask for a billion bodies."""
    bomb = '<replicate count="100000"><body><freejoint/><geom size="1"/></body></replicate>'
    file = written(tmp_path, f"<mujoco><worldbody>{bomb}</worldbody></mujoco>")
    monkeypatch.setattr(mjcf, "MAX_SECONDS", 2)
    with pytest.raises(ValueError, match=r"MuJoCo takes more than (2 s of computing|20 s)"):
        mjcf.check(file)
    for place, message in ((Path("/dev/zero"), "not a regular file"), (tmp_path / "none.xml", "No such file")):
        with pytest.raises(ValueError, match=message):
            mjcf.check(place)
    with pytest.raises(ValueError, match="no name of a file"):
        mjcf.check(Path("a\0b"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("joints = 3", "joints must be a table"),
        ("[joints]\nFR_hip_joint = 3", "must name a joint of the model"),
        ('[joints]\nFR_hip = "FR_hip_joint"', "the robot has no joint 'FR_hip'; did you mean"),
        ('[joints]\nFR_hip_joint = "x"', "model.xml has no joint 'x'"),
        ('[joints]\nFR_hip_joint = "FL_hip_joint"\nFL_hip_joint = "FL_hip_joint"', "is given to two joints"),
        ('[joints]\nFR_hip_joint = { joint = "FR_hip_joint", sign = 2 }', "sign must be 1 or -1"),
        ('[joints]\nFR_hip_joint = { joint = "FR_hip_joint", offset = nan }', "must be 1 finite number"),
        ("base_quaternion = [0, 0, 0, 0]", "must have length 1"),
        ('base = "nobody"', "has no body 'nobody'"),
        ("speed = 1", "there is no key 'speed'"),
        ("= 3", "is no TOML"),
    ],
)
def test_wrong_map_files_are_refused(tmp_path, a1, content, message):
    with pytest.raises(polypod.ConfigError, match=message):
        model_of(written(tmp_path, a1), given=mapping.Given.read(written(tmp_path, content, "map.toml")))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--map", "x.toml"), "--map needs --model FILE"),
        (("--commands", "phases"), "--commands phases needs --model FILE"),
        (("--model", "x.xml", "--steps", "3"), "--steps does not go with --model; choose --phase-s"),
        (("--model", "x.xml", "--command", "1", "0", "0"), "--command does not go with --model; choose --phases"),
        (("--model", "x.xml", "--commands", "task"), "--commands task does not go with --model"),
        (("--model", "x.xml", "--phases", "hop=1"), "there is no phase 'hop'"),
        (("--model", "x.xml", "--phases", "turn=0"), "give a speed up to 20, such as turn=0.5"),
        (("--model", "x.xml", "--phases", "stop=1"), "a stop has no speed"),
        (("--model", "x.xml", "--phase-s", "nan"), "--phase-s nan must be from"),
        (("--model", "x.xml", "--rounds", "0"), "--rounds 0 must be from 1"),
        (("--model", "x.xml", "--robots", "spot,unitree_a1"), "--model is a model of one robot; name one"),
        (
            (
                "--model",
                "/nothing/x.xml",
            ),
            "--model /nothing/x.xml: No such file",
        ),
    ],
)
def test_flags_that_do_not_go_together_get_one_line(capsys, arguments, message):
    assert polypod.cli.main(["sim2sim", "--checkpoint", str(FLAT_POLICY), *arguments]) == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert errors.count("\n") == 1


# The command


def test_it_plays_ranks_and_writes(tmp_path, capsys, a1):
    """One changed item of the model is the only difference, in the table and in the file."""
    text = a1.replace('kp="', 'kp="').replace("<worldbody>", '<default><joint armature="0.02"/></default><worldbody>')
    file, figures = written(tmp_path, text, "unitree_a1.xml"), tmp_path / "figures.json"
    line = [
        "sim2sim",
        "--checkpoint",
        str(FLAT_POLICY),
        "--model",
        str(file),
        "--actuators",
        "policy",
        "--num-envs",
        "1",
    ]
    code = polypod.cli.main([*line, "--phases", "forward=0.6,stop", "--phase-s", "2.4", "--json", str(figures)])
    output, found = capsys.readouterr().out, json.loads(figures.read_text())
    assert code == (0 if found["transfers"] else 3)
    assert found["robot"] == "unitree_a1"
    assert [phase["phase"] for phase in found["on_model"]["phases"]] == ["forward 0.6", "stop"]
    ahead, stop = found["on_model"]["phases"]
    assert ahead["reached"] > 0.7
    assert ahead["falls"] == stop["falls"] == 0.0
    assert stop["reached"] is None
    assert stop["drift"] < 0.2
    assert found["polypod"]["phases"][0]["saturated"] is None
    assert 0.0 <= ahead["saturated"] < 0.5
    ranked = found["differences"]
    assert [entry["item"] for entry in ranked] == ["the model itself", "armature"]
    assert ranked[1]["theirs"] == "0.02 kg m^2"
    # taken over, it is all that there is
    assert ranked[1]["base"] == pytest.approx(ranked[0]["base"], rel=0.2, abs=2e-3)
    assert ranked[1]["joints"] > 0.01
    for words in ("12 joints by name", "forward 0.6", "armature", "the model itself"):
        assert words in output


def test_the_battery_runs_on_a_makers_model(tmp_path, a1):
    """Its conditions change the maker's model; contacts stay unless they are varied."""
    file = written(tmp_path, a1.replace('type="plane"', 'type="plane" condim="6"'))
    model = in_mujoco.MakersModel(file, None, Choices("policy"))
    loaded = policy.load(FLAT_POLICY)
    setting = in_polypod.Setting.of(loaded.manifest, ["unitree_a1"], given=(), seed=0, steps=5, threads=1)
    nominal = in_polypod.Nominal.of(setting, 1)
    battery, (body,) = in_mujoco.Mujoco(loaded, setting, 1, model), nominal.robots.values()
    by_name = {entry.name: entry for entry in robustness.CONDITIONS}

    def changed(name):
        return battery.twin(by_name[name], in_mujoco.AS_IS, body).reference

    usual = changed("nominal")
    assert (usual.model.geom_condim == 6).any()
    assert (changed("joint_damping_2.0").model.dof_damping[usual.v[6:]].ravel()[:12] == 2.0).all()
    assert (changed("friction_0.3").model.geom_friction[:, 0] == 0.3).all()
    heavier = changed("payload_plus_20").model.body(usual.root).mass / usual.model.body(usual.root).mass
    assert heavier == pytest.approx(1.2)
    options = robustness.Options(
        ("nominal", "torsional_friction_0.01", "torque"), ("mujoco",), mujoco_envs=1, steps=5, threads=1, model=model
    )
    found = robustness.measure(FLAT_POLICY, ["unitree_a1"], options)
    assert [(row.condition, row.simulator) for row in found.rows] == [
        ("nominal", "model"),
        ("torsional_friction_0.01", "model-4"),
        ("torque_minus_20", "model"),
    ]
    assert all(row.robots["unitree_a1"].fall_rate == 0.0 for row in found.rows)
    assert f"--model {file} --actuators policy --contact asis" in found.command


def test_names_that_geometry_contradicts_are_refused(tmp_path, a1):
    """The left legs have the names of the right ones."""
    swapped = a1
    for one, other in (("FL_", "@@"), ("FR_", "FL_"), ("@@", "FR_")):
        swapped = swapped.replace(f'joint name="{one}', f'joint name="{other}')
    assert swapped != a1
    text = edited(swapped, drop=("actuator",))
    with pytest.raises(polypod.ConfigError, match=r"do not lie where the robot's do; .*pair them in a --map FILE"):
        model_of(written(tmp_path, text))
