"""Unusual descriptions are read by `polypod add`, or it says what to do."""

import json
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from test_add import HOME, fox
from test_new_robot import quadruped

from polypod import _core
from polypod.add import add, judge, mjcf, sources, urdf

FREE = "0 0 {} 1 0 0 0 "


def bird() -> str:
    """A biped with linkages: a rod moves the shank, a crank and a rod move the foot."""
    bar = 'type="capsule" contype="0" conaffinity="0" size="0.01" mass="0.1"'

    def leg(name: str, y: float) -> str:
        return f"""
        <body name="{name}_hip" pos="0 {y} 0">
          <joint name="{name}_roll" axis="1 0 0"/><geom size="0.05" mass="1"/>
          <body name="{name}_thigh"><joint name="{name}_pitch"/><geom size="0.05" mass="3"/>
            <body name="{name}_rod"><joint name="{name}_rod" type="ball" range="0 60"/>
              <geom {bar} fromto="0 0 0 0 0 -0.4"/></body>
            <body name="{name}_shin" pos="0 0 -0.3"><joint name="{name}_knee"/><geom size="0.03" mass="1"/>
              <body name="{name}_shank" pos="0 0 -0.1"><joint name="{name}_tarsus"/><geom size="0.03" mass="1"/>
                <body name="{name}_crank"><joint name="{name}_crank"/><geom {bar} fromto="0 0 0 0.05 0 0"/>
                  <body name="{name}_bar" pos="0.05 0 0"><joint name="{name}_bar"/>
                    <geom {bar} fromto="0 0 0 0 0 -0.3"/></body></body>
                <body name="{name}_foot" pos="0 0 -0.3"><joint name="{name}_toe"/><geom size="0.03" mass="0.3"/></body>
              </body></body></body></body>"""

    sides = ("left", "right")
    driven = ("roll", "pitch", "knee", "crank")
    motors = "".join(f'<motor joint="{side}_{joint}"/>' for side in sides for joint in driven)
    loops = "".join(
        f'<connect name="{side}_achilles" body1="{side}_rod" body2="{side}_shank" anchor="0 0 -0.4"/>'
        f'<connect name="{side}_plantar" body1="{side}_bar" body2="{side}_foot" anchor="0 0 -0.3"/>'
        for side in sides
    )
    return f"""<mujoco model="bird"><default><joint axis="0 1 0" range="-60 60"/></default><worldbody>
      <body name="pelvis"><freejoint/><geom size="0.1" mass="9"/>{leg("left", 0.1)}{leg("right", -0.1)}</body>
    </worldbody><actuator>{motors}</actuator><equality>{loops}</equality></mujoco>"""


def test_joints_of_linkages_are_named(tmp_path: Path) -> None:
    """The loops of knees and ankles are left out; the joints that they move are held."""
    file = tmp_path / "bird.xml"
    file.write_text(bird())
    _, robot = mjcf.read(file)
    assert (
        "equality left_achilles, left_plantar, right_achilles, right_plantar: closes a loop: left out; joint "
        "left_tarsus, left_bar, left_toe, right_tarsus and 2 more, which it moves, does not follow it"
    ) in robot.notes
    assert set(robot.held) == {f"{side}_{joint}" for side in ("left", "right") for joint in ("tarsus", "bar", "toe")}
    assert any("ball joint left_rod, right_rod: locked" in note for note in robot.notes)


def test_a_base_without_a_free_joint_keeps_its_keyframes(tmp_path: Path) -> None:
    """A keyframe has a place for the base only where the base is free."""
    file = tmp_path / "fox.xml"
    crate = '<body name="crate" pos="3 0 1"><freejoint/><geom size="0.1"/></body>'
    text = fox(world="").replace("<freejoint/>", "")
    for height in ("0.5", "0.4"):
        text = text.replace(FREE.format(height), "3 0 1 1 0 0 0 ")
    file.write_text(text.replace('<body name="trunk"', f'{crate}<body name="trunk"'))
    made, robot = mjcf.read(file)
    assert robot.pose == "home"
    assert [joint.home for joint in robot.joints] == [float(angle) for angle in HOME.split()]
    assert made.model.key_qpos[1][:14].tolist() == [3, 0, 1, 1, 0, 0, 0, 0, 0, 0.5, 1, 0, 0, 0]
    added = add(str(file), tmp_path / "mine")
    assert added.new.standing.holds
    assert added.errors["float64"].worst() < judge.BOUNDS["float64"]


def test_a_keyframe_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "fox.xml"
    file.write_text(fox(key=HOME.replace("0.8", "nan")))
    with pytest.raises(_core.ConfigError, match=r"fox\.xml: key other: qpos has a number that is not finite"):
        mjcf.read(file)


