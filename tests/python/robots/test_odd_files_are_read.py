"""`polypod add` reads files that MuJoCo refuses or that hold what a robot does not need."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_add import HOME, fox
from test_new_robot import quadruped

from polypod import _core
from polypod import add as adding
from polypod.add import add, inertias, sources
from polypod.mujoco_model import robot as model_robot
from polypod.mujoco_model.reference import Reference

WAG = '<body pos="0 0 .1"><joint name="wag"/><geom size=".03" mass=".2"/></body>'


def test_a_body_on_hinges_about_two_points_moves_as_in_mujoco(tmp_path):
    """The links between the hinges weigh what the body lacks, where it does not move with them."""
    text = fox().replace('_haa" class="abduction"/>', '_haa" class="abduction" pos="0 0 0.1"/>')
    (tmp_path / "fox.xml").write_text(text.replace('armature="0.02"', 'armature="1e-4"'))
    added = add(str(tmp_path / "fox.xml"), tmp_path / "library")
    assert added.errors["float64"].worst() < 1e-8


def test_the_spring_of_a_free_joint_is_left_out_and_named(tmp_path):
    """A free joint gets one where its class states the stiffness of all joints."""
    (tmp_path / "fox.xml").write_text(fox().replace("<freejoint/>", '<joint type="free" stiffness="5" axis="0 0 1"/>'))
    added = add(str(tmp_path / "fox.xml"), tmp_path / "library")
    assert "the spring of the free joint, which holds the base in the air: left out" in added.notes
    assert added.errors["float64"].worst() < 1e-6


CRATE = '<body name="crate"><freejoint/><geom type="mesh" mesh="crate"/></body>'
LOST = {
    "a material": ({}, ('type="box" size="0.3', 'material="paint" type="box" size="0.3'), None),
    "a sensor's site": (
        {},
        ("<sensor>", '<sensor><touch name="nose" site="nowhere"/>'),
        "sensor nose: the file has no element of the name that it states: left out",
    ),
    "a mesh of another body": (
        {"world": CRATE, "key": f"{HOME} 1 1 1 1 0 0 0"},
        ("<worldbody>", '<asset><mesh name="crate" file="crate.stl"/></asset><worldbody>'),
        "mesh crate: its file is not there, and no part of the robot: left out",
    ),
}
"""Elements that a file names and lacks: parts of a fox, a change of its text, and the note."""


@pytest.mark.parametrize("what", LOST)
def test_what_no_robot_needs_may_be_missing(tmp_path, what):
    parts, (before, after), note = LOST[what]
    assert before in fox(**parts)
    (tmp_path / "fox.xml").write_text(fox(**parts).replace(before, after, 1))
    with pytest.raises(ValueError, match="Error"):
        mujoco.MjModel.from_xml_path(str(tmp_path / "fox.xml"))
    added = add(str(tmp_path / "fox.xml"), tmp_path / "library")
    assert note is None or note in added.notes, added.notes
    assert added.errors["float64"].worst() < 1e-6


def test_a_mesh_of_the_robot_may_not_be_missing(tmp_path):
    text = fox(trunk='<geom type="mesh" mesh="crate"/>')
    (tmp_path / "fox.xml").write_text(
        text.replace("<worldbody>", '<asset><mesh name="crate" file="crate.stl"/></asset><worldbody>', 1)
    )
    with pytest.raises(_core.ConfigError, match=r"mesh crate: .*crate\.stl is not there, and body trunk touches"):
        add(str(tmp_path / "fox.xml"), tmp_path / "library")


def test_a_robot_whose_scene_says_what_touches_names_the_scene(tmp_path):
    (tmp_path / "fox.xml").write_text(fox().replace('conaffinity="1"', 'conaffinity="0"'))
    (tmp_path / "scene.xml").write_text('<mujoco><include file="fox.xml"/></mujoco>')
    (tmp_path / "other.xml").write_text('<mujoco><include file="wolf.xml"/></mujoco>')
    assert [path.name for path in sources.including(tmp_path / "fox.xml")] == ["scene.xml"]
    with pytest.raises(_core.RobotError, match=r"no collision shape .*; scene\.xml includes this file and may say"):
        add(str(tmp_path / "fox.xml"), tmp_path / "library")


def test_legs_below_a_waist_are_told_how_to_hang_on_the_base():
    error = _core.RobotError("robot.urdf: <robot>: the legs are not one at each corner of the base: [waist -> hip]")
    read = adding._Found("apollo", "", {}, [], None, None, "")
    remedy = r"on the joints of a waist, lock these \(--lock JOINT=POSITION\)"
    named = adding._named_after(Path("robot.urdf"), Path("staged"), "apollo", read)
    with pytest.raises(_core.RobotError, match=remedy), named:
        raise error


def odd(urdf: str, count: int = 1) -> str:
    """A URDF whose first `count` links have moments that no body has, about turned axes."""
    return re.sub(
        r"<inertial>.*?</inertial>",
        '<inertial><origin xyz="0.01 0.02 0" rpy="0.3 0.2 0.1"/><mass value="1"/>'
        '<inertia ixx="0.002" iyy="0.003" izz="0.009" ixy="0.0001" ixz="0" iyz="0"/></inertial>',
        urdf,
        count=count,
        flags=re.DOTALL,
    )


def test_moments_that_no_body_has_are_compared_too(tmp_path):
    """MuJoCo refuses them; polypod warns. `accuracy` and `sim2sim` need MuJoCo's model as well."""
    text = odd(quadruped())
    (tmp_path / "dingo.urdf").write_text(text)
    spec = mujoco.MjSpec.from_string(text)
    spec.compiler.fusestatic = False
    with pytest.raises(ValueError, match=r"A \+ B >= C"):
        spec.compile()
    added = add(str(tmp_path / "dingo.urdf"), tmp_path / "library")
    assert any("violates the triangle inequality" in note for note in added.notes)
    assert not any("not compared" in note for note in added.notes)
    assert added.errors["float64"].worst() < 1e-6
    robot = model_robot.load(str(added.new.path))
    reference = Reference.of(robot, dt=0.005)
    moments = np.linalg.eigvalsh([[0.002, 0.0001, 0], [0.0001, 0.003, 0], [0, 0, 0.009]])
    bodies = np.asarray(reference.model.body_inertia)
    assert any(np.allclose(np.sort(each), moments) for each in bodies)


