"""Bipeds and humanoids that stand upright with axes along those of the base."""

import numpy as np

from polypod.bodies.parts import HIP_ORDERS, Body, Joint, Link, Vector, bent, drive_of_legs, log_uniform, rod, softer


def draw(name: str, rng: np.random.Generator, arms: bool) -> Body:
    """Draws a biped, or a humanoid with arms, of narrow ranges; `two_legs` has the wide ones."""
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
    flexion, bend = bent(0.0, rng.uniform(0.88, 0.97) * leg, thigh, shank)
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
        links.append(rod(names[2], shares["thigh"] * mass, thigh, 0.07 * leg))
        links.append(rod(names[3], shares["shank"] * mass, shank, 0.05 * leg))
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
            links.append(rod(names[1], arm["upper"] * mass, upper_arm, 0.04 * leg))
            links.append(rod(names[2], arm["fore"] * mass, forearm, 0.035 * leg))
            at = (0.0, y * beside, top)
            add(Joint(f"{place}_SHOULDER_PITCH", shoulders, names[0], at, "y", -2.5, 2.5, "arms", 0.2))
            low, high = (-0.3, 1.6) if y > 0 else (-1.6, 0.3)
            add(Joint(f"{place}_SHOULDER_ROLL", names[0], names[1], (0.0, 0.0, 0.0), "x", low, high, "arms", 0.1 * y))
            add(Joint(f"{place}_ELBOW", names[1], names[2], (0.0, 0.0, -upper_arm), "y", -2.2, 0.1, "arms", -0.4))
    legs = drive_of_legs(rng, (0.3, 1.0))
    # like machines: too soft at the ankles to stand without a policy
    drives = {"legs": legs}
    if has_soles:
        drives["ankles"] = softer(legs, rng.uniform(0.15, 0.6), rng.uniform(0.2, 0.6))
    if arms:
        drives["arms"] = softer(legs, rng.uniform(0.08, 0.2), rng.uniform(0.1, 0.3))
    rewards = "two_legs" if has_soles else "two_points"
    kind = "humanoid" if arms else "biped"
    return Body(name, kind, links, joints, feet, leg, rewards, drives, rng.uniform(0.25, 0.5))
