"""Randomly generated robots, as a library.

Quadrupeds, bipeds, humanoids and hexapods of drawn lengths.

Lengths, densities, stances and drives are drawn, and the rest follows from them. A body's mass
grows with the cube of its leg's length, and a link's share with the link's length. Gains, efforts
and speeds are shares of weight and leg length. The ranges of the lengths are about those of a
thousand published bodies (Velythyl/embodiment-scaling-laws, BSD-3-Clause); the robots of the
library lie within all ranges.
"""

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from polypod import _core, bodies_on_two_legs
from polypod.body_parts import HIP_ORDERS, Body, Drive, Joint, Link, Vector, around, log_uniform
from polypod.files import new_folder, write_text

BY_DEFAULT = ("quadruped", "quadruped8", "biped", "humanoid", "hexapod")
"""Four legs of three joints or of two, two legs, two legs with arms, six legs."""
KINDS = (*BY_DEFAULT, "quadruped_arm")
"""All kinds: also four legs of three joints with an arm on the base."""
TASK = "velocity_flat_generated"
GRAVITY = _core.EARTH_GRAVITY
"""Gravity, m/s^2."""


def draw(kind: str, name: str, rng: np.random.Generator, wide: bool = False) -> Body:
    """Draws a body of one of `KINDS`. The same generator state gives the same body.

    With `wide`, quadrupeds also differ in what makers choose in different ways: where the thigh
    hangs on the hip, joint limits, weak and strong motors, slow and fast ones, dry friction, and
    soft and stiff gains. Bodies on two legs are those of `polypod.bodies_on_two_legs`.
    """
    on_two_legs = bodies_on_two_legs.draw if wide else _biped
    makers = {
        "quadruped": lambda: _quadruped(name, rng, abduction=True, wide=wide),
        "quadruped8": lambda: _quadruped(name, rng, abduction=False, wide=wide),
        "biped": lambda: on_two_legs(name, rng, arms=False),
        "humanoid": lambda: on_two_legs(name, rng, arms=True),
        "hexapod": lambda: _hexapod(name, rng),
        "quadruped_arm": lambda: _with_arm(_quadruped(name, rng, abduction=True, wide=wide), rng),
    }
    if kind not in makers:
        raise _core.ConfigError(f"there is no kind of body `{kind}`; known: {', '.join(KINDS)}")
    return makers[kind]()


def generate(
    out: Path,
    count: int,
    seed: int = 0,
    kinds: Sequence[str] = BY_DEFAULT,
    prefix: str = "body",
    force: bool = False,
    *,
    wide: bool = False,
) -> list[Body]:
    """Writes a library of bodies for `POLYPOD_PATH`: a folder with tasks of all of them.

    The i-th body depends on `seed`, `kinds` and i alone, so that more bodies change none.

    Args:
        out: the folder.
        count: how many bodies; kinds take turns.
        seed: of the draws.
        kinds: of `KINDS`.
        prefix: what names begin with; kind and number follow.
        force: write over files that are there.
        wide: see `draw`.

    Raises:
        ConfigError: for an unknown kind or a bad prefix, or where the folder holds files already or
            cannot be written.
    """
    if seed < 0:
        raise _core.ConfigError(f"the seed {seed} is negative; pass 0 or more")
    if not kinds or count < 1:
        raise _core.ConfigError("no bodies are asked for: pass a count of at least 1 and at least one kind")
    if not prefix.isidentifier() or not prefix.isascii() or prefix != prefix.lower():
        raise _core.ConfigError(f"`{prefix}` is no prefix of names: use small letters, digits and underscores")
    if out.exists() and not out.is_dir():
        raise _core.ConfigError(f"{out} is no folder; choose another one")
    if out.is_dir() and any(out.iterdir()) and not force:
        raise _core.ConfigError(f"{out} holds files already; pass --force to write over them, or choose another folder")
    digits = len(str(count - 1))
    bodies = []
    for index in range(count):
        kind = kinds[index % len(kinds)]
        bodies.append(draw(kind, f"{prefix}_{kind}_{index:0{digits}}", np.random.default_rng([seed, index]), wide))
    try:
        with new_folder(out) as folder:
            _write(folder, bodies, seed)
            facts = {"count": count, "seed": seed, "kinds": list(kinds), "prefix": prefix, "wide": wide}
            write_text(folder / "bodies.json", json.dumps(facts) + "\n")
    except OSError as error:
        raise _core.ConfigError(f"cannot write {out}: {error.strerror}; choose another folder") from error
    return bodies


