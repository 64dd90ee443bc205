"""Bipeds and humanoids as different as makers build them, for `polypod bodies generate --wide`.

A body is drawn standing upright on straight legs with hanging arms, the upright pose. Every angle
counts from there. The choices of makers come on top: the pose that a file calls zero, the
place of its base frame, canted axes, limits, and drives of each group of joints. The default pose
follows: soles are level, below the centre of mass. Lengths are shares of the leg's.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from polypod import rotations
from polypod.arrays import Array
from polypod.bodies.parts import HIP_ORDERS, Body, Drive, Joint, Link, Vector, around, log_uniform, rod

POINTS = 0.2
"""Share of bipeds on points."""
_CANT = 0.3
"""Share of bodies with canted axes."""
_IN_LEGS, _IN_ARMS, _IN_BASE = 0.52, 0.28, 0.12
"""Largest shares of the mass in both legs and in both arms, and the least share in the base."""
_STATED = {"WRIST_ROLL": 0, "WRIST_PITCH": 1, "WRIST_YAW": 2}
"""Axes that these roles state, x, y and z."""
_TOLD = 0.1
"""Least cosine with which an axis has a direction along the role's, as in src/robot."""


@dataclasses.dataclass
class _Part:
    """A link of the upright pose with the joint that holds it."""

    link: Link
    """Link whose shape is relative to the joint."""
    parent: str = ""
    """Empty for the base."""
    joint: str = ""
    at: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Place relative to the parent's joint, m."""
    axis: tuple[float, ...] = (0.0, 1.0, 0.0)
    lower: float = 0.0
    upper: float = 0.0
    group: str = ""
    angle: float = 0.0
    """Angle in the default pose, rad."""
    zero: float = 0.0
    """Angle that the file calls zero, rad."""


def draw(name: str, rng: np.random.Generator, arms: bool) -> Body:
    """Draws a body on two legs, with arms or without."""
    leg = log_uniform(rng, 0.17, 1.0)
    # light legs of machines that hop, heavy chests of small humanoids
    mass = 36.0 * (leg / 0.7) ** 3 * (log_uniform(rng, 0.45, 2.6) if arms else log_uniform(rng, 0.12, 2.0))
    has_soles = arms or bool(rng.random() >= POINTS)
    parts = [_Part(Link("base", 0.0, "box", (1.0, 1.0, 1.0)))]
    ends = _legs(parts, rng, leg, mass, has_soles)
    carried = sum(part.link.mass for part in parts)
    _upper_body(parts, rng, leg, mass, mass - carried, arms)
    _stand(parts, rng, leg, ends)
    _call_zero(parts, rng)
    base = _base_frame(rng)
    joints, links, feet = _written(parts, leg * base, ends)
    drives, friction = _drives(parts, rng, leg, mass, has_soles)
    return Body(
        name,
        "humanoid" if arms else "biped",
        links,
        joints,
        feet,
        leg,
        "two_legs" if has_soles else "two_points",
        drives,
        rng.uniform(0.25, 0.55),
        friction=friction,
    )


@dataclasses.dataclass(frozen=True)
class _End:
    """The part of a leg that stands on the ground."""

    link: str
    middle: Vector
    """Middle of the sole or of the ball, from the link's joint."""
    radius: float
    """Radius of a ball; 0 for a sole."""


