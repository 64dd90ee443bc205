"""Robots whose URDF has another base frame than x forward and z up, or other units than metres."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import tomllib
from test_new_robot import quadruped

from common import ROOT
from polypod import VecSim, _core, base_frames, bodies, urdf_copies
from polypod.add import add, compiling, judge
from polypod.add import turned as upright_model
from polypod.new_robot import new_robot

LIBRARY = sorted((ROOT / "assets" / "robots").glob("*/robot.urdf"))
FRAMES = {
    "y forward, z up": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "x forward, y up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "z forward, y up": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "x forward, -z up": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "z forward, x up": ((0, 0, 1), (0, -1, 0), (1, 0, 0)),
    "y forward, -z up": ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
    "y forward, x up": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
}
"""Where the axes of the base forward, left and up point, in the columns."""


def turned(text: str, columns: tuple[tuple[int, ...], ...], aside: float = 0.0) -> str:
    """A URDF whose root has other axes, and a frame that lies to the left of the middle plane."""
    turn = np.array(columns, dtype=np.float64)
    robot = ElementTree.fromstring(text)
    children = {joint.find("child").get("link") for joint in robot.findall("joint")}
    (root,) = (link for link in robot.findall("link") if link.get("name") not in children)
    below = [joint for joint in robot.findall("joint") if joint.find("parent").get("link") == root.get("name")]
    for part in [*root, *below]:
        origin = part.find("origin")
        if origin is None:
            origin = ElementTree.SubElement(part, "origin")
        own, place = base_frames._pose(origin)
        origin.set("xyz", " ".join(map(str, turn @ (place - [0.0, aside, 0.0]))))
        origin.set("rpy", " ".join(map(str, base_frames._angles(turn @ own))))
    return ElementTree.tostring(robot, encoding="unicode")


def test_angles_are_those_of_the_pose():
    for angles in ((0.3, -0.5, 2.0), (1.0, np.pi / 2, 0.0), (-2.0, -np.pi / 2, 0.0), (np.pi / 2, 0.0, np.pi / 2)):
        origin = ElementTree.Element("origin", {"rpy": " ".join(map(str, angles))})
        turn, _ = base_frames._pose(origin)
        origin.set("rpy", " ".join(map(str, base_frames._angles(turn))))
        np.testing.assert_allclose(base_frames._pose(origin)[0], turn, atol=1e-12)


def test_drafts_of_files_of_one_name_keep_their_own_copies(tmp_path):
    """Many are called robot.urdf; the second draft took the first one's copy with `force`."""
    frame = next(iter(FRAMES.values()))
    texts = {"fox": quadruped(), "g1": (ROOT / "assets/robots/unitree_g1/robot.urdf").read_text()}
    for name, text in texts.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "robot.urdf").write_text(turned(text, frame))
        new_robot(tmp_path / name / "robot.urdf", tmp_path / f"{name}.toml", force=True)
    urdfs = [tomllib.loads((tmp_path / f"{name}.toml").read_text())["urdf"] for name in texts]
    assert urdfs == ["robot_upright.urdf", "g1_upright.urdf"]
    assert "fox" not in (tmp_path / "g1_upright.urdf").read_text()
    sim = VecSim("velocity_flat_any_legged", 2, robots=[str(tmp_path / f"{name}.toml") for name in texts], threads=1)
    assert len(sim.robots) == 2
    # again, and each keeps its own
    for name in texts:
        new_robot(tmp_path / name / "robot.urdf", tmp_path / f"{name}.toml", force=True)
    assert urdfs == [tomllib.loads((tmp_path / f"{name}.toml").read_text())["urdf"] for name in texts]


@pytest.mark.parametrize("robot", ["fox", "unitree_g1", "booster_t1"])
@pytest.mark.parametrize("frame", FRAMES)
def test_a_turned_base_frame_is_put_upright(tmp_path, frame, robot):
    """The draft is that of the file with x forward and z up."""
    text = quadruped() if robot == "fox" else (ROOT / f"assets/robots/{robot}/robot.urdf").read_text()
    known = tmp_path / "known.urdf"
    known.write_text(text)
    right = tomllib.loads(new_robot(known, tmp_path / "known.toml").path.read_text())
    other = tmp_path / "other.urdf"
    other.write_text(turned(text, FRAMES[frame]))
    made = new_robot(other, tmp_path / "other.toml")
    config = tomllib.loads(made.path.read_text())
    assert config["urdf"] == "other_upright.urdf"
    assert config["joint_roles"] == right["joint_roles"]
    assert config["feet"] == right["feet"]
    assert config["default_pose"] == pytest.approx(right["default_pose"], abs=2e-3)
    forward, up = frame[0], frame.split()[2]
    (note,) = (note for note in made.notes if "let its frame have x forward and z up" in note)
    assert f"so {up} is taken for up and {forward} for forward" in note
    assert not [note for note in made.notes if base_frames.ROOT in note]


