"""Gains of drafted robots on two legs, joint by joint.

Makers let a policy balance a robot on two legs: their ankles are far softer than their hips, and no
such robot stands on its gains alone. The rule predicts the gains of `configs/robots` from weight,
height of the hips and effort limits, which a URDF has:

    load  = weight x height of the hips
    leg   = LEG x (15 kg / mass)^0.2 x load
    hips, knees, other joints of legs   leg^0.75 x effort^0.25
    torso                               leg^0.5 x effort^0.5
    ankles                              effort, at most leg
    arms, heads                         ARM x load, at most leg

with stiffness in N m/rad and effort in N m. Damping is a share of the stiffness.
"""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from polypod import _core, simulated
from polypod.compat import tomllib

GRAVITY = 9.81
LEG = 0.41
"""Stiffness of a hip or knee whose effort limit is as large, over the load; of a robot of
`USUAL_MASS`. `configs/robots` have 0.19 to 1.24."""
USUAL_MASS = 15.0
POWER_OF_MASS = -0.2
"""Light robots are stiffer, as among quadrupeds."""
ARM = 0.085
"""Stiffness of arms and heads over the load; `configs/robots` have 0.067 to 0.124."""
SHARE_OF_EFFORT = {"TORSO": 0.5, "ANKLE": 1.0}
SHARE_IN_LEGS = 0.25
DAMPING = {"ANKLE": 0.06, "ARM": 0.1}
"""Damping over stiffness, s; makers have 0.02 to 0.2 at ankles and 0.06 to 0.25 at arms."""
DAMPING_OF_LEGS = 0.04
"""Makers have 0.025 to 0.064."""
EFFORT_OF_ANKLES, EFFORT_OF_LEGS = 0.16, 0.38
"""Effort limit over the load where the URDF has only a placeholder: of a heavy robot's ankles, and
of other joints."""
HEAVY = 50.0
"""Mass of a heavy robot, kg. Torques grow with the volume and the load with length more, so that
ankles of lighter robots are stronger, as those of hobby servos: at most like their legs."""
LEAST_EFFORT = 0.15
"""Legs of one effort limit below this share of the load state no motor's: exporters write 1 N m
into every joint. Knees of makers have 0.36 and more."""
ASSUMED = "assumed: the URDF's is no motor's"
"""Comment on such a limit in the config."""
LISTED = 3
"""Number of roles up to which the name of a group lists them."""


def stiffness(slot: str, mass: float, hip_height: float, effort: float) -> float:
    """Stiffness of the joint of a slot, N m/rad.

    Args:
        slot: name of the slot, such as `L_HIP_PITCH`.
        mass: of the robot, kg.
        hip_height: height of the hips above the soles in the default pose, m.
        effort: effort limit of the joint, N m.
    """
    load = mass * GRAVITY * hip_height
    leg = LEG * (mass / USUAL_MASS) ** POWER_OF_MASS * load
    part = part_of(slot)
    if part == "ARM":
        return min(ARM * load, leg)
    share = SHARE_OF_EFFORT.get(part, SHARE_IN_LEGS)
    most = leg if part == "ANKLE" else float("inf")
    return min(leg ** (1.0 - share) * effort**share, most)


def assumed_effort(slot: str, mass: float) -> float:
    """Effort limit over the load of a joint whose URDF has only a placeholder."""
    if part_of(slot) != "ANKLE":
        return EFFORT_OF_LEGS
    return min(EFFORT_OF_ANKLES * (mass / HEAVY) ** (-1 / 3), EFFORT_OF_LEGS)


def damping(slot: str, stiff: float) -> float:
    """Damping of the joint of a slot of this stiffness, N m s/rad."""
    return DAMPING.get(part_of(slot), DAMPING_OF_LEGS) * stiff


def part_of(slot: str) -> str:
    """`ANKLE`, `LEG`, `TORSO`, or `ARM` for arms and heads."""
    if slot.startswith("TORSO_"):
        return "TORSO"
    if re.search(r"_(SHOULDER|ELBOW|WRIST|FINGER)", slot) or not slot.startswith(("L_", "R_")):
        return "ARM"
    return "ANKLE" if "_ANKLE" in slot else "LEG"


