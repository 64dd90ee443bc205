"""The loop that runs an exported policy on a robot, with polypod's physics in the robot's place.

    polypod export --checkpoint model_280.pt --robots unitree_go2 --formats onnx --out exported
    python examples/deploy/robot_loop.py exported/policy_unitree_go2.onnx --command 0.5 0 0 --seconds 5

It knows nothing but the ONNX file: order of joints, gains, default pose and control step stand in its metadata. `Robot`
has the shape of a low-level SDK (unitree_sdk2: LowState in, LowCmd out; ros2_control: state and command interfaces):
put your robot's calls in the place of `SimulatedRobot`, and an estimator in that of its `base_lin_vel`.
"""

import argparse
import dataclasses
import os
from typing import Protocol

import numpy as np
import numpy.typing as npt

# onnxruntime reports its use to its maker unless this is set before it is imported
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
import onnxruntime

import polypod

Array = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class State:
    """State of a robot, as in `LowState`: joints in the order of the policy's metadata."""

    joint_pos: Array
    """rad."""
    joint_vel: Array
    """rad/s."""
    quaternion: Array
    """Orientation of the base: w, x, y, z."""
    angular_velocity: Array
    """Angular velocity of the base, base axes, rad/s."""
    linear_velocity: Array
    """Velocity of the base's origin, base axes, m/s. A real robot estimates it."""


class Robot(Protocol):
    """A robot that takes position targets and gains, as `LowCmd` does."""

    def read(self) -> State:
        """The present state."""

    def write(self, joint_pos_target: Array, stiffness: Array, damping: Array) -> None:
        """Holds targets (rad) with gains (N m/rad, N m s/rad) until the next call."""

    def wait(self, seconds: float) -> None:
        """Returns when the control step is over."""


class SimulatedRobot:
    """polypod's physics in the place of a robot: 200 Hz, the gains in the joints."""

    def __init__(self, name: str, joint_names: list[str]) -> None:
        """Stands on a plane in its default pose."""
        self.sim = polypod.Simulation(name, dt=0.005)
        self.order = [self.sim.joint_names.index(joint) for joint in joint_names]

    def read(self) -> State:
        """The present state; velocities turn from world to base axes."""
        qpos, qvel = self.sim.qpos[0], self.sim.qvel[0]
        return State(
            joint_pos=qpos[7:][self.order],
            joint_vel=qvel[6:][self.order],
            quaternion=qpos[3:7],
            angular_velocity=qvel[3:6],
            linear_velocity=rotation(qpos[3:7]).T @ qvel[:3],
        )

    def write(self, joint_pos_target: Array, stiffness: Array, damping: Array) -> None:
        """Takes the command of the next steps."""
        targets, kp, kd = (np.empty(len(self.order)) for _ in range(3))
        targets[self.order], kp[self.order], kd[self.order] = joint_pos_target, stiffness, damping
        self.command = {"targets": targets, "kp": kp, "kd": kd}

    def wait(self, seconds: float) -> None:
        """Simulates the control step."""
        self.sim.step(**self.command, n=round(seconds / self.sim.dt))


class Policy:
    """An exported graph and the numbers in its metadata."""

    def __init__(self, path: str) -> None:
        """Reads the file."""
        self.session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        said = self.session.get_modelmeta().custom_metadata_map
        self.robot, self.step_dt = said["robot"], float(said["step_dt"])
        self.joint_names = said["joint_names"].split(",")
        self.stiffness, self.damping, self.default_joint_pos, self.lower, self.upper = (
            np.array(said[key].split(","), dtype=np.float64)
            for key in ("joint_stiffness", "joint_damping", "default_joint_pos", "joint_pos_lower", "joint_pos_upper")
        )
        self.fed_back = {"last_action": "actions"}
        """Inputs that earlier outputs fill: the last action and the states."""
        if "state_inputs" in said:
            states = zip(said["state_inputs"].split(","), said["state_outputs"].split(","), strict=True)
            self.fed_back |= dict(states)
        self.reset()

    def reset(self) -> None:
        """Starts an episode."""
        self.memory = {
            entry.name: np.zeros([size if isinstance(size, int) else 1 for size in entry.shape], dtype=np.float32)
            for entry in self.session.get_inputs()
            if entry.name in self.fed_back
        }

    def act(self, state: State, command: tuple[float, float, float]) -> Array:
        """Position targets of the next control step, rad; forward and left velocity, m/s, and yaw rate, rad/s."""
        given = {
            "base_lin_vel": state.linear_velocity,
            "base_ang_vel": state.angular_velocity,
            "projected_gravity": rotation(state.quaternion).T @ [0.0, 0.0, -1.0],
            "velocity_commands": command,
            "joint_pos": state.joint_pos,
            "joint_vel": state.joint_vel,
        }
        feeds = {name: np.array(value, dtype=np.float32)[np.newaxis] for name, value in given.items()}
        feeds |= self.memory
        names = [entry.name for entry in self.session.get_inputs()]
        outputs = ["joint_pos_target", *(self.fed_back[name] for name in self.memory)]
        targets, *after = self.session.run(outputs, {name: feeds[name] for name in names})
        self.memory = dict(zip(self.memory, after, strict=True))
        return np.clip(targets[0].astype(np.float64), self.lower, self.upper)


def rotation(quaternion: Array) -> Array:
    """The matrix that turns base axes to world axes."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def run(policy: Policy, robot: Robot, command: tuple[float, float, float], seconds: float) -> None:
    """Stands for a second, then walks."""
    for step in range(round((seconds + 1.0) / policy.step_dt)):
        state = robot.read()
        walks = step * policy.step_dt >= 1.0
        targets = policy.act(state, command) if walks else policy.default_joint_pos
        robot.write(targets, policy.stiffness, policy.damping)
        robot.wait(policy.step_dt)


def main() -> None:
    """Runs the policy and prints how far the robot came."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", help="policy_<robot>.onnx of an export")
    parser.add_argument("--command", type=float, nargs=3, default=(0.5, 0.0, 0.0), metavar=("VX", "VY", "WZ"))
    parser.add_argument("--seconds", type=float, default=5.0)
    arguments = parser.parse_args()
    policy = Policy(arguments.policy)
    robot = SimulatedRobot(policy.robot, policy.joint_names)
    begun = robot.sim.qpos[0, :3].copy()
    run(policy, robot, tuple(arguments.command), arguments.seconds)
    moved = robot.sim.qpos[0, :3] - begun
    up = rotation(robot.read().quaternion)[2, 2]
    print(f"{policy.robot}: moved {moved[0]:.2f} m ahead, {moved[1]:.2f} m to the left; upright {up:.2f}")


if __name__ == "__main__":
    main()
