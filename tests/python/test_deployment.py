"""An exported file is enough for a robot: its metadata hold the numbers, and a loop that reads nothing else walks."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest

import polypod
from common import ROBOTS

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "deploy"
MJLAB = {"run_path", "joint_names", "joint_stiffness", "joint_damping", "default_joint_pos", "command_names"}
MJLAB |= {"observation_names", "action_scale"}
"""Keys that deployments of mjlab's policies read."""


def metadata(path):
    return {entry.key: entry.value for entry in onnx.load(path).metadata_props}


def numbers(text):
    return np.array(text.split(","), dtype=np.float64)


@pytest.mark.parametrize("robot", ROBOTS or [entry["name"] for entry in polypod.robots()])
def test_the_numbers_of_a_robot_are_read_back(exported_policy, robot):
    folder, _ = exported_policy
    said = metadata(folder / f"policy_{robot}.onnx")
    assert said.keys() >= MJLAB
    env = polypod.make("velocity_flat_universal", 1, robots=[robot], seed=0)
    info = json.loads(env.sim.robot_info())[robot]
    assert said["robot"] == robot
    assert said["joint_names"].split(",") == info["joint_names"]
    for key, name in (
        ("joint_stiffness", "stiffness"),
        ("joint_damping", "damping"),
        ("default_joint_pos", "default_pose"),
        ("joint_effort_limit", "effort_limit"),
        ("joint_pos_lower", "lower"),
        ("joint_pos_upper", "upper"),
    ):
        np.testing.assert_array_equal(numbers(said[key]).astype(np.float32), np.array(info[name], dtype=np.float32))
    np.testing.assert_array_equal(
        numbers(said["action_scale"]).astype(np.float32), np.full(12, info["action_scale"], dtype=np.float32)
    )
    assert said["action_joint_names"].split(",") == [joint for joint, _ in env.joint_map(robot)]
    assert float(said["step_dt"]) == env.step_dt


def test_what_the_policy_observes_is_read_back(exported_policy):
    folder, _ = exported_policy
    said = metadata(folder / "policy.onnx")
    layout = json.loads((folder / "policy.json").read_text())["observation_layout"]
    assert said["observation_names"].split(",") == [entry["term"] for entry in layout]
    assert said["observation_sizes"].split(",") == [str(entry["size"]) for entry in layout]
    assert set(said["observation_history_lengths"].split(",")) == {"1"}
    np.testing.assert_array_equal(numbers(said["observation_scales"]), [entry["scale"] for entry in layout])
    np.testing.assert_array_equal(numbers(said["observation_offsets"]), [entry["offset"] for entry in layout])
    clips = [None if not clip else [float(x) for x in clip.split(":")] for clip in said["observation_clips"].split(",")]
    assert clips == [entry["clip"] for entry in layout]
    assert said["command_names"] == "velocity_commands"
    # eight robots have eight sets of gains: none of them stands in the graph of all
    assert "joint_names" not in said


@pytest.mark.parametrize("robot", ["spot", "unitree_a1"])
def test_the_loop_walks_with_nothing_but_the_file(robot_loop, exported_policy, tmp_path, robot):
    folder, _ = exported_policy
    alone = tmp_path / "alone.onnx"
    shutil.copy(folder / f"policy_{robot}.onnx", alone)
    policy = robot_loop.Policy(str(alone))
    simulated = robot_loop.SimulatedRobot(policy.robot, policy.joint_names)
    robot_loop.run(policy, simulated, (0.5, 0.0, 0.0), 4.0)
    ahead, _, height = simulated.sim.qpos[0, :3]
    assert 1.4 < ahead < 2.6
    assert robot_loop.rotation(simulated.read().quaternion)[2, 2] > 0.95
    assert height > 0.15


def test_the_loop_takes_the_joints_of_a_robot_in_any_order(robot_loop, exported_policy):
    folder, _ = exported_policy
    policy = robot_loop.Policy(str(folder / "policy_spot.onnx"))
    mixed = list(reversed(policy.joint_names))
    robot, other = robot_loop.SimulatedRobot("spot", policy.joint_names), robot_loop.SimulatedRobot("spot", mixed)
    np.testing.assert_array_equal(robot.read().joint_pos, other.read().joint_pos[::-1])


def test_the_example_runs_as_printed(exported_policy):
    folder, _ = exported_policy
    command = [sys.executable, EXAMPLES / "robot_loop.py", folder / "policy_spot.onnx", "--seconds", "0.5"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.startswith("spot: moved ")


def test_the_loop_in_cpp_gives_the_same_targets(robot_loop, exported_policy, cpp_loop):
    if cpp_loop is None:
        pytest.skip("needs g++ and onnxruntime's C++ headers: those of a release at ONNXRUNTIME, or libonnxruntime-dev")
    folder, _ = exported_policy
    policy = robot_loop.Policy(str(folder / "policy_spot.onnx"))
    robot = robot_loop.SimulatedRobot("spot", policy.joint_names)
    lines, expected = [], []
    for _ in range(20):
        state = robot.read()
        given = {
            "base_lin_vel": state.linear_velocity,
            "base_ang_vel": state.angular_velocity,
            "projected_gravity": robot_loop.rotation(state.quaternion).T @ [0.0, 0.0, -1.0],
            "velocity_commands": np.array([0.5, 0.0, 0.0]),
            "joint_pos": state.joint_pos,
            "joint_vel": state.joint_vel,
        }
        names = [entry.name for entry in policy.session.get_inputs() if entry.name != "last_action"]
        lines.append(" ".join(f"{x:.9g}" for name in names for x in given[name]))
        targets = policy.act(state, (0.5, 0.0, 0.0))
        expected.append(targets)
        robot.write(targets, policy.stiffness, policy.damping)
        robot.wait(policy.step_dt)
    command = [cpp_loop, folder / "policy_spot.onnx"]
    done = subprocess.run(
        command, input="\n".join(lines) + "\n", capture_output=True, text=True, check=True, timeout=60
    )
    step, joints, *rows = done.stdout.splitlines()
    assert step == "step_dt 0.02"
    assert [joint.split(":")[0] for joint in joints.split()[1:]] == policy.joint_names
    found = np.clip(np.array([row.split() for row in rows], dtype=np.float64), policy.lower, policy.upper)
    np.testing.assert_allclose(found, expected, atol=1e-4)