def test_inertias_that_mujoco_takes_stay_as_it_reads_them():
    text = re.sub(r'izz="0\.009"', 'izz="0.0045"', odd(quadruped()))
    spec, again = mujoco.MjSpec.from_string(text), mujoco.MjSpec.from_string(text)
    assert (inertias.compiled(spec).body_inertia == again.compile().body_inertia).all()


def test_rotors_that_are_left_out_are_named_with_the_remedy(tmp_path):
    """The rotor of a locked follower counts at the joint that drives it."""
    follows = '<equality><joint joint1="{}" joint2="{}" polycoef="0 {}"/></equality>'
    for name, ends in (("a", ("wag", "lf_hfe", 3)), ("b", ("lf_hfe", "wag", 0.5))):
        (tmp_path / "fox.xml").write_text(fox(trunk=WAG, key=HOME + " 0", more=follows.format(*ends)))
        added = add(str(tmp_path / "fox.xml"), tmp_path / name)
        share = 0.02 * (9 if name == "a" else 4)
        assert (
            f"armature of joint wag: left out, as it is locked: it is {share:.3g} at joint lf_hfe; add it to that "
            "joint's armature in the TOML"
        ) in added.notes
    rope = '<fixed name="rope" armature="0.04"><joint joint="lf_haa" coef="3"/><joint joint="lf_hfe" coef="1"/></fixed>'
    (tmp_path / "fox.xml").write_text(fox(more=f"<tendon>{rope}</tendon>"))
    added = add(str(tmp_path / "fox.xml"), tmp_path / "c")
    assert any("what couples its joints is left out; play the policy on the file" in note for note in added.notes)
