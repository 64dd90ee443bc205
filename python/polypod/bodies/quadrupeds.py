"""Quadrupeds, with and without an arm."""

import dataclasses
import math

import numpy as np

from polypod.bodies.parts import Body, Drive, Joint, Link, around, bent, drive_of_legs, log_uniform, rod, softer


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
    """Additional abduction in the default pose, rad."""
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


def draw(name: str, rng: np.random.Generator, abduction: bool, wide: bool) -> Body:
    """Draws a body on four legs.

    Args:
        name: of the robot.
        rng: of the draws.
        abduction: whether legs have three joints, else two.
        wide: whether makers' choices differ, too.
    """
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
        flexion, bend = (back * angle for angle in bent(back * float(ahead[end]), below, thigh, shank))
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
        links.append(rod(names[1], shares["thigh"] * mass, thigh, 0.07 * leg))
        links.append(rod(names[2], shares["shank"] * mass, shank, 0.035 * leg))
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
    legs = drive_of_legs(rng, (0.2 * crouch, 0.7 * crouch))
    legs = dataclasses.replace(
        legs,
        stiffness=legs.stiffness * choices.stiffness,
        effort=legs.effort * choices.effort,
        armature=legs.armature * choices.armature,
    )
    drives = {"legs": legs, "knees": softer(legs, 1.0, rng.uniform(1.0, 1.6))}
    scale = rng.uniform(0.2, 0.5)
    return Body(name, kind, links, joints, feet, leg, "quadruped", drives, scale, choices.speed, choices.friction)


_WRIST = (("ARM_YAW_2", "z"), ("ARM_PITCH_3", "y"), ("ARM_ROLL", "x"))


def with_arm(body: Body, rng: np.random.Generator) -> Body:
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
    drives = {**body.drives, "arm": arm, **({"wrist": softer(arm, 0.4, 0.4)} if wrists else {})}
    return dataclasses.replace(
        body, kind="quadruped_arm", links=[*body.links, *links], joints=[*body.joints, *joints], drives=drives
    )