def _write(out: Path, bodies: Sequence[Body], seed: int) -> None:
    """Writes the URDFs, the configs and the tasks of bodies."""
    for body in bodies:
        write_text(out / "assets" / "robots" / body.name / "robot.urdf", urdf(body))
        write_text(out / "configs" / "robots" / f"{body.name}.toml", toml(body, seed))
    for name, text in _tasks([body.name for body in bodies]).items():
        write_text(out / "configs" / "tasks" / f"{name}.toml", text)


def _bent(ahead: float, below: float, thigh: float, shank: float) -> tuple[float, float]:
    """Angles of hip and knee about y that put the end of a leg there from its hip.

    Knees bend by a negative angle.
    """
    square = ahead**2 + below**2
    bend = math.acos(max(-1.0, min(1.0, (square - thigh**2 - shank**2) / (2 * thigh * shank))))
    inner = math.acos(max(-1.0, min(1.0, (square + thigh**2 - shank**2) / (2 * math.sqrt(square) * thigh))))
    return math.atan2(-ahead, below) + inner, -bend


def _rod(name: str, mass: float, length: float, radius: float) -> Link:
    """A link that hangs from its frame."""
    return Link(name, mass, "cylinder", (radius, length), (0.0, 0.0, -length / 2))


def _drive(rng: np.random.Generator, stiffness: tuple[float, float]) -> Drive:
    """A drive of the legs, with a stiffness within a range."""
    return Drive(
        stiffness=log_uniform(rng, *stiffness),
        effort=log_uniform(rng, 0.18, 1.4),
        damping_time=log_uniform(rng, 1 / 60, 1 / 18),
        armature=log_uniform(rng, 2e-5, 4e-4),
    )


def _softer(drive: Drive, stiffness: float, effort: float) -> Drive:
    """The same with so much less of both."""
    return dataclasses.replace(
        drive,
        stiffness=drive.stiffness * stiffness,
        effort=max(drive.effort * effort, 0.05),
        armature=drive.armature * effort,
    )


@dataclasses.dataclass(frozen=True)
class _Choices:
    """Choices in which makers of quadrupeds differ.

    The defaults are those of bodies that are not wide.
    """

    mass: float = 1.0
    """Factor on the drawn mass."""
    beside: float = 1.0
    """Distance of the thigh from the axis of abduction, as a share of the drawn one."""
    below: float = 0.0
    """Distance of the thigh below that axis, as a share of the leg."""
    spread: float = 0.0
    """More abduction in the default pose, rad."""
    light: float = 1.0
    """Factor on the mass of the legs."""
    inwards: float = 0.9
    outwards: float = 0.9
    """Limits of the abduction, rad."""
    hip: tuple[float, float] = (-1.5, 3.4)
    knee: tuple[float, float] = (-2.7, -0.3)
    """Limits of legs whose knees bend to the rear, rad."""
    speed: float = 1.0
    """Factor on the speed limit."""
    stiffness: float = 1.0
    effort: float = 1.0
    armature: float = 1.0
    """Factors on the drive's."""
    friction: float = 0.0
    """Dry friction of the joints, as a share of weight times leg length."""


def _choices(rng: np.random.Generator) -> _Choices:
    """Samples the choices of makers, about as widely as in the library and in makers' files."""
    hangs_below = rng.random() < 0.3
    turns_freely, abducts_freely = rng.random() < 0.15, rng.random() < 0.08
    return _Choices(
        mass=log_uniform(rng, 0.35, 1.3),
        beside=rng.uniform(0.0, 1.0) if hangs_below else 1.0,
        below=rng.uniform(0.02, 0.16) if hangs_below else 0.0,
        spread=rng.uniform(0.0, 0.15),
        light=log_uniform(rng, 0.6, 1.1),
        inwards=math.pi if abducts_freely else rng.uniform(0.3, 1.3),
        outwards=math.pi if abducts_freely else rng.uniform(0.35, 1.6),
        hip=(-math.pi, math.pi) if turns_freely else (rng.uniform(-3.1, 0.1), rng.uniform(0.8, 4.6)),
        knee=(-math.pi, math.pi) if turns_freely else (rng.uniform(-3.1, -2.2), rng.uniform(-1.1, 0.4)),
        speed=log_uniform(rng, 0.35, 5.0),
        stiffness=log_uniform(rng, 0.8, 1.5),
        effort=log_uniform(rng, 0.7, 1.2),
        armature=0.0 if rng.random() < 0.3 else log_uniform(rng, 0.3, 2.0),
        friction=0.0 if rng.random() < 0.5 else log_uniform(rng, 5e-4, 8e-3),
    )


