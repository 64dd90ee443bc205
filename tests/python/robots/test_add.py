"""`polypod add` makes robots of MJCF, URDF, xacro and zip files, and executes nothing of them."""

import dataclasses
import json
import os
import re
import sys
import zipfile
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import tomllib
from test_new_robot import quadruped

import polypod
from polypod import _core, rotations
from polypod.add import add, archive, compiling, ellipsoid, judge, mjcf, xacro_child
from polypod.add.description import urdf
from polypod.runs import run_dir
from watched import nothing_started

KNEE = 0.15
"""`ref` of the fox's knees, rad."""


def leg(name: str, x: int, y: int) -> str:
    """A leg with a foot and a hip of two joints in one body.

    The second joint lies off the body's origin.
    """
    return f"""
    <frame pos="{0.25 * x} {0.1 * y} 0">
      <body name="{name}_hip">
        <joint name="{name}_haa" class="abduction"/>
        <joint name="{name}_hfe" pos="0 {0.05 * y} 0" class="flexion"/>
        <frame pos="0 {0.05 * y} 0"><geom class="thigh"/></frame>
        <body name="{name}_shank" pos="0 {0.05 * y} -0.24">
          <joint name="{name}_kfe" class="knee"/>
          <geom class="shank"/>
          <geom class="foot" name="{name}_foot"/>
          <geom class="shown"/>
        </body>
      </body>
    </frame>"""


CORNERS = (("lf", 1, 1), ("rf", 1, -1), ("lh", -1, 1), ("rh", -1, -1))
HOME = " ".join(["0.0 0.8 -1.5"] * 2 + ["0.0 1.0 -1.5"] * 2)
DRIVES = "".join(
    f'<position joint="{name}_haa" class="servo"/><motor joint="{name}_hfe" class="motor"/>'
    f'<general joint="{name}_kfe" class="geared"/>'
    for name, _, _ in CORNERS
)


def fox(more: str = "", world: str = "", drives: str = DRIVES, key: str = HOME, trunk: str = "") -> str:
    """A quadruped in an MJCF file with defaults, classes, frames, gears and a keyframe."""
    return f"""<mujoco model="test fox scene">
  <compiler angle="radian" autolimits="true"/>
  <default>
    <joint axis="0 1 0" damping="0.3" armature="0.02" frictionloss="0.1"/>
    <geom contype="0" conaffinity="1"/>
    <default class="abduction"><joint axis="1 0 0" range="-0.9 0.9"/></default>
    <default class="flexion"><joint range="-1.5 2.5"/></default>
    <default class="knee"><joint range="-2.6 -0.3" ref="{KNEE}" armature="0.03"/></default>
    <default class="thigh"><geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.8"/></default>
    <default class="shank"><geom type="capsule" fromto="0 0 -0.03 0 0 -0.2" size="0.015" mass="0.3"/></default>
    <default class="foot"><geom type="sphere" pos="0 0 -0.24" size="0.025" mass="0.05" priority="1"/></default>
    <default class="shown"><geom type="box" size="0.01 0.02 0.03" conaffinity="0" mass="0.01"/></default>
    <default class="servo"><position kp="80" kv="1.5" forcerange="-40 40"/></default>
    <default class="motor"><motor gear="8" ctrlrange="-5 5"/></default>
    <default class="geared">
      <general gear="2" gainprm="30" biastype="affine" biasprm="0 -30 -0.5" forcerange="-30 30"/>
    </default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" contype="1" conaffinity="0"/>
    <body name="trunk" pos="0 0 0.5">
      <freejoint/>
      <geom type="box" size="0.3 0.12 0.07" mass="9" pos="0.01 0 0.02"/>
      <site name="imu_site" pos="0.1 0 0.05"/>
      {"".join(leg(*corner) for corner in CORNERS)}{trunk}
    </body>{world}
  </worldbody>
  <actuator>{drives}</actuator>
  <sensor><gyro site="imu_site"/></sensor>
  <keyframe><key name="other" qpos="0 0 0.5 1 0 0 0 {key}"/><key name="home" qpos="0 0 0.4 1 0 0 0 {key}"/></keyframe>
  {more}
</mujoco>"""


@pytest.fixture
def written(tmp_path):
    """Writes a fox and returns its file."""

    def write(name: str = "fox.xml", **parts: str) -> Path:
        file = tmp_path / name
        file.write_text(fox(**parts))
        return file

    return write


