"""Messages and interfaces of ROS 2.

sensor_msgs/JointState and sensor_msgs/Imu in, interfaces of ros2_control out.

No module of ROS is imported: anything of the messages' shape will do.
"""

from typing import Any

import numpy as np

from .policy_contract import Contract
from .policy_loop import Command, Sensors

INTERFACES = ("position", "velocity", "effort", "kp", "kd")
"""Command interfaces of a joint whose drive takes gains."""


def sensors_of(contract: Contract, joints: Any, imu: Any) -> Sensors:
    """The sensors in a `JointState` and an `Imu`; joints by name, in any order.

    An `Imu` has x, y, z, w, and says with orientation_covariance[0] = -1 that it gives no
    orientation. The older of the two messages tells the time. Absent values are not finite, at
    which the loop damps.
    """
    place = {name: index for index, name in enumerate(joints.name)}
    joint_pos, joint_vel = (np.full(len(contract.joints), np.nan) for _ in range(2))
    for index, name in enumerate(contract.joint_names):
        at = place.get(name)
        if at is not None and at < min(len(joints.position), len(joints.velocity)):
            joint_pos[index], joint_vel[index] = joints.position[at], joints.velocity[at]
    q, w = imu.orientation, imu.angular_velocity
    return Sensors(
        time=min(_seconds(joints.header.stamp), _seconds(imu.header.stamp)),
        joint_pos=joint_pos,
        joint_vel=joint_vel,
        quaternion=[np.nan if imu.orientation_covariance[0] == -1.0 else q.w, q.x, q.y, q.z],
        angular_velocity=[w.x, w.y, w.z],
    )


def interfaces(contract: Contract, command: Command) -> dict[str, float]:
    """Values of the command interfaces, such as `knee/position`, of hardware that takes gains."""
    columns = (command.q, command.dq, command.tau, command.kp, command.kd)
    return {
        f"{name}/{interface}": float(values[index])
        for index, name in enumerate(contract.joint_names)
        for interface, values in zip(INTERFACES, columns, strict=True)
    }


def efforts(contract: Contract, command: Command, sensors: Sensors) -> dict[str, float]:
    """Values of the interfaces `<joint>/effort` alone, of hardware without gains.

    Call it at the rate of the controller manager, with the newest sensors; the command stays for a
    control step.
    """
    limit = np.array([joint.effort_limit for joint in contract.joints])
    found = command.efforts(sensors.joint_pos, sensors.joint_vel, limit)
    found = np.where(np.isfinite(found), found, 0.0)
    return {f"{name}/effort": float(value) for name, value in zip(contract.joint_names, found, strict=True)}


def _seconds(stamp: Any) -> float:
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)