def _legs(parts: list[_Part], rng: np.random.Generator, leg: float, mass: float, has_soles: bool) -> list[_End]:
    """Adds both legs; returns what they stand on, the left one first."""
    thigh = leg * rng.uniform(0.42, 0.56)
    shank = leg - thigh
    beside = leg * rng.uniform(0.09, 0.25)
    ankle_roll = bool(rng.random() < 0.75)
    order = str(rng.choice(HIP_ORDERS)).split()
    if not has_soles:
        # a point does not hold against yaw
        order = [turn for turn in order if turn != "yaw"]
    # hips in one point, or one below the other
    apart = rng.random() < 0.75
    offsets = [leg * np.array([_beside(rng, 0.1), 0.0, -rng.uniform(0.0, 0.16)]) * apart for _ in order[1:]]
    inwards = [leg * rng.uniform(-0.06, 0.06) * apart for _ in order[1:]]
    canted = has_soles and ankle_roll and rng.random() < _CANT
    tilt, cant = rng.uniform(-0.45, 0.45) * canted, rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.8) * canted
    cants_pitch = bool(rng.random() < 0.4)
    canted_ankle = rng.uniform(-0.2, 0.2) * (rng.random() < 0.25)
    ahead = leg * np.array([_beside(rng, 0.06), _beside(rng, 0.06)])
    back = -1.0 if rng.random() < (0.12 if has_soles else 0.6) else 1.0
    shares = {
        "hip": log_uniform(rng, 0.006, 0.06),
        "thigh": log_uniform(rng, 0.045, 0.14),
        "shank": log_uniform(rng, 0.016, 0.08),
        "ankle": log_uniform(rng, 0.002, 0.015),
        "sole": log_uniform(rng, 0.004, 0.062),
    }
    shares = _at_most(_IN_LEGS, shares, {"hip": 2.0 * (len(order) - 1)}, 2.0)
    limits = {
        "yaw": (-rng.uniform(0.17, 2.8), rng.uniform(0.4, 2.8)),
        "roll": (-rng.uniform(0.2, 1.1), rng.uniform(0.35, 2.9)),
        "pitch": (-rng.uniform(1.0, 3.1), rng.uniform(0.5, 2.9)),
        "knee": (-rng.uniform(0.0, 0.3), rng.uniform(2.0, 2.9)),
        "ankle": (-rng.uniform(0.5, 1.75), rng.uniform(0.35, 0.85)),
        "tilt": (-rng.uniform(0.25, 0.9), rng.uniform(0.25, 0.9)),
    }
    sole = (leg * rng.uniform(0.22, 0.4), leg * rng.uniform(0.09, 0.2), leg * rng.uniform(0.02, 0.06))
    foot = (leg * rng.uniform(-0.03, 0.08), 0.0, -leg * rng.uniform(0.04, 0.14))
    roll_at = (leg * _beside(rng, 0.06), 0.0, -leg * rng.uniform(0.0, 0.06) * (rng.random() < 0.5))
    radius = leg * rng.uniform(0.03, 0.06)
    ends = []
    for place, y in (("L", 1.0), ("R", -1.0)):
        names = [f"{place}_{part}" for part in ("hip_1", "hip_2", "thigh", "shank", "ankle", "sole")]
        hips = [*names[: len(order) - 1], names[2]]
        at: Array = np.array([0.0, y * (beside - sum(inwards)), 0.0])
        for i, (turn, parent, child) in enumerate(zip(order, ["base", *hips[:-1]], hips, strict=True)):
            axis = _axis(turn, y, tilt if cants_pitch else 0.0, cant)
            is_last = child == names[2]
            size = 0.05 * leg
            link = (
                rod(child, shares["thigh"] * mass, thigh, 0.07 * leg, float(ahead[0]))
                if is_last
                else Link(child, shares["hip"] * mass, "sphere", (size,))
            )
            low, high = limits[turn]
            if turn == "pitch" and back < 0:
                low, high = -high, -low
            if turn != "pitch" and y < 0:
                low, high = -high, -low
            parts.append(_Part(link, parent, f"{place}_HIP_{turn.upper()}", tuple(at), axis, low, high, f"hip_{turn}"))
            at = offsets[i] + [0.0, y * inwards[i], 0.0] if i < len(offsets) else at
        low, high = limits["knee"] if back > 0 else (-limits["knee"][1], -limits["knee"][0])
        pitch = _axis("pitch", y, tilt if cants_pitch else 0.0, cant)
        shin = rod(names[3], shares["shank"] * mass, shank, 0.04 * leg, float(ahead[1]))
        at = np.array([ahead[0], 0.0, -thigh])
        parts.append(_Part(shin, names[2], f"{place}_KNEE", tuple(at), pitch, low, high, "knee", angle=back))
        end = (float(ahead[1]), 0.0, -shank)
        if not has_soles:
            ends.append(_End(names[3], end, radius))
            continue
        low, high = limits["ankle"]
        plate = Link(names[5], shares["sole"] * mass, "box", sole, foot)
        if ankle_roll:
            ball = Link(names[4], shares["ankle"] * mass, "sphere", (0.03 * leg,))
            parts.append(_Part(ball, names[3], f"{place}_ANKLE_PITCH", end, pitch, low, high, "ankle_pitch"))
            low, high = limits["tilt"] if y > 0 else (-limits["tilt"][1], -limits["tilt"][0])
            roll = _axis("roll", y, 0.0, canted_ankle)
            parts.append(_Part(plate, names[4], f"{place}_ANKLE_ROLL", roll_at, roll, low, high, "ankle_roll"))
        else:
            plate = dataclasses.replace(plate, mass=(shares["sole"] + shares["ankle"]) * mass)
            parts.append(_Part(plate, names[3], f"{place}_ANKLE_PITCH", end, pitch, low, high, "ankle_pitch"))
        ends.append(_End(names[5], (foot[0], 0.0, foot[2] - sole[2] / 2), 0.0))
    return ends


