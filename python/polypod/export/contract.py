"""The contract of a policy and one robot.

The inputs that a loop must give the graph, its outputs, and inputs that are forbidden.

`polypod export` writes it as JSON into the metadata of each graph of one robot.
`contract.schema.json` is its schema, `onboard/policy_loop.py` reads it on the robot, and
docs/deploy.md explains it.
"""

import functools
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from polypod import _core, simulated
from polypod.export import metadata, states
from polypod.export.robot import RobotInterface
from polypod.networks.onnx_network import output_of
from polypod.observation import placed

VERSION = 1
"""Version of the contract. A loop refuses another one."""
KEY = "polypod_contract"
"""Key of the metadata under which the contract stands."""
SUM_KEY = "polypod_contract_sha256"
"""Key of the SHA-256 of the contract's text: a C++ loop compares it with that of its header."""
SCHEMA = Path(__file__).parent / "contract.schema.json"
MOTORS = Path(__file__).parent / "motors.json"
"""Motors of makers' interfaces, by robot."""

STALE_STEPS = 3.0
"""Control steps without a new measurement after which a loop stops: two lost messages are
forgiven."""
MAX_TILT = 1.0
"""Tilt at which a loop stops where the task has no termination by tilt, rad."""
JOINT_MARGIN = 0.1
"""Angle beyond its limits at which a joint may be measured, rad: calibration and the give of a
stop."""
QUATERNION_TOLERANCE = 0.05
"""Largest difference of a quaternion's length from 1."""
DAMPING_TIME = 0.1
"""Damping over stiffness in the damping mode, s: a joint falls as slowly as its own spring would
creep back."""
STAND_TIME = 2.0
"""Time from any pose to the default pose, s."""

ESTIMATED = ("base_lin_vel",)
"""Inputs that no sensor of a robot measures: an estimator gives them."""
MAPPED = ("height_scan",)
"""Inputs that need a map of the ground."""

NEVER = {
    "not_finite": "a number that is not finite: one NaN stays in the memory of a policy for good",
    "base_velocity": "a velocity of the base that is not an input of the graph, or one in world axes",
    "quaternion_order": "a quaternion x, y, z, w: the loop takes w, x, y, z, from base to world axes",
    "degrees": "angles in degrees, and joints in the order or with the zero of another file than joints say",
    "normalized": "observations that are normalised, scaled or clipped already: the graph does all of it",
    "other_action": "a last action other than the output of the step before, such as clipped joint targets",
    "old": "a measurement that is older than safety.stale_after",
    "padding": "anything but 0 in a column of last_action whose joint is null",
    "privileged": "what only a simulator knows: contact forces, friction, masses, terrain beyond the height scan",
}
"""Inputs that a loop must never feed, by a short name."""

FRAMES = {
    "base": "x forward, y left, z up, at the origin of the base link",
    "quaternion": "w, x, y, z",
    "quaternion_turns": "base axes to world axes, world z up",
    "angular_velocity": "base axes, rad/s",
    "linear_velocity": "of the base link's origin, base axes, m/s",
    "gravity": "unit vector along gravity, base axes: 0, 0, -1 for a level robot",
    "joint_position": "rad, or m for a joint that slides",
}
"""Frames and units of all measurements."""

COMMAND_UNITS = ("m/s", "m/s", "rad/s")


