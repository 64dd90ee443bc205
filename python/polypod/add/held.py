"""Joints of a compiled MJCF file that do not move in polypod."""

from collections.abc import Container, Mapping

import numpy as np

from polypod.add.compiling import Compiled, mujoco
from polypod.add.description import listed
from polypod.arrays import Array


def held_in(
    made: Compiled, names: Mapping[int, str], home: Array, drives: Container[int], notes: list[str]
) -> dict[str, float]:
    """Joints that equality constraints tie, and undriven joints where others are driven.

    Args:
        made: the compiled file.
        names: the robot's joints by number.
        home: positions of the pose that the file states.
        drives: joints that actuators act on.
        notes: gets a line for each treatment.

    Returns:
        Joint -> position at which it is held, rad or m.
    """
    mj, model = mujoco(), made.model
    held: dict[int, float] = {}
    tied, free, loops, tendons, rotors = [], [], [], [], []
    moved: set[int] = set()
    for index in range(model.neq):
        if not model.eq_active0[index]:
            continue
        kind = int(model.eq_type[index])
        name = made.named("EQUALITY", index) or f"equality_{index}"
        if kind == int(mj.mjtEq.mjEQ_JOINT):
            joint, other = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
            ends = [end for end in (joint, other) if end in names and made.moves(end)]
            if len(ends) == 2 and all(end in drives for end in ends):
                free.append(f"{names[joint]} and {names[other]}")
            elif joint in drives and len(ends) == 2:
                # the joint that is driven moves on; the other one would follow it
                held[other] = float(home[model.jnt_qposadr[other]])
                tied.append(names[other])
                slope = _slope(made, index, other, home)
                rotors += _rotor(made, names, other, joint, 1.0 / slope if slope else 0.0)
            elif joint in ends:
                held[joint] = _tied(made, index, joint, other, home)
                tied.append(names[joint])
                if len(ends) == 2:
                    rotors += _rotor(made, names, joint, other, _slope(made, index, other, home))
        elif kind == int(mj.mjtEq.mjEQ_TENDON):
            tendons.append(name)
        elif _concerns(made, index):
            loops.append(name)
            moved |= _around(made, index)
    if tied:
        notes.append(f"joint {listed(tied)}: tied by an equality constraint: locked")
    notes += rotors
    if free:
        notes.append(f"joint {listed(free)}: tied by an equality constraint, both with actuators: the tie is left out")
    if loops:
        still = [names[joint] for joint in sorted(moved) if joint in names and joint not in drives]
        driven = f"; joint {listed(still)}, which it moves, does not follow it" if drives and still else ""
        notes.append(f"equality {listed(loops)}: closes a loop: left out{driven}")
    if tendons:
        notes.append(f"equality {listed(tendons)}: ties a tendon: left out")
    if drives:
        idle = [joint for joint in names if made.moves(joint) and joint not in drives and joint not in held]
        held |= {joint: float(home[model.jnt_qposadr[joint]]) for joint in idle}
        if idle:
            notes.append(f"joint {listed([names[joint] for joint in idle])}: no actuator acts on it: locked")
    else:
        notes.append("the file has no actuators: replaced by position actuators, with gains by weight")
    return {names[joint]: made.within(joint, position) for joint, position in sorted(held.items())}


def _tied(made: Compiled, index: int, joint: int, other: int, home: Array) -> float:
    """Position at which an equality constraint holds a joint in the home pose."""
    model = made.model
    at = 0.0
    if other >= 0:
        address = model.jnt_qposadr[other]
        at = float(home[address] - model.qpos0[address])
    polynomial = np.polynomial.Polynomial(model.eq_data[index][:5])
    return float(model.qpos0[model.jnt_qposadr[joint]] + polynomial(at))


def _slope(made: Compiled, index: int, other: int, home: Array) -> float:
    """Way of the first joint of an equality constraint per way of the `other`, in the home pose."""
    model = made.model
    address = model.jnt_qposadr[other]
    polynomial = np.polynomial.Polynomial(model.eq_data[index][:5])
    return float(polynomial.deriv()(float(home[address] - model.qpos0[address])))


def _rotor(made: Compiled, names: Mapping[int, str], joint: int, driven: int, ratio: float) -> list[str]:
    """A line for the rotor of a locked joint, which turns `ratio` times as far as a driven one."""
    armature = ratio**2 * float(made.model.dof_armature[made.model.jnt_dofadr[joint]])
    if not armature:
        return []
    return [
        f"armature of joint {names[joint]}: left out, as it is locked: it is {armature:.3g} at joint {names[driven]}; "
        "add it to that joint's armature in the TOML"
    ]


def _ends(made: Compiled, index: int) -> list[int]:
    """Bodies that an equality constraint between bodies or sites holds together."""
    model = made.model
    is_site = int(model.eq_objtype[index]) == int(mujoco().mjtObj.mjOBJ_SITE)
    ends = [int(model.eq_obj1id[index]), int(model.eq_obj2id[index])]
    return [int(model.site_bodyid[end]) if is_site else end for end in ends if end >= 0]


def _concerns(made: Compiled, index: int) -> bool:
    """Whether an equality constraint between bodies or sites holds a part of the robot."""
    return any(end in made.inside for end in _ends(made, index))


def _around(made: Compiled, index: int) -> set[int]:
    """Joints of the loop that an equality constraint closes."""
    loop: set[int] = set()
    for end in _ends(made, index):
        path: set[int] = set()
        body = end
        while body in made.inside:
            path |= set(made.joints_of(body))
            body = int(made.model.body_parentid[body])
        # joints above both ends are no part of it
        loop ^= path
    return {joint for joint in loop if made.moves(joint)}