def _at_most(
    most: float, shares: Mapping[str, float], times: Mapping[str, float], otherwise: float
) -> dict[str, float]:
    """Scales shares of the mass down to a sum of `most`; `times` counts the parts of each share."""
    total = sum(times.get(part, otherwise) * share for part, share in shares.items())
    return {part: share * min(1.0, most / total) for part, share in shares.items()}


def _beside(rng: np.random.Generator, reach: float) -> float:
    """A distance to either side, 0 for half of the bodies."""
    return float(rng.uniform(-reach, reach) * (rng.random() < 0.5))


def _axis(turn: str, y: float, tilt: float, cant: float) -> tuple[float, ...]:
    """Axis of a joint of the left leg, or its mirror image, in the direction of the role.

    Pitch is canted about x by `tilt`, yaw and roll about y by `cant`.
    """
    if turn == "pitch":
        return (0.0, math.cos(tilt), y * math.sin(tilt))
    if turn == "roll":
        return (math.cos(cant), 0.0, -math.sin(cant))
    return (math.sin(cant), 0.0, math.cos(cant))


def _upper_body(parts: list[_Part], rng: np.random.Generator, leg: float, mass: float, rest: float, arms: bool) -> None:
    """Gives the base its shape and adds waist, arms and head, which share the mass `rest`."""
    beside = abs(parts[1].at[1])
    width = max(2.0 * beside, 0.2 * leg)
    chest = leg * rng.uniform(0.4, 0.75)
    lean = leg * rng.uniform(-0.06, 0.1)
    above = leg * rng.uniform(-0.02, 0.2)
    if not arms:
        size = (leg * rng.uniform(0.2, 0.4), width, chest * rng.uniform(0.4, 1.0))
        parts[0].link = Link("base", rest, "box", size, (lean, 0.0, above + size[2] / 2))
        return
    waist = [["yaw"], [], ["yaw", "roll", "pitch"], ["yaw", "roll"], ["roll", "yaw"]][
        rng.choice(5, p=[0.35, 0.3, 0.2, 0.05, 0.1])
    ]
    with_yaw, wrists = rng.random() < 0.8, int(rng.choice([0, 1, 3], p=[0.55, 0.2, 0.25]))
    with_head = bool(rng.random() < 0.5)
    arm_share = {
        "shoulder": log_uniform(rng, 0.006, 0.04),
        "upper": log_uniform(rng, 0.012, 0.05),
        "fore": log_uniform(rng, 0.006, 0.05),
        "wrist": log_uniform(rng, 0.003, 0.025),
    }
    arm_share = _at_most(_IN_ARMS, arm_share, {"wrist": 2.0 * wrists}, 2.0)
    head_share = log_uniform(rng, 0.008, 0.06) if with_head else 0.0
    in_arms = 2.0 * mass * (sum(arm_share.values()) + (wrists - 1) * arm_share["wrist"])
    rest -= in_arms + head_share * mass
    depth = leg * rng.uniform(0.16, 0.3)
    holder, top = "base", above + chest
    if waist:
        share = max(rng.uniform(0.2, 0.5), _IN_BASE * mass / rest)
        parts[0].link = Link("base", share * rest, "box", (depth, width, 0.18 * leg), (lean / 2, 0.0, 0.0))
        at: tuple[float, ...] = (leg * _beside(rng, 0.08), 0.0, above)
        for i, turn in enumerate(waist):
            is_last = i == len(waist) - 1
            child = "torso" if is_last else f"waist_{i + 1}"
            box = Link(child, (1.0 - share) * rest - 0.01 * mass * (len(waist) - 1), "box", (depth, width, chest))
            box = dataclasses.replace(box, at=(lean, 0.0, chest / 2))
            link = box if is_last else Link(child, 0.01 * mass, "sphere", (0.04 * leg,))
            reach = rng.uniform(1.0, 2.7) if turn == "yaw" else rng.uniform(0.25, 0.7)
            parts.append(
                _Part(link, holder, f"TORSO_{turn.upper()}", at, _axis(turn, 1.0, 0.0, 0.0), -reach, reach, "waist")
            )
            holder, at = child, (0.0, 0.0, leg * rng.uniform(0.0, 0.08))
        top = chest
    else:
        parts[0].link = Link("base", rest, "box", (depth, width, chest), (lean, 0.0, above + chest / 2))
    if with_head:
        low, high = -rng.uniform(0.3, 0.7), rng.uniform(0.5, 1.3)
        reach = rng.uniform(0.9, 2.3)
        neck, face = (lean, 0.0, top + 0.03 * leg), (leg * _beside(rng, 0.04), 0.0, leg * rng.uniform(0.02, 0.1))
        mount = Link("neck", 0.3 * head_share * mass, "sphere", (0.04 * leg,))
        parts.append(_Part(mount, holder, "HEAD_YAW", neck, (0.0, 0.0, 1.0), -reach, reach, "head"))
        skull = Link("head", 0.7 * head_share * mass, "sphere", (0.1 * leg,), (0.0, 0.0, 0.1 * leg))
        parts.append(_Part(skull, "neck", "HEAD_PITCH", face, (0.0, 1.0, 0.0), low, high, "head"))
    _arms(parts, rng, leg, mass, arm_share, holder, (lean, width, top), with_yaw, wrists)


