"""Turns base frames of MJCF robots to x forward and z up, and nothing moves."""

import dataclasses

import numpy as np

from polypod.add import compiling, inertias
from polypod.add.compiling import Compiled, mujoco
from polypod.arrays import Array

FRAME = "polypod_upright"
"""Name of the frame."""


def turned(made: Compiled, axes: Array) -> Compiled:
    """The same robot with another frame of its base. Its spec is changed.

    Each element in the base's frame gets a separate frame there, so that MuJoCo resolves any way to
    write a place or a turn.

    Args:
        made: the model.
        axes: the new frame's axes in the old one, in the columns.
    """
    mj, spec = mujoco(), made.spec
    base = spec.bodies[made.base]
    back, turn = _quaternion(axes.T), _quaternion(axes)
    if base.explicitinertial:
        # as compiled, whatever way it is written
        base.ipos = axes.T @ made.model.body_ipos[made.base]
        base.iquat = _product(back, made.model.body_iquat[made.base])
        base.inertia = made.model.body_inertia[made.base]
        base.fullinertia = np.full(6, np.nan)
        base.ialt.type = mj.mjtOrientation.mjORIENTATION_QUAT
    free = int(made.model.body_jntadr[made.base])
    q, v = int(made.model.jnt_qposadr[free]), int(made.model.jnt_dofadr[free])
    for key in spec.keys:
        for name, at in (("qpos", q + 3), ("qvel", v + 3)):
            numbers = np.array(getattr(key, name))
            if len(numbers):
                own = numbers[at : at + (4 if name == "qpos" else 3)]
                numbers[at : at + len(own)] = _product(own, turn) if name == "qpos" else axes.T @ own
                setattr(key, name, numbers)
    base.quat, base.alt.type = _product(made.model.body_quat[made.base], turn), mj.mjtOrientation.mjORIENTATION_QUAT
    frame = base.add_frame(name=FRAME, quat=back)
    for own in [*base.geoms, *base.sites, *base.cameras, *base.lights, *compiling.children(base)]:
        outermost = own
        while outermost.frame is not None:
            outermost = outermost.frame
        # two things may lie in one frame of the file
        if getattr(outermost, "name", "") != FRAME:
            outermost.set_frame(frame)
    return dataclasses.replace(made, model=inertias.compiled(spec), base=base.id)


def _quaternion(rotation: Array) -> Array:
    found = np.zeros(4)
    mujoco().mju_mat2Quat(found, rotation.flatten())
    return found


def _product(one: Array, other: Array) -> Array:
    found = np.zeros(4)
    mujoco().mju_mulQuat(found, np.array(one, dtype=np.float64), np.array(other, dtype=np.float64))
    return found
