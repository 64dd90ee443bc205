"""Messages of Unitree's SDKs: what a loop reads of a state, and what it writes into a command.

The messages are those of unitree_sdk2 (`LowState_`, `LowCmd_` of unitree_go and unitree_hg) and of
unitree_legged_sdk (`LowState`, `LowCmd`), or anything of their shape. Head, level, checksum and the
release of the robot's own controller are the SDK's business. Quaternions are w, x, y, z in all of
them.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from .policy_contract import Contract, Motors
from .policy_loop import Command, Sensors

_FIELDS = {
    "unitree_sdk2": ("motor_state", "imu_state", "motor_cmd", "kp", "kd"),
    "unitree_legged_sdk": ("motorState", "imu", "motorCmd", "Kp", "Kd"),
}
"""Names of the fields in which the SDKs differ."""


def sensors_of(contract: Contract, state: Any, time: float, motors: Motors | None = None) -> Sensors:
    """The sensors in a `LowState` that came at `time`, s.

    `motors` takes the place of those that the contract names. Raises ValueError where neither names
    them.
    """
    motors = _motors(contract, motors)
    states, imu, *_ = _FIELDS[motors.interface]
    joint_pos, joint_vel = (np.full(len(contract.joints), np.nan) for _ in range(2))
    for motor, joint in _places(contract, motors):
        joint_pos[joint], joint_vel[joint] = (getattr(getattr(state, states)[motor], key) for key in ("q", "dq"))
    return Sensors(
        time=time,
        joint_pos=joint_pos,
        joint_vel=joint_vel,
        quaternion=list(getattr(state, imu).quaternion),
        angular_velocity=list(getattr(state, imu).gyroscope),
    )


def write(contract: Contract, command: Command, message: Any, motors: Motors | None = None) -> None:
    """Fills the motors of a `LowCmd`; a motor that moves no joint stays as it is.

    See `sensors_of` for `motors`.
    """
    motors = _motors(contract, motors)
    *_, commands, kp, kd = _FIELDS[motors.interface]
    for motor, joint in _places(contract, motors):
        to = getattr(message, commands)[motor]
        to.mode = motors.modes[motor]
        for key, values in (("q", command.q), ("dq", command.dq), ("tau", command.tau), (kp, command.kp)):
            setattr(to, key, float(values[joint]))
        setattr(to, kd, float(command.kd[joint]))


def _motors(contract: Contract, motors: Motors | None) -> Motors:
    found = motors or contract.motors
    if found is None or found.interface not in _FIELDS:
        raise ValueError(f"the contract names no motors of {contract.robot} in Unitree's order; pass motors")
    return found


def _places(contract: Contract, motors: Motors) -> Iterator[tuple[int, int]]:
    """Motors and their joints."""
    names = contract.joint_names
    for motor, joint in enumerate(motors.joints):
        if joint is not None:
            yield motor, names.index(joint)