def _quadruped(name: str, rng: np.random.Generator, abduction: bool, wide: bool) -> Body:
    choices = _choices(np.random.default_rng(rng.integers(1 << 32))) if wide else _Choices()
    leg = log_uniform(rng, 0.22, 0.9)
    thigh = leg * rng.uniform(0.42, 0.58)
    shank = leg - thigh
    length, width, height = leg * rng.uniform(0.75, 1.5), leg * rng.uniform(0.2, 0.55), leg * rng.uniform(0.15, 0.35)
    mass = 15.0 * (leg / 0.426) ** 3 * log_uniform(rng, 0.5, 1.6) * choices.mass
    hip = leg * rng.uniform(0.06, 0.28)
    heavy = {part: log_uniform(rng, 0.5, 1.8) * choices.light for part in ("hip", "thigh", "shank")}
    shares = {
        "hip": 0.04 * heavy["hip"],
        "thigh": 0.065 * heavy["thigh"] * 2 * thigh / leg,
        "shank": 0.016 * heavy["shank"] * 2 * shank / leg,
    }
    base = 1.0 - 4 * sum(shares.values())
    links = [Link("base", base * mass, "box", (length, width, height))]
    joints: list[Joint] = []
    feet = []
    radius = leg * rng.uniform(0.035, 0.07)
    # directions of the knees in front and behind: both back, towards each other, apart, both ahead
    knees = [(1, 1), (1, -1), (-1, 1), (-1, -1)][rng.choice(4, p=[0.5, 0.3, 0.1, 0.1])]
    below = leg * rng.uniform(0.66, 0.92)
    ahead = leg * np.array([rng.uniform(-0.15, 0.05), rng.uniform(-0.2, 0.05)])
    spread = rng.uniform(-0.03, 0.15) + choices.spread
    for place, x, y in (("LF", 1, 1), ("LH", -1, 1), ("RF", 1, -1), ("RH", -1, -1)):
        names = [f"{place}_{part}" for part in ("hip", "thigh", "shank", "foot")]
        end = 0 if x > 0 else 1
        back = knees[end]
        flexion, bend = (back * angle for angle in _bent(back * float(ahead[end]), below, thigh, shank))
        corner = (x * length / 2, y * width / 2, 0.0)
        if abduction:
            links.append(Link(names[0], shares["hip"] * mass, "sphere", (0.1 * leg,)))
            low, high = (-choices.inwards, choices.outwards) if y > 0 else (-choices.outwards, choices.inwards)
            if wide:
                low, high = around(spread * y, low, high)
            joints.append(Joint(f"{place}_HAA", "base", names[0], corner, "x", low, high, "legs", spread * y))
        # legs that cannot spread stand as far apart as those that can
        beside = (corner[0], y * (width / 2 + hip + 0.07 * leg), 0.0)
        on_hip = (0.0, y * hip * choices.beside, -leg * choices.below)
        parent, at = (names[0], on_hip) if abduction else ("base", beside)
        links.append(_rod(names[1], shares["thigh"] * mass, thigh, 0.07 * leg))
        links.append(_rod(names[2], shares["shank"] * mass, shank, 0.035 * leg))
        (low, high), (lower, upper) = choices.hip, choices.knee
        if back < 0:
            low, high, lower, upper = -high, -low, -upper, -lower
        if wide:
            (low, high), (lower, upper) = around(flexion, low, high), around(bend, lower, upper)
        joints.append(Joint(f"{place}_HFE", parent, names[1], at, "y", low, high, "legs", flexion))
        joints.append(Joint(f"{place}_KFE", names[1], names[2], (0.0, 0.0, -thigh), "y", lower, upper, "knees", bend))
        feet.append((names[3], names[2], (0.0, 0.0, -shank), radius))
    kind = "quadruped" if abduction else "quadruped8"
    # bent legs carry the weight on longer levers
    crouch = (0.9 * leg / below) ** 2
    legs = _drive(rng, (0.2 * crouch, 0.7 * crouch))
    legs = dataclasses.replace(
        legs,
        stiffness=legs.stiffness * choices.stiffness,
        effort=legs.effort * choices.effort,
        armature=legs.armature * choices.armature,
    )
    drives = {"legs": legs, "knees": _softer(legs, 1.0, rng.uniform(1.0, 1.6))}
    scale = rng.uniform(0.2, 0.5)
    return Body(name, kind, links, joints, feet, leg, "quadruped", drives, scale, choices.speed, choices.friction)


