"""The TOML of an added robot: the draft, with the file's actuators and pose to stand in."""

import dataclasses
import json
import re
from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Any

from polypod.add.description import Description, Joint, Surface
from polypod.compat import tomllib

_HEAD = "# Drafted by `polypod robot new`"
_SOFT = re.compile(r"^soft_limit_factor = [\d.]+")
_UNITS = {
    "stiffness": "N m / rad",
    "damping": "N m s / rad",
    "effort_limit": "N m",
    "velocity_limit": "rad/s",
    "armature": "kg m^2",
    "spring_stiffness": "N m / rad",
    "spring_reference": "rad",
}


@dataclasses.dataclass(frozen=True)
class Slots:
    """Joint of the file for each slot, and its direction."""

    joint_of: dict[str, str]
    sign_of: dict[str, float]

    @classmethod
    def of(cls, info: Mapping[str, Any]) -> "Slots":
        """Reads the `robot_info` of a simulation of the robot."""
        names = info["joint_names"]
        joints = {slot: names[joint] for slot, joint in zip(info["slots"], info["joint_of_slot"], strict=True)}
        return cls(joints, dict(zip(info["slots"], info["slot_signs"], strict=True)))


def refined(draft: str, robot: Description, slots: Slots, origin: str, *, posed: bool) -> str:
    """The text of a draft with the file's gains, limits, rotors and, where `posed`, pose."""
    joints = {joint.name: joint for joint in robot.joints}
    own = {slot: joints[name] for slot, name in slots.joint_of.items() if name in joints}
    config = tomllib.loads(draft)
    pieces = _sections(draft)
    if posed:
        pose = [f"{slot} = {_number(slots.sign_of[slot] * joint.home)}" for slot, joint in own.items()]
        if any(_is_near_limit(joint, config["reset"]["soft_limit_factor"]) for joint in own.values()):
            pieces = [(name, [_SOFT.sub("soft_limit_factor = 1.0", line) for line in lines]) for name, lines in pieces]
        comment = f"# Joint angles of the default pose, rad: the keyframe {json.dumps(robot.pose)} of the file."
        pieces = _replaced(pieces, ["default_pose"], [comment, "[default_pose]", *pose])
    text = _actuators(config["actuators"], own, slots.sign_of)
    if text:
        pieces = _replaced(pieces, [f"actuators.{group}" for group in config["actuators"]], text)
    surfaces = _surfaces(robot)
    if surfaces:
        pieces.append(("surfaces", surfaces))
    return (
        "\n\n".join("\n".join(lines) for _, lines in pieces).replace(
            _HEAD + " from the URDF alone", f"# Added by `polypod add` from {json.dumps(origin)}"
        )
        + "\n"
    )


def _is_near_limit(joint: Joint, factor: float) -> bool:
    """Whether resets, which use a share of a joint's range, could not begin at its home."""
    margin = 0.5 * (1.0 - factor) * (joint.upper - joint.lower)
    return not joint.lower + margin <= joint.home <= joint.upper - margin


def _number(value: float) -> str:
    return repr(float(f"{value:.9g}") + 0.0)


def _sections(text: str) -> list[tuple[str, list[str]]]:
    """Tables of a text by name, each with the comment above it; the first has no name."""
    sections: list[tuple[str, list[str]]] = [("", [])]
    comment: list[str] | None = None
    for line in text.splitlines():
        if line.startswith("["):
            sections.append((line[1 : line.index("]")], [*(comment or []), line]))
            comment = None
        elif not line.strip():
            # a comment below an empty line is the next table's
            sections[-1][1].extend(comment or [])
            comment = []
        elif comment is not None and line.startswith("#"):
            comment.append(line)
        else:
            sections[-1][1].extend([*(comment or []), line])
            comment = None
    return sections


def _replaced(sections: list[tuple[str, list[str]]], names: list[str], lines: list[str]) -> list[tuple[str, list[str]]]:
    """Sections with `lines` in the place of those of `names`."""
    out: list[tuple[str, list[str]]] = []
    is_done = False
    for name, own in sections:
        if name not in names:
            out.append((name, own))
        elif not is_done:
            out.append((name, lines))
            is_done = True
    return out


def _surfaces(robot: Description) -> list[str]:
    """Tables of surfaces: the links whose contact with the ground is not the usual one."""
    tables: dict[Surface, list[str]] = {}
    for link in robot.links:
        if link.shapes and link.shapes[0].surface != Surface():
            tables.setdefault(link.shapes[0].surface, []).append(link.name)
    lines: list[str] = []
    for surface, members in tables.items():
        lines += (
            [""] if lines else ["# Surfaces on the file's ground. Friction is a factor in a task, whose ground has 1."]
        )
        lines.append(f"[surfaces.{re.sub(r'[^A-Za-z0-9_-]', '_', members[0])}]")
        lines.append(f"bodies = [{', '.join(json.dumps(name) for name in members)}]")
        lines.append(f"friction = {surface.friction!r}")
        figures = {key: value for key, value in dataclasses.asdict(surface).items() if key != "friction" and value}
        lines += [f"{key} = {value!r}   # m" for key, value in figures.items()]
    return lines


def _actuators(groups: Mapping[str, Any], own: Mapping[str, Joint], signs: Mapping[str, float]) -> list[str]:
    """Tables of actuators, where the file says anything of them.

    Joints with the same figures are a group.
    """
    if not any(joint.drive is not None or joint.armature or joint.stiffness for joint in own.values()):
        return []
    tables: dict[tuple[tuple[str, float], ...], list[str]] = {}
    for slot, joint in own.items():
        drafted = next(group for group in groups.values() if any(fnmatchcase(slot, p) for p in group["joints"]))
        figures = {key: float(drafted[key]) for key in ("stiffness", "damping", "effort_limit") if key in drafted}
        if "velocity_limit" in drafted:
            figures["velocity_limit"] = float(drafted["velocity_limit"])
        if joint.drive is not None and joint.drive.stiffness is not None:
            figures |= {"stiffness": joint.drive.stiffness, "damping": joint.drive.damping}
        if joint.drive is not None and joint.drive.effort is not None:
            figures["effort_limit"] = joint.drive.effort
        if joint.armature:
            figures["armature"] = joint.armature
        if joint.stiffness:
            figures["spring_stiffness"] = joint.stiffness
            if joint.rest:
                figures["spring_reference"] = signs[slot] * joint.rest
        # rotors and springs are kept to the last digit: accelerations follow from them
        kept = ("armature", "spring_stiffness", "spring_reference")
        exact = {key: value if key in kept else float(f"{value:.9g}") for key, value in figures.items()}
        tables.setdefault(tuple(exact.items()), []).append(slot)
    lines = [
        "# Gains, limits of effort and rotors of the file's actuators; where it has none, by weight and leg length."
    ]
    names: list[str] = []
    for figures_of, members in tables.items():
        name = _group_name(members, names)
        names.append(name)
        lines += [f"[actuators.{name}]", f"joints = [{', '.join(json.dumps(slot) for slot in members)}]"]
        lines.append('model = "ideal_pd"            # ideal_pd | dc_motor | delayed_pd')
        lines += [f"{key} = {value!r}   # {_UNITS[key]}" for key, value in figures_of]
    return lines


def _group_name(members: list[str], taken: list[str]) -> str:
    roles = list(dict.fromkeys("_".join(slot.split("_")[1:]).lower() or slot.lower() for slot in members))
    name = "_and_".join(roles[:2]) + ("_and_others" if len(roles) > 2 else "")
    return name if name not in taken else f"{name}_{len(taken) + 1}"
