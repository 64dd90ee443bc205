"""Actuators of a compiled MJCF file, added up at the joints that they act on.

Gains and limits are those at the joint: both count `gear`.
"""

from collections.abc import Mapping

import numpy as np

from polypod.add.compiling import Compiled, mujoco
from polypod.add.description import Drive, listed
from polypod.add.geared import coefficients


def drives_of(made: Compiled, names: Mapping[int, str], notes: list[str]) -> dict[int, Drive]:
    """Drives of the joints.

    Args:
        made: the compiled file.
        names: the robot's joints by number.
        notes: gets a line for joints that are driven otherwise.
    """
    mj, model = mujoco(), made.model
    drives: dict[int, Drive] = {}
    odd: dict[str, list[str]] = {}
    at_joint = (int(mj.mjtTrn.mjTRN_JOINT), int(mj.mjtTrn.mjTRN_JOINTINPARENT))
    for index in range(model.nu):
        name = made.named("ACTUATOR", index) or f"actuator_{index}"
        target, kind = int(model.actuator_trnid[index][0]), int(model.actuator_trntype[index])
        if kind == int(mj.mjtTrn.mjTRN_TENDON):
            for joint in _tendon_joints(made, target, names):
                drives.setdefault(joint, Drive())
                odd.setdefault("acts on a tendon: replaced by a position actuator at each of its joints", [])
                odd["acts on a tendon: replaced by a position actuator at each of its joints"].append(name)
            continue
        if kind not in at_joint:
            odd.setdefault("acts on no joint: left out", []).append(name)
            continue
        if target not in names or not made.moves(target):
            continue
        _add(made, index, name, drives.setdefault(target, Drive()), odd)
    for what, those in odd.items():
        unique = list(dict.fromkeys(those))
        notes.append(f"actuator {listed(unique)}: {what}")
    for joint, drive in drives.items():
        limit = _joint_effort(made, joint)
        drive.effort = limit if drive.effort is None else drive.effort if limit is None else min(drive.effort, limit)
    return drives


def _add(made: Compiled, index: int, name: str, drive: Drive, odd: dict[str, list[str]]) -> None:
    """Adds an actuator to the drive of its joint."""
    mj, model = mujoco(), made.model
    gear = float(model.actuator_gear[index][0])
    gain, bias = float(model.actuator_gainprm[index][0]), model.actuator_biasprm[index]
    fixed = int(model.actuator_gaintype[index]) == int(mj.mjtGain.mjGAIN_FIXED)
    kinds = {
        int(mj.mjtBias.mjBIAS_NONE): (0.0, 0.0),
        int(mj.mjtBias.mjBIAS_AFFINE): (float(bias[1]), float(bias[2])),
    }
    terms = kinds.get(int(model.actuator_biastype[index]))
    if not fixed or terms is None:
        odd.setdefault("is no position, velocity or motor actuator: replaced by a position actuator", []).append(name)
        terms = (0.0, 0.0)
    if int(model.actuator_dyntype[index]) != int(mj.mjtDyn.mjDYN_NONE):
        odd.setdefault("has an activation state: left out, it acts at once", []).append(name)
    pull, brake = (-term * gear * gear for term in terms)
    if pull > 0.0:
        drive.stiffness = (drive.stiffness or 0.0) + pull
    elif brake > 0.0:
        odd.setdefault("is a velocity actuator: replaced by a position actuator", []).append(name)
    if pull > 0.0:
        drive.damping += max(brake, 0.0)
    limits = []
    if model.actuator_forcelimited[index]:
        limits.append(float(np.abs(model.actuator_forcerange[index]).max()) * abs(gear))
    if terms == (0.0, 0.0) and fixed and model.actuator_ctrllimited[index]:
        limits.append(float(np.abs(model.actuator_ctrlrange[index]).max()) * abs(gain * gear))
    if limits and min(limits) > 0.0:
        drive.effort = (drive.effort or 0.0) + min(limits)


def _joint_effort(made: Compiled, joint: int) -> float | None:
    if not made.model.jnt_actfrclimited[joint]:
        return None
    most = float(np.abs(made.model.jnt_actfrcrange[joint]).max())
    return most if most > 0.0 else None


def _tendon_joints(made: Compiled, tendon: int, names: Mapping[int, str]) -> list[int]:
    return [joint for joint in coefficients(made, tendon) if joint in names and made.moves(joint)]


def actuators_of(made: Compiled, joint: int) -> list[int]:
    """Actuators that act on a joint itself."""
    kinds = (int(mujoco().mjtTrn.mjTRN_JOINT), int(mujoco().mjtTrn.mjTRN_JOINTINPARENT))
    return [
        index
        for index in range(made.model.nu)
        if int(made.model.actuator_trntype[index]) in kinds and int(made.model.actuator_trnid[index][0]) == joint
    ]


def of_actuator(made: Compiled, key: str, index: int) -> float:
    """A number of an actuator at its joint; MuJoCo before 4 has none of them."""
    numbers = getattr(made.model, key, None)
    return 0.0 if numbers is None else float(numbers[index]) * float(made.model.actuator_gear[index][0]) ** 2
