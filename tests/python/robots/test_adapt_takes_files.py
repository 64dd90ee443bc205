"""`polypod adapt` drafts every file that `polypod add` takes."""

import zipfile
from pathlib import Path

import pytest
import tomllib
from test_add import fox
from test_new_robot import quadruped

import polypod
from polypod import adapt


def mjcf(file):
    file.write_text(fox())


def xacro(file):
    opening = '<robot xmlns:xacro="http://ros.org/wiki/xacro" name="fox"><xacro:property name="r" value="0.025"/>'
    text = quadruped().replace('<robot name="Test Fox">', opening).replace('radius="0.025"', 'radius="${r}"')
    file.write_text(text)


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
    robot = adapt._draft(adapt.Options(str(tmp_path / name)), tmp_path / "run", adapt.Progress())
    assert robot.startswith(str(tmp_path / "run" / "robot"))
    assert "LF_HAA" in tomllib.loads(Path(robot).read_text())["default_pose"]
    env = polypod.make("velocity_flat", 1, robots=[robot], seed=0)
    env.reset()
    env.close()


@pytest.mark.parametrize("name", ["nothing.xml", "nothing.urdf.xacro", "nothing.zip"])
def test_a_file_that_is_not_there_is_named(cli, tmp_path, name):
    done = cli("adapt", name, "--device", "cpu", "--threads", "1", "--max-minutes", "1")
    assert done.returncode == 2
    assert f"{name}: there is no such file" in done.stderr
    assert not list(tmp_path.glob("logs/rsl_rl/adapt/*"))
