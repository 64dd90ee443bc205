"""Data of a compiled MJCF file that has no place in a robot of polypod's."""

from collections.abc import Mapping

import numpy as np

from polypod import _core
from polypod.add.compiling import Compiled
from polypod.add.description import listed
from polypod.add.ellipsoid import BALL_POINTS


def left_out(made: Compiled, ellipsoids: Mapping[str, float]) -> list[str]:
    """One line for each sort of data that is left out.

    Args:
        made: the compiled file.
        ellipsoids: error of the polyhedron that stands for an ellipsoid, m, by the ellipsoid's
            name.
    """
    model, joints = made.model, made.joints()
    notes: list[str] = []
    if ellipsoids:
        notes.append(
            f"geom {listed(list(ellipsoids))}: an ellipsoid: replaced by a convex hull of "
            f"{BALL_POINTS} points, which is at most {1e3 * max(ellipsoids.values()):.2g} mm off"
        )
    joint = int(model.body_jntadr[made.base])
    first = int(model.jnt_dofadr[joint])
    free = slice(first, first + 6)
    if model.dof_armature[free].any() or model.dof_damping[free].any() or model.dof_frictionloss[free].any():
        notes.append("armature, damping and friction of the free joint: left out")
    if np.any(model.jnt_stiffness[joint]):
        notes.append("the spring of the free joint, which holds the base in the air: left out")
    dofs = [int(model.jnt_dofadr[joint]) for joint in joints if made.moves(joint)]
    bent = getattr(model, "jnt_stiffnesspoly", None)
    if bent is not None and np.any(np.asarray(bent)[joints]):
        notes.append("springs whose force is no multiple of the way: left out but for its linear part")
    curved = getattr(model, "dof_dampingpoly", None)
    if curved is not None and np.any(np.asarray(curved)[dofs]):
        notes.append("damping that is no multiple of the speed: left out but for its linear part")
    if model.ntendon:
        names = [made.named("TENDON", tendon) or f"tendon_{tendon}" for tendon in range(model.ntendon)]
        notes.append(f"tendon {listed(names)}: left out")
    if getattr(model, "nflex", 0) or getattr(model, "nskin", 0):
        notes.append("flexible bodies and skins: left out")
    if np.any(np.asarray(model.body_gravcomp)[made.bodies()]):
        notes.append("gravity compensation: left out")
    if model.opt.density or model.opt.viscosity or np.any(model.opt.wind):
        notes.append("the medium's density, viscosity and wind: left out")
    others = [
        made.named("BODY", body) or f"body_{body}"
        for body in range(1, model.nbody)
        if int(model.body_parentid[body]) == 0 and body not in made.inside and int(model.body_dofnum[body])
    ]
    if others:
        notes.append(f"body {listed(others)}: moves beside the robot: left out")
    if not np.allclose(model.opt.gravity, [0.0, 0.0, -_core.EARTH_GRAVITY]):
        notes.append("gravity is not the Earth's along -z: left out: the task has it")
    return notes