def _arms(
    parts: list[_Part],
    rng: np.random.Generator,
    leg: float,
    mass: float,
    shares: Mapping[str, float],
    holder: str,
    shoulders: Vector,
    with_yaw: bool,
    wrists: int,
) -> None:
    """Adds both arms to the link that holds them."""
    lean, width, top = shoulders
    upper_arm, forearm = leg * rng.uniform(0.26, 0.42), leg * rng.uniform(0.26, 0.42)
    beside = max(width / 2, 0.12 * leg) + leg * rng.uniform(0.02, 0.1)
    out = leg * rng.uniform(0.0, 0.13)
    tilt = rng.uniform(0.1, 0.45) * (rng.random() < 0.35)
    bend = -rng.uniform(0.0, 1.6)
    swing, spread, turn_in = rng.uniform(-0.15, 0.35), rng.uniform(0.0, 0.3), rng.uniform(-0.2, 0.2)
    reaches = [rng.uniform(0.4, 2.6) for _ in range(wrists)]
    limits = {
        "pitch": (-rng.uniform(2.0, 3.14), rng.uniform(1.0, 3.1)),
        "roll": (-rng.uniform(0.15, 1.6), rng.uniform(1.3, 3.1)),
        "yaw": (-rng.uniform(0.8, 3.1), rng.uniform(0.8, 3.1)),
        "elbow": (-rng.uniform(1.4, 2.9), rng.uniform(0.0, 1.1)),
    }
    for place, y in (("L", 1.0), ("R", -1.0)):

        def sides(limit: str, y: float = y) -> tuple[float, float]:
            low, high = limits[limit]
            return (low, high) if y > 0 else (-high, -low)

        prefix = f"{place}_"
        at: tuple[float, ...] = (lean, y * beside, top - 0.06 * leg)
        pitch = (0.0, math.cos(tilt), y * math.sin(tilt))
        ball = Link(f"{prefix}shoulder", shares["shoulder"] * mass, "sphere", (0.04 * leg,))
        low, high = limits["pitch"]
        parts.append(_Part(ball, holder, f"{prefix}SHOULDER_PITCH", at, pitch, low, high, "shoulders", swing))
        at, parent = (0.0, y * out, 0.0), f"{prefix}shoulder"
        link = rod(f"{prefix}upper_arm", shares["upper"] * mass, upper_arm, 0.04 * leg)
        low, high = sides("roll")
        roll_link = link
        if with_yaw:
            link = dataclasses.replace(link, mass=0.6 * link.mass)
            roll_link = Link(f"{prefix}shoulder_2", 0.4 * shares["upper"] * mass, "sphere", (0.035 * leg,))
        roll = (1.0, 0.0, 0.0)
        parts.append(_Part(roll_link, parent, f"{prefix}SHOULDER_ROLL", at, roll, low, high, "shoulders", spread * y))
        if with_yaw:
            low, high = sides("yaw")
            z = (0.0, 0.0, 1.0)
            parts.append(
                _Part(
                    link,
                    roll_link.name,
                    f"{prefix}SHOULDER_YAW",
                    (0.0, 0.0, 0.0),
                    z,
                    low,
                    high,
                    "shoulders",
                    turn_in * y,
                )
            )
        low, high = limits["elbow"]
        fore = rod(f"{prefix}forearm", shares["fore"] * mass, forearm, 0.035 * leg)
        below = (0.0, 0.0, -upper_arm)
        parts.append(
            _Part(fore, f"{prefix}upper_arm", f"{prefix}ELBOW", below, (0.0, 1.0, 0.0), low, high, "elbows", bend)
        )
        parent, at = fore.name, (0.0, 0.0, -0.5 * forearm)
        for turn, reach in zip(("ROLL", "PITCH", "YAW"), reaches, strict=False):
            # about the forearm, across it, and across both
            axis = {"ROLL": (0.0, 0.0, 1.0), "PITCH": (0.0, 1.0, 0.0), "YAW": (1.0, 0.0, 0.0)}[turn]
            hand = Link(f"{prefix}wrist_{turn.lower()}", shares["wrist"] * mass, "sphere", (0.03 * leg,))
            parts.append(_Part(hand, parent, f"{prefix}WRIST_{turn}", at, axis, -reach, reach, "wrists"))
            parent, at = hand.name, (0.0, 0.0, -0.15 * forearm)


