"""Where an observation holds what belongs to which joint: from flat rows to one row per joint, and the rest."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from polypod import _core

Layout = Sequence[tuple[str, int]]
"""(term, size) of an observation, in order."""

ROLES = ("HAA", "HFE", "KFE")
"""Roles of joints: hip abduction, hip flexion, knee flexion."""
NUM_PLACES = 4 * len(ROLES)
"""Numbers that say which leg's which joint it is."""
_SIDES = {"L": 1.0, "R": -1.0}
_PLACES = {"F": 1.0, "M": 0.0, "H": -1.0}
_JOINT_TERMS = {"joint_pos_rel": 1.0, "joint_vel_rel": 0.1, "last_action": 1.0}
"""With the factors that bring them to the order of one where nothing normalises them: joints turn at some 10 rad/s."""
_DESCRIPTION = "morphology"
_BODY_NUMBERS = 7
"""Numbers about the whole body at the beginning of the description; one more is at its end."""
_ROLE_NUMBERS = 5
"""Numbers of each role, after those of the body."""


@dataclasses.dataclass(frozen=True)
class JointTable:
    """Rows of numbers per joint, each a column of the observation times a factor plus a constant.

    `rows[b, j, f] = observation[b, column[j, f]] * factor[j, f] + constant[j, f]`. The first `num_states` features are
    the joint's state (position, velocity, last action), the others describe the joint: role, leg, default position,
    gains, limits, and the body that it belongs to. Their meaning and number do not depend on how many joints there are.
    """

    column: npt.NDArray[np.int64]
    """[joints, features]"""
    factor: npt.NDArray[np.float32]
    """[joints, features]"""
    constant: npt.NDArray[np.float32]
    """[joints, features]"""
    num_states: int
    place: npt.NDArray[np.float32]
    """[joints, `NUM_PLACES`], role and leg alone: 1, side, place along the body and their product, in the role's block.
    On four legs of three joints the rows are orthogonal, so that a linear layer on them may treat each joint by itself.
    """
    general: npt.NDArray[np.int64]
    """Columns that belong to no joint: [n]."""
    kind: npt.NDArray[np.int64]
    """[num_obs], the kind of each number: a term of all joints of one role, or a column that belongs to none."""
    num_kinds: int
    num_obs: int

    @property
    def num_joints(self) -> int:
        """How many joints."""
        return len(self.column)

    def selection(self, first: int = 0) -> npt.NDArray[np.float32]:
        """[joints, features, num_obs], `selection @ observation + constant` are the rows, from feature `first` on."""
        joints, features = self.column[:, first:].shape
        selection = np.zeros((joints, features, self.num_obs), dtype=np.float32)
        place = np.ogrid[:joints, :features]
        selection[place[0], place[1], self.column[:, first:]] = self.factor[:, first:]
        return selection


def leg_and_role(joint: str) -> tuple[float, float, str]:
    """Side (left 1, right -1), place along the body (front 1, middle 0, hind -1) and role of a canonical joint.

    Raises:
        ConfigError: for a name that is none, such as LF_HAA.
    """
    leg, _, role = joint.partition("_")
    if len(leg) != 2 or leg[0] not in _SIDES or leg[1] not in _PLACES or role not in ROLES:
        raise _core.ConfigError(
            f"{joint!r} is not the name of a leg's joint; use L or R, then F, M or H, then _HAA, _HFE or _KFE"
        )
    return _SIDES[leg[0]], _PLACES[leg[1]], role


def joint_table(layout: Layout, joint_names: Sequence[str], normalized: bool = False) -> JointTable:
    """The table of an observation.

    Args:
        layout: terms of the observation; of the joints' terms and `morphology` one each.
        joint_names: canonical joints, in the order of the joints' terms.
        normalized: whether the observation comes with mean 0 and deviation 1.

    Raises:
        ConfigError: for a name that is no leg's joint, a term that is missing, and a size that does not fit the joints.
    """
    places = [leg_and_role(name) for name in joint_names]
    roles = list(dict.fromkeys(role for _, _, role in places))
    joints = len(places)
    description = _BODY_NUMBERS + _ROLE_NUMBERS * len(roles) + joints + 1
    sizes = dict.fromkeys(_JOINT_TERMS, joints) | {_DESCRIPTION: description}
    starts: dict[str, int] = {}
    general: list[int] = []
    end = 0
    for term, size in layout:
        if term not in sizes:
            general += range(end, end + size)
        elif sizes[term] != size:
            raise _core.ConfigError(
                f"the observation term {term} has {size} numbers, but {joints} joints of {len(roles)} roles need "
                f'{sizes[term]}; use a network that looks at no joints, class_name = "MLPModel"'
            )
        else:
            starts[term] = end
        end += size
    missing = [term for term in sizes if term not in starts]
    if missing:
        raise _core.ConfigError(
            f"a network of joints needs the observation term {missing[0]}, which the task lacks; use a task "
            "that has it, such as velocity_flat_universal"
        )
    start = starts[_DESCRIPTION]
    body = [*range(start, start + _BODY_NUMBERS), start + description - 1]

    def features(joint: int) -> list[tuple[int, float, float]]:
        side, along_body, role = places[joint]
        scales = {term: 1.0 if normalized else scale for term, scale in _JOINT_TERMS.items()}
        states = [(starts[term] + joint, scale, 0.0) for term, scale in scales.items()]
        mass, along, across, *lengths_and_unit, height = body
        of_role = start + _BODY_NUMBERS + _ROLE_NUMBERS * roles.index(role)
        default = start + description - 1 - joints + joint
        described = [default, *range(of_role, of_role + _ROLE_NUMBERS), mass, *lengths_and_unit, height]
        return [
            *states,
            *((0, 0.0, value) for value in _place(*places[joint])),
            # where the leg begins: half the distance of the hips to either side
            (along, 0.5 * along_body, 0.0),
            (across, 0.5 * side, 0.0),
            *((column, 1.0, 0.0) for column in described),
        ]

    table = np.array([features(joint) for joint in range(joints)])
    columns = general + body
    kind = np.zeros(end, dtype=np.int64)
    kind[columns] = np.arange(len(columns))
    of_role = len(_JOINT_TERMS) + 1 + _ROLE_NUMBERS
    for joint, (_, _, role) in enumerate(places):
        first = len(columns) + of_role * ROLES.index(role)
        own = [starts[term] + joint for term in _JOINT_TERMS]
        block = start + _BODY_NUMBERS + _ROLE_NUMBERS * roles.index(role)
        own += [start + description - 1 - joints + joint, *range(block, block + _ROLE_NUMBERS)]
        kind[own] = first + np.arange(of_role)
    return JointTable(
        column=table[..., 0].astype(np.int64),
        factor=table[..., 1].astype(np.float32),
        constant=table[..., 2].astype(np.float32),
        num_states=len(_JOINT_TERMS),
        place=np.array([_place(*place) for place in places], dtype=np.float32),
        general=np.array(columns, dtype=np.int64),
        kind=kind,
        num_kinds=len(columns) + of_role * len(ROLES),
        num_obs=end,
    )


def _place(side: float, along_body: float, role: str) -> list[float]:
    leg = (1.0, side, along_body, side * along_body)
    return [float(role == other) * value for other in ROLES for value in leg]
