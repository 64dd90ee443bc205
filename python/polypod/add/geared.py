"""Rotors that turn several joints through a fixed tendon: armature as a matrix.

A rotor of inertia `a` on a tendon of length `sum(c_i q_i)` adds `a c c^T` to the mass matrix.
polypod's armature is diagonal: each joint has its own share `a c_i^2`, and the products that couple
the joints are left out.
"""

import numpy as np

from polypod.add.compiling import Compiled, mujoco
from polypod.add.description import listed


def shares(made: Compiled) -> dict[int, float]:
    """Share of each joint in the armature of tendons and of actuators on them, kg m^2 or kg."""
    found: dict[int, float] = {}
    for tendon, armature in _rotors(made).items():
        for joint, coefficient in coefficients(made, tendon).items():
            found[joint] = found.get(joint, 0.0) + armature * coefficient**2
    return found


def notes(made: Compiled) -> list[str]:
    """A line for the products that are left out, if there are any."""
    rotors = _rotors(made)
    coupled = [
        made.named("TENDON", tendon) or f"tendon_{tendon}"
        for tendon in rotors
        if len(coefficients(made, tendon)) > 1 or not coefficients(made, tendon)
    ]
    if not coupled:
        return []
    return [
        f"armature of tendon {listed(coupled)}: replaced by each joint's own share: what couples its joints is left "
        "out; play the policy on the file with `polypod sim2sim --model` to see what that does"
    ]


def coefficients(made: Compiled, tendon: int) -> dict[int, float]:
    """Coefficient of each joint of a fixed tendon; empty for a spatial one."""
    model, wrap = made.model, int(mujoco().mjtWrap.mjWRAP_JOINT)
    first = int(model.tendon_adr[tendon])
    wraps = range(first, first + int(model.tendon_num[tendon]))
    found: dict[int, float] = {}
    for at in wraps:
        joint = int(model.wrap_objid[at])
        if int(model.wrap_type[at]) == wrap and joint in made.joints():
            found[joint] = found.get(joint, 0.0) + float(model.wrap_prm[at])
    return found


def _rotors(made: Compiled) -> dict[int, float]:
    """Armature of each tendon that has any, that of the actuators on it included."""
    model = made.model
    of_tendons = getattr(model, "tendon_armature", None)
    total = np.zeros(model.ntendon) if of_tendons is None else np.array(of_tendons, dtype=np.float64)
    of_actuators = getattr(model, "actuator_armature", None)
    for index in range(model.nu):
        if of_actuators is not None and int(model.actuator_trntype[index]) == int(mujoco().mjtTrn.mjTRN_TENDON):
            gear = float(model.actuator_gear[index][0])
            total[int(model.actuator_trnid[index][0])] += float(of_actuators[index]) * gear**2
    return {int(tendon): float(total[tendon]) for tendon in np.flatnonzero(total)}
