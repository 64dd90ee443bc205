"""Hexapods, whose legs point away from the body."""

import math

import numpy as np

from polypod.bodies.parts import Body, Joint, Link, drive_of_legs, log_uniform


def draw(name: str, rng: np.random.Generator) -> Body:
    """Draws a body on six legs."""
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
    drives = {"legs": drive_of_legs(rng, (0.3, 1.2))}
    return Body(name, "hexapod", links, joints, feet, leg, "six_legs", drives, rng.uniform(0.2, 0.4))