def of(
    robot: RobotInterface,
    memory: Mapping[str, states.Shape],
    policy: Mapping[str, Any],
    *,
    is_folded: bool,
    is_normalized: bool,
    step_dt: float,
    description: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The contract of a graph.

    Args:
        robot: the interface of policy and robot.
        memory: states of the graph, see `polypod.export.states`.
        policy: name, task, checkpoint_sha256, iteration and polypod.
        is_folded: whether the graph takes sensors and gives joint targets; otherwise it takes the
            observation.
        is_normalized: whether the graph normalises its observation.
        step_dt: control step, s.
        description: whether the robot is one of the training, else its distance from the nearest
            body of it, see `polypod.descriptions`; None: unknown.
    """
    physics_dt = float(robot.task["sim"]["dt"])
    joints = _joints(robot, physics_dt)
    return {
        "version": VERSION,
        "graph": "folded" if is_folded else "network",
        "policy": dict(policy),
        "robot": {
            "name": robot.name,
            "title": str(robot.info.get("title", robot.name)),
            "mass": float(robot.info["mass"]),
            "base_height": float(robot.info["base_height"]),
            "base_com": [_float(x) for x in robot.base_com],
            "feet": list(robot.info.get("feet", ())),
        },
        "rates": {"control_dt": float(step_dt), "physics_dt": physics_dt, "hold": "zero_order"},
        "frames": FRAMES,
        "joints": joints,
        "columns": _columns(robot),
        "observation": _observation(robot, is_normalized),
        "inputs": _inputs(robot, is_folded),
        "outputs": _outputs(robot, is_folded),
        "states": [
            {"input": name, "output": output_of(name), "shape": list(states.full_shape(shape, 1))}
            for name, shape in memory.items()
        ],
        "command": {
            "names": list(metadata.COMMAND_RANGES),
            "units": list(COMMAND_UNITS),
            "low": [_float(robot.command_ranges[key][0]) for key in metadata.COMMAND_RANGES],
            "high": [_float(robot.command_ranges[key][1]) for key in metadata.COMMAND_RANGES],
        },
        "height_scan": {"points": [[_float(x) for x in point] for point in robot.scan_points]}
        if len(robot.scan_points)
        else None,
        "needs": {
            "estimated": [name for name in robot.inputs() if name in ESTIMATED],
            "mapped": [name for name in robot.inputs() if name in MAPPED],
        },
        "never": NEVER,
        "safety": _safety(robot, joints, step_dt),
        "description": None if description is None else dict(description),
        "motors": motors_of(robot.name),
    }


def text_of(contract: Mapping[str, Any]) -> str:
    """The contract as the text that a graph holds.

    Raises ConfigError for a number that is not finite.
    """
    try:
        return json.dumps(contract, separators=(",", ":"), allow_nan=False)
    except ValueError as error:
        raise _core.ConfigError(
            f"the contract of {contract['robot']['name']} holds a number that is not finite"
        ) from error


def entries(contract: Mapping[str, Any]) -> dict[str, str]:
    """The metadata of a graph that hold the contract."""
    text = text_of(contract)
    return {KEY: text, SUM_KEY: hashlib.sha256(text.encode()).hexdigest()}


@functools.cache
def _motors() -> dict[str, Any]:
    robots: dict[str, Any] = json.loads(MOTORS.read_text(encoding="utf-8"))["robots"]
    return robots


def motors_of(robot: str) -> dict[str, Any] | None:
    """Motors of the maker's interface in its order; None if unknown.

    Joints by name, null where a motor is none.
    """
    found: dict[str, Any] | None = _motors().get(robot)
    return found


def _joints(robot: RobotInterface, physics_dt: float) -> list[dict[str, Any]]:
    info = robot.info
    groups: Mapping[str, Mapping[str, Any]] = robot.config["actuators"]
    slot_of = {joint: at for at, joint in enumerate(robot.joint_of_slot.tolist())}
    # joints that the policy does not drive have actuators, too
    own_slots = simulated.slot_of_joint(info)
    late = _task_delay(robot)
    joints = []
    for joint, name in enumerate(robot.joint_names):
        at = slot_of.get(joint)
        slot = None if at is None else robot.action_names[robot.columns[at]]
        sign = 0.0 if at is None else float(robot.signs[at])
        own, _ = own_slots.get(joint, ("", 0.0))
        group = next(
            (group for group in groups.values() if own and any(fnmatchcase(own, p) for p in group["joints"])), {}
        )
        low, high = group.get("delay", (0, 0))
        joints.append(
            {
                "name": name,
                "slot": slot,
                "column": None if at is None else int(robot.columns[at]),
                "sign": sign,
                "action_scale": _float(sign * robot.action_scale),
                "default_pos": _float(info["default_pose"][joint]),
                "lower": _limit(info["lower"][joint]),
                "upper": _limit(info["upper"][joint]),
                "stiffness": _float(info["stiffness"][joint]),
                "damping": _float(info["damping"][joint]),
                "armature": _float(group.get("armature", 0.0)),
                "effort_limit": _limit(info["effort_limit"][joint]),
                "velocity_limit": _limit(info["velocity_limit"][joint]),
                "delay": [_float((low + late[0]) * physics_dt), _float((high + late[1]) * physics_dt)],
                "drive": "network" if "network_file" in group else "gains",
            }
        )
    return joints


def _task_delay(robot: RobotInterface) -> tuple[int, int]:
    """Physics steps by which the training delayed all targets of a robot, fewest and most."""
    event = robot.task.get("events", {}).get("action_delay")
    if not event or not event.get("enabled", True):
        return 0, 0
    low, high = event.get("delay_range", robot.config.get("randomization", {}).get("action_delay", (0, 0)))
    return int(low), int(high)


def _columns(robot: RobotInterface) -> list[dict[str, Any]]:
    joint_of = dict(zip(robot.columns.tolist(), robot.joint_of_slot.tolist(), strict=True))
    return [{"name": name, "joint": joint_of.get(column)} for column, name in enumerate(robot.action_names)]


def _observation(robot: RobotInterface, is_normalized: bool) -> dict[str, Any]:
    terms = []
    for term, at in placed(robot.terms):
        constant = None if term.inputs else robot.constants.get(term.term)
        clip = term.treatment.clip
        terms.append(
            {
                "name": term.term,
                "start": at.start,
                "size": term.size,
                "history": term.history_length,
                "source": term.source,
                "units": term.units,
                "inputs": list(term.inputs),
                "offset": _float(term.treatment.offset),
                "clip": None if clip is None else [_float(clip[0]), _float(clip[1])],
                "scale": _float(term.treatment.scale),
                "constant": None if constant is None else [_float(x) for x in constant],
            }
        )
    return {
        "size": sum(term.size for term in robot.terms),
        "order": "oldest_first",
        "first_step": "the past is filled with the first reading",
        "padding": "0 in each column whose joint is null",
        "normalization": "in_graph" if is_normalized else "none",
        "terms": terms,
    }


def _inputs(robot: RobotInterface, is_folded: bool) -> list[dict[str, Any]]:
    sizes = robot.inputs()
    if not is_folded:
        meaning = "the observation: see observation.terms"
        return [{"name": "obs", "size": sum(term.size for term in robot.terms), "meaning": meaning}]
    return [{"name": name, "size": size, "meaning": robot.meaning(name)} for name, size in sizes.items()]


def _outputs(robot: RobotInterface, is_folded: bool) -> list[dict[str, Any]]:
    actions = {"name": "actions", "size": robot.num_actions}
    return [{"name": "joint_pos_target", "size": len(robot.joint_names)}, actions] if is_folded else [actions]


def _safety(robot: RobotInterface, joints: Sequence[Mapping[str, Any]], step_dt: float) -> dict[str, Any]:
    tilt = robot.task.get("terminations", {}).get("bad_orientation", {}).get("limit_angle", MAX_TILT)
    return {
        "behaviour": "damping",
        "latched": True,
        "stale_after": _float(STALE_STEPS * step_dt),
        "max_tilt": _float(min(max(float(tilt), 0.1), 0.5 * math.pi)),
        "joint_margin": JOINT_MARGIN,
        "quaternion_tolerance": QUATERNION_TOLERANCE,
        "damping": [_float(max(joint["damping"], DAMPING_TIME * joint["stiffness"])) for joint in joints],
        "stand_time": STAND_TIME,
        "faults": list(FAULTS),
    }


FAULTS = (
    "sensor_missing",
    "sensor_size",
    "sensor_not_finite",
    "sensor_stale",
    "quaternion_not_unit",
    "tilt",
    "joint_limit",
    "command_not_finite",
    "action_not_finite",
)
"""Faults after which a loop damps, in the order in which it looks for them."""


def _float(value: Any) -> float:
    """A number that reads back as the same float32."""
    return float(f"{float(value):.9g}")


def _limit(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else _float(value)