@pytest.mark.parametrize("rpy", ["0 0 0", "3.14159265358979 0 0"])
@pytest.mark.parametrize("frame", ["x forward, -z up", "z forward, x up"])
def test_a_turned_body_below_an_empty_root_is_put_upright(tmp_path, frame, rpy):
    """The root may be turned against the body; the body's frame is the base's."""
    known = tmp_path / "known.urdf"
    known.write_text(quadruped())
    right = tomllib.loads(new_robot(known, tmp_path / "known.toml").path.read_text())
    root = (
        f'<link name="origin"/><joint name="at" type="fixed"><origin xyz="0 0 0.1" rpy="{rpy}"/>'
        '<parent link="origin"/><child link="trunk"/></joint></robot>'
    )
    text = turned(quadruped(), FRAMES[frame])
    assert '<link name="trunk">' in text
    other = tmp_path / "other.urdf"
    other.write_text(text.replace("</robot>", root))
    made = new_robot(other, tmp_path / "other.toml")
    config = tomllib.loads(made.path.read_text())
    assert config["joint_roles"] == right["joint_roles"]
    assert config["default_pose"] == pytest.approx(right["default_pose"], abs=2e-3)
    assert made.standing.holds


@pytest.mark.parametrize("aside", [0.0, 0.05])
@pytest.mark.parametrize("robot", ["fox", "unitree_g1"])
@pytest.mark.parametrize("frame", ["y forward, z up", "x forward, -z up", "z forward, x up"])
def test_a_turned_robot_is_added_upright(tmp_path, frame, robot, aside):
    """`polypod add` writes the upright file into the library, and MuJoCo agrees with it."""
    text = quadruped() if robot == "fox" else (ROOT / f"assets/robots/{robot}/robot.urdf").read_text()
    known, other = tmp_path / "known.urdf", tmp_path / "other.urdf"
    known.write_text(text)
    other.write_text(turned(text, FRAMES[frame], aside))
    right = tomllib.loads(new_robot(known, tmp_path / "known.toml").path.read_text())
    added = add(str(other), tmp_path / "library", name="other")
    config = tomllib.loads(added.new.path.read_text())
    assert config["urdf"] == "assets/robots/other/robot.urdf"
    assert config["joint_roles"] == right["joint_roles"]
    assert config["default_pose"] == pytest.approx(right["default_pose"], abs=2e-3)
    (note,) = (note for note in added.notes if "let its frame have x forward and z up" in note)
    assert f"so {frame.split()[2]} is taken for up" in note
    assert len([note for note in added.notes if "of the middle plane" in note]) == (aside > 0.0)
    assert added.errors
    for dtype, errors in added.errors.items():
        assert errors.worst() <= judge.BOUNDS[dtype]


@pytest.mark.parametrize("robot", ["fox", "unitree_g1"])
@pytest.mark.parametrize("frame", ["y forward, z up", "x forward, -z up", "z forward, x up", "x forward, y up"])
def test_a_turned_mjcf_robot_is_added_upright(tmp_path, frame, robot):
    """Its base gets another frame, and its keyframe stands as it stood."""
    mujoco = pytest.importorskip("mujoco")
    text = quadruped() if robot == "fox" else (ROOT / f"assets/robots/{robot}/robot.urdf").read_text()
    turn = np.array(FRAMES[frame], dtype=np.float64)
    right, other = tmp_path / "right.xml", tmp_path / "other.xml"
    for file, urdf, upright in ((right, text, np.eye(3)), (other, turned(text, FRAMES[frame]), turn.T)):
        options = '<mujoco><compiler fusestatic="false" discardvisual="true"/></mujoco></robot>'
        plain = re.sub("<mujoco>.*?</mujoco>", "", urdf, flags=re.DOTALL)
        spec = mujoco.MjSpec.from_string(plain.replace("</robot>", options))
        (base,) = list(spec.worldbody.bodies)[:1]
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, upright.flatten())
        base.quat = quaternion
        base.add_freejoint()
        size = spec.compile().nq
        spec.add_key(name="home", qpos=[0.0, 0.0, 1.0, *quaternion, *np.zeros(size - 7)])
        file.write_text(spec.to_xml(), encoding="utf-8")
    known, added = (add(str(file), tmp_path / file.stem, name=file.stem) for file in (right, other))
    made, wanted = (tomllib.loads(each.new.path.read_text()) for each in (added, known))
    assert made["joint_roles"] == wanted["joint_roles"]
    assert made["feet"] == wanted["feet"]
    assert made["default_pose"] == pytest.approx(wanted["default_pose"], abs=2e-3)
    assert added.new.pose_holds == known.new.pose_holds
    (note,) = (note for note in added.notes if "let its frame have x forward and z up" in note)
    assert f"so {frame.split()[2]} is taken for up" in note
    assert not [note for note in known.notes if "let its frame" in note]
    assert added.errors
    for dtype, errors in added.errors.items():
        assert errors.worst() <= judge.BOUNDS[dtype]


