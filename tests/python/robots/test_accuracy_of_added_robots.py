"""A robot made of an MJCF file is compared with MuJoCo's model of that file.

The harness is that of the library's robots.
"""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_add import HOME, fox

import polypod
from polypod.accuracy import bounds, report
from polypod.accuracy.file import compare_file
from polypod.accuracy.standing import FRICTION, hold, pose
from polypod.accuracy.statics import compare_statics
from polypod.add import add, judge, kept
from polypod.mujoco_model import reference, robot
from polypod.mujoco_model.reference import Ground, Reference

TAIL = """
  <body name="tail_base" pos="-0.3 0 0">
    <joint name="wag" axis="0 0 1" pos="0.01 0.02 0" range="-1 1" ref="0.2"/>
    <joint name="lift" axis="0 1 0" pos="0 0 0.03" range="-1 1"/>
    <geom type="box" size="0.03 0.01 0.01" mass="0.2" pos="-0.03 0 0"/>
  </body>"""
"""A body with two joints, away from its origin and from their zeros, which nothing drives: both are
locked."""


@pytest.fixture(scope="module")
def added(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The config of a fox with a tail."""
    folder = tmp_path_factory.mktemp("fox")
    (folder / "fox.xml").write_text(fox(trunk=TAIL, key=f"{HOME} 0.3 -0.2"))
    return add(str(folder / "fox.xml"), folder / "mine").new.path


def model_of(config: Path) -> Path:
    return config.parents[2] / "assets/robots" / config.stem / kept.NAME


def test_the_kept_file_is_mujocos_model(added):
    """To the last digit; MuJoCo's writer keeps six."""
    (original,) = added.parents[3].glob("fox.xml")
    ours = mujoco.MjModel.from_xml_path(str(model_of(added)))
    theirs = mujoco.MjModel.from_xml_path(str(original))
    for name in (
        "body_mass",
        "body_pos",
        "jnt_range",
        "jnt_pos",
        "qpos0",
        "dof_armature",
        "actuator_gainprm",
        "key_qpos",
    ):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-12, atol=1e-15)
    assert (ours.nu, ours.nkey, ours.npair) == (theirs.nu, theirs.nkey, theirs.npair)


def test_the_robot_keeps_the_bounds_against_its_file(added):
    fox = robot.load(str(added))
    assert fox.origin is not None
    assert set(fox.locked_joints) == {"wag", "lift"}
    assert [each.dtype for each in compare_file(fox)] == ["float64", "float32"]
    assert not bounds.exceeded(*compare_file(fox), compare_statics(fox, states=20))
    # the tables' model is that of the file, hips with two joints in one body and held joints among
    # it
    assert compare_statics(fox, states=2, dtype="float64").worst() < judge.BOUNDS["float64"]


def test_it_touches_the_ground_with_the_files_shapes(added):
    fox = robot.load(str(added))
    twin = Reference.of(fox, dt=0.002, ground=Ground(FRICTION))
    assert twin.model.ngeom == 1 + len(fox.origin.touching)
    sim = polypod.Simulation(fox.source, dt=0.002, friction=FRICTION, self_collision=False, threads=1)
    for each in (twin, sim):
        each.set_state(pose(fox, 0.0))
    twin.step(fox.default_position, 200)
    hold(sim, fox, 0.4)
    assert twin.data.ncon >= 4
    np.testing.assert_allclose(twin.qpos[:7], sim.qpos[0, :7], atol=2e-3)


