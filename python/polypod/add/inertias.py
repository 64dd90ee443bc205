"""Moments of inertia that files state and MuJoCo refuses."""

from typing import Any

import numpy as np

from polypod.add.compiling import matrix, mujoco


def compiled(spec: Any) -> Any:
    """Compiles a spec with the inertias that it states.

    MuJoCo refuses principal moments of which two add up to less than the third. No body of positive
    density has them, but some URDFs do, and polypod reads them with a warning. MuJoCo then compiles
    even moments, and the stated ones are written into its model.
    """
    try:
        return spec.compile()
    except ValueError as error:
        if "balanceinertia" not in str(error):
            raise
    spec.compiler.balanceinertia = True
    model = spec.compile()
    for body in spec.bodies:
        full = np.array(body.fullinertia)
        if not body.explicitinertial or not np.isfinite(full).all():
            continue
        xx, yy, zz, xy, xz, yz = full
        turn = matrix(body.iquat)
        tensor = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        moments, axes = np.linalg.eigh(tensor)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        index = model.body(body.name).id
        model.body_inertia[index] = moments
        mujoco().mju_mat2Quat(model.body_iquat[index], axes.ravel())
    mujoco().mj_setConst(model, mujoco().MjData(model))
    return model