_WRIST = (("ARM_YAW_2", "z"), ("ARM_PITCH_3", "y"), ("ARM_ROLL", "x"))


def _with_arm(body: Body, rng: np.random.Generator) -> Body:
    """Adds an arm of three to six joints, folded above the base, that weighs up to an eighth."""
    leg, mass = body.leg_length, body.mass * rng.uniform(0.03, 0.13)
    length, _, height = body.links[0].size
    upper, fore = leg * rng.uniform(0.35, 0.7, 2)
    wrists = int(rng.integers(0, 4))
    shares = {"shoulder": 0.2, "upper_arm": 0.4, "forearm": 0.4 - 0.08 * wrists}
    upright = float(rng.uniform(-1.4, 0.2))
    bend = float(rng.uniform(0.8, 2.2))
    aside = float(rng.choice([0.0, rng.uniform(-2.0, 2.0)]))
    links = [
        Link("arm_shoulder", shares["shoulder"] * mass, "sphere", (0.06 * leg,), (0.0, 0.0, 0.06 * leg)),
        Link("arm_upper", shares["upper_arm"] * mass, "cylinder", (0.04 * leg, upper), (0.0, 0.0, upper / 2)),
        Link("arm_fore", shares["forearm"] * mass, "cylinder", (0.035 * leg, fore), (0.0, 0.0, fore / 2)),
    ]
    at = (float(rng.uniform(-0.1, 0.45)) * length, 0.0, height / 2)
    joints = [
        Joint("ARM_YAW", "base", links[0].name, at, "z", -2.9, 2.9, "arm", aside),
        Joint("ARM_PITCH", links[0].name, links[1].name, (0.0, 0.0, 0.12 * leg), "y", -2.2, 2.2, "arm", upright),
        Joint("ARM_PITCH_2", links[1].name, links[2].name, (0.0, 0.0, upper), "y", -2.8, 2.8, "arm", bend),
    ]
    along = fore
    for name, axis in _WRIST[:wrists]:
        links.append(Link(name.lower(), 0.08 * mass, "sphere", (0.04 * leg,), (0.0, 0.0, 0.04 * leg)))
        joints.append(Joint(name, links[-2].name, links[-1].name, (0.0, 0.0, along), axis, -2.5, 2.5, "wrist"))
        along = 0.08 * leg
    # stiff enough to hold it up
    arm = Drive(
        stiffness=log_uniform(rng, 0.15, 0.8),
        effort=log_uniform(rng, 0.12, 0.5),
        damping_time=log_uniform(rng, 1 / 60, 1 / 18),
        armature=log_uniform(rng, 2e-5, 4e-4),
        speed=log_uniform(rng, 0.05, 1.0),
    )
    drives = {**body.drives, "arm": arm, **({"wrist": _softer(arm, 0.4, 0.4)} if wrists else {})}
    return dataclasses.replace(
        body, kind="quadruped_arm", links=[*body.links, *links], joints=[*body.joints, *joints], drives=drives
    )


