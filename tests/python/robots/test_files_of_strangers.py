"""`polypod add` ends any file in one line that names it, and reads nothing beyond an archive."""

import re
import tempfile
import warnings
import zipfile
from pathlib import Path

import pytest
from test_add import DRIVES, HOME, fox
from test_new_robot import quadruped

from polypod import _core
from polypod.add import add, child, compiling

MESH = '<asset><mesh name="m" file="{}"/></asset><worldbody><body><geom type="mesh" mesh="m"/></body></worldbody>'
WAG = '<body pos="0 0 .1"><joint name="wag"/><geom size=".03" mass=".2"/></body>'


def replaced(old: str, new: str) -> bytes:
    text = fox()
    assert old in text
    return text.replace(old, new).encode()


NUMBERS = {
    "a gear whose square overflows": (replaced('gear="8"', 'gear="1e200"'), "actuator 1 at joint lf_hfe: gear"),
    "an infinite gain": (replaced('kp="80"', 'kp="inf"'), "actuator 0 at joint lf_haa: gainprm"),
    "no gain": (replaced('kp="80"', 'kp="nan"'), "actuator 0 at joint lf_haa: gainprm"),
    "no limit of force": (replaced('"-40 40"', '"nan nan"'), "actuator 0 at joint lf_haa: forcerange"),
    "no range": (replaced('range="-1.5 2.5"', 'range="nan nan"'), "joint lf_hfe: range"),
    "no armature": (replaced('armature="0.02"', 'armature="nan"'), "joint lf_haa: armature"),
    "no keyframe": (replaced('qpos="0 0 0.4', 'qpos="nan 0 0.4'), "key home: qpos"),
    "no mass": (replaced('mass="9"', 'mass="nan"'), "a number in it is NaN, which MuJoCo takes as absent; write the"),
    "no friction": (replaced('priority="1"', 'priority="1" friction="nan 0 0"'), "geom lf_foot: friction"),
    "no gravity": (replaced("<worldbody>", '<option gravity="0 nan -9.81"/><worldbody>'), "<option>: gravity"),
    "names in Latin-1": (
        fox().replace("lf_haa", "lf_hä").encode("latin-1"),
        "not text in UTF-8; save the file in UTF-8",
    ),
}
"""Contents of MJCF files, and what is said of them."""


@pytest.mark.parametrize("what", NUMBERS)
def test_numbers_that_nothing_computes_with_are_named(tmp_path, capfd, monkeypatch, what):
    content, problem = NUMBERS[what]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fox.xml").write_bytes(content)
    with pytest.raises(_core.ConfigError) as caught:
        compiling.compiled(Path("fox.xml"))
    assert str(caught.value).startswith("fox.xml: ")
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)
    # MuJoCo itself would write a line, and a file into the user's folder
    assert capfd.readouterr() == ("", "")
    assert [file.name for file in tmp_path.iterdir()] == ["fox.xml"]


def test_files_at_which_mujoco_ends_or_hangs_are_refused(tmp_path, monkeypatch):
    """The first of them ends the process that compiles it, by a violation of memory."""
    itself = '<asset><model name="self" file="fox.xml"/></asset>'
    attached = '<attach model="self" body="trunk" prefix="z"/>'
    file = tmp_path / "fox.xml"
    file.write_text(fox(more=itself, trunk=attached))
    with pytest.raises(_core.ConfigError, match=r"fox\.xml: MuJoCo .*; correct"):
        add(str(file), tmp_path / "mine")
    bomb = '<replicate count="100000"><body><freejoint/><geom size="1"/></body></replicate>'
    file.write_text(fox(world=bomb, key=HOME))
    monkeypatch.setattr(compiling, "SECONDS", 3)
    with pytest.raises(_core.ConfigError, match=r"fox\.xml: MuJoCo takes more than (3 s of computing|30 s); correct"):
        add(str(file), tmp_path / "mine")
    assert not (tmp_path / "mine").exists()


def test_a_process_that_waits_for_others_has_its_time(tmp_path):
    """On a busy machine, too, a file takes as long as it computes."""
    script = tmp_path / "script.py"
    script.write_text("import time\ntime.sleep(1.5)\nprint('[1]')")
    assert child.ask(str(script), None, 1) == [1]
    script.write_text("import resource\nresource.setrlimit(resource.RLIMIT_CPU, (1, 9))\nwhile True:\n    pass")
    with pytest.raises(child.UnansweredError, match=r"takes more than (1 s of computing|10 s)"):
        child.ask(str(script), None, 1)
    script.write_text("raise SystemExit(3)")
    with pytest.raises(child.UnansweredError, match=r"ends at it \(exit code 3\)"):
        child.ask(str(script), None, 1)


