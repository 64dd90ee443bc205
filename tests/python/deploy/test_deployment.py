"""An exported file is enough for a robot.

Its metadata hold the numbers, and a loop that reads nothing else walks.
"""

import json
import shutil
import subprocess
import sys

import numpy as np
import onnx
import pytest

import polypod
from common import ROBOTS, ROOT

EXAMPLES = ROOT / "examples" / "deploy"
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
    loop = robot_loop.open_loop(alone)
    simulated = robot_loop.SimulatedRobot(loop.contract.robot, loop.contract.joint_names)
    last = robot_loop.run(loop, simulated, (0.5, 0.0, 0.0), 4.0)
    assert (last.mode, last.fault) == ("walk", None)
    ahead, _, height = simulated.sim.qpos[0, :3]
    assert 1.4 < ahead < 2.6
    assert robot_loop.rotation(simulated.sim.qpos[0, 3:7])[2, 2] > 0.95
    assert height > 0.15


def test_the_loop_takes_the_joints_of_a_robot_in_any_order(robot_loop, exported_policy):
    folder, _ = exported_policy
    names = robot_loop.open_loop(folder / "policy_spot.onnx").contract.joint_names
    robot, other = robot_loop.SimulatedRobot("spot", names), robot_loop.SimulatedRobot("spot", list(reversed(names)))
    np.testing.assert_array_equal(robot.read().joint_pos, other.read().joint_pos[::-1])


def test_the_example_runs_as_printed(exported_policy):
    folder, _ = exported_policy
    command = [sys.executable, EXAMPLES / "robot_loop.py", folder / "policy_spot.onnx", "--seconds", "0.5"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.startswith("spot: moved ")


def test_the_loop_in_cpp_gives_the_same_targets(robot_loop, exported_policy, cpp_loop):
    if cpp_loop is None:
        pytest.skip("needs g++ and onnxruntime's C++ headers: those of a release at ONNXRUNTIME, or libonnxruntime-dev")
    loop = robot_loop.open_loop(exported_policy[0] / "policy_spot.onnx")
    robot = robot_loop.SimulatedRobot("spot", loop.contract.joint_names)
    loop.walk(at_once=True)
    lines, expected = [], []
    for _ in range(20):
        sensors = robot.read()
        given = [sensors.time, *sensors.quaternion, *sensors.angular_velocity, *sensors.joint_pos, *sensors.joint_vel]
        lines.append(" ".join(f"{x:.9g}" for x in (*given, 0.5, 0.0, 0.0, *sensors.linear_velocity)))
        command = loop.step(sensors.time, sensors, (0.5, 0.0, 0.0))
        expected.append([number for joint in zip(command.q, command.kp, command.kd, strict=True) for number in joint])
        robot.write(command)
        robot.wait(loop.contract.control_dt)
    done = subprocess.run(
        [cpp_loop, cpp_loop.parent / "policy_spot.onnx"],
        input="\n".join(lines) + "\n",
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    rows = [row.split() for row in done.stdout.splitlines()]
    assert {tuple(row[:2]) for row in rows} == {("walk", "-")}
    np.testing.assert_allclose(np.array([row[2:] for row in rows], dtype=np.float64), expected, atol=1e-4)
