"""`polypod adapt` drafts every file that `polypod add` takes."""

import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest
import tomllib
from test_add import fox
from test_new_robot import quadruped
from test_trainings_end_when_robots_walk import bad

import polypod
from common import ROOT
from polypod import adapt, simulated


def mjcf(file):
    file.write_text(fox())


def xacro(file):
    opening = '<robot xmlns:xacro="http://ros.org/wiki/xacro" name="fox"><xacro:property name="r" value="0.025"/>'
    text = quadruped().replace('<robot name="Test Fox">', opening).replace('radius="0.025"', 'radius="${r}"')
    file.write_text(text)


def with_bent_elbows(text):
    """The URDF with elbows that are always bent; the left one turns the other way round."""
    tree = ElementTree.fromstring(text)
    for name, low, high in (("left_elbow_joint", -2.0, -0.3), ("right_elbow_joint", 0.3, 2.0)):
        joint = next(joint for joint in tree.findall("joint") if joint.get("name") == name)
        joint.find("limit").set("lower", repr(low))
        joint.find("limit").set("upper", repr(high))
        if high < 0.0:
            axis = joint.find("axis")
            axis.set("xyz", " ".join(repr(-float(number)) for number in axis.get("xyz").split()))
    return ElementTree.tostring(tree, encoding="unicode")


def zipped(file):
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("fox/fox.urdf", quadruped())


@pytest.mark.parametrize(
    ("name", "write"),
    [("fox.xml", mjcf), ("unitree_go2.xml", mjcf), ("fox.urdf.xacro", xacro), ("FOX.ZIP", zipped)],
)
def test_a_file_is_drafted_next_to_the_run(tmp_path, name, write):
    pytest.importorskip("xacro" if write is xacro else "mujoco")
    write(tmp_path / name)
    (tmp_path / "run").mkdir()
    robot = adapt._draft(adapt.Options(str(tmp_path / name)), tmp_path / "run", adapt.Progress(), {})
    assert robot.startswith(str(tmp_path / "run" / "robot"))
    assert "LF_HAA" in tomllib.loads(Path(robot).read_text())["default_pose"]
    env = polypod.make("velocity_flat", 1, robots=[robot], seed=0)
    env.reset()
    env.close()


def test_joints_above_the_legs_are_held_where_they_stand(tmp_path):
    text = (ROOT / "assets" / "robots" / "unitree_g1" / "robot.urdf").read_text()
    (tmp_path / "run").mkdir()
    file = tmp_path / "g.urdf"
    file.write_text(with_bent_elbows(text))
    options = adapt.Options(str(file))
    above = adapt._above_legs_of_file(options)
    whole, legs = (adapt._draft(options, tmp_path / "run", adapt.Progress(), held) for held in ({}, above))
    assert above == adapt._above_legs(whole)
    infos = []
    for robot in (whole, legs):
        env = polypod.make("velocity_flat_legged", 1, robots=[robot], seed=0)
        infos.append(next(iter(simulated.robots(env.sim).values())))
        env.close()
    assert infos[0]["slot_signs"][infos[0]["slots"].index("L_ELBOW")] == -1.0
    assert len(infos[0]["slots"]) > 12
    assert all(slot.split("_", 1)[1].startswith(("HIP", "KNEE", "ANKLE")) for slot in infos[1]["slots"])
    held = tomllib.loads(Path(legs).read_text())["locked_joints"]
    for joint in infos[0]["joint_of_slot"]:
        name = infos[0]["joint_names"][joint]
        if name in held:
            assert held[name] == pytest.approx(infos[0]["default_pose"][joint], abs=1e-6)
    assert held["left_elbow_joint"] <= -0.3
    assert held["right_elbow_joint"] >= 0.3


@pytest.mark.parametrize(("from_scratch", "moved"), [(False, 29), (True, 12)])
def test_many_joints_are_held_sooner_from_scratch(tmp_path, monkeypatch, from_scratch, moved):
    """A file of 29 joints: a network that begins with a pretrained one moves them all."""
    file = tmp_path / "g.urdf"
    file.write_text((ROOT / "assets" / "robots" / "unitree_g1" / "robot.urdf").read_text())
    (tmp_path / "run").mkdir()
    monkeypatch.setattr(adapt, "_measured", lambda checkpoint, robots, *rest: {"g": bad(0.4)})
    options = adapt.Options(str(file), separate="always", from_scratch=from_scratch, device="cpu")
    start = adapt._start(options, tmp_path / "run", adapt.Progress())
    assert len(adapt._robot_of(start.robot)["slots"]) == moved


def test_a_config_has_no_joints_to_hold(cli):
    done = cli("adapt", "unitree_g1", "--legs-alone", "always")
    assert done.returncode == 2
    assert "--legs-alone is of a URDF" in done.stderr


@pytest.mark.parametrize("name", ["nothing.xml", "nothing.urdf.xacro", "nothing.zip"])
def test_a_file_that_is_not_there_is_named(cli, tmp_path, name):
    done = cli("adapt", name, "--device", "cpu", "--threads", "1", "--max-minutes", "1")
    assert done.returncode == 2
    assert f"{name}: there is no such file" in done.stderr
    assert not list(tmp_path.glob("logs/rsl_rl/adapt/*"))