def test_the_guard_says_what_the_reader_says_of_the_users_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for file in (Path("fox.xml"), Path("a/fox.xml"), tmp_path / "fox.xml"):
        file.parent.mkdir(exist_ok=True)
        asset = '<asset><mesh name="m" file="gone.stl"/></asset>'
        file.write_text(fox(more=asset, trunk='<geom type="mesh" mesh="m"/>'))
        messages = []
        for reading in (compiling.check, compiling.compiled):
            with pytest.raises(_core.ConfigError) as caught:
                reading(file)
            messages.append(str(caught.value))
        assert messages[0] == messages[1]
        assert messages[0].startswith(f"{file}: mesh m: ")


OUTSIDE = {
    "an include": lambda place: {"fox.xml": fox(more=f'<include file="{place}"/>')},
    "a mesh": lambda place: {"fox.xml": fox(more=MESH.format(place))},
    "a folder of meshes": lambda place: {
        "fox.xml": fox(more=f'<compiler meshdir="{place.parent}"/>' + MESH.format(place.name))
    },
    "a text that is included": lambda place: {
        "fox.xml": fox(more='<include file="parts/more.txt"/>'),
        "parts/more.txt": f"<mujoco>{MESH.format(place)}</mujoco>",
    },
    "an escaped name": lambda place: {
        "fox.xml": fox(more="<include file='" + str(place).replace(".", "&#46;").replace("/", "\\") + "'/>")
    },
    "a URDF's mesh": lambda place: {
        "fox.urdf": quadruped().replace(
            "<collision>", f'<collision><geometry><mesh filename="{place}"/></geometry></collision><collision>', 1
        )
    },
    "a xacro": lambda place: {
        "fox.xacro": '<robot name="x" xmlns:xacro="http://ros.org/wiki/xacro">'
        f'<xacro:include filename="{place}"/></robot>'
    },
}
"""Files of an archive that name a place outside of it."""


@pytest.mark.parametrize("is_relative", [False, True], ids=["absolute", "relative"])
@pytest.mark.parametrize("what", OUTSIDE)
def test_nothing_beyond_an_archive_is_read(tmp_path, monkeypatch, what, is_relative):
    """Each of these would put a file of the user's into a robot that may be passed on."""
    if what == "a xacro":
        pytest.importorskip("xacro")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / "mine.obj").write_text(
        "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
        if "mesh" in what or "text" in what
        else '<robot name="y"/>'
        if what == "a xacro"
        else "<mujoco/>"
    )
    place = Path("../mine.obj") if is_relative else tmp_path / "mine.obj"
    with zipfile.ZipFile(tmp_path / "kit.zip", "w") as kit:
        for name, text in OUTSIDE[what](place).items():
            kit.writestr(name, text)
    with pytest.raises(_core.PolypodError) as caught:
        add(str(tmp_path / "kit.zip"), tmp_path / "library")
    assert str(tmp_path / "kit.zip") in str(caught.value)
    assert "leads out of the archive" in str(caught.value) or "outside the robot's folder" in str(caught.value)
    assert "polypod-add-" not in str(caught.value)
    assert not (tmp_path / "library").exists()


def test_an_archive_may_name_its_own_files_by_way_of_the_folders_above(tmp_path):
    with zipfile.ZipFile(tmp_path / "kit.zip", "w") as kit:
        kit.writestr("xml/fox.xml", fox(more='<include file="../parts/more.xml"/>'))
        kit.writestr("parts/more.xml", '<mujoco><custom><text name="a" data="b"/></custom></mujoco>')
    assert add(str(tmp_path / "kit.zip"), tmp_path / "library", file="xml/fox.xml").errors


@pytest.mark.parametrize(
    "names", [("a.xml", "a.xml"), ("a", "a/b.xml"), ("x" * 300,), ("/".join("d" * 3000),)], ids=range(4)
)
def test_entries_that_no_folder_can_hold_are_named(tmp_path, names):
    with warnings.catch_warnings(), zipfile.ZipFile(tmp_path / "kit.zip", "w") as kit:
        warnings.simplefilter("ignore")
        for name in names:
            kit.writestr(name, "x")
    with pytest.raises(_core.ConfigError, match=rf"kit\.zip: '{re.escape(names[-1][:80])}' cannot be unpacked: ") as it:
        add(str(tmp_path / "kit.zip"), tmp_path / "library")
    assert "polypod-add-" not in str(it.value)


