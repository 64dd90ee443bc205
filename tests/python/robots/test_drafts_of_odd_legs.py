"""Legs and files as makers publish them, beyond the usual: wheels, yawing hips, repeated lines."""

import re
from itertools import pairwise
from xml.etree import ElementTree

import pytest
import tomllib
from test_new_robot import joint, link, quadruped

from common import ROOT
from polypod import _core
from polypod.new_robot import new_robot

AXLE = '<cylinder radius="0.05" length="0.04"/>'


def wheeled(parents, at, ahead=0.0):
    """A wheel below each of these links, whose joint is revolute and has no position limits."""
    parts = ""
    for parent in parents:
        name = f"wheel_{parent}"
        wheel = link(name, 0.4, (0.1, 0.04, 0.1), at=(ahead, 0.0, 0.0), shape=AXLE)
        wheel = wheel.replace("<collision><origin xyz", '<collision><origin rpy="1.5707963 0 0" xyz')
        turns = joint(f"{name}_joint", parent, name, at, "0 1 0")
        parts += wheel + turns.replace('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><limit effort="2" velocity="100"/>')
    return parts


def biped():
    """A trunk on two legs without feet: each has a hip and a knee about y."""
    parts = [link("trunk", 3.0, (0.15, 0.2, 0.2))]
    for side, y in (("left", 0.15), ("right", -0.15)):
        limits = (-1.4, 1.4, 16.0, 28.0)
        parts += [
            link(f"{side}_thigh", 0.4, (0.04, 0.04, 0.17), at=(0.0, 0.0, -0.085)),
            link(f"{side}_shank", 0.3, (0.03, 0.03, 0.17), at=(0.0, 0.0, -0.085)),
            joint(f"{side}_hip", "trunk", f"{side}_thigh", (0.0, y, -0.1), "0 1 0", limits),
            joint(
                f"{side}_knee", f"{side}_thigh", f"{side}_shank", (0.0, 0.0, -0.17), "0 1 0", (-2.4, 2.4, 16.0, 28.0)
            ),
        ]
    return f'<robot name="wheels">{"".join(parts)}</robot>'


@pytest.mark.parametrize(("ahead", "is_wheel"), [(0.0, True), (0.04, False)])
def test_a_joint_without_limits_that_carries_a_body_about_its_axle_is_a_wheel(tmp_path, ahead, is_wheel):
    """Makers of wheels write `revolute` and no limits; a foot whose mass lies ahead is a foot."""
    file = tmp_path / "wheels.urdf"
    wheels = wheeled(("left_shank", "right_shank"), (0.0, 0.0, -0.17), ahead)
    file.write_text(biped().replace("</robot>", f"{wheels}</robot>"))
    draft = tomllib.loads(_core.draft_robot(file)["toml"])
    held = {"wheel_left_shank_joint", "wheel_right_shank_joint"}
    assert set(draft.get("locked_joints", {})) == (held if is_wheel else set())
    assert ("L_ANKLE_PITCH" in draft["joint_roles"]) is not is_wheel


def yawing(arms):
    """A body on four legs whose hips yaw before they pitch; they have ankles."""
    parts = [link("trunk", 30.0, (0.7, 0.3, 0.15))]
    limits = (-2.0, 2.0, 200.0, 9.0)
    for number, (x, y) in enumerate([(1, 1), (1, -1), (-1, 1), (-1, -1)]):
        chain = ["trunk", *(f"{part}{number}" for part in ("yaw", "thigh", "shank", "ankle"))]
        places = [(0.3 * x, 0.15 * y, -0.05), (0.0, 0.1 * y, -0.05), (0.0, 0.0, -0.3), (0.0, 0.0, -0.3)]
        axes = ["0 0 1", "0 1 0", "0 1 0", "0 1 0"]
        for (above, below), place, axis in zip(pairwise(chain), places, axes, strict=True):
            length = 0.3 if below.startswith(("thigh", "shank")) else 0.1
            shape = '<sphere radius="0.05"/>' if below == chain[-1] else None
            parts += [
                link(below, 1.5, (0.06, 0.06, length), at=(0.0, 0.0, -length / 2), shape=shape),
                joint(f"{below}_joint", above, below, place, axis, limits),
            ]
    if arms:
        for side, y in (("left", 0.2), ("right", -0.2)):
            chain = ["trunk", f"{side}_upper", f"{side}_lower"]
            for (above, below), place in zip(pairwise(chain), [(0.3, y, 0.3), (0.0, 0.0, -0.2)], strict=True):
                parts += [
                    link(below, 0.8, (0.05, 0.05, 0.2), at=(0.0, 0.0, -0.1)),
                    joint(f"{below}_joint", above, below, place, "0 1 0", (-2.0, 2.0, 50.0, 9.0)),
                ]
    return f'<robot name="yawing">{"".join(parts)}</robot>'