FRAMED = """<mujoco><worldbody><body name="base" pos="0 0 1" euler="10 20 30"><freejoint/>{inertial}
  <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0.1"/>
  <frame euler="0 0 30"><geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0"/><frame pos="0 0.1 0">
    <site name="in_two" zaxis="1 1 0"/><body name="a" pos="0.2 0 0"><joint axis="0 1 0"/><geom size="0.1"/></body>
  </frame></frame>
  <body name="b" pos="0.3 0 0" euler="10 20 30"><joint axis="1 0 0"/><geom size="0.1" pos="0 0 0.2"/></body>
</body></worldbody>
<keyframe><key name="home" qpos="0.1 0.2 1 0.5 0.5 -0.5 0.5 0.3 -0.4" qvel="1 2 3 0.1 0.2 0.3 4 5"/></keyframe>
</mujoco>"""


@pytest.mark.parametrize(
    "inertial",
    [
        "",
        '<inertial pos="0.1 0 0" mass="2" fullinertia="0.1 0.2 0.25 0.01 0.02 0"/>',
        '<inertial pos="0.1 0 0" euler="5 6 7" mass="2" diaginertia="0.1 0.2 0.25"/>',
    ],
)
@pytest.mark.parametrize("frame", FRAMES)
def test_a_turned_model_is_the_same_robot(tmp_path, frame, inertial):
    """All ways to write a place: what is where, and how heavy, stays."""
    mujoco = pytest.importorskip("mujoco")
    file = tmp_path / "framed.xml"
    file.write_text(FRAMED.format(inertial=inertial))
    axes = np.array(FRAMES[frame], dtype=np.float64)
    found = []
    for made in (compiling.compiled(file), upright_model.turned(compiling.compiled(file), axes)):
        made.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
        data = mujoco.MjData(made.model)
        mujoco.mj_resetDataKeyframe(made.model, data, 0)
        mujoco.mj_forward(made.model, data)
        found.append(data)
    one, other = found
    np.testing.assert_allclose(one.geom_xpos, other.geom_xpos, atol=1e-12)
    np.testing.assert_allclose(one.geom_xmat, other.geom_xmat, atol=1e-12)
    np.testing.assert_allclose(one.site_xmat, other.site_xmat, atol=1e-12)
    np.testing.assert_allclose(one.xipos, other.xipos, atol=1e-12)
    np.testing.assert_allclose(one.energy, other.energy, rtol=1e-12)
    np.testing.assert_allclose(one.xmat[1].reshape(3, 3) @ axes, other.xmat[1].reshape(3, 3), atol=1e-12)


@pytest.mark.parametrize("robot", ["fox", "unitree_go2", "unitree_g1"])
@pytest.mark.parametrize("frame", ["x forward, z up", "x forward, y up"])
def test_a_base_frame_beside_the_middle_plane_is_moved(tmp_path, frame, robot):
    """Five centimetres: a waist in that frame is no shoulder."""
    text = quadruped() if robot == "fox" else (ROOT / f"assets/robots/{robot}/robot.urdf").read_text()
    known = tmp_path / "known.urdf"
    known.write_text(text)
    right = tomllib.loads(new_robot(known, tmp_path / "known.toml").path.read_text())
    other = tmp_path / "other.urdf"
    columns = FRAMES.get(frame, ((1, 0, 0), (0, 1, 0), (0, 0, 1)))
    other.write_text(turned(text, columns, aside=0.05))
    made = new_robot(other, tmp_path / "other.toml")
    config = tomllib.loads(made.path.read_text())
    assert config["urdf"] == ("other_upright_centred.urdf" if frame in FRAMES else "other_centred.urdf")
    assert config["joint_roles"] == right["joint_roles"]
    assert config["default_pose"] == pytest.approx(right["default_pose"], abs=2e-3)
    assert [note for note in made.notes if "its frame lies 0.050 m to the left of the middle plane" in note]


@pytest.mark.parametrize("urdf", LIBRARY, ids=lambda urdf: urdf.parent.name)
def test_robots_of_the_library_stay_as_they_are(urdf, tmp_path):
    robot = ElementTree.fromstring(urdf.read_text())
    base_frames.check_units(urdf, robot)
    assert base_frames.turn_upright(robot) is None
    assert base_frames.put_in_the_middle(robot) is None
    if base_frames.put_upright(robot) is not None:
        # six legs that point away all around: the reader sees no better fit in the other frame
        other = tmp_path / "other.urdf"
        other.write_text(ElementTree.tostring(robot, encoding="unicode"))
        notes = _core.draft_robot(other, name="other", urdf="other.urdf")["notes"]
        assert not [note for note in notes if base_frames.is_taken(note)]