def _places(parts: Sequence[_Part], angles: Mapping[str, float]) -> dict[str, tuple[Array, Array]]:
    """Orientation of each link and place of its joint, in the base's frame of the upright pose."""
    places: dict[str, tuple[Array, Array]] = {}
    for part in parts:
        if not part.parent:
            places[part.link.name] = np.eye(3), np.zeros(3)
            continue
        turned, at = places[part.parent]
        here = turned @ rotations.matrix_about(part.axis, angles[part.joint])
        places[part.link.name] = here, at + turned @ np.array(part.at)
    return places


def _centre(parts: Sequence[_Part], places: Mapping[str, tuple[Array, Array]]) -> Array:
    """The centre of mass."""
    total = sum(part.link.mass for part in parts)
    moments = [
        part.link.mass * (places[part.link.name][1] + places[part.link.name][0] @ np.array(part.link.at))
        for part in parts
    ]
    centre: Array = np.sum(moments, axis=0) / total
    return centre


def _stand(parts: list[_Part], rng: np.random.Generator, leg: float, ends: Sequence[_End]) -> None:
    """Finds the angles of the legs with which soles are level, below the centre of mass."""
    angles = {part.joint: part.angle for part in parts if part.joint}
    ours = [part for part in parts if part.joint.startswith("L_") and part.group.startswith(("hip", "knee", "ankle"))]
    knee = next(part for part in ours if part.group == "knee")
    back, (end, _) = knee.angle, ends
    upright = _places(parts, dict.fromkeys(angles, 0.0))
    lowest = upright[end.link][1] + np.array(end.middle)
    crouch, spread = leg * rng.uniform(0.015, 0.14), leg * rng.uniform(-0.02, 0.05) * (len(ours) == 6)
    lean = leg * rng.uniform(-0.02, 0.02)
    bend = back * 2.0 * math.sqrt(2.0 * crouch / leg)
    start = {"hip_pitch": -bend / 2, "knee": bend, "ankle_pitch": -bend / 2}
    for part in ours:
        angles[part.joint] = start.get(part.group, 0.0)
    for _ in range(4):
        _mirror(parts, ours, angles)
        goal = lowest + np.array([0.0, spread, crouch])
        goal[0] = _centre(parts, _places(parts, angles))[0] + lean
        _reach(parts, ours, angles, end, goal, leg)
    _mirror(parts, ours, angles)
    for part in parts:
        if part.joint:
            part.angle = angles[part.joint]
            part.lower, part.upper = around(part.angle, part.lower, part.upper)