@pytest.mark.parametrize("arms", [False, True])
def test_four_legs_that_yaw_before_they_pitch_are_legs(tmp_path, arms):
    file = tmp_path / "yawing.urdf"
    file.write_text(yawing(arms))
    made = new_robot(file, tmp_path / "yawing.toml")
    assert made.kind == ("quadruped with an arm" if arms else "quadruped")
    assert made.standing.holds, made
    roles = tomllib.loads(made.path.read_text())["joint_roles"]
    assert (roles["LF_HIP_YAW"], roles["LF_HFE"], roles["RH_KFE"]) == ("yaw0_joint", "thigh0_joint", "shank3_joint")
    assert "LF_ANKLE_PITCH" in roles


def test_wheels_below_yawing_legs_are_held(tmp_path):
    file = tmp_path / "rover.urdf"
    ends = [f"ankle{number}" for number in range(4)]
    wheels = wheeled(ends, (0.0, 0.0, -0.12))
    file.write_text(yawing(arms=False).replace("</robot>", f"{wheels}</robot>"))
    made = new_robot(file, tmp_path / "rover.toml")
    assert made.standing.holds, made
    draft = tomllib.loads(made.path.read_text())
    assert set(draft["locked_joints"]) == {f"wheel_{end}_joint" for end in ends}
    assert set(draft["feet"].values()) == {f"wheel_{end}" for end in ends}


@pytest.mark.parametrize(
    "shape", ['<sphere radius="0"/>', '<cylinder radius="0.0" length="0.1"/>', '<box size="0.1 0 0.1"/>']
)
def test_shapes_of_no_size_are_left_out_with_a_note(tmp_path, shape):
    """Exporters write them for frames; they touch nothing."""
    file = tmp_path / "fox.urdf"
    frame = link("frame", 0.1, (0.02, 0.02, 0.02), shape=shape) + joint("fixed", "trunk", "frame", (0, 0, 0.1), None)
    file.write_text(quadruped().replace("</robot>", f"{frame}</robot>"))
    made = new_robot(file, tmp_path / "fox.toml")
    assert made.standing.holds
    (note,) = (note for note in made.notes if "of length 0" in note)
    assert note.startswith('link "frame", <collision>, <')
    assert "the shape is left out" in note


def test_lengths_below_zero_are_still_refused(tmp_path):
    file = tmp_path / "fox.urdf"
    file.write_text(quadruped().replace('<sphere radius="0.025"/>', '<sphere radius="-0.025"/>', 1))
    with pytest.raises(_core.RobotError, match=r"<sphere radius>: -0\.025 is no length of a robot"):
        _core.draft_robot(file)


@pytest.mark.parametrize(
    ("old", "twice"),
    [
        ('<axis xyz="1 0 0"/>', '<axis xyz="1 0 0"/><axis xyz="1 0 0"/>'),
        ('<mass value="', '<mass value="15.399999999999999"/><mass value="'),
        ('<parent link="trunk"/>', '<parent link="trunk"/><parent link="trunk"/>'),
    ],
)
def test_elements_that_say_the_same_twice_are_read_once(tmp_path, old, twice):
    once, both = tmp_path / "once.urdf", tmp_path / "twice.urdf"
    once.write_text(quadruped())
    assert old in quadruped()
    both.write_text(quadruped().replace(old, twice, 1))
    drafts = [_core.draft_robot(file, urdf="fox.urdf")["toml"] for file in (once, both)]
    assert drafts[0] == drafts[1]