def _biped(name: str, rng: np.random.Generator, arms: bool) -> Body:
    leg = log_uniform(rng, 0.3, 1.0)
    thigh = leg * rng.uniform(0.44, 0.56)
    shank = leg - thigh
    mass = 36.0 * (leg / 0.7) ** 3 * log_uniform(rng, 0.5, 1.6)
    width = leg * rng.uniform(0.2, 0.4)
    sole = (leg * rng.uniform(0.24, 0.4), leg * rng.uniform(0.09, 0.18), 0.04 * leg)
    ankle_roll, torso = bool(rng.random() < 0.7), arms and bool(rng.random() < 0.5)
    has_soles = arms or bool(rng.random() < 0.8)
    order = str(rng.choice(HIP_ORDERS)).split()
    upper_arm, forearm = leg * rng.uniform(0.3, 0.4), leg * rng.uniform(0.3, 0.4)
    heavy = {part: log_uniform(rng, 0.6, 1.5) for part in ("hip", "thigh", "shank")}
    shares = {
        "hip": 0.03 * heavy["hip"],
        "thigh": 0.08 * heavy["thigh"] * 2 * thigh / leg,
        "shank": 0.045 * heavy["shank"] * 2 * shank / leg,
        "ankle": 0.01,
        "sole": 0.02,
    }
    arm = {"shoulder": 0.015, "upper": 0.03 * upper_arm / (0.35 * leg), "fore": 0.02 * forearm / (0.35 * leg)}
    rest = 1.0 - 2 * (sum(shares.values()) + shares["hip"]) - (2 * sum(arm.values()) if arms else 0.0)
    chest = leg * rng.uniform(0.45, 0.65)
    pelvis = (0.2 * leg, width, 0.16 * leg)
    links: list[Link] = []
    joints: list[Joint] = []
    feet: list[tuple[str, str, Vector, float]] = []
    add = joints.append
    if torso:
        links.append(Link("base", 0.35 * rest * mass, "box", pelvis))
    else:
        box = (0.2 * leg, width, chest)
        links.append(Link("base", rest * mass, "box", box, (0.0, 0.0, chest / 2 - 0.08 * leg)))
    # hips above the middle of the soles, knees bent forwards
    flexion, bend = _bent(0.0, rng.uniform(0.88, 0.97) * leg, thigh, shank)
    flexion, bend = -flexion, -bend
    foot = (rng.uniform(0.0, 0.2) * sole[0], 0.0, -0.06 * leg)
    turns = {"yaw": ("z", -0.8, 0.8, 0.0), "roll": ("x", -0.6, 0.6, 0.0), "pitch": ("y", -2.0, 1.0, flexion)}
    if not has_soles:
        # on points there is nothing to turn about
        order = [turn for turn in order if turn != "yaw"]
    for place, y in (("L", 1), ("R", -1)):
        names = [f"{place}_{part}" for part in ("hip_1", "hip_2", "thigh", "shank", "ankle", "sole")]
        hips = [*names[: len(order) - 1], names[2]]
        for hip in hips[:-1]:
            links.append(Link(hip, shares["hip"] * mass, "sphere", (0.05 * leg,)))
        links.append(_rod(names[2], shares["thigh"] * mass, thigh, 0.07 * leg))
        links.append(_rod(names[3], shares["shank"] * mass, shank, 0.05 * leg))
        at: Vector = (0.0, y * width / 2, -0.1 * leg)
        for turn, parent, child in zip(order, ["base", *hips[:-1]], hips, strict=True):
            axis, lower, upper, angle = turns[turn]
            add(Joint(f"{place}_HIP_{turn.upper()}", parent, child, at, axis, lower, upper, "legs", angle))
            at = (0.0, 0.0, 0.0)
        add(Joint(f"{place}_KNEE", names[2], names[3], (0.0, 0.0, -thigh), "y", 0.0, 2.4, "legs", bend))
        if not has_soles:
            feet.append((names[5], names[3], (0.0, 0.0, -shank), 0.04 * leg))
            continue
        tilt = -flexion - bend
        end = names[5]
        if ankle_roll:
            links.append(Link(names[4], shares["ankle"] * mass, "sphere", (0.03 * leg,)))
            links.append(Link(names[5], shares["sole"] * mass, "box", sole, foot))
            add(Joint(f"{place}_ANKLE_PITCH", names[3], names[4], (0.0, 0.0, -shank), "y", -1.1, 0.8, "ankles", tilt))
            add(Joint(f"{place}_ANKLE_ROLL", names[4], end, (0.0, 0.0, 0.0), "x", -0.5, 0.5, "ankles"))
        else:
            links.append(Link(end, (shares["ankle"] + shares["sole"]) * mass, "box", sole, foot))
            add(Joint(f"{place}_ANKLE_PITCH", names[3], end, (0.0, 0.0, -shank), "y", -1.1, 0.8, "ankles", tilt))
    if arms:
        shoulders, top = "base", chest - 0.12 * leg
        if torso:
            shoulders = "torso"
            box = (0.2 * leg, width, 0.9 * chest)
            links.append(Link("torso", 0.65 * rest * mass, "box", box, (0.0, 0.0, 0.5 * chest)))
            add(Joint("TORSO_YAW", "base", "torso", (0.0, 0.0, 0.08 * leg), "z", -1.5, 1.5, "legs"))
            top = 0.9 * chest
        for place, y in (("L", 1), ("R", -1)):
            names = [f"{place}_{part}" for part in ("shoulder", "upper_arm", "forearm")]
            beside = width / 2 + 0.09 * leg
            links.append(Link(names[0], arm["shoulder"] * mass, "sphere", (0.04 * leg,)))
            links.append(_rod(names[1], arm["upper"] * mass, upper_arm, 0.04 * leg))
            links.append(_rod(names[2], arm["fore"] * mass, forearm, 0.035 * leg))
            at = (0.0, y * beside, top)
            add(Joint(f"{place}_SHOULDER_PITCH", shoulders, names[0], at, "y", -2.5, 2.5, "arms", 0.2))
            low, high = (-0.3, 1.6) if y > 0 else (-1.6, 0.3)
            add(Joint(f"{place}_SHOULDER_ROLL", names[0], names[1], (0.0, 0.0, 0.0), "x", low, high, "arms", 0.1 * y))
            add(Joint(f"{place}_ELBOW", names[1], names[2], (0.0, 0.0, -upper_arm), "y", -2.2, 0.1, "arms", -0.4))
    legs = _drive(rng, (0.3, 1.0))
    # like machines: too soft at the ankles to stand without a policy
    drives = {"legs": legs}
    if has_soles:
        drives["ankles"] = _softer(legs, rng.uniform(0.15, 0.6), rng.uniform(0.2, 0.6))
    if arms:
        drives["arms"] = _softer(legs, rng.uniform(0.08, 0.2), rng.uniform(0.1, 0.3))
    rewards = "two_legs" if has_soles else "two_points"
    kind = "humanoid" if arms else "biped"
    return Body(name, kind, links, joints, feet, leg, rewards, drives, rng.uniform(0.25, 0.5))


