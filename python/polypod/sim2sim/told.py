"""The gains that a policy is told of a robot on a maker's model.

Policies that read `joint_descriptors` know a body by its gains. Where the model's own actuators for
positions drive it, these are the model's.
"""

import dataclasses

import numpy as np

from polypod.arrays import Array
from polypod.descriptions import DESCRIPTORS, TERM
from polypod.export.robot import RobotInterface
from polypod.sim2sim.maker import Model

STIFFNESS, DAMPING = (DESCRIPTORS.index(gain) for gain in ("stiffness", "damping"))
"""Places of the gains among a joint's numbers."""
UNITS = {STIFFNESS: 100.0, DAMPING: 5.0}
"""Units of the gains in the description: N m/rad, N m s/rad."""
NAMES = {STIFFNESS: "a stiffness of {} N m/rad", DAMPING: "a damping of {} N m s/rad"}
SAME = 0.01
"""Share by which a gain differs at most from one that counts as the same."""


def interface_on(model: Model, interface: RobotInterface) -> tuple[RobotInterface, str | None]:
    """The interface of a policy to its robot on a model.

    Damping of the model's joints is no gain, and is not told: where an actuator has no
    damping, the policy keeps polypod's.

    Args:
        model: of the robot.
        interface: to polypod's robot.

    Returns:
        The interface with the model's gains, and a line that names them; the same interface and
        None where they are the same, and for a policy that reads none.
    """
    own = ~model.is_policys
    if TERM not in interface.constants or _is_scaled(interface) or not own.any():
        return interface, None
    told = interface.constants[TERM].reshape(len(DESCRIPTORS), -1).copy()
    columns, joints = interface.columns, interface.joint_of_slot
    found = []
    for place, gains in ((STIFFNESS, _stiffness(model)), (DAMPING, _damping(model))):
        is_told = (own & (gains > 0.0))[joints]
        before = told[place, columns]
        after = np.where(is_told, gains[joints] / UNITS[place], before).astype(np.float32)
        if not np.allclose(after, before, rtol=SAME, atol=1e-6):
            told[place, columns] = after
            low, high = (f"{end:.3g}" for end in (gains[own].min(), gains[own].max()))
            found.append(NAMES[place].format(low if low == high else f"{low} to {high}"))
    if not found:
        return interface, None
    constants = {**interface.constants, TERM: told.reshape(-1)}
    line = f"the policy reads gains, and is told those of the model's actuators: {' and '.join(found)}"
    return dataclasses.replace(interface, constants=constants), line


def _is_scaled(interface: RobotInterface) -> bool:
    """Whether descriptions are in units of the body."""
    groups = interface.task.get("observations", {})
    terms = [term for group in groups.values() if isinstance(group, list) for term in group]
    return any(term.get("term") == TERM and term.get("units", "metric") != "metric" for term in terms)


def _stiffness(model: Model) -> Array:
    """Stiffness of the model's actuators, [joints], N m/rad."""
    found: Array = model.model.actuator_gainprm[model.actuators, 0] * model.gears**2
    return found


def _damping(model: Model) -> Array:
    """Damping of the model's actuators, [joints], N m s/rad."""
    found: Array = 0.0 - model.model.actuator_biasprm[model.actuators, 2] * model.gears**2
    return found