def _reach(
    parts: Sequence[_Part], ours: Sequence[_Part], angles: dict[str, float], end: _End, goal: Array, leg: float
) -> None:
    """Moves the left leg until its sole is level and there, by damped least squares."""
    for _ in range(40):
        places = _places(parts, angles)
        turned, at = places[end.link]
        here = at + turned @ np.array(end.middle)
        tilt = np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]) / 2
        wrong = np.concatenate([(goal - here) / leg, [] if end.radius else -tilt])
        columns = []
        for part in ours:
            axis = places[part.parent][0] @ np.array(part.axis)
            lever = here - places[part.link.name][1]
            columns.append(np.concatenate([np.cross(axis, lever) / leg, [] if end.radius else axis]))
        slopes = np.array(columns).T
        step = slopes.T @ np.linalg.solve(slopes @ slopes.T + 1e-6 * np.eye(len(wrong)), wrong)
        for part, change in zip(ours, np.clip(step, -0.3, 0.3), strict=True):
            angles[part.joint] += float(change)
        if np.abs(wrong).max() < 1e-9:
            return


def _mirror(parts: Sequence[_Part], ours: Sequence[_Part], angles: dict[str, float]) -> None:
    """Gives the right leg the left one's angles."""
    for part in ours:
        odd = not part.group.endswith(("pitch", "knee"))
        angles["R" + part.joint[1:]] = -angles[part.joint] if odd else angles[part.joint]


def _call_zero(parts: Sequence[_Part], rng: np.random.Generator) -> None:
    """Chooses the pose that the file calls zero.

    Straight legs and hanging arms, bent legs, arms that point sideways or forearms ahead.
    """
    legs, arms, forearms = rng.random() < 0.2, rng.random() < 0.3, rng.random() < 0.4
    share = rng.choice([0.5, 1.0])
    for part in parts:
        if legs and part.group in ("hip_pitch", "knee", "ankle_pitch"):
            part.zero = share * part.angle
        elif arms and part.joint.endswith("SHOULDER_ROLL"):
            part.zero = math.pi / 2 if part.joint.startswith("L") else -math.pi / 2
        elif forearms and part.group == "elbows":
            part.zero = -math.pi / 2


def _base_frame(rng: np.random.Generator) -> Array:
    """Place of the base's frame, as a share of the leg, from the upright pose's origin."""
    where = rng.choice(3, p=[0.45, 0.48, 0.07])
    above = (rng.uniform(-0.02, 0.12), rng.uniform(0.1, 0.48), -rng.uniform(0.9, 1.3))[where]
    return np.array([_beside(rng, 0.12), 0.0, above])


def _written(
    parts: Sequence[_Part], frame: Array, ends: Sequence[_End]
) -> tuple[list[Joint], list[Link], list[tuple[str, str, Vector, float]]]:
    """Joints, links and balls as a file has them: frames are parallel in its zero pose."""
    places = _places(parts, {part.joint: part.zero for part in parts})
    places = {name: (turned, at - frame) for name, (turned, at) in places.items()}
    links, joints = [], []
    for part in parts:
        turned, at = places[part.link.name]
        origin = np.zeros(3) if not part.parent else at
        middle = at - origin + turned @ np.array(part.link.at)
        links.append(dataclasses.replace(part.link, at=_vector(middle), turned=_vector(_angles(turned))))
        if part.parent:
            parent = places[part.parent]
            from_parent = at - (parent[1] if part.parent != "base" else np.zeros(3))
            axis = _vector(_in_direction_of_the_role(part, parent[0] @ np.array(part.axis)))
            lower, upper = part.lower - part.zero, part.upper - part.zero
            group, angle = part.group, part.angle - part.zero
            joints.append(
                Joint(part.joint, part.parent, part.link.name, _vector(from_parent), axis, lower, upper, group, angle)
            )
    feet = [
        (f"{end.link[0]}_foot", end.link, _vector(places[end.link][0] @ np.array(end.middle)), end.radius)
        for end in ends
        if end.radius
    ]
    return joints, links, feet