def _hexapod(name: str, rng: np.random.Generator) -> Body:
    leg = log_uniform(rng, 0.15, 0.6)
    femur = leg * rng.uniform(0.38, 0.5)
    tibia = leg - femur
    coxa = leg * rng.uniform(0.12, 0.22)
    length, width, height = leg * rng.uniform(1.2, 1.8), leg * rng.uniform(0.6, 1.0), leg * rng.uniform(0.15, 0.25)
    mass = 12.0 * (leg / 0.4) ** 3 * rng.uniform(0.7, 1.3)
    spread = rng.uniform(0.5, 0.9)
    shares = {"coxa": 0.03 * coxa / (0.17 * leg), "femur": 0.045 * 2 * femur / leg, "tibia": 0.012 * 2 * tibia / leg}
    base = 1.0 - 6 * sum(shares.values())
    links = [Link("base", base * mass, "box", (length, width, height))]
    joints: list[Joint] = []
    part = links.append
    feet = []
    lift = -0.3
    places = (("LF", 1, 1), ("LM", 0, 1), ("LH", -1, 1), ("RF", 1, -1), ("RM", 0, -1), ("RH", -1, -1))
    for place, x, y in places:
        names = [f"{place}_{piece}" for piece in ("coxa", "femur", "tibia", "foot")]
        part(Link(names[0], shares["coxa"] * mass, "cylinder", (0.06 * leg, coxa), (coxa / 2, 0.0, 0.0), "x"))
        part(Link(names[1], shares["femur"] * mass, "cylinder", (0.06 * leg, femur), (femur / 2, 0.0, 0.0), "x"))
        part(Link(names[2], shares["tibia"] * mass, "cylinder", (0.04 * leg, tibia), (tibia / 2, 0.0, 0.0), "x"))
        at = (x * length / 2, y * width / 2, 0.0)
        # legs point away from the body, those at the ends along it too
        yaw = y * (math.pi / 2 - x * spread)
        joints.append(Joint(f"{place}_HIP_YAW", "base", names[0], at, "z", -0.7, 0.7, "legs", 0.0, yaw))
        joints.append(Joint(f"{place}_HIP_LIFT", names[0], names[1], (coxa, 0.0, 0.0), "y", -1.2, 1.2, "legs", lift))
        knee = math.pi / 2 - lift - 0.15
        joints.append(Joint(f"{place}_KNEE", names[1], names[2], (femur, 0.0, 0.0), "y", 0.2, 2.7, "legs", knee))
        feet.append((names[3], names[2], (tibia, 0.0, 0.0), 0.045 * leg))
    drives = {"legs": _drive(rng, (0.3, 1.2))}
    return Body(name, "hexapod", links, joints, feet, leg, "six_legs", drives, rng.uniform(0.2, 0.4))