def test_an_mjcf_file_becomes_a_robot_that_trains(cli, tmp_path, written, monkeypatch):
    written()
    (tmp_path / "LICENSE").write_text("Do as you like.")
    done = cli("add", "fox.xml", "--out", "mine")
    assert done.returncode == 0, done.stderr
    assert "16 of 16 stand" in done.stdout
    assert "dynamics agree with MuJoCo's model of the file" in done.stdout
    assert "POLYPOD_PATH=mine polypod accuracy test_fox" in done.stdout
    assert "POLYPOD_PATH=mine polypod train --robots test_fox" in done.stdout
    assets = tmp_path / "mine/assets/robots/test_fox"
    assert (assets / "LICENSE").read_text() == "Do as you like."
    source = (assets / "SOURCE.md").read_text()
    assert "`fox.xml`" in source
    assert "| lf_kfe | -2.6 to -0.3 | 120 | 2 | 60 | 0.03 | 0.3 | 0.1 |" in source
    config = tomllib.loads((tmp_path / "mine/configs/robots/test_fox.toml").read_text())
    assert config["urdf"] == "assets/robots/test_fox/robot.urdf"
    assert config["feet"] == {leg.upper(): f"{leg}_shank_foot" for leg in ("lf", "lh", "rf", "rh")}
    assert {config["default_pose"][f"{leg}_HFE"] for leg in ("LF", "RF")} == {0.8}
    assert {config["default_pose"][f"{leg}_HFE"] for leg in ("LH", "RH")} == {1.0}
    groups = {joint: group for group in config["actuators"].values() for joint in group["joints"]}
    keys = ("stiffness", "damping", "effort_limit", "armature")
    assert [groups["LF_HAA"][key] for key in keys] == [80.0, 1.5, 40.0, 0.02]
    # gains of 30 at a gear of 2 turn the joint four times as hard
    assert [groups["LF_KFE"][key] for key in keys] == [120.0, 2.0, 60.0, 0.03]
    # a motor has an effort and no gains: those of the draft
    assert groups["LF_HFE"]["effort_limit"] == 40.0
    assert groups["LF_HFE"]["stiffness"] not in (80.0, 120.0)
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path / "mine"))
    quick = ("--num-envs", "32", "--max-iterations", "1", "--logger", "none", "--set", "sim.episode_length_s=0.4")
    done = cli("train", *quick, "--robots", "test_fox,spot")
    assert done.returncode == 0, done.stderr


def test_a_keyframe_in_which_a_robot_lies_is_no_default_pose(tmp_path, written):
    """Its joints hold it low above the ground: policies stand up from there first, if they do."""
    thigh, knee = 1.35, KNEE - 2.55
    file = written(key=" ".join([f"0 {thigh} {knee}"] * 4))
    added = add(str(file), tmp_path / "mine")
    (note,) = (note for note in added.notes if note.startswith("the keyframe home"))
    assert re.fullmatch(
        r"the keyframe home: its hips are 0\.1\d m high, and 0\.3\d m where it stands: replaced by a pose that it "
        "stands in",
        note,
    )
    assert added.new.standing.holds
    pose = tomllib.loads(added.new.path.read_text())["default_pose"]
    assert all(abs(pose[f"{leg}_HFE"]) < 1.1 for leg in ("LF", "LH", "RF", "RH"))


def test_added_robots_of_three_kinds_train_in_one_batch_with_robots_of_the_library(cli, tmp_path, written, monkeypatch):
    """A fox, gymnasium's ant and its humanoid, with three robots of the library.

    These are a quadruped, a humanoid and a hexapod.
    """
    files = Path(gymnasium.__file__).parent / "envs/mujoco/assets"
    for file in (written(), files / "ant.xml", files / "humanoid.xml"):
        add(str(file), tmp_path / "mine", name=f"my_{file.stem}")
    robots = ["my_fox", "my_ant", "my_humanoid", "spot", "unitree_h1", "phantomx"]
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path / "mine"))
    sizes = ("--num-envs", "24", "--max-iterations", "2", "--device", "cpu", "--set", "sim.episode_length_s=0.4")
    line = ("train", "--task", "velocity_flat_legged", "--robots", ",".join(robots), *sizes)
    done = cli(*line, "--logger", "none")
    assert done.returncode == 0, done.stderr
    (checkpoint,) = tmp_path.glob("logs/rsl_rl/*/*/model_2.pt")
    assert run_dir.read_manifest(checkpoint)["robots"] == robots
    curve = [float(reward) for reward in re.findall(r"iteration \d/2  reward (\S+)", done.stdout)]
    assert len(curve) == 2
    assert np.isfinite(curve).all()
    for robot in robots:
        # the evaluation at the end has a row of finite errors for each: all of them step
        (row,) = re.findall(rf"^{robot} +(\S+)", done.stdout, re.MULTILINE)
        assert np.isfinite(float(row))


