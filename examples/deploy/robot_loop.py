"""The loop of an exported policy, with polypod's physics in the robot's place.

    polypod export --checkpoint flat --robots unitree_go2 --formats onnx --out exported
    python examples/deploy/robot_loop.py exported/policy_unitree_go2.onnx --command 0.5 0 0

The loop is the one that `polypod deploy write` copies for the robot. It knows nothing but the
contract in the file. Put your robot's calls in the place of `SimulatedRobot`: `onboard/unitree.py`
and `onboard/ros2_control.py` read and fill the messages of unitree_sdk2, unitree_legged_sdk and
ROS 2. Put an estimator in that of its `linear_velocity`.
"""

import argparse
from typing import Protocol

import numpy as np
import numpy.typing as npt

import polypod
from polypod.deploy.onboard.policy_loop import Command, Loop, Sensors, open_loop

Array = npt.NDArray[np.float64]


class Robot(Protocol):
    """A robot that takes position targets and gains, as `LowCmd` does."""

    def read(self) -> Sensors:
        """The newest measurement."""

    def write(self, command: Command) -> None:
        """Holds a command until the next call."""

    def wait(self, seconds: float) -> None:
        """Returns when the control step is over."""


class SimulatedRobot:
    """polypod's physics in the place of a robot: 200 Hz, the gains in the joints."""

    def __init__(self, name: str, joint_names: list[str]) -> None:
        """Stands on a plane in its default pose."""
        self.sim = polypod.Simulation(name, dt=0.005)
        self.order = [self.sim.joint_names.index(joint) for joint in joint_names]

    def read(self) -> Sensors:
        """The present state; velocities turn from world to base axes."""
        qpos, qvel = self.sim.qpos[0], self.sim.qvel[0]
        return Sensors(
            time=self.sim.time,
            joint_pos=qpos[7:][self.order],
            joint_vel=qvel[6:][self.order],
            quaternion=qpos[3:7],
            angular_velocity=qvel[3:6],
            linear_velocity=rotation(qpos[3:7]).T @ qvel[:3],
        )

    def write(self, command: Command) -> None:
        """Takes the command of the next steps."""
        targets, kp, kd = (np.empty(len(self.order)) for _ in range(3))
        targets[self.order], kp[self.order], kd[self.order] = command.q, command.kp, command.kd
        self.command = {"targets": targets, "kp": kp, "kd": kd}

    def wait(self, seconds: float) -> None:
        """Simulates the control step."""
        self.sim.step(**self.command, n=round(seconds / self.sim.dt))


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


def run(loop: Loop, robot: Robot, velocity: tuple[float, float, float], seconds: float) -> Command:
    """Moves to the default pose, then walks; returns the last command."""
    loop.stand()
    loop.walk()
    step_dt = loop.contract.control_dt
    for _ in range(round((loop.contract.safety.stand_time + seconds) / step_dt)):
        sensors = robot.read()
        command = loop.step(sensors.time, sensors, velocity)
        robot.write(command)
        robot.wait(step_dt)
    return command


def main() -> None:
    """Runs the policy and prints how far the robot came."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", help="policy_<robot>.onnx of an export")
    parser.add_argument("--command", type=float, nargs=3, default=(0.5, 0.0, 0.0), metavar=("VX", "VY", "WZ"))
    parser.add_argument("--seconds", type=float, default=5.0)
    arguments = parser.parse_args()
    loop = open_loop(arguments.policy)
    robot = SimulatedRobot(loop.contract.robot, loop.contract.joint_names)
    begun = robot.sim.qpos[0, :3].copy()
    last = run(loop, robot, tuple(arguments.command), arguments.seconds)
    moved = robot.sim.qpos[0, :3] - begun
    up = rotation(robot.sim.qpos[0, 3:7])[2, 2]
    ended = f"; {last.mode}: {last.fault} ({last.detail})" if last.fault else ""
    print(f"{loop.contract.robot}: moved {moved[0]:.2f} m ahead, {moved[1]:.2f} m to the left; upright {up:.2f}{ended}")


if __name__ == "__main__":
    main()