def test_only_meshes_are_copied(tmp_path):
    """A URDF may name any file, and a library may be passed on."""
    (tmp_path / "secret").write_text("secret")
    mesh = '<collision><geometry><mesh filename="secret"/></geometry></collision><collision>'
    (tmp_path / "fox.urdf").write_text(quadruped().replace("<collision>", mesh, 1))
    added = add(str(tmp_path / "fox.urdf"), tmp_path / "library")
    assert not [file for file in (tmp_path / "library").rglob("*") if file.is_file() and "secret" in file.name]
    assert any("collision mesh secret: is none of .stl, .obj, .dae: left out" in note for note in added.notes)
    assert not any(".tmp" in note for note in added.notes), added.notes


def test_names_are_printed_in_one_line(tmp_path):
    drive = '<adhesion name="a&#10;\x1b[2J" body="trunk" ctrlrange="0 1"/>'
    (tmp_path / "fox.xml").write_text(fox(drives=DRIVES + drive))
    added = add(str(tmp_path / "fox.xml"), tmp_path / "library")
    assert any("actuator a \ufffd[2J: acts on no joint: left out" in note for note in added.notes), added.notes


TENDON = (
    '<tendon><fixed name="rope" {}><joint joint="lf_haa" coef="3"/><joint joint="lf_hfe" coef="-0.5"/></fixed></tendon>'
)
ON_A_ROPE = DRIVES.replace(
    '<position joint="lf_haa" class="servo"/>', '<position tendon="rope" kp="9" armature="0.01" gear="2" damping="3"/>'
)


@pytest.mark.parametrize("where", ["tendon", "actuator"])
def test_joints_keep_their_share_of_a_rotor_that_turns_several(tmp_path, where):
    """`a c_i^2` of each joint is armature; what couples the joints is left out, and named."""
    is_tendon = where == "tendon"
    text = fox(more=TENDON.format('armature="0.04"' if is_tendon else ""), drives=DRIVES if is_tendon else ON_A_ROPE)
    (tmp_path / "fox.xml").write_text(text)
    if not is_tendon and not hasattr(compiling.compiled(tmp_path / "fox.xml").model, "actuator_armature"):
        pytest.skip("MuJoCo before 4 has no armature of actuators")
    added = add(str(tmp_path / "fox.xml"), tmp_path / "library")
    assert any("armature of tendon rope: replaced by each joint's own share" in note for note in added.notes)
    table = (tmp_path / "library/assets/robots/test_fox/SOURCE.md").read_text()
    shares = {
        joint: float(re.search(rf"^\| {joint} \|(?: [^|]*\|){{4}} ([\d.]+) \|", table, re.MULTILINE)[1])
        for joint in ("lf_haa", "lf_hfe")
    }
    assert shares == {"lf_haa": pytest.approx(0.02 + 0.04 * 9), "lf_hfe": pytest.approx(0.02 + 0.04 * 0.25)}
    assert added.errors["float64"].worst() < 1e-6


def test_a_driven_joint_that_is_tied_moves_on(tmp_path):
    """The joint that follows it is locked; of two that are driven neither is."""
    follows = '<equality><joint joint1="lf_hfe" joint2="wag" polycoef="0 1"/></equality>'
    (tmp_path / "fox.xml").write_text(fox(trunk=WAG, key=HOME + " 0.1", more=follows))
    added = add(str(tmp_path / "fox.xml"), tmp_path / "a")
    assert "joint wag: tied by an equality constraint: locked" in added.notes
    both = '<equality><joint joint1="lf_hfe" joint2="lh_hfe" polycoef="0 1"/></equality>'
    (tmp_path / "fox.xml").write_text(fox(more=both))
    added = add(str(tmp_path / "fox.xml"), tmp_path / "b")
    assert (
        "joint lf_hfe and lh_hfe: tied by an equality constraint, both with actuators: the tie is left out"
        in added.notes
    )


def test_a_leg_that_a_locked_joint_breaks_names_the_joint(tmp_path):
    tie = '<equality><joint joint1="lf_hfe" polycoef="0.3"/></equality>'
    (tmp_path / "fox.xml").write_text(fox(more=tie))
    with pytest.raises(
        _core.RobotError, match=r"legs were found .*; joint lf_hfe: tied by an equality constraint: locked"
    ):
        add(str(tmp_path / "fox.xml"), tmp_path / "library")