def _number(x: float) -> str:
    return f"{x:.6g}" if abs(x) > 1e-12 else "0"


def _numbers(values: Sequence[float]) -> str:
    return " ".join(map(_number, values))


def _shape(link: Link) -> str:
    if link.shape == "box":
        return f'<box size="{_numbers(link.size)}"/>'
    if link.shape == "sphere":
        return f'<sphere radius="{_number(link.size[0])}"/>'
    return f'<cylinder radius="{_number(link.size[0])}" length="{_number(link.size[1])}"/>'


_AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}


def urdf(body: Body) -> str:
    """The URDF of a body. Feet are links without mass, fixed to their legs."""
    limits = _limits(body)
    friction = body.friction * body.mass * GRAVITY * body.leg_length
    out = [
        '<?xml version="1.0" encoding="utf-8"?>',
        f"<!-- A {body.kind} that was drawn by `polypod bodies generate`. -->",
    ]
    out += [f'<robot name="{body.name}">', "  <!-- MuJoCo only: feet have no mass. -->"]
    out += ['  <mujoco><compiler inertiafromgeom="false"/></mujoco>']
    by_child = {joint.child: joint for joint in body.joints}
    for link in body.links:
        joint = by_child.get(link.name)
        if joint is not None:
            effort, velocity = limits[joint.group]
            axis = _AXES[joint.axis] if isinstance(joint.axis, str) else _numbers(joint.axis)
            out += [
                f'  <joint name="{joint.name}" type="revolute">',
                f'    <origin xyz="{_numbers(joint.at)}" rpy="0 0 {_number(joint.yaw)}"/>',
                f'    <parent link="{joint.parent}"/><child link="{joint.child}"/><axis xyz="{axis}"/>',
                f'    <limit lower="{_number(joint.lower)}" upper="{_number(joint.upper)}" effort="{_number(effort)}" '
                f'velocity="{_number(velocity)}"/>',
                *([f'    <dynamics damping="0" friction="{_number(friction)}"/>'] if friction > 0.0 else []),
                "  </joint>",
            ]
        x, y, z = link.inertia()
        own = f' rpy="{_numbers(link.turned)}"' if any(link.turned) else ""
        turned = ' rpy="0 1.5707963267948966 0"' if link.along == "x" else own
        inertia = f'ixx="{_number(x)}" iyy="{_number(y)}" izz="{_number(z)}" ixy="0" ixz="0" iyz="0"'
        shape = f'<origin xyz="{_numbers(link.at)}"{turned}/><geometry>{_shape(link)}</geometry>'
        out += [
            f'  <link name="{link.name}">',
            f'    <inertial><origin xyz="{_numbers(link.at)}"{own}/><mass value="{_number(link.mass)}"/>',
            f"      <inertia {inertia}/></inertial>",
            f"    <visual>{shape}</visual>",
            f"    <collision>{shape}</collision>",
            "  </link>",
        ]
    for name, parent, at, radius in body.feet:
        sphere = f'<geometry><sphere radius="{_number(radius)}"/></geometry>'
        out += [
            f'  <joint name="{name}_fixed" type="fixed">',
            f'    <origin xyz="{_numbers(at)}"/><parent link="{parent}"/><child link="{name}"/>',
            "  </joint>",
            f'  <link name="{name}"><visual>{sphere}</visual><collision>{sphere}</collision></link>',
        ]
    return "\n".join([*out, "</robot>", ""])


def _limits(body: Body) -> dict[str, tuple[float, float]]:
    """Effort (N m) and speed (rad/s) of each group.

    Gains can hold the body, and speeds are those of like motion.
    """
    load = body.mass * GRAVITY * body.leg_length
    speed = 20.0 * body.speed * math.sqrt(0.4 / body.leg_length)
    return {group: (drive.effort * load, speed * drive.speed) for group, drive in body.drives.items()}