@pytest.mark.parametrize("key", [None, "assets/fox.urdf"])
def test_millimetres_are_no_metres(tmp_path, key):
    robot = ElementTree.fromstring(quadruped())
    for element in robot.iter():
        for name in ("xyz", "size", "radius"):
            if element.tag != "axis" and name in element.attrib:
                element.set(name, " ".join(str(1000.0 * float(number)) for number in element.get(name).split()))
    urdf = tmp_path / "fox.urdf"
    urdf.write_text(ElementTree.tostring(robot, encoding="unicode"))
    with pytest.raises(_core.RobotError, match=r'fox\.urdf: joint "m01": it lies 260 m from the root link.*metres'):
        new_robot(urdf, tmp_path / "fox.toml", urdf_key=key)
    assert [path.name for path in tmp_path.iterdir()] == ["fox.urdf"]


def test_a_number_that_is_none_is_named_by_the_reader(tmp_path):
    urdf = tmp_path / "fox.urdf"
    urdf.write_text(quadruped().replace('<axis xyz="0 1 0"/>', '<axis xyz="0 one 0"/>', 1))
    with pytest.raises(_core.RobotError, match=r"0 one 0|axis"):
        new_robot(urdf, tmp_path / "fox.toml")


@pytest.mark.parametrize("number", ["nan", "1e308"])
def test_a_place_that_is_nowhere_is_named_by_the_reader(tmp_path, number):
    urdf = tmp_path / "fox.urdf"
    text = quadruped().replace('<origin xyz="0.24', f'<origin xyz="{number}', 1)
    assert text != quadruped()
    urdf.write_text(text)
    with pytest.raises(_core.RobotError):
        new_robot(urdf, tmp_path / "fox.toml")


def test_a_deep_tree_is_left_to_the_reader(tmp_path):
    urdf = tmp_path / "deep.urdf"
    urdf.write_text('<robot name="deep">' + "<a>" * 20_000 + "</a>" * 20_000 + "</robot>")
    assert urdf_copies.read(urdf) is None
    with pytest.raises(_core.RobotError):
        new_robot(urdf, tmp_path / "deep.toml")


def test_a_tree_in_a_circle_is_left_to_the_reader():
    robot = ElementTree.fromstring(
        '<robot name="ring"><link name="a"/><link name="b"/><joint name="j" type="revolute"><parent link="a"/>'
        '<child link="b"/></joint><joint name="k" type="revolute"><parent link="b"/><child link="a"/></joint></robot>'
    )
    assert base_frames.put_upright(robot) is None
    base_frames.check_units(Path("ring.urdf"), robot)


def hexapod(kind):
    """A URDF on six legs: the library's, or one that is drawn."""
    if kind == "phantomx":
        return (ROOT / "assets/robots/phantomx/robot.urdf").read_text()
    return bodies.urdf(bodies.draw("hexapod", "body", np.random.default_rng(7)))


@pytest.mark.parametrize("kind", ["phantomx", "drawn"])
@pytest.mark.parametrize("forward", ["y", "-y"])
def test_six_legs_around_a_body_tell_which_way_is_forward(tmp_path, kind, forward):
    """Their joints turn about all horizontal axes; the middle legs point to the sides."""
    known = tmp_path / "known.urdf"
    known.write_text(hexapod(kind))
    right = tomllib.loads(new_robot(known, tmp_path / "known.toml").path.read_text())
    robot = ElementTree.fromstring(hexapod(kind))
    sign = 1.0 if forward == "y" else -1.0
    turn = np.array([[0.0, sign, 0.0], [-sign, 0.0, 0.0], [0.0, 0.0, 1.0]])
    base_frames._turn(robot, base_frames._base(robot), turn)
    other = tmp_path / "other.urdf"
    other.write_text(ElementTree.tostring(robot, encoding="unicode"))
    with pytest.raises(_core.RobotError, match="not as many legs on the left as on the right"):
        _core.draft_robot(other)
    made = new_robot(other, tmp_path / "other.toml")
    config = tomllib.loads(made.path.read_text())
    assert made.kind == "hexapod"
    assert made.standing.holds
    assert config["urdf"] == "other_upright.urdf"
    assert [note for note in made.notes if "the middle ones of its six legs point along x" in note]
    if forward == "y":
        assert config["joint_roles"] == right["joint_roles"]
        assert config["default_pose"] == pytest.approx(right["default_pose"], abs=2e-3)
