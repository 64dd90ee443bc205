"""What both simulators are told about a robot: one URDF and one set of actuators."""

import dataclasses
import functools
import json
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.compat import tomllib

Array = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Actuators:
    """Position actuators in the order of the robot's joints; infinity where there is no limit.

    The effort is `stiffness (target - q) - damping qd`, held within the torque-speed line of a DC motor, where there is
    one, and within the effort limit or its table over the joint angle.
    """

    stiffness: Array
    """N m/rad."""
    damping: Array
    """N m s/rad."""
    armature: Array
    """Rotor inertia as seen at the joint, kg m^2."""
    joint_damping: Array
    """Viscous friction of the joint, N m s/rad; NaN: the URDF's."""
    friction: Array
    """Dry friction of the joint, N m; NaN: the URDF's."""
    effort_limit: Array
    """N m."""
    saturation_effort: Array
    """Torque of a DC motor at standstill, N m."""
    no_load_speed: Array
    """Of a DC motor, rad/s."""
    effort_tables: tuple[Array | None, ...]
    """Rows of (rad, N m) in place of the effort limit."""
    delay: Array
    """Fewest and most physics steps by which targets come late, [joints, 2]."""
    groups: tuple[str, ...]
    """Name of each joint's group; joints of a group are late together."""
    networks: npt.NDArray[np.bool_]
    """Joints whose torque a network gives in the place of the gains, [joints]."""

    def effort_range(self, position: Array, velocity: Array) -> Array:
        """Least and most effort [..., joints, 2] of each actuator at the joints' positions and velocities."""
        limit = np.broadcast_to(self.effort_limit, position.shape).copy()
        for joint, table in enumerate(self.effort_tables):
            if table is not None:
                limit[..., joint] = np.interp(position[..., joint], table[:, 0], table[:, 1])
        motor = np.isfinite(self.saturation_effort)
        stall = np.where(motor, self.saturation_effort, 0.0)
        speed = velocity / self.no_load_speed
        most = np.where(motor, np.clip(stall * (1.0 - speed), 0.0, limit), limit)
        least = np.where(motor, np.clip(-stall * (1.0 + speed), -limit, 0.0), -limit)
        return np.stack([least, most], axis=-1)


@dataclasses.dataclass(frozen=True)
class Robot:
    """A robot of the library."""

    name: str
    urdf: str
    """The URDF's text."""
    joint_names: tuple[str, ...]
    """In polypod's order."""
    default_position: Array
    """Of the joints, rad."""
    joint_range: Array
    """[joints, 2], rad."""
    base_height: float
    """Of the base above the lowest foot in the default pose, m."""
    actuators: Actuators

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    def with_gains(self, factor: float) -> "Robot":
        """The same robot with `factor` times the stiffness and damping."""
        actuators = self.actuators
        stiffness, damping = factor * actuators.stiffness, factor * actuators.damping
        return dataclasses.replace(self, actuators=dataclasses.replace(actuators, stiffness=stiffness, damping=damping))


TASK = "velocity_flat_legged_play"
"""Has a reward set for every robot of the library."""


def names(task: str | None = None) -> list[str]:
    """The robots of the library, or those of a task by an alias."""
    if task is None:
        return [entry["name"] for entry in _core.robots()]
    (robots,) = (entry["robots"] for entry in _core.tasks() if task in entry["aliases"])
    return robots


@functools.cache
def load(name: str) -> Robot:
    """Reads a robot of the library with its actuators.

    Raises:
        UnknownNameError: for another name.
        ConfigError: for a robot whose actuators are networks.
    """
    robot = of(_core.VecSim(TASK, 1, robots=[name], threads=1), name, name)
    if robot.actuators.networks.any():
        raise _core.ConfigError(
            f"{name}: its actuators are networks, and accuracy compares engines under gains; compare the robot it "
            "extends, or its policy with polypod sim2sim"
        )
    return robot


def of(sim: _core.VecSim, name: str, source: str) -> Robot:
    """The robot `name` of a simulation, which was made from `source`: its name, or the path of its config."""
    info = json.loads(sim.robot_info())[name]
    groups = tomllib.loads(sim.resolved_config())["robots"][name]["actuators"]
    slots = dict(zip(info["joint_of_slot"], info["slots"], strict=True))
    signs = dict(zip(info["joint_of_slot"], info["slot_signs"], strict=True))
    of_joint = [
        next(key for key, group in groups.items() if any(fnmatchcase(slots[joint], p) for p in group["joints"]))
        for joint in range(len(info["joint_names"]))
    ]
    return Robot(
        name=name,
        urdf=_core.robot_urdf(source),
        joint_names=tuple(info["joint_names"]),
        default_position=np.array(info["default_pose"]),
        joint_range=np.stack([_limits(info["lower"], -np.inf), _limits(info["upper"], np.inf)], axis=1),
        base_height=info["base_height"],
        actuators=_actuators(
            [groups[key] for key in of_joint],
            tuple(of_joint),
            [signs[joint] for joint in range(len(of_joint))],
            _limits(info["effort_limit"], np.inf),
        ),
    )


def _limits(values: list[float | None], absent: float) -> Array:
    return np.array([absent if value is None else value for value in values], dtype=np.float64)


def _actuators(
    rows: list[dict[str, Any]], groups: tuple[str, ...], signs: list[float], effort_limit: Array
) -> Actuators:
    """Reads the actuators of the joints.

    Args:
        rows: actuator of each joint, as the config has it.
        groups: its group.
        signs: -1 where a joint turns the other way round than its slot, whose direction configs are in.
        effort_limit: N m, of the config or, where that has none, of the URDF.
    """

    def table(row: dict[str, Any], sign: float) -> Array | None:
        if not row.get("effort_table"):
            return None
        angles = np.array(row["effort_table"]) * [sign, 1.0]
        return angles if sign > 0 else angles[::-1]

    def column(key: str, default: float) -> Array:
        return np.array([row.get(key, default) for row in rows], dtype=np.float64)

    motor = np.array(["saturation_effort" in row for row in rows])
    networks = np.array(["network_file" in row for row in rows])
    return Actuators(
        stiffness=np.where(networks, 0.0, column("stiffness", 0.0)),
        damping=np.where(networks, 0.0, column("damping", 0.0)),
        armature=column("armature", 0.0),
        joint_damping=column("joint_damping", np.nan),
        friction=column("friction", np.nan),
        effort_limit=np.array([row.get("effort_limit", own) for row, own in zip(rows, effort_limit, strict=True)]),
        saturation_effort=np.where(motor, column("saturation_effort", np.inf), np.inf),
        no_load_speed=np.where(motor, column("velocity_limit", np.inf), np.inf),
        effort_tables=tuple(table(row, sign) for row, sign in zip(rows, signs, strict=True)),
        delay=np.array([row.get("delay", [0, 0]) for row in rows], dtype=np.float64),
        groups=groups,
        networks=networks,
    )
