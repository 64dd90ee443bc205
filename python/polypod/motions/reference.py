"""The reference of one robot: all its clips frame by frame, and how far envs are from it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, rotations
from polypod.arrays import Array
from polypod.motions.body import Body
from polypod.motions.motion import Motion, velocities

Ids = npt.NDArray[np.int64]
Floats = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference:
    """Clips of a robot at the rate of the control steps, one after the other."""

    body: Body
    names: tuple[str, ...]
    first: Ids
    """First frame of each clip, [clips]."""
    last: Ids
    """Last frame of each clip, [clips]."""
    joint_pos: Array
    """Joint positions in canonical order and directions, rad, [frames, slots]."""
    joint_vel: Array
    base_pos: Array
    """Positions of the base's frame, [frames, 3], m."""
    base_quat: Array
    base_lin_vel: Array
    """Velocities of the base's origin, world axes, m/s, [frames, 3]."""
    base_ang_vel: Array
    """Angular velocities of the base, [frames, 3], world axes, rad/s."""
    links: Ids
    """Key links among the robot's, [keys]; the base is the first of both."""
    ends: npt.NDArray[np.bool_]
    """Feet and hands among the key links, [keys]."""
    link_pos: Array
    """Positions of the key links, [frames, keys, 3], m."""
    link_quat: Array
    link_lin_vel: Array
    link_ang_vel: Array
    single: tuple[npt.NDArray[np.float32], ...]
    """Key links in single precision: ways from the base, orientations, linear and angular
    velocities."""

    @classmethod
    def of(cls, body: Body, motions: Sequence[Motion], step_dt: float) -> "Reference":
        """Prepares clips. Raises ConfigError for joints that the body does not have."""
        clips = [motion.resampled(1.0 / step_dt) for motion in motions]
        counts = np.array([clip.frames for clip in clips])
        last = np.cumsum(counts) - 1
        moving = [velocities(clip) for clip in clips]
        base = [np.concatenate(parts) for parts in zip(*((m[0], m[1]) for m in moving), strict=True)]
        qpos = np.concatenate([body.qpos(clip) for clip in clips])
        speeds = np.zeros((len(qpos), len(body.joints)))
        for clip, (_, _, joints), end, count in zip(clips, moving, last, counts, strict=True):
            columns = [body.joints.index(name) for name in clip.joint_names]
            speeds[end - count + 1 : end + 1, columns] = joints
        angular = rotations.rotated(rotations.inverse(qpos[:, 3:7]), base[1])
        pos, quat, lin, ang = body.moving(qpos, np.concatenate([base[0], angular, speeds], axis=1))
        keys = np.array([body.links.index(link) for link in body.key_links])
        ends = {body.foot(0), body.foot(1), *body.hands}
        return cls(
            body=body,
            names=tuple(motion.name for motion in motions),
            first=last - counts + 1,
            last=last,
            joint_pos=body.by_slot(qpos[:, 7:]),
            joint_vel=body.by_slot(speeds),
            base_pos=qpos[:, :3],
            base_quat=qpos[:, 3:7],
            base_lin_vel=base[0],
            base_ang_vel=base[1],
            links=keys,
            ends=np.array([link in ends for link in body.key_links]),
            link_pos=pos[:, keys],
            link_quat=quat[:, keys],
            link_lin_vel=lin[:, keys],
            link_ang_vel=ang[:, keys],
            single=tuple(
                np.ascontiguousarray(rows, dtype=np.float32)
                for rows in (pos[:, keys] - qpos[:, np.newaxis, :3], quat[:, keys], lin[:, keys], ang[:, keys])
            ),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Errors:
    """Differences of envs of one robot from their frames. World axes; m, rad, s."""

    anchor_pos: Array
    """Ways from the base to the reference's, [n, 3], m."""
    anchor_ori: Array
    """Angle between the base's orientation and the reference's, [n], rad."""
    heading: Array
    """Angle of the base's heading from the reference's, to the left, rad, [n]."""
    gravity: Array
    """Difference of the vertical direction's z component in base axes, [n]."""
    link_pos: Floats
    """Differences of the key links' places, m, [n, keys, 3], with the reference moved to the base's
    place on the ground and heading."""
    link_ori: Floats
    """Angles between the key links' orientations, rad, [n, keys], with the reference moved in the
    same way."""
    link_lin_vel: Floats
    """Differences of the key links' velocities, [n, keys, 3], m/s."""
    link_ang_vel: Floats


def errors(reference: Reference, frame: Ids, pos: Floats, quat: Floats, lin: Floats, ang: Floats) -> Errors:
    """Compares the key links of envs with their frames of the reference.

    Args:
        reference: of their robot.
        frame: [n].
        pos: [n, keys, 3], relative to the env's origin; the base is the first.
        quat: [n, keys, 4].
        lin: [n, keys, 3], velocities of the links' origins.
        ang: [n, keys, 3].
    """
    base, turn = pos[:, 0].astype(np.float64), quat[:, 0].astype(np.float64)
    ref_base, ref_turn = reference.base_pos[frame], reference.base_quat[frame]
    heading = rotations.heading(rotations.product(turn, rotations.inverse(ref_turn)))
    # links of envs are the larger part of the work, and single precision is enough
    cos, sin = (of(heading).astype(np.float32)[:, np.newaxis] for of in (np.cos, np.sin))
    offset, ref_quat, ref_lin, ref_ang = (np.take(rows, frame, axis=0) for rows in reference.single)
    link_pos = (base[:, np.newaxis] - pos).astype(np.float32)
    link_pos[..., 2] += (ref_base[:, 2] - base[:, 2]).astype(np.float32)[:, np.newaxis]
    link_pos[..., 0] += cos * offset[..., 0] - sin * offset[..., 1]
    link_pos[..., 1] += sin * offset[..., 0] + cos * offset[..., 1]
    link_pos[..., 2] += offset[..., 2]
    half_cos, half_sin = (of(0.5 * heading).astype(np.float32)[:, np.newaxis] for of in (np.cos, np.sin))
    w, x, y, z = np.moveaxis(ref_quat, -1, 0)
    turned = (
        half_cos * w - half_sin * z,
        half_cos * x - half_sin * y,
        half_cos * y + half_sin * x,
        half_cos * z + half_sin * w,
    )
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), base.shape)
    ref_down, own_down = (rotations.rotated(rotations.inverse(q), down)[:, 2] for q in (ref_turn, turn))
    return Errors(
        anchor_pos=ref_base - base,
        anchor_ori=rotations.angle(ref_turn, turn),
        heading=heading,
        gravity=np.abs(ref_down - own_down),
        link_pos=link_pos,
        link_ori=_angle(turned, quat.astype(np.float32, copy=False)),
        link_lin_vel=ref_lin - lin.astype(np.float32, copy=False),
        link_ang_vel=ref_ang - ang.astype(np.float32, copy=False),
    )


def _angle(left: tuple[Floats, ...], right: Floats) -> Floats:
    """Angles between orientations [...], rad; exact for small ones in single precision too."""
    dot = sum(part * right[..., i] for i, part in enumerate(left))
    sign = np.copysign(np.float32(1.0), dot)
    square: Floats = np.zeros_like(sign)
    for i, part in enumerate(left):
        difference = part * sign - right[..., i]
        square += difference * difference
    angle: Floats = 4.0 * np.arcsin(np.minimum(0.5 * np.sqrt(square), np.float32(1.0)))
    return angle


def errors_in(sim: _core.VecSim, robot: str, reference: Reference, frame: Ids) -> Errors:
    """`errors` of a robot's envs in a simulator."""
    links = sim.links(robot, reference.body.key_links)
    return errors(reference, frame, *(links[key] for key in ("pos", "quat", "lin_vel", "ang_vel")))