def toml(body: Body, seed: int) -> str:
    """The config of a body."""
    load = body.mass * GRAVITY * body.leg_length
    weight = body.mass * GRAVITY
    lines = [
        f"# Drawn by `polypod bodies generate` with seed {seed}. {body.mass:.2f} kg, legs of {body.leg_length:.3f} m.",
        f'name = "{body.name}"',
        f'title = "{body.name.replace("_", " ").title()}"',
        f'urdf = "assets/robots/{body.name}/robot.urdf"',
        f'reward_set = "{body.reward_set}"',
        f"action_scale = {_real(body.action_scale)}          # rad per unit of action",
        "self_collisions = false",
        "",
        "[joint_roles]",
        *(f'{joint.name} = "{joint.name}"' for joint in body.joints),
        "",
        "[default_pose]               # rad",
        *(f"{joint.name} = {_real(joint.angle)}" for joint in body.joints),
    ]
    for group, (effort, velocity) in _limits(body).items():
        joints = ", ".join(f'"{joint.name}"' for joint in body.joints if joint.group == group)
        drive = body.drives[group]
        stiffness = drive.stiffness * load
        lines += [
            "",
            f"[actuators.{group}]",
            f"joints = [{joints}]",
            'model = "ideal_pd"',
            f"stiffness = {_real(stiffness)}             # N m / rad",
            f"damping = {_real(stiffness * drive.damping_time)}               # N m s / rad",
            f"effort_limit = {_real(effort)}          # N m",
            f"velocity_limit = {_real(velocity)}        # rad/s",
            f"armature = {_real(drive.armature * load)}            # kg m^2",
        ]
    lines += ["", "[commands.base_velocity]      # what such a body can be asked for, m/s"]
    lines += [f"{key} = [{_real(low)}, {_real(high)}]" for key, (low, high) in _commands(body).items()]
    tenth = _real(0.1 * body.mass)
    lightest = _real(min(0.1 * body.mass, 0.9 * body.links[0].mass))
    lever = _real(0.05 * body.leg_length)
    lines += [
        "",
        "[reset]",
        'joint_position = { mode = "scale", range = [0.95, 1.05] }',
        "base_velocity = { range = [0.0, 0.0] }",
        "soft_limit_factor = 0.9",
        "spawn_margin = 0.01",
        "",
        "[randomization]",
        "static_friction = [0.5, 1.25]",
        "dynamic_friction = [0.4, 1.0]",
        f"base_mass_offset = [-{lightest}, {tenth}]             # kg",
        f"base_com_offset = {{ x = [-{lever}, {lever}], y = [-{lever}, {lever}], z = [-{lever}, {lever}] }}   # m",
        'stiffness = { operation = "scale", distribution_params = [0.9, 1.1] }',
        'damping = { operation = "scale", distribution_params = [0.9, 1.1] }',
        "motor_strength = [0.9, 1.1]",
        f"external_force = [-{_real(0.1 * weight)}, {_real(0.1 * weight)}]       # N",
        "action_delay = [0, 2]",
        "",
    ]
    return "\n".join(lines)


def _commands(body: Body) -> dict[str, tuple[float, float]]:
    """Command ranges: speeds of like motion, no side-steps for legs that cannot spread."""
    fast = min(1.0, math.sqrt(body.leg_length / 0.35))
    ahead, back, aside = {
        "quadruped": (fast, fast, fast),
        "quadruped8": (fast, fast, 0.0),
        "quadruped_arm": (fast, fast, fast),
        "biped": (fast, 0.5 * fast, 0.4 * fast),
        "humanoid": (fast, 0.5 * fast, 0.4 * fast),
        "hexapod": (0.6 * fast, 0.6 * fast, 0.4 * fast),
    }[body.kind]
    return {"lin_vel_x": (-back, ahead), "lin_vel_y": (-aside, aside)}


def _real(x: float) -> str:
    """A TOML float of six digits."""
    text = f"{x:.6g}" if abs(x) > 1e-12 else "0.0"
    return text if "." in text or "e" in text else f"{text}.0"


def _tasks(names: list[str]) -> dict[str, str]:
    """Tasks of all bodies, by file name."""
    robots = "\n".join(f'    "{name}",' for name in names)
    flat = f"""# Velocity tracking on flat ground of all bodies of this library.
extends = "velocity_flat_any_legged"
name = "Velocity-Flat-Generated-v0"
aliases = ["{TASK}"]
experiment_name = "generated_flat"
robots = [
{robots}
]
"""
    play = f"""# The task for watching and measuring a policy: no noise, no randomisation, no pushes.
extends = ["{TASK}", "velocity_flat_play"]
name = "Velocity-Flat-Generated-Play-v0"
aliases = ["{TASK}_play"]
"""
    return {TASK: flat, f"{TASK}_play": play}
