"""Motions of one body for another, by the roles of joints."""

from dataclasses import replace

import numpy as np

from polypod import rotations
from polypod.arrays import Array
from polypod.motions.body import SIDES, Body
from polypod.motions.key_poses import clip_notes
from polypod.motions.motion import Motion

NOTED = 0.5
"""Least turn of a joint without counterpart that is said, degrees."""
MISSED = 0.002
"""Least distance of a foot from its place that is said, m."""


def retarget(motion: Motion, source: Body, target: Body) -> Motion:
    """A motion of `source` for `target`; its `notes` say what is lost.

    Joints take over the change from the default pose of the joint of the same role. The base and
    the feet go ways that are scaled by the ratio of the leg lengths, so that a foot that stands
    still does so again; the legs follow by inverse kinematics. The base is moved by `Body.lean`.

    Raises ConfigError for joints that the source does not have.
    """
    qpos = source.qpos(motion)
    scale = target.leg / source.leg
    lost = [] if abs(scale - 1.0) < 1e-3 else [f"base and feet go {scale:.2f} times as far, as the legs are long"]
    change = source.by_slot(qpos[:, 7:]) - source.by_slot(source.default)
    slots = np.tile(target.by_slot(target.default), (motion.frames, 1))
    for column, slot in enumerate(source.slots):
        place = target.slot(slot)
        if place is not None:
            slots[:, place] += change[:, column]
        elif (turned := float(np.degrees(np.abs(change[:, column]).max()))) > NOTED:
            lost.append(f"{target.name} has no {slot}, which turns by up to {turned:.0f} deg")
    joints = target.by_joint(slots)
    clipped = np.clip(joints, target.lower, target.upper)
    base = scale * motion.base_pos
    base[:, 2] = target.height + scale * (motion.base_pos[:, 2] - source.height)
    lean = np.broadcast_to([target.lean - scale * source.lean, 0.0, 0.0], base.shape)
    base += rotations.rotated(rotations.yaw(motion.base_quat), lean)
    position, orientation = source.kinematics(qpos)
    at = [source.links.index(source.foot(side)) for side in range(2)]
    places, soles = [], []
    for side in range(2):
        turn = rotations.product(orientation[:, at[side]], rotations.inverse(source.soles[side]))
        offset = np.broadcast_to(target.feet[side] - scale * source.feet[side], (motion.frames, 3))
        places.append(scale * position[:, at[side]] + rotations.rotated(rotations.yaw(turn), offset))
        soles.append(rotations.product(turn, np.broadcast_to(target.soles[side], turn.shape)))
    start = np.concatenate([base, motion.base_quat, clipped], axis=1)
    moved, missed = target.with_feet(start, np.stack(places, axis=1), np.stack(soles, axis=1))
    legs = [*target.leg_joints(0), *target.leg_joints(1)]
    joints[:, legs] = clipped[:, legs] = 0.0
    lost += clip_notes(target, joints, clipped)
    for side in range(2):
        if (worst := float(missed[:, side].max())) > MISSED:
            lost.append(f"the foot {SIDES[side]} misses its place by up to {1000.0 * worst:.0f} mm")
    return replace(
        motion,
        robot=target.source,
        joint_names=target.joints,
        joint_pos=moved[:, 7:],
        base_pos=moved[:, :3],
        base_quat=rotations.unit(moved[:, 3:7]),
        link_pos=None,
        notes=(*motion.notes, *lost),
    )


def on_the_ground(motion: Motion, body: Body) -> tuple[Motion, float]:
    """The motion moved up or down as a whole, so that its lowest foot stands on the ground.

    Returns it and how far it was moved, m.
    """
    lowest: Array = body.feet_gap(body.qpos(motion)).min(axis=1)
    shift = -float(np.quantile(lowest, 0.05))
    return replace(motion, base_pos=motion.base_pos + np.array([0.0, 0.0, shift])), shift
