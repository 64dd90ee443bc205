"""Metadata of an exported ONNX file: all that a robot's loop needs, so that it reads no other file.

The keys `run_path`, `joint_names`, `joint_stiffness`, `joint_damping`, `default_joint_pos`,
`action_scale`, `observation_names` and `command_names` are those of mjlab's exporter (mjlab,
`rl/exporter_utils.py`, Apache-2.0); the others are polypod's. Lists are written with commas
between, numbers so that float32 is read back exactly.
"""

from collections.abc import Iterable, Sequence

from polypod import _core
from polypod.export.robot import RobotInterface
from polypod.observation import Term

COMMAND_RANGES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
"""Names of the numbers of a velocity command, in order."""
_ELEMENTS = {"vector": ("x", "y", "z"), "pseudovector": ("x", "y", "z"), "planar_velocity": ("x", "y", "yaw")}
"""Names of the numbers of a term by its kind."""


def of_observation(terms: Sequence[Term], action_names: Sequence[str], run_path: str, step_dt: float) -> dict[str, str]:
    """Entries for all robots: the columns of the observation and of the action.

    `observation_clips` holds `low:high` per term, or nothing where it has no limits;
    `observation_offsets` is subtracted first, `observation_scales` multiplies last.
    `observation_columns` and `action_names` have a name per number.
    """
    treatments = [term.treatment for term in terms]
    return {
        "run_path": run_path,
        "step_dt": _number(step_dt),
        "observation_names": _list([term.term for term in terms]),
        "observation_sizes": _list([str(term.size) for term in terms]),
        "observation_history_lengths": _list([str(term.history_length) for term in terms]),
        "observation_sources": _list([term.source for term in terms]),
        "observation_offsets": _numbers([treatment.offset for treatment in treatments]),
        "observation_clips": _list(
            ["" if clip is None else _pair(clip) for clip in (treatment.clip for treatment in treatments)]
        ),
        "observation_scales": _numbers([treatment.scale for treatment in treatments]),
        "observation_columns": _list(observation_columns(terms, action_names)),
        "command_names": _list([term.term for term in terms if term.source == "velocity_command"]),
        "action_names": _list(action_names),
    }


def of_robot(robot: RobotInterface) -> dict[str, str]:
    """A robot's numbers, joints in its own order.

    Gains (N m/rad, N m s/rad), pose (rad), limits (rad, N m).

    The target of joint j of `action_joint_names` is `default_joint_pos[j] + action_scale[j] *
    actions[c]` with c of `action_columns`; all other targets are the default pose. `action_scale`
    has the joint's sign, and so have the numbers of the joint in the observation (`joint_signs`).
    """
    info = robot.info
    names = [robot.joint_names[joint] for joint in robot.joint_of_slot]
    scales, signs = [0.0] * len(robot.joint_names), [0.0] * len(robot.joint_names)
    for joint, sign in zip(robot.joint_of_slot.tolist(), robot.signs.tolist(), strict=True):
        scales[joint], signs[joint] = sign * robot.action_scale, sign
    said = {
        "robot": robot.name,
        "joint_names": _list(robot.joint_names),
        "joint_stiffness": _numbers(info["stiffness"]),
        "joint_damping": _numbers(info["damping"]),
        "default_joint_pos": _numbers(info["default_pose"]),
        "joint_effort_limit": _limits(info["effort_limit"], "inf"),
        "joint_pos_lower": _limits(info["lower"], "-inf"),
        "joint_pos_upper": _limits(info["upper"], "inf"),
        "joint_signs": _numbers(signs),
        "action_joint_names": _list(names),
        "action_columns": _list([str(column) for column in robot.columns.tolist()]),
        "action_scale": _numbers(scales),
        "base_com": _numbers(robot.base_com.tolist()),
        "command_ranges": _list([_pair(robot.command_ranges[key]) for key in COMMAND_RANGES]),
    }
    if robot.constants:
        said["observation_constants"] = _numbers(x for value in robot.constants.values() for x in value.tolist())
    if len(robot.scan_points):
        said["height_scan_points"] = _list([_pair(point) for point in robot.scan_points.tolist()])
    return said


def observation_columns(terms: Sequence[Term], action_names: Sequence[str]) -> list[str]:
    """A name per number of the observation, such as `joint_pos_rel.LF_HAA`.

    Numbers of a term that remembers end in the control step that they are of: `[-1]` is the one
    before the present one, `[0]`.
    """
    columns = []
    for term in terms:
        elements = _elements(term, action_names)
        names = [f"{term.term}.{element}" if element else term.term for element in elements]
        if term.history_length == 1:
            columns += names
        else:
            columns += [f"{name}[{step}]" for step in range(1 - term.history_length, 1) for name in names]
    return columns


def _elements(term: Term, action_names: Sequence[str]) -> list[str]:
    """Names of the numbers of one control step of a term."""
    if term.kind == "per_joint" and action_names and term.width % len(action_names) == 0:
        numbers = term.width // len(action_names)
        ends = [""] if numbers == 1 else [f".{number}" for number in range(numbers)]
        return [f"{slot}{end}" for end in ends for slot in action_names]
    if len(known := _ELEMENTS.get(term.kind, ())) == term.width:
        return list(known)
    return [""] if term.width == 1 else [str(number) for number in range(term.width)]


def _list(values: Iterable[str]) -> str:
    """Raises ConfigError for a value that a list would not give back."""
    values = list(values)
    for value in values:
        if "," in value:
            raise _core.ConfigError(
                f"the name {value!r} holds a comma, which separates the names in an exported file; rename it"
            )
    return ",".join(values)


def _number(value: float) -> str:
    # nine digits tell every float32 from its neighbours
    return f"{value:.9g}"


def _numbers(values: Iterable[float]) -> str:
    return _list(_number(value) for value in values)


def _pair(values: Sequence[float]) -> str:
    return ":".join(_number(value) for value in values)


def _limits(values: Sequence[float | None], none: str) -> str:
    """Limits of joints, of which some have none."""
    return _list(none if value is None else _number(value) for value in values)
