"""The joints of a robot in MuJoCo as lines in space, with what hangs between them."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod.arrays import Array
from polypod.mujoco_model.reference import mujoco

BASE = -1
"""Stands for the base where the index of a joint is asked."""


@dataclasses.dataclass(frozen=True)
class Skeleton:
    """A robot at a position of its joints; all in the frame of its base.

    A cluster is all that no joint lies within: the base with what is fixed to it, and what moves
    with each joint.
    """

    names: tuple[str, ...]
    ids: npt.NDArray[np.intp]
    """MuJoCo's numbers of the joints, [joints]."""
    parents: tuple[int, ...]
    """Index of the next joint towards the base, or `BASE`."""
    slides: npt.NDArray[np.bool_]
    """Whether joints are prismatic, [joints]."""
    anchors: Array
    """A point of each axis, m, [joints, 3]."""
    axes: Array
    """Axes of unit length, [joints, 3]."""
    ranges: Array
    """Position limits, rad or m, [joints, 2]; infinite without limits."""
    masses: Array
    """Masses of the clusters, kg, [joints + 1]; the base's is the last one, so that `BASE` is its
    index."""
    centers: Array
    """Centres of mass of the clusters, m, [joints + 1, 3]; the joint's anchor where there is no
    mass."""
    clusters: npt.NDArray[np.intp]
    """Cluster of each body, [bodies of the model]: the index of a joint, `BASE`, or less for a body
    of no part."""

    @property
    def size(self) -> float:
        """Largest distance of a joint from the middle of all, m."""
        reach = np.linalg.norm(self.anchors - self.anchors.mean(axis=0), axis=1)
        return float(max(reach.max(initial=0.0), 0.05))

    def children(self, joint: int) -> list[int]:
        """The joints that come next away from the base."""
        return [index for index, parent in enumerate(self.parents) if parent == joint]


def joints_below(model: Any, root: int) -> list[int]:
    """Numbers of the joints that turn or slide, in a body and below it, base to feet."""
    mj = mujoco()
    kinds = (int(mj.mjtJoint.mjJNT_HINGE), int(mj.mjtJoint.mjJNT_SLIDE))
    return [
        joint
        for joint in range(model.njnt)
        if int(model.jnt_type[joint]) in kinds and is_below(model, int(model.jnt_bodyid[joint]), root)
    ]


def is_below(model: Any, body: int, root: int) -> bool:
    """Whether a body is `root` or hangs on it."""
    while body not in (0, root):
        body = int(model.body_parentid[body])
    return body == root


def skeleton(model: Any, root: int, joints: Sequence[int], positions: Mapping[int, float] | None = None) -> Skeleton:
    """The joints of a robot, by their numbers in the model.

    Args:
        model: MuJoCo's.
        root: number of the base's body, which has a free joint or none.
        joints: numbers of joints, in the order of the result. Others count as fixed.
        positions: of joints by number, rad or m; those that are not named are at zero.
    """
    mj = mujoco()
    data = mj.MjData(model)
    data.qpos[:] = model.qpos0
    for joint in joints_below(model, root):
        data.qpos[model.jnt_qposadr[joint]] = (positions or {}).get(joint, 0.0)
    mj.mj_kinematics(model, data)
    ids = np.array(joints, dtype=np.intp)
    index_of = {int(joint): index for index, joint in enumerate(ids)}
    place, turn = data.xpos[root].copy(), data.xmat[root].reshape(3, 3).copy()
    last = np.full(model.nbody, -2, dtype=np.intp)
    parents = [BASE] * len(ids)
    for body in range(1, model.nbody):
        if not is_below(model, body, root):
            continue
        above = BASE if body == root else int(last[model.body_parentid[body]])
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            if joint in index_of:
                parents[index_of[joint]] = above
                above = index_of[joint]
        last[body] = above
    anchors = (data.xanchor[ids] - place) @ turn
    masses = np.zeros(len(ids) + 1)
    centers = np.concatenate([anchors, np.zeros((1, 3))])
    for cluster in (*range(len(ids)), BASE):
        bodies = np.flatnonzero(last == cluster)
        masses[cluster] = model.body_mass[bodies].sum()
        if masses[cluster] > 0.0:
            middle = model.body_mass[bodies] @ data.xipos[bodies] / masses[cluster]
            centers[cluster] = (middle - place) @ turn
    limited = model.jnt_limited[ids].astype(bool)
    return Skeleton(
        names=tuple(model.joint(int(joint)).name or f"joint {joint}" for joint in ids),
        ids=ids,
        parents=tuple(parents),
        slides=model.jnt_type[ids] == int(mj.mjtJoint.mjJNT_SLIDE),
        anchors=anchors,
        axes=data.xaxis[ids] @ turn,
        ranges=np.where(limited[:, None], model.jnt_range[ids], [-np.inf, np.inf]),
        masses=masses,
        centers=centers,
        clusters=last,
    )
