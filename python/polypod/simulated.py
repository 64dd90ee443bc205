"""Robots, shapes and config of a simulator, which gives them as text."""

import json
from typing import Any, TypedDict

from polypod import _core
from polypod.compat import tomllib

_Class = TypedDict("_Class", {"class": str})  # a word of Python


class _Networks(TypedDict, total=False):
    """Keys of robots with actuator networks."""

    actuator_networks: list[dict[str, Any]]
    """Networks in the place of gains, with their inputs and joints."""


class HeldJoint(TypedDict):
    """A joint that the policy does not drive."""

    joint: int
    slot: str
    sign: float
    """1 where the joint turns as its slot does, -1 where it turns the other way round."""


class _Held(TypedDict, total=False):
    """Keys of robots in tasks that drive some joints alone (`actions.joint_pos.joint_names`)."""

    held_joints: list[HeldJoint]
    """Joints that hold their default pose."""


class RobotInfo(_Class, _Networks, _Held):
    """Numbers of a robot, joints in its own order; see `VecSim.robot_info`."""

    title: str
    mass: float
    """Mass of all links, kg."""
    joint_names: list[str]
    joint_of_slot: list[int]
    """Joint that each of the robot's slots moves; slots that the task drives."""
    slots: list[str]
    slot_signs: list[float]
    """1 where a joint turns as its slot does, -1 where it turns the other way round."""
    columns: list[int]
    """Column of the action of each slot."""
    default_pose: list[float]
    """Default position of each joint, rad."""
    action_scale: float
    """Change of a target by one unit of action, rad."""
    stiffness: list[float]
    """Stiffness of each joint's gains, N m/rad."""
    damping: list[float]
    """Damping of each joint's gains, N m s/rad."""
    effort_limit: list[float | None]
    """Effort limit of each joint, N m; None: it has none."""
    velocity_limit: list[float]
    """Speed limit of each joint, rad/s."""
    lower: list[float | None]
    upper: list[float | None]
    """Position limits of each joint, rad; None: it has none on this side."""
    base_height: float
    """Height of the base above the lowest foot in the default pose, m."""
    hip_height: float
    """Height of the hips above the base in the default pose, m."""
    feet: list[str]
    legs: list[str]
    mirror: list[tuple[int, float]]
    """Slot that each slot becomes in the mirror image, and the sign of its numbers."""


def robots(sim: _core.VecSim) -> dict[str, RobotInfo]:
    """Numbers of each robot."""
    found: dict[str, RobotInfo] = json.loads(sim.robot_info())
    return found


def standing_height(info: RobotInfo) -> float:
    """Height at which a robot stands, m: `MorphologyModel::standing_height`."""
    height, hips = info["base_height"], info["base_height"] + info["hip_height"]
    return height if height >= 0.5 * hips else hips


def slot_of_joint(info: RobotInfo) -> dict[int, tuple[str, float]]:
    """Slot and direction of each joint, driven or held."""
    driven = zip(info["joint_of_slot"], info["slots"], info["slot_signs"], strict=True)
    held = ((held["joint"], held["slot"], held["sign"]) for held in info.get("held_joints", ()))
    return {joint: (slot, sign) for joint, slot, sign in (*driven, *held)}


def shapes(sim: _core.VecSim) -> dict[str, Any]:
    """Links and collision shapes of each robot; see `VecSim.robot_shapes`."""
    found: dict[str, Any] = json.loads(sim.robot_shapes())
    return found


def config(sim: _core.VecSim) -> dict[str, Any]:
    """The resolved task and its robots; see `VecSim.resolved_config`."""
    return tomllib.loads(sim.resolved_config())