def with_gains(text: str, robot: Path) -> tuple[str, list[str]]:
    """The text of a drafted config with these gains, and what was assumed of its motors.

    Drafts with another number of legs stay as they are.

    Args:
        text: the draft.
        robot: its file, with that text.
    """
    sim = _core.VecSim("velocity_flat_any_legged_play", 1, robots=[str(robot)], threads=1)
    (info,) = simulated.robots(sim).values()
    if len(info["legs"]) != 2:
        return text, []
    lines = text.splitlines()
    start = next(at for at, line in enumerate(lines) if line.startswith("[actuators."))
    end = next(at for at, line in enumerate(lines) if at > start and not line)
    groups, notes = _groups(lines[start:end], info)
    return "\n".join([*lines[:start], *groups, *lines[end:], ""]), notes


def _groups(lines: Sequence[str], info: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """The tables of the actuators, joints of equal gains and limits in one each; and notes.

    A draft gives each joint an effort limit.
    """
    mass, height = info["mass"], info["base_height"] + info["hip_height"]
    load = mass * GRAVITY * height
    slots = dict(zip(info["slots"], info["joint_of_slot"], strict=True))
    stated = {info["effort_limit"][joint] for slot, joint in slots.items() if part_of(slot) in ("LEG", "ANKLE")}
    is_placeholder = len(stated) == 1 and max(stated) < LEAST_EFFORT * load
    groups: dict[tuple[str, ...], list[str]] = {}
    limits = _limits(lines, slots)
    replaced: dict[float, list[str]] = {}
    for slot, joint in slots.items():
        effort, effort_line, speed_line = info["effort_limit"][joint], *limits[slot]
        if is_placeholder and effort in stated:
            effort = rounded(assumed_effort(slot, mass) * load)
            effort_line = f"effort_limit = {effort!r}          # N m, {ASSUMED}"
            replaced.setdefault(effort, []).append(info["joint_names"][joint])
        stiff = rounded(stiffness(slot, mass, height, effort))
        own: tuple[str, ...] = (
            f"stiffness = {stiff!r}             # N m / rad",
            f"damping = {rounded(damping(slot, stiff))!r}               # N m s / rad",
            effort_line,
            speed_line,
        )
        groups.setdefault(own, []).append(slot)
    out: list[str] = []
    names: list[str] = []
    for own, members in groups.items():
        name, patterns = _pattern(members, list(slots))
        if name in names:
            name = f"{name}_{len(names)}"
        names.append(name)
        out += [f"[actuators.{name}]", f"joints = {json.dumps(patterns)}"]
        out += ['model = "ideal_pd"            # ideal_pd | dc_motor | delayed_pd', *own]
    notes = [
        f"[actuators]: the URDF's effort limit of {max(stated):g} N m is no motor's, for {', '.join(joints)}; "
        f"{effort} N m follow from weight and hip height: write the motor's"
        for effort, joints in replaced.items()
    ]
    return out, notes


def _limits(lines: Sequence[str], slots: Collection[str]) -> dict[str, tuple[str, str]]:
    """The lines with a slot's limits of effort and speed, and what they say of their origin."""
    found: dict[str, tuple[str, str]] = {}
    starts = [at for at, line in enumerate(lines) if line.startswith("[")]
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        table = lines[start:end]
        patterns: list[str] = tomllib.loads("\n".join(table[1:]))["joints"]
        effort, speed = (next(line for line in table if line.startswith(key)) for key in ("effort_", "velocity_"))
        for slot in slots:
            if any(fnmatchcase(slot, pattern) for pattern in patterns):
                found[slot] = (effort, speed)
    return found


def _pattern(members: Collection[str], slots: Collection[str]) -> tuple[str, list[str]]:
    """A name for a group, and its patterns: one for both sides where both are members."""
    if len(members) == len(slots):
        return "legs", ["*"]
    roles: dict[str, str] = {}
    for slot in members:
        side, _, role = slot.partition("_")
        pattern = f"*_{role}"
        reached = [other for other in slots if fnmatchcase(other, pattern)]
        is_whole = side in ("L", "R") and len(reached) > 1 and set(reached) <= set(members)
        roles[pattern if is_whole else slot] = (role if side in ("L", "R") else slot).lower()
    names = list(dict.fromkeys(roles.values()))
    name = "_and_".join([*names[:LISTED], "others"] if len(names) > LISTED else names)
    return name, list(roles)


def rounded(value: float) -> float:
    """Two significant digits: a draft knows no more."""
    return float(f"{value:.2g}")
