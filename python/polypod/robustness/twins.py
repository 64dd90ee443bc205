"""Changes of a robot in MuJoCo.

Each function returns one that changes a twin or a maker's model before its first step.

Each has a separate compiled model. `run` computes MuJoCo's derived constants again after the
change.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from polypod.mujoco_model.reference import Reference, mujoco
from polypod.robustness.body import Body
from polypod.sim2sim.driven import Driven

Change = Callable[[Driven, Body], None]

TORSIONAL = 0.02
"""m, of contacts with `condim` 4 and 6 unless a condition says otherwise: the feet of Menagerie's
quadrupeds."""
ROLLING = 0.01
"""m, of contacts with `condim` 6."""


def nothing(twin: Driven, body: Body) -> None:
    """Leaves the robot as it is."""


def friction(coefficient: float) -> Change:
    """Coulomb's coefficient of every contact; surfaces of a robot's config multiply it."""

    def change(twin: Driven, body: Body) -> None:
        reference = twin.reference
        factor = reference.friction_factor if isinstance(reference, Reference) else 1.0
        reference.model.geom_friction[:, 0] = coefficient * factor

    return change


def contact(condim: int, torsional: float = TORSIONAL, rolling: float = ROLLING) -> Change:
    """Contacts of `condim` 3, 4 (with torsional friction) or 6 (with rolling friction, too), m."""

    def change(twin: Driven, body: Body) -> None:
        model = twin.reference.model
        model.geom_condim[:] = condim
        model.geom_friction[:, 1] = torsional if condim >= 4 else 0.0
        model.geom_friction[:, 2] = rolling if condim >= 6 else 0.0

    return change


def joint_damping(value: float) -> Change:
    """Viscous friction of every joint, N m s/rad."""

    def change(twin: Driven, body: Body) -> None:
        twin.reference.model.dof_damping[twin.reference.v[6:]] = value

    return change


def dry_friction(value: float) -> Change:
    """Dry friction of every joint, N m."""

    def change(twin: Driven, body: Body) -> None:
        twin.reference.model.dof_frictionloss[twin.reference.v[6:]] = value

    return change


def armature(value: float) -> Change:
    """Rotor inertia of every joint, kg m^2."""

    def change(twin: Driven, body: Body) -> None:
        twin.reference.model.dof_armature[twin.reference.v[6:]] = value

    return change


def trunk_mass(factor: float) -> Change:
    """Factor on mass and inertia of the trunk and of all that is fixed to it."""

    def change(twin: Driven, body: Body) -> None:
        model = twin.reference.model
        root = model.body(twin.reference.root).id
        trunk = model.body_weldid == root
        model.body_mass[trunk] *= factor
        model.body_inertia[trunk] *= factor

    return change


def trunk_com(forward: float, left: float) -> Change:
    """Shift of the trunk's centre of mass in shares of the robot's height, base axes.

    Inertias about the centre of mass stay. Every link of the trunk is shifted, so that their common
    centre is.
    """

    def change(twin: Driven, body: Body) -> None:
        mj, model = mujoco(), twin.reference.model
        root = model.body(twin.reference.root).id
        data = mj.MjData(model)
        mj.mj_kinematics(model, data)
        axes = data.xmat.reshape(-1, 3, 3)
        shift = axes[root] @ twin.base_axes @ [forward * body.height, left * body.height, 0.0]
        for link in np.flatnonzero(model.body_weldid == root):
            model.body_ipos[link] += axes[link].T @ shift
            # else MuJoCo takes the frame of the link for that of its inertia
            model.body_sameframe[link] = 0

    return change


def torque(share: float) -> Change:
    """Share of its torque that each motor gives, limits included."""

    def change(twin: Driven, body: Body) -> None:
        model, actuators = twin.reference.model, twin.robot.actuators
        model.actuator_gainprm[:, 0] *= share
        model.actuator_biasprm[:, 1:3] *= share
        # for a maker's model; a twin sets them in every step
        model.actuator_forcerange[:] *= share
        model.jnt_actfrcrange[:] *= share
        weaker = dataclasses.replace(
            actuators,
            effort_limit=share * actuators.effort_limit,
            saturation_effort=share * actuators.saturation_effort,
            effort_tables=tuple(None if table is None else table * [1.0, share] for table in actuators.effort_tables),
        )
        twin.robot = dataclasses.replace(twin.robot, actuators=weaker)

    return change