def test_it_has_the_springs_and_surfaces_of_the_config(tmp_path):
    """Feet are links of their own in polypod alone."""
    text = fox().replace('damping="0.3"', 'damping="0.3" stiffness="7" springref="0.25"')
    text = text.replace('mass="0.05" priority="1"/>', 'mass="0.05" priority="1" condim="6" friction="1.2 .03 .01"/>')
    (tmp_path / "fox.xml").write_text(text)
    config = add(str(tmp_path / "fox.xml"), tmp_path / "mine").new.path
    loaded = robot.load(str(config))
    assert loaded.origin is not None
    twin = Reference.of(loaded, dt=0.002, ground=Ground(0.5))
    joints = [twin.model.joint(name) for name in loaded.joint_names]
    np.testing.assert_allclose([float(np.ravel(twin.model.jnt_stiffness[joint.id])[0]) for joint in joints], 7.0)
    np.testing.assert_allclose([twin.model.qpos_spring[joint.qposadr[0]] for joint in joints], 0.25, atol=1e-9)
    is_foot = twin.model.geom_condim == 6
    assert is_foot.sum() == 4
    np.testing.assert_allclose(twin.model.geom_friction[is_foot], [[0.6, 0.03, 0.01]] * 4)
    np.testing.assert_allclose(twin.model.geom_friction[~is_foot, 0], 0.5)
    np.testing.assert_allclose(twin.friction_factor, np.where(is_foot, 1.2, 1.0))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [('mass="0.3', 'mass="0.31', "MJCF file"), ('armature="0.03"', 'armature="0.031"', "MJCF file")],
)
def test_another_file_is_seen(added, tmp_path, old, new, words):
    """It is the file that counts, and not what was written of it."""
    text = model_of(added).read_text()
    assert old in text
    library = tmp_path / "mine"
    for file in (added, model_of(added), model_of(added).with_name("robot.urdf")):
        place = library / file.relative_to(added.parents[2])
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(file.read_text().replace(old, new) if file.name == kept.NAME else file.read_text())
    fox = robot.load(str(library / added.relative_to(added.parents[2])))
    broken = bounds.exceeded(*compare_file(fox))
    assert len(broken) == 2
    assert all(words in line for line in broken)


def test_a_report_has_the_files_figures_and_a_verdict(added):
    fox = robot.load(str(added))
    made = report.Report("x.y", files=compare_file(fox))
    assert "1e-4" in made.verdict() or "1e-6" in made.verdict()
    assert "test_fox" in made.verdict()
    worse = dataclasses.replace(made.files[1], errors=dataclasses.replace(made.files[1].errors, joint_limits=0.01))
    assert "1.0e-02 exceeds 1e-4" in dataclasses.replace(made, files=[worse]).broken()[0]


def test_a_held_joint_leaves_the_others_where_they_were():
    """Whichever of a body's joints it is, and wherever its anchor and its zero are."""
    axes = ("1 0 0", "0 1 0", "0.6 0 0.8")
    kinds = ("hinge", "hinge", "slide")
    joints = "".join(
        f'<joint name="j{i}" type="{kind}" axis="{axis}" pos="0.1 {0.05 * i} -0.02" ref="{0.1 * i}"/>'
        for i, (axis, kind) in enumerate(zip(axes, kinds, strict=True))
    )
    text = f"""<mujoco><compiler angle="radian"/><worldbody><body name="a" pos="0.3 0.1 1" quat="0.8 0.6 0 0">{joints}
    <geom size="0.1" pos="0.2 0 0"/></body></worldbody></mujoco>"""
    whole = mujoco.MjModel.from_xml_string(text)
    q = np.array([0.7, -0.4, 0.3])
    data = mujoco.MjData(whole)
    data.qpos[:] = q
    mujoco.mj_kinematics(whole, data)
    for held in range(3):
        spec = mujoco.MjSpec.from_string(text)
        reference._lock(mujoco, spec, f"j{held}", q[held])
        model = spec.compile()
        assert model.nq == 2
        other = mujoco.MjData(model)
        other.qpos[:] = np.delete(q, held)
        mujoco.mj_kinematics(model, other)
        np.testing.assert_allclose(other.geom_xpos, data.geom_xpos, atol=1e-12)
        np.testing.assert_allclose(other.geom_xmat, data.geom_xmat, atol=1e-12)


def test_a_robot_of_a_urdf_has_no_file():
    assert robot.load("spot").origin is None
    assert compare_file(robot.load("spot")) == []