def test_elements_that_say_two_things_are_refused(tmp_path):
    file = tmp_path / "fox.urdf"
    file.write_text(quadruped().replace('<axis xyz="1 0 0"/>', '<axis xyz="1 0 0"/><axis xyz="-1 0 0"/>', 1))
    with pytest.raises(_core.RobotError, match=r'joint "m01", <axis>: is there more than once; keep one'):
        _core.draft_robot(file)


def test_a_package_may_be_named_with_three_slashes(tmp_path):
    """`package:///NAME/mesh` names no empty package."""
    folder = tmp_path / "fox_description" / "urdf"
    folder.mkdir(parents=True)
    file = folder / "fox.urdf"
    mesh = '<mesh filename="package:///fox_description/meshes/head.obj"/>'
    head = link("head", 0.2, (0.1, 0.1, 0.1), shape=mesh) + joint("fixed", "trunk", "head", (0.3, 0, 0.1), None)
    file.write_text(quadruped().replace("</robot>", f"{head}</robot>"))
    (note,) = (note for note in _core.draft_robot(file)["notes"] if "is not found" in note)
    assert "--package-dir fox_description=FOLDER" in note
    (tmp_path / "fox_description" / "meshes").mkdir()
    text = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "fox_description" / "meshes" / "head.obj").write_text(text)
    assert not [note for note in _core.draft_robot(file)["notes"] if "is not found" in note]


@pytest.mark.parametrize("moment", [0.02, 0.05])
def test_boxes_of_raised_inertias_are_no_larger_than_a_robot_bears(tmp_path, moment):
    """Makers raise the moments of light links for their simulators; here the meshes are missing."""
    tree = ElementTree.fromstring(quadruped(thigh=0.26, shank=0.3))
    for number in range(4):
        for tag, name in (("joint", f"f{number}"), ("link", f"pad{number}")):
            tree.remove(tree.find(f'{tag}[@name="{name}"]'))
        shank = tree.find(f'link[@name="c{number}"]')
        shank.find("collision/geometry")[:] = [ElementTree.Element("mesh", {"filename": "shank.stl"})]
        shank.find("inertial/inertia").attrib |= dict.fromkeys(("ixx", "iyy", "izz"), str(moment))
    file = tmp_path / "raised.urdf"
    ElementTree.ElementTree(tree).write(file)
    made = new_robot(file, tmp_path / "raised.toml")
    assert made.standing.holds, made
    # 0.3 kg have the moments of a cube of 0.6 to 1 m; the centre of mass is 0.12 m from the knee
    sides = re.findall(r"\bc\d +on c\d: box of ([0-9.]+) x", _core.check(file, {}))
    assert [float(side) for side in sides] == pytest.approx([2.5 * 0.12] * 4, abs=1e-3)


@pytest.mark.parametrize("joints", [2, 4])
def test_a_neck_on_two_legs_is_no_arm(tmp_path, joints):
    """Walking birds have necks with as many joints as an arm, and no arms."""
    tree = ElementTree.parse(ROOT / "assets/robots/berkeley_humanoid/robot.urdf")
    parent, places = "torso", [(0.05, 0.0, 0.3), (0.0, 0.0, 0.1), (0.0, 0.0, 0.1), (0.05, 0.0, 0.0)]
    for number, (place, axis) in enumerate(zip(places[:joints], ("0 1 0", "0 1 0", "0 0 1", "1 0 0"), strict=False)):
        name = f"neck{number}"
        tree.getroot().append(ElementTree.fromstring(link(name, 0.2, (0.05, 0.05, 0.1), at=(0.0, 0.0, 0.05))))
        limits = (-0.5, 0.5, 3.0, 5.0)
        tree.getroot().append(ElementTree.fromstring(joint(f"{name}_joint", parent, name, place, axis, limits)))
        parent = name
    tree.write(tmp_path / "bird.urdf")
    draft = _core.draft_robot(tmp_path / "bird.urdf")
    roles = tomllib.loads(draft["toml"])["joint_roles"]
    assert draft["kind"] == "biped"
    assert sum(slot.startswith("HEAD_") for slot in roles) == joints
