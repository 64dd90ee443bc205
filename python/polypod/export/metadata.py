"""What an exported ONNX file says of itself, so that a robot needs no other file.

The keys `run_path`, `joint_names`, `joint_stiffness`, `joint_damping`, `default_joint_pos`, `action_scale`,
`observation_names` and `command_names` are those of mjlab's exporter (mjlab, `rl/exporter_utils.py`, Apache-2.0); the
others are polypod's. Lists are written with commas between, numbers so that float32 is read back exactly.
"""

import math
from collections.abc import Sequence

from polypod.export.robot import RobotInterface
from polypod.observation import Term


def of_observation(terms: Sequence[Term], run_path: str, step_dt: float) -> dict[str, str]:
    """What holds for all robots: the terms of the observation, in order, and what the task does to each.

    `observation_clips` holds `low:high` per term, or nothing where it has no limits; `observation_offsets` is
    subtracted first, `observation_scales` multiplies last.
    """
    treatments = [term.treatment for term in terms]
    return {
        "run_path": run_path,
        "step_dt": _number(step_dt),
        "observation_names": _list([term.term for term in terms]),
        "observation_sizes": _list([str(term.size) for term in terms]),
        "observation_history_lengths": _list([str(term.history_length) for term in terms]),
        "observation_offsets": _numbers([treatment.offset for treatment in treatments]),
        "observation_clips": _list(
            ["" if clip is None else f"{_number(clip[0])}:{_number(clip[1])}" for clip in (t.clip for t in treatments)]
        ),
        "observation_scales": _numbers([treatment.scale for treatment in treatments]),
        "command_names": _list([term.term for term in terms if term.source == "velocity_command"]),
    }


def of_robot(robot: RobotInterface) -> dict[str, str]:
    """A robot's joints, in its own order: names, gains (N m/rad, N m s/rad), pose (rad), limits (rad, N m).

    `action_scale` is in rad per unit of action. `action_joint_names` are the joints that the numbers of an action move.
    A limit that a joint lacks is `-inf` or `inf`.
    """
    joints = len(robot.joint_names)
    action_joints = [robot.joint_names[joint] for joint in robot.joint_of_slot]
    return {
        "robot": robot.name,
        "joint_names": _list(robot.joint_names),
        "joint_stiffness": _numbers(robot.info["stiffness"]),
        "joint_damping": _numbers(robot.info["damping"]),
        "default_joint_pos": _numbers(robot.info["default_pose"]),
        "action_scale": _numbers([robot.action_scale] * joints),
        "joint_effort_limit": _limits(robot.info["effort_limit"], math.inf),
        "joint_pos_lower": _limits(robot.info["lower"], -math.inf),
        "joint_pos_upper": _limits(robot.info["upper"], math.inf),
        "action_joint_names": _list(action_joints),
    }


def _list(values: Sequence[str]) -> str:
    return ",".join(values)


def _number(value: float) -> str:
    # nine digits tell every float32 from its neighbours
    return f"{value:.9g}"


def _limits(values: Sequence[float | None], absent: float) -> str:
    return _numbers([absent if value is None else value for value in values])


def _numbers(values: Sequence[float]) -> str:
    return _list([_number(value) for value in values])