def test_what_is_written_down_is_what_mujoco_compiled(tmp_path, written):
    """Compares with MuJoCo's numbers for body and joint, not with the comparison of `add`."""
    made, robot = mjcf.read(written())
    model = made.model
    file = tmp_path / "robot.urdf"
    file.write_text(urdf(robot))
    sim = polypod.Simulation(file, ground=None, dtype="float64", armature=[joint.armature for joint in robot.joints])
    assert sim.total_mass == pytest.approx(model.body_mass.sum(), rel=1e-14)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    for _ in range(5):
        angles = rng.uniform(sim.joint_range[:, 0], sim.joint_range[:, 1])
        data.qpos[:7] = [0.3, -0.2, 0.9, 0.8, 0.0, 0.6, 0.0]
        for name, angle in zip(sim.joint_names, angles, strict=True):
            data.qpos[model.joint(name).qposadr[0]] = angle
        data.qvel[:] = rng.uniform(-3.0, 3.0, model.nv)
        mujoco.mj_forward(model, data)
        order = [*range(6), *(model.joint(name).dofadr[0] for name in sim.joint_names)]
        sim.set_state([*data.qpos[:7], *angles], data.qvel[order])
        full = np.zeros((model.nv, model.nv))
        for column, unit in zip(full, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        matrix = full[np.ix_(order, order)]
        # each hip has a link of a milligram between its two joints, 5 cm from the body's place for
        # it
        np.testing.assert_allclose(sim.mass_matrix()[0], matrix, atol=1e-8)
        np.testing.assert_allclose(sim.bias_force()[0], data.qfrc_bias[order], atol=1e-6)
        links, positions = list(sim.link_names), sim.link_pose()[0][0]
        for leg_name, _, _ in CORNERS:
            shank = positions[links.index(f"{leg_name}_shank")]
            np.testing.assert_allclose(shank, data.body(f"{leg_name}_shank").xpos, atol=1e-12)
    # shapes: the ones that a floor touches, the foot on a separate link, and no more
    shapes = {link.name: [shape.kind for shape in link.shapes] for link in robot.links}
    assert shapes["trunk"] == ["box"]
    assert shapes["lf_shank"] == ["capsule"]
    assert shapes["lf_shank_foot"] == ["sphere"]
    assert "imu_site" in shapes
    assert robot.pose == "home"


def test_the_comparison_sees_a_wrong_robot(tmp_path, written):
    """Each figure that is compared, and the bound of each precision."""
    library = tmp_path / "mine"
    file = written()
    added = add(str(file), library)
    assert added.errors["float64"].worst() < judge.BOUNDS["float64"]
    assert added.errors["float32"].worst() < judge.BOUNDS["float32"]
    made, robot = mjcf.read(file)
    text = (library / "assets/robots/test_fox/robot.urdf").read_text()
    config = added.new.path

    def errors(before: str, after: str, where: Path) -> judge.Errors:
        whole = where.read_text()
        assert before in whole
        where.write_text(whole.replace(before, after))
        try:
            return judge.compare(config, robot, made.model, made.base)
        finally:
            where.write_text(whole)

    place = library / "assets/robots/test_fox/robot.urdf"
    mass = f'<mass value="{robot.links[0].mass!r}" />'
    assert mass in text
    wrong = errors(mass, f'<mass value="{robot.links[0].mass * 1.00001!r}" />', place)
    assert wrong.total_mass > 1e-6
    assert wrong.bias_force > 1e-6
    assert errors('lower="-2.6"', 'lower="-2.599"', place).joint_limits == pytest.approx(1e-3)
    assert errors('damping="0.3"', 'damping="0.31"', place).physics_step > 1e-6
    assert errors('friction="0.1"', 'friction="0.11"', place).physics_step > 1e-6
    assert errors("armature = 0.03", "armature = 0.0301", config).forward_dynamics > 1e-6
    assert errors('xyz="0.0 0.0 -0.24"', 'xyz="0.0 0.0 -0.2401"', place).mass_matrix > 1e-6


HELD = {
    "springs": (
        {
            "trunk": '<body pos="0 0 .1"><joint name="wag" stiffness="3"/><geom size=".03" mass=".2"/></body>',
            "key": HOME + " 0.2",
        },
        ["joint wag: no actuator acts on it: locked", "joint wag: a spring pulls it: left out, as it is locked"],
    ),
    "balls": (
        {
            "trunk": '<body pos="0 0 .1"><joint name="neck" type="ball"/><geom size=".03" mass=".2"/></body>',
            "key": HOME + " 1 0 0 0",
        },
        ["ball joint neck: locked"],
    ),
    "ties": (
        {
            "trunk": '<body pos="0 0 .1"><joint name="wag"/><geom size=".03" mass=".2"/></body>',
            "key": HOME + " 0",
            "more": '<equality><joint joint1="wag" joint2="lf_haa" polycoef="0.1 1"/></equality>',
        },
        ["joint wag: tied by an equality constraint: locked"],
    ),
    "loops": (
        {"more": '<equality><connect name="rod" body1="lf_shank" body2="rf_shank" anchor="0 0 0"/></equality>'},
        ["equality rod: closes a loop: left out"],
    ),
    "tendons": (
        {
            "drives": DRIVES.replace('<position joint="lf_haa" class="servo"/>', '<position tendon="pull" kp="9"/>'),
            "more": '<tendon><fixed name="pull"><joint joint="lf_haa" coef="1"/></fixed></tendon>',
        },
        ["acts on a tendon: replaced by a position actuator", "tendon pull: left out"],
    ),
    "muscles": (
        {
            "drives": DRIVES.replace(
                '<position joint="lf_haa" class="servo"/>', '<muscle name="biceps" joint="lf_haa" lengthrange="0.1 1"/>'
            )
        },
        ["actuator biceps: is no position, velocity or motor actuator: replaced", "activation state: left out"],
    ),
    "roots": (
        {"world": '<body name="crate"><freejoint/><geom size="0.1"/></body>', "key": HOME + " 1 1 1 1 0 0 0"},
        ["body crate: moves beside the robot: left out"],
    ),
    "ellipsoids": (
        {"trunk": '<geom name="egg" type="ellipsoid" size=".1 .05 .05" mass="0.1" pos="0 0 .1"/>'},
        ["geom egg: an ellipsoid: replaced by a convex hull of 32 points, which is at most 4 mm off"],
    ),
    "no actuators": ({"drives": ""}, ["the file has no actuators: replaced by position actuators"]),
    "the medium": ({"more": '<option density="1000"/>'}, ["the medium's density, viscosity and wind: left out"]),
}
"""Parts of a fox that polypod cannot hold, and what is said of them."""


@pytest.mark.parametrize("what", HELD)
def test_what_cannot_be_held_is_named(tmp_path, written, what):
    parts, notes = HELD[what]
    added = add(str(written(**parts)), tmp_path / "mine")
    for note in notes:
        assert any(note in each for each in added.notes), added.notes
        assert note in (tmp_path / "mine/assets/robots/test_fox/SOURCE.md").read_text()
    # and the rest is MuJoCo's to the bound
    assert added.errors["float64"].worst() < judge.BOUNDS["float64"]
    if what == "ties":
        locked = tomllib.loads(added.new.path.read_text())["locked_joints"]
        assert locked == {"wag": pytest.approx(0.1)}


SPRUNG = {
    '<joint axis="0 1 0" damping="0.3"': '<joint axis="0 1 0" damping="0.3" stiffness="7" springref="0.25"',
    'mass="0.05" priority="1"/>': 'mass="0.05" priority="1" condim="6" friction="1.2 .03 .01"/>',
    'size="0.02" mass="0.8"/>': 'size="0.02" mass="0.8" condim="4" friction="0.6 .02" margin=".003"/>',
    'type="plane" size="0 0 1"': 'type="plane" size="0 0 1" friction="0.7 .005 .1"',
}
"""Changes of a fox: springs, feet that decide alone, thighs that are mixed with the ground, the
ground."""


def test_springs_and_surfaces_are_those_of_the_file(tmp_path, written):
    file = written()
    text = file.read_text()
    for before, after in SPRUNG.items():
        assert before in text
        text = text.replace(before, after)
    file.write_text(text)
    added = add(str(file), tmp_path / "mine")
    assert added.errors["float64"].worst() < judge.BOUNDS["float64"]
    assert added.errors["float32"].worst() < judge.BOUNDS["float32"]
    assert not [note for note in added.notes if "spring" in note or "friction" in note]
    config = tomllib.loads(added.new.path.read_text())
    signs = polypod.make("velocity_flat_legged_play", 1, robots=[str(added.new.path)]).sim.robot_info()
    (info,) = json.loads(signs).values()
    slots = dict(zip(info["slots"], info["slot_signs"], strict=True))
    for group in config["actuators"].values():
        assert group["spring_stiffness"] == 7.0
        (reference,) = {slots[slot] * group["spring_reference"] for slot in group["joints"]}
        assert reference == 0.25
    feet, thighs = (
        next(each for each in config["surfaces"].values() if body in each["bodies"])
        for body in ("lf_shank_foot", "lf_hip")
    )
    assert {key: feet[key] for key in feet if key != "bodies"} == {
        "friction": 1.2,
        "torsional_friction": 0.03,
        "rolling_friction": 0.01,
    }
    # the larger of 0.6 and 0.7, of 0.02 and 0.005
    assert {key: thighs[key] for key in thighs if key != "bodies"} == {
        "friction": 0.7,
        "torsional_friction": 0.02,
        "contact_margin": 0.003,
    }
    # the others touch it as all robots do: the ground's rolling friction has no part in contacts of
    # condim 3
    assert len(config["surfaces"]) == 2


def test_the_comparison_sees_a_wrong_spring(tmp_path, written):
    file = written()
    file.write_text(file.read_text().replace('damping="0.3"', 'damping="0.3" stiffness="7" springref="0.25"'))
    added = add(str(file), tmp_path / "mine")
    made, robot = mjcf.read(file)
    text = added.new.path.read_text()
    for key, wrong in (("spring_stiffness = 7.0", "spring_stiffness = 7.01"), ("= 0.25 ", "= 0.2501 ")):
        assert key in text
        added.new.path.write_text(text.replace(key, wrong))
        assert judge.compare(added.new.path, robot, made.model, made.base).physics_step > 1e-6


def test_geoms_of_a_body_that_differ_in_friction_become_links(tmp_path, written):
    file = written(trunk='<geom name="belly" size=".04" mass="0.1" pos="0 0 -.07" friction="0.3" priority="1"/>')
    added = add(str(file), tmp_path / "mine")
    _, robot = mjcf.read(file)
    shapes = {link.name: [shape.kind for shape in link.shapes] for link in robot.links}
    assert (shapes["trunk"], shapes["trunk_surface"]) == (["box"], ["sphere"])
    surfaces = tomllib.loads(added.new.path.read_text())["surfaces"]
    assert surfaces == {"trunk_surface": {"bodies": ["trunk_surface"], "friction": 0.3}}
    assert added.errors["float64"].worst() < judge.BOUNDS["float64"]


def test_a_pair_of_an_mjcf_file_decides_how_its_geoms_touch(tmp_path, written):
    pairs = "".join(
        f'<pair geom1="floor" geom2="{name}_foot" condim="4" friction="0.4 0.4 0.02 0.1 0.1" margin="0.002"/>'
        for name, _, _ in CORNERS
    )
    added = add(str(written(more=f"<contact>{pairs}</contact>")), tmp_path / "mine")
    (feet,) = tomllib.loads(added.new.path.read_text())["surfaces"].values()
    assert feet == {
        "bodies": [f"{name}_shank_foot" for name, _, _ in CORNERS],
        "friction": 0.4,
        "torsional_friction": 0.02,
        "contact_margin": 0.002,
    }


def test_a_polyhedron_stands_for_an_ellipsoid_within_its_bound():
    size = np.array([0.3, 0.1, 0.05])
    corners, faces = ellipsoid.ball(size)
    assert (len(corners), len(faces)) == (ellipsoid.BALL_POINTS, 60)
    directions = np.random.default_rng(0).standard_normal((200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    exact = np.linalg.norm(directions * size, axis=1)
    share = (directions @ corners.T).max(axis=1) / exact - 1.0
    assert np.abs(share).max() < ellipsoid.BALL_ERROR < 1.05 * np.abs(share).max()
    assert ellipsoid.BALL_ERROR < 0.041
    # faces look outwards
    first, second, third = (corners[faces[:, corner]] for corner in range(3))
    assert (np.einsum("fk,fk->f", np.cross(second - first, third - first), first) > 0.0).all()


def test_limits_that_a_draft_narrows_are_no_difference(tmp_path):
    """Legs that the file lets turn freely.

    `add` would refuse a robot that differs from MuJoCo's model.
    """
    file = tmp_path / "fox.xml"
    file.write_text(fox().replace('"flexion"><joint range="-1.5 2.5"/>', '"flexion"><joint range="-3.3 3.3"/>'))
    added = add(str(file), tmp_path / "mine")
    assert set(tomllib.loads(added.new.path.read_text())["joint_limits"]) >= {"LF_HFE", "RH_HFE"}
    assert all(errors.joint_limits == 0.0 for errors in added.errors.values())


def test_a_file_may_leave_the_ground_of_its_pairs_to_a_scene(tmp_path, written):
    pairs = "".join(f'<pair geom1="{name}_foot" geom2="ground"/>' for name, _, _ in CORNERS)
    text = fox(more=f"<contact>{pairs}</contact>").replace('class="foot" name=', 'class="foot" conaffinity="0" name=')
    file = tmp_path / "fox.xml"
    file.write_text(text)
    made, robot = mjcf.read(file)
    assert "geom ground: in a <pair> and not in the file: replaced by a plane, the ground" in made.notes
    assert sum(shape.kind == "sphere" for link in robot.links for shape in link.shapes) == 4
    added = add(str(file), tmp_path / "mine")
    assert added.new.standing.holds


def test_height_fields_and_pictures_of_a_scene_may_be_missing(tmp_path, written):
    """Neither is read: the ground is the task's, and nobody looks."""
    assets = '<asset><hfield name="hills" file="hills.png" size="9 9 1 1"/><texture name="t" type="2d" file="t.png"/>'
    assets += '<material name="m" texture="t"/><mesh name="shell" file="shell.stl"/></asset>'
    shell = '<geom type="mesh" mesh="shell" material="m" contype="0" conaffinity="0"/>'
    inertial = '<inertial pos="0 0 0" mass="9" diaginertia=".1 .2 .2"/>'
    added = add(
        str(written(world='<geom type="hfield" hfield="hills"/>', trunk=shell + inertial, more=assets)),
        tmp_path / "mine",
    )
    assert any("height fields of the scene: left out" in note for note in added.notes)
    with pytest.raises(_core.ConfigError, match=r"mesh shell: .*shell\.stl is not there, and body trunk touches"):
        add(
            str(written(trunk=shell.replace('conaffinity="0"', 'conaffinity="1"') + inertial, more=assets)),
            tmp_path / "mine",
            name="b",
        )


def test_meshes_become_hulls(tmp_path, written):
    box = "".join(f"v {x} {y} {z}\n" for x in (-0.1, 0.1) for y in (-0.05, 0.05) for z in (0.0, 0.04))
    faces = ("1 2 4", "1 4 3", "5 8 6", "5 7 8", "1 6 2", "1 5 6", "3 4 8", "3 8 7", "1 3 7", "1 7 5", "2 6 8", "2 8 4")
    (tmp_path / "shell.obj").write_text(box + "".join(f"f {face}\n" for face in faces))
    parts = {
        "trunk": '<geom name="shell" type="mesh" mesh="shell" pos="0 0 0.1" mass="0.1"/>',
        "more": '<asset><mesh name="shell" file="shell.obj"/></asset>',
    }
    add(str(written(**parts)), tmp_path / "mine")
    (mesh,) = (tmp_path / "mine/assets/robots/test_fox/meshes").iterdir()
    assert mesh.read_text().count("\nv ") + 1 == 8
    env = polypod.make("velocity_flat", 1, robots=[str(tmp_path / "mine/configs/robots/test_fox.toml")])
    (shapes,) = json.loads(env.sim.robot_shapes()).values()
    (trunk,) = (body for body in shapes["bodies"] if body["name"] == "trunk")
    (hull,) = (shape for shape in trunk["shapes"] if "points" in shape)
    w, x, y, z = hull["quaternion"]
    turned = np.array(hull["points"]) @ compiling.matrix(np.array([w, x, y, z])).T + hull["position"]
    np.testing.assert_allclose(turned.min(axis=0), [-0.1, -0.05, 0.1], atol=1e-6)
    np.testing.assert_allclose(turned.max(axis=0), [0.1, 0.05, 0.14], atol=1e-6)


REFUSED = {
    "planar.xml": (
        "<mujoco><worldbody><body name='b'><joint name='x' type='slide' axis='1 0 0'/><geom size='1'/><body>"
        "<joint name='y'/><geom size='1'/></body></body></worldbody></mujoco>",
        "body b: its base moves on the joints x, and a robot's base floats",
    ),
    "twins.xml": (
        "<mujoco><worldbody>"
        + "".join(
            f"<body name='{name}'><freejoint/><geom size='1'/><body><joint/><geom size='1'/></body></body>"
            for name in "ab"
        )
        + "</worldbody></mujoco>",
        "2 bodies could be the robot, with 1 joints each: a, b; name one with --root",
    ),
    "crate.xml": (
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>",
        "no body has joints that turn or slide",
    ),
    "broken.xml": ("<mujoco><worldbody><body>", "MuJoCo does not compile it"),
    "arm.xml": (
        "<mujoco><worldbody><body><freejoint/><geom size='1'/><body><joint/><geom size='1'/></body></body>"
        "</worldbody></mujoco>",
        "legs were found instead of 2, 4 or 6",
    ),
    "page.xml": ("<html/>", "its root element is not <robot> or <mujoco>"),
    "entities.urdf": ('<!DOCTYPE robot [<!ENTITY a "b">]><robot name="&a;"/>', "it has a document type"),
    "cart.urdf": ('<robot name="cart"><link name="a"/></robot>', "cart.urdf"),
}
"""Files that are refused, and what the line says."""


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_legged_robot_is_refused_in_one_line(cli, tmp_path, name):
    text, problem = REFUSED[name]
    (tmp_path / name).write_text(text)
    done = cli("add", name, "--out", "mine")
    assert done.returncode == 2, done.stdout
    assert problem in done.stderr
    assert name in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.glob("mine/**/*"))


def test_a_root_may_be_named(tmp_path, written):
    tail = '<body name="tail"><freejoint/><geom size=".1"/>' + "".join(
        '<body><joint/><geom size=".1"/></body>' for _ in range(13)
    )
    file = written(world=tail + "</body>", key=HOME + " 3 3 3 1 0 0 0" + " 0" * 13)
    with pytest.raises(_core.PolypodError):
        add(str(file), tmp_path / "mine")
    assert add(str(file), tmp_path / "mine", root="trunk").new.standing.holds
    with pytest.raises(
        _core.ConfigError, match="--root nothing: no body of the scene has this name; there are: trunk, tail"
    ):
        add(str(file), tmp_path / "mine", root="nothing")


def test_a_robot_that_is_there_is_kept(cli, tmp_path, written):
    written()
    assert cli("add", "fox.xml", "--out", "mine").returncode == 0
    kept = tmp_path / "mine/configs/robots/test_fox.toml"
    kept.write_text("mine")
    done = cli("add", "fox.xml", "--out", "mine")
    assert done.returncode == 2
    assert "--force" in done.stderr
    assert kept.read_text() == "mine"
    assert cli("add", "fox.xml", "--out", "mine", "--force").returncode == 0
    assert kept.read_text() != "mine"
    done = cli("add", "fox.xml", "--out", "mine", "--name", "spot")
    assert done.returncode == 2
    assert "there is a robot `spot` already" in done.stderr
    done = cli("add", "fox.xml")
    assert done.returncode == 2
    assert "--out" in done.stderr


def test_a_urdf_is_copied_with_its_meshes(cli, tmp_path):
    """And its config is that of `robot new`."""
    mesh = '<mesh filename="package://fox/pad.obj"/>'
    text = (
        quadruped()
        .replace('<sphere radius="0.025"/>', mesh)
        .replace("</link>", f"<visual><geometry>{mesh}</geometry></visual></link>")
    )
    corners = [(x, y, z) for x in (-0.02, 0.02) for y in (-0.02, 0.02) for z in (-0.02, 0.02)]
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/pad.obj").write_text(vertices + "".join(f"f {i} {i} {i}\n" for i in range(1, 9)))
    (tmp_path / "robot.urdf").write_text(text)
    done = cli("add", "robot.urdf", "--out", "mine", "--package-dir", "fox=elsewhere")
    assert done.returncode == 0, done.stderr
    assert "visuals: left out" in done.stdout
    assert "dynamics agree with MuJoCo's model" in done.stdout
    (tmp_path / "elsewhere/pad.obj").unlink()
    assets = tmp_path / "mine/assets/robots/test_fox"
    assert "<visual" not in (assets / "robot.urdf").read_text()
    done = cli("check", str(assets / "robot.urdf"))
    assert "convex hull of 8 of its 8 vertices" in done.stdout
    assert cli("robot", "new", str(assets / "robot.urdf")).returncode == 0
    theirs = tomllib.loads((assets / "test_fox.toml").read_text())
    ours = tomllib.loads((tmp_path / "mine/configs/robots/test_fox.toml").read_text())
    assert {**ours, "urdf": ""} == {**theirs, "urdf": ""}


def test_a_folder_or_zip_file_has_one_robot_or_names_it(cli, tmp_path, written):
    written("kit/fox.xml".replace("kit/", ""))
    (tmp_path / "kit").mkdir()
    (tmp_path / "fox.xml").rename(tmp_path / "kit/fox.xml")
    (tmp_path / "kit/scene.xml").write_text('<mujoco><include file="fox.xml"/></mujoco>')
    done = cli("add", "kit", "--out", "mine")
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(tmp_path / "kit.zip", "w") as kit:
        kit.write(tmp_path / "kit/fox.xml", "a/fox.xml")
        kit.write(tmp_path / "kit/fox.xml", "a/wolf.xml")
    done = cli("add", "kit.zip", "--out", "mine", "--name", "zipped")
    assert done.returncode == 2
    assert "2 files could be the robot: a/fox.xml, a/wolf.xml; name one with --file" in done.stderr
    done = cli("add", "kit.zip", "--out", "mine", "--name", "zipped", "--file", "a/wolf.xml")
    assert done.returncode == 0, done.stderr


def test_zip_files_of_strangers_stay_within_bounds(tmp_path, monkeypatch):
    def made(fill) -> Path:
        with zipfile.ZipFile(tmp_path / "evil.zip", "w", zipfile.ZIP_DEFLATED) as evil:
            fill(evil)
        return tmp_path / "evil.zip"

    def refused(fill) -> str:
        folder = tmp_path / "inside"
        with pytest.raises(_core.ConfigError) as caught:
            archive.unpack(made(fill), folder)
        return str(caught.value)

    for name in ("../robot.urdf", "/robot.urdf", "a/../../robot.urdf", "C:robot.urdf", "a\\robot.urdf"):
        assert "leads out of the archive" in refused(lambda evil, name=name: evil.writestr(name, "x"))
    link = zipfile.ZipInfo("robot.urdf")
    link.external_attr = 0o120777 << 16
    assert "is a link" in refused(lambda evil: evil.writestr(link, "/etc/passwd"))
    monkeypatch.setattr(archive, "MOST_BYTES", 1 << 20)
    assert "take more than 1 MiB" in refused(lambda evil: evil.writestr("a", bytes(2 << 20)))
    assert (tmp_path / "inside/a").stat().st_size <= 1 << 20
    monkeypatch.setattr(archive, "MOST_FILES", 3)
    assert "it has 4 files" in refused(lambda evil: [evil.writestr(str(number), "x") for number in range(4)])
    assert not (tmp_path / "robot.urdf").exists()
    (tmp_path / "evil.zip").write_bytes(b"PK\x03\x04" + bytes(100))
    with pytest.raises(_core.ConfigError, match="no zip file that can be read"):
        archive.unpack(tmp_path / "evil.zip", tmp_path / "inside")


ESCAPES = (
    "(lambda: ().__class__.__base__.__subclasses__())()",
    "[each for each in (1,)]",
    "(x for x in ()).gi_frame",
    "'{0.__class__}'.format(1)",
    "f'{1}'",
    "open('/etc/passwd')",
    "__import__('os')",
    "table.__class__",
    "type(1)",
    "'a' * 99999999",
    "9 ** 9 ** 9",
    "2 ** 100000",
    "'%999999999d' % 1",
    "(lambda x: x)(1)",
    "sin.__self__",
)


@pytest.mark.parametrize("text", ESCAPES)
def test_expressions_of_a_xacro_file_only_compute(text):
    names = {"table": {"a": {"b": 2.0}}, "side": -1}
    functions = {"sin": np.sin, "max": max}
    assert xacro_child.evaluate("side * table.a.b + sin(0)", names.__getitem__, functions) == -2.0
    assert xacro_child.evaluate("max(1, 2) if side < 0 else table['a']", names.__getitem__, functions) == 2
    with nothing_started(), pytest.raises((xacro_child.RefusedError, NameError)):
        xacro_child.evaluate(text, names.__getitem__, functions)


def xacro_file(folder: Path, body: str) -> Path:
    folder.mkdir(exist_ok=True)
    file = folder / "fox.urdf.xacro"
    file.write_text(f'<robot name="x fox" xmlns:xacro="http://www.ros.org/wiki/xacro">{body}</robot>')
    return file


def test_a_xacro_file_is_expanded(cli, tmp_path):
    pytest.importorskip("xacro")
    inner = quadruped().removeprefix('<robot name="Test Fox">').removesuffix("</robot>")
    mass = 'mass value="15.399999999999999"'
    assert inner.count(mass) == 1
    inner = inner.replace(mass, 'mass value="${2*m}"')
    macro = f'<xacro:macro name="all" params="m">{inner}</xacro:macro>'
    (tmp_path / "kit").mkdir()
    (tmp_path / "kit/parts.xacro").write_text(f'<robot xmlns:xacro="http://www.ros.org/wiki/xacro">{macro}</robot>')
    begin = '<xacro:arg name="m" default="7.5"/><xacro:include filename="$(find kit)/parts.xacro"/>'
    xacro_file(tmp_path / "kit", begin + '<xacro:all m="$(arg m)"/>')
    done = cli("add", "kit/fox.urdf.xacro", "--out", "mine", "--xacro-arg", "m=7")
    assert done.returncode == 0, done.stderr
    assert '<mass value="14"' in (tmp_path / "mine/assets/robots/x_fox/robot.urdf").read_text()


@pytest.mark.parametrize(
    "body",
    [
        "<link name=\"${(lambda: [c for c in ().__class__.__base__.__subclasses__() if c.__name__ == '_wrap_close'][0]"
        ".__init__.__globals__['system']('touch PWNED'))()}\"/>",
        "<link name=\"$(eval ''.join([c for c in 'a']))\"/>",
        '<link name="$(env HOME)"/>',
        '<xacro:include filename="/etc/passwd"/>',
        "<link name=\"${xacro.load_yaml('/etc/hostname')}\"/>",
        '<xacro:macro name="m" params="n"><xacro:m n="${n+1}"/></xacro:macro><xacro:m n="0"/>',
    ],
)
def test_a_xacro_file_of_a_stranger_executes_nothing(cli, tmp_path, body):
    pytest.importorskip("xacro")
    xacro_file(tmp_path / "kit", body.replace("'touch PWNED'", f"'touch {tmp_path}/PWNED'"))
    done = cli("add", "kit", "--out", "mine")
    assert done.returncode == 2, done.stdout
    assert "xacro does not expand it" in done.stderr
    assert not (tmp_path / "PWNED").exists()
    assert not (tmp_path / "mine").exists()


def test_robots_of_other_packages(cli, tmp_path, written, monkeypatch):
    """Found by name; where the package is missing or cannot be reached, one line says so."""
    written()
    package = tmp_path / "packages/robot_descriptions"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "_descriptions.py").write_text(
        "class D:\n    license_spdx = 'MIT'\nDESCRIPTIONS = {'fox_mj_description': D}\n"
    )
    (package / "fox_mj_description.py").write_text(
        f"MJCF_PATH = {str(tmp_path / 'fox.xml')!r}\nPACKAGE_PATH = {str(tmp_path)!r}\n"
    )
    (package / "far_description.py").write_text("print('Cloning')\nraise OSError('no route to host')\n")
    for name in list(sys.modules):
        if name.partition(".")[0] in ("robot_descriptions", "mujoco_menagerie"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(str(tmp_path / "packages"))
    done = cli("add", "robot_descriptions:fox_mj", "--out", "mine")
    assert done.returncode == 0, done.stderr
    assert "MIT" in (tmp_path / "mine/assets/robots/test_fox/SOURCE.md").read_text()
    for source, problem in {
        "robot_descriptions:far": "downloads it on first use, and that fails: no route to host; connect to the network",
        "robot_descriptions:fxo": "has no robot of this name",
        "robot_descriptions:../x": "names no robot",
        "robot_descriptions:": "names no robot",
    }.items():
        done = cli("add", source, "--out", "other")
        assert (done.returncode, done.stdout) == (2, "")
        assert problem in done.stderr
        assert done.stderr.count("\n") == 1
    for name in [name for name in sys.modules if name.startswith("robot_descriptions")]:
        monkeypatch.delitem(sys.modules, name)


@pytest.mark.skipif(os.name == "nt", reason="links ask for rights there")
def test_a_failure_writes_nothing(tmp_path, written, monkeypatch):
    """A robot that does not move as MuJoCo's is refused, and the library stays as it was."""
    right = judge.compare

    def off(*arguments, **options):
        return dataclasses.replace(right(*arguments, **options), mass_matrix=1e-3)

    monkeypatch.setattr(judge, "compare", off)
    with pytest.raises(
        _core.ConfigError, match=r"mass_matrix: what is read of it differs from MuJoCo's model by 1\.0e-03"
    ):
        add(str(written()), tmp_path / "mine")
    assert not (tmp_path / "mine").exists()


def test_angles_survive_writing():
    rng = np.random.default_rng(0)
    for _ in range(200):
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        roll, pitch, yaw = rotations.angles(turn)
        np.testing.assert_allclose(_turn(roll, pitch, yaw), turn, atol=1e-14)
    for pitch in (np.pi / 2, -np.pi / 2):
        turn = _turn(0.3, pitch, -0.8)
        np.testing.assert_allclose(_turn(*rotations.angles(turn)), turn, atol=1e-9)


def _turn(roll: float, pitch: float, yaw: float) -> np.ndarray:
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(angle), np.sin(angle)) for angle in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


@pytest.mark.parametrize(
    ("name", "content"), [("r.usda", b"#usda 1.0\n"), ("r.usd", b"PXR-USDC\0"), ("r.usdz", b"PK\3\4")]
)
def test_a_usd_file_is_named_as_such(cli, tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    done = cli("add", name, "--name", "mine", "--out", "mine")
    assert done.returncode == 2
    assert "this is a USD file; export the robot as URDF or MJCF" in done.stderr