def _in_direction_of_the_role(part: _Part, axis: Array) -> Array:
    """Flips the axis of a wrist that points against the direction of its role."""
    if part.group != "wrists":
        return axis
    along = axis[_STATED[part.joint[2:]]]
    told = along if abs(along) > _TOLD else axis[np.abs(axis).argmax()]
    return -axis if told < 0.0 else axis


def _vector(values: Array) -> Vector:
    x, y, z = (round(float(value), 9) + 0.0 for value in values)
    return x, y, z


def _angles(turned: Array) -> Array:
    """Roll, pitch and yaw of an orientation."""
    pitch = math.asin(max(-1.0, min(1.0, -turned[2, 0])))
    return np.array([math.atan2(turned[2, 1], turned[2, 2]), pitch, math.atan2(turned[1, 0], turned[0, 0])])


def _drives(
    parts: Sequence[_Part], rng: np.random.Generator, leg: float, mass: float, has_soles: bool
) -> tuple[dict[str, Drive], float]:
    """Drives of the groups of joints, and dry friction."""
    stiffness = log_uniform(rng, 0.18, 1.35)
    effort = log_uniform(rng, 0.11, 1.0)
    time = log_uniform(rng, 1 / 60, 1 / 18)
    armature = 0.0 if rng.random() < 0.45 else log_uniform(rng, 2e-5, 4e-4)
    speed = log_uniform(rng, 0.45, 2.2)
    # one motor in every joint, or the makers' choice for each; gains that follow from weight and
    # leg, or softer ones at the ankles
    alike, drafted = bool(rng.random() < 0.3), bool(rng.random() < 0.4)
    knees = [part for part in parts if part.group == "knee"]
    places = _places(parts, {part.joint: part.angle for part in parts})
    centre = _centre(parts, places)
    lever = max(abs(places[part.link.name][1][0] - centre[0]) for part in knees) / leg
    least = {"knee": 1.4 * lever, "hip_pitch": 0.6 * lever + 0.08, "hip_roll": 0.16, "ankle_pitch": 0.07}
    shares = {
        "ankle_pitch": (0.25, 0.8, 0.08, 0.6),
        "ankle_roll": (0.15, 0.6, 0.03, 0.5),
        "waist": (0.3, 1.0, 0.3, 1.0),
        "head": (0.06, 0.3, 0.1, 0.25),
        "shoulders": (0.1, 0.5, 0.06, 0.4),
        "elbows": (0.1, 0.5, 0.05, 0.25),
        "wrists": (0.04, 0.3, 0.05, 0.2),
    }
    drives = {}
    for group in dict.fromkeys(part.group for part in parts if part.joint):
        strong, stiff = rng.uniform(0.7, 1.5), rng.uniform(0.7, 1.2)
        quick = log_uniform(rng, 0.6, 1.6)
        if group in shares:
            low, high, soft, hard = shares[group]
            strong, stiff = log_uniform(rng, low, high), log_uniform(rng, soft, hard)
            if drafted and group.startswith("ankle"):
                stiff = 1.0
        if alike:
            strong = quick = 1.0
        slow = log_uniform(rng, 1.0, 4.0) if group in ("shoulders", "elbows", "wrists", "head") else 1.0
        drives[group] = Drive(
            stiffness=stiffness * (stiff if not drafted or group in shares else 1.0),
            effort=max(effort * strong, least.get(group, 0.04)),
            damping_time=time * slow,
            armature=armature * strong,
            speed=speed * quick,
        )
    dry = 0.0 if rng.random() < 0.6 else log_uniform(rng, 5e-4, 2e-2)
    return drives, min(dry, 0.1 * min(drive.effort for drive in drives.values()))
