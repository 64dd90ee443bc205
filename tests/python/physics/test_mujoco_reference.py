"""The MuJoCo models that polypod is compared with have the robots' own joints, limits and stops."""

from pathlib import Path

import numpy as np
import pytest

import polypod
from polypod.mujoco_model.reference import Reference
from polypod.mujoco_model.robot import load, names


@pytest.mark.parametrize("name", names())
def test_only_the_robots_joints_move(name: str) -> None:
    robot = load(name)
    model = Reference.of(robot, dt=0.001).model
    assert model.nv == 6 + robot.num_joints


@pytest.mark.parametrize("position", [0.0, -1.0])
def test_a_locked_joint_stays_where_it_is_locked(position: float) -> None:
    robot = load("unitree_go2")
    locked = "FL_thigh_joint"
    free = Reference.of(robot, dt=0.001)
    qpos = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, *robot.default_position])
    qpos[7 + robot.joint_names.index(locked)] = position
    free.set_state(qpos)
    others = tuple(name for name in robot.joint_names if name != locked)
    held = Reference(robot.urdf, joint_names=others, dt=0.001, locked_joints={locked: position})
    held.set_state(np.delete(qpos, 7 + robot.joint_names.index(locked)))
    links = ["FL_thigh", "FL_calf", "FL_foot"]
    for ours, theirs in zip(held.link_pose(links), free.link_pose(links), strict=True):
        assert ours == pytest.approx(theirs, abs=1e-12)
    assert held.mass_matrix() == pytest.approx(
        np.delete(np.delete(free.mass_matrix(), k := 6 + robot.joint_names.index(locked), 0), k, 1), abs=1e-9
    )


@pytest.mark.parametrize("name", names())
def test_in_the_default_pose_the_lowest_shape_touches_the_ground(name: str) -> None:
    sim = polypod.Simulation(name, threads=1)
    height = load(name).base_height
    assert height == pytest.approx(sim.default_qpos[2], abs=1e-6)
    sim.set_state(np.array([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0, *load(name).default_position]))
    assert sim.ground_gap().min() == pytest.approx(0.0, abs=1e-6)


def test_position_limits_of_a_config_hold_in_mujoco(tmp_path: Path) -> None:
    """`[joint_limits]` narrows the URDF's, in the direction of the slot."""
    config = tmp_path / "narrow.toml"
    config.write_text(
        'extends = "unitree_h1"\nname = "narrow"\ntitle = "narrow"\n[joint_limits]\nL_HIP_PITCH = [-0.6, 0.4]\n'
    )
    robot = load(str(config))
    model = Reference.of(robot, dt=0.001).model
    wide = Reference.of(load("unitree_h1"), dt=0.001).model
    ranges = np.array([model.jnt_range[model.joint(name).id] for name in robot.joint_names])
    np.testing.assert_allclose(ranges, robot.joint_range, atol=1e-7)
    moved = [k for k in range(1, model.njnt) if not np.array_equal(model.jnt_range[k], wide.jnt_range[k])]
    assert [model.joint(k).name for k in moved] == ["left_hip_pitch_joint"]
    assert model.jnt_range[moved[0]] == pytest.approx([-0.6, 0.4])