def test_files_that_a_mac_hides_in_a_zip_file_are_no_robots(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "kit.zip", "w") as kit:
        kit.writestr("kit/fox.urdf", quadruped())
        kit.writestr("__MACOSX/kit/._fox.urdf", b"\0\5\x16\7\0\2\0\0Mac OS X")
        kit.writestr("kit/.fox.urdf", "<robot/>")
    with sources.opened(str(tmp_path / "kit.zip")) as found:
        assert (found.kind, found.file.name) == ("urdf", "fox.urdf")


def test_a_urdf_with_macros_is_expanded(tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    text = quadruped()
    mass = 'mass value="15.399999999999999"'
    assert mass in text
    macros = '<robot name="Test Fox" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:property name="m" value="7"/>'
    file = tmp_path / "robot.urdf"
    file.write_text(text.replace('<robot name="Test Fox">', macros).replace(mass, 'mass value="${2*m}"'))
    add(str(file), tmp_path / "mine")
    assert '<mass value="14"' in (tmp_path / "mine/assets/robots/test_fox/robot.urdf").read_text()


MESH = '<mesh filename="package://fox_description/meshes/pad.obj"/>'
PAD = "".join(f"v {x} {y} {z}\n" for x in (-0.02, 0.02) for y in (-0.02, 0.02) for z in (-0.02, 0.02)) + "".join(
    f"f {corner} {corner} {corner}\n" for corner in range(1, 9)
)


@pytest.fixture
def padded(tmp_path: Path) -> Path:
    """A URDF with feet of meshes, in a folder as GitHub names it."""
    folder = tmp_path / "fox_description-main"
    (folder / "urdf").mkdir(parents=True)
    file = folder / "urdf/robot.urdf"
    file.write_text(quadruped().replace('<sphere radius="0.025"/>', MESH))
    return file


def test_meshes_that_are_missing_are_named_with_their_package(padded: Path, tmp_path: Path) -> None:
    """Once, and in the error of a foot that has no shape without them."""
    lost = "collision mesh package://fox_description/meshes/pad.obj: not found: left out; name the package's folder"
    lost = f"{lost}: --package-dir fox_description=FOLDER"
    added = add(str(padded), tmp_path / "mine")
    assert [note for note in added.notes if "pad.obj" in note] == [lost]
    assert lost in (tmp_path / "mine/assets/robots/test_fox/SOURCE.md").read_text()
    text = padded.read_text()
    root = ElementTree.fromstring(text)
    for link in root.iter("link"):
        for collision in link.findall("collision"):
            if collision.find("geometry/mesh") is None:
                link.remove(collision)
            else:
                # a mass would give the foot the box of its inertia
                link.remove(link.find("inertial"))
    padded.write_text(ElementTree.tostring(root, encoding="unicode"))
    with pytest.raises(_core.PolypodError, match=r"no collision shape for a foot") as caught:
        add(str(padded), tmp_path / "other")
    assert str(caught.value).endswith(lost)


@pytest.mark.parametrize("known_by", ["package.xml", "the mesh"])
def test_the_folder_of_a_package_may_have_another_name(padded: Path, known_by: str) -> None:
    package = padded.parents[1]
    place = package
    if known_by == "package.xml":
        # a nested description, too far below for the mesh alone
        nested = package / "robots/fox/urdf/robot.urdf"
        nested.parent.mkdir(parents=True)
        padded = padded.rename(nested)
        (package / "package.xml").write_text("<package><name> fox_description </name></package>")
    (place / "meshes").mkdir()
    (place / "meshes/pad.obj").write_text(PAD)
    copy = urdf.copied(padded.read_text(), padded, {})
    assert copy.meshes == {"pad.obj": PAD.encode()}
    assert copy.missing is None
    # and as Windows writes it
    backward = padded.read_text().replace("package://fox_description/meshes/pad.obj", "..\\meshes\\pad.obj")
    if known_by == "the mesh":
        assert urdf.copied(backward, padded, {}).meshes == {"pad.obj": PAD.encode()}


def test_notes_name_the_first_joints_and_count_the_others(tmp_path: Path) -> None:
    """A line for each limit that a file lacks, and one for rotors without inertia."""
    file = tmp_path / "fox.xml"
    file.write_text(fox(drives="").replace('armature="0.02"', "").replace('armature="0.03"', ""))
    added = add(str(file), tmp_path / "mine")
    first = "joint lf_haa, lf_hfe, lf_kfe, rf_haa and 8 more"
    assert f"{first}: the file has no armature: the rotor has no inertia; write the motor's" in added.notes
    for limit in ("effort", "velocity"):
        (note,) = (note for note in added.notes if f"the file has no {limit} limit" in note)
        assert " and 8 more: " in note
        assert note.endswith("write the motor's")
    assert max(map(len, added.notes)) < 200
    assert json.dumps(added.notes).count("lf_haa") <= 3
    assert np.isfinite(added.new.standing.height)
