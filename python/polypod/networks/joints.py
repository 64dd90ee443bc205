"""Where an observation holds what belongs to which joint: from flat rows to one row per joint, and the rest."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.observation import Layout, Term, read_layout

ROLES = ("HAA", "HFE", "KFE")
"""Roles of joints: hip abduction, hip flexion, knee flexion."""
NUM_PLACES = 4 * len(ROLES)
"""Numbers that say which leg's which joint it is."""
_SIDES = {"L": 1.0, "R": -1.0}
_PLACES = {"F": 1.0, "M": 0.0, "H": -1.0}
_PERCEPTRON = 'use a network that looks at no joints, class_name = "MLPModel"'


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
        layout: terms of the observation, at least one of the kind `per_joint` and one of the kind `body`.
        joint_names: canonical joints, in the order of the joints' terms.
        normalized: whether the observation comes with mean 0 and deviation 1.

    Raises:
        ConfigError: for a name that is no leg's joint, a kind that is missing, and a size that does not fit the joints.
    """
    places = [leg_and_role(name) for name in joint_names]
    columns = _Columns(read_layout(layout), len(places), list(dict.fromkeys(role for _, _, role in places)))
    scales = [1.0 if normalized else 1.0 / magnitude for magnitude in columns.magnitudes]

    def features(joint: int) -> list[tuple[int, float, float]]:
        side, along_body, _ = places[joint]
        return [
            *((column, scale, 0.0) for column, scale in zip(columns.states(joint), scales, strict=True)),
            *((0, 0.0, value) for value in _place(*places[joint])),
            # where the leg begins: half the distance of the hips to either side
            *((column, 0.5 * along_body, 0.0) for column in columns.lengths),
            *((column, 0.5 * side, 0.0) for column in columns.widths),
            *((column, 1.0, 0.0) for column in columns.described(joint, places[joint][2])),
            *((column, 1.0, 0.0) for column in columns.body),
        ]

    table = np.array([features(joint) for joint in range(len(places))])
    general = columns.general + sorted(columns.lengths + columns.widths + columns.body)
    kind = np.zeros(columns.end, dtype=np.int64)
    kind[general] = np.arange(len(general))
    of_role = columns.per_role
    for joint, (_, _, role) in enumerate(places):
        own = [*columns.states(joint), *columns.described(joint, role)]
        kind[own] = len(general) + of_role * ROLES.index(role) + np.arange(of_role)
    return JointTable(
        column=table[..., 0].astype(np.int64),
        factor=table[..., 1].astype(np.float32),
        constant=table[..., 2].astype(np.float32),
        num_states=len(scales),
        place=np.array([_place(*place) for place in places], dtype=np.float32),
        general=np.array(general, dtype=np.int64),
        kind=kind,
        num_kinds=len(general) + of_role * len(ROLES),
        num_obs=columns.end,
    )


class _Columns:
    """Where an observation holds numbers of joints, of roles, of the body, and all else."""

    def __init__(self, terms: Sequence[Term], joints: int, roles: list[str]) -> None:
        self.roles = roles
        self.magnitudes: list[float] = []
        self.lengths: list[int] = []
        self.widths: list[int] = []
        self.body: list[int] = []
        """Numbers of the whole body that are no distances between legs."""
        self.general: list[int] = []
        """Columns of terms of other kinds."""
        self._states: list[int] = []
        self._of_joint: list[int] = []
        self._of_role: list[range] = []
        self.end = 0
        for term in terms:
            start, self.end = self.end, self.end + term.size
            if term.kind == "per_joint":
                _check_size(term, joints, len(roles), joints)
                self._states.append(start)
                self.magnitudes.append(term.magnitude)
            elif term.kind == "body":
                _check_size(term, joints, len(roles), sum(block.size(len(roles), joints) for block in term.blocks))
                self._add_blocks(term, start, joints)
            else:
                self.general += range(start, self.end)
        for kind, example, found in (
            ("per_joint", "joint_pos_rel", self._states),
            ("body", "morphology", self._of_joint + self._of_role + self.body),
        ):
            if not found:
                raise _core.ConfigError(
                    f"a network of joints needs an observation term of the kind {kind}, such as {example}, which the "
                    "task lacks; use a task that has it, such as velocity_flat_universal"
                )

    def _add_blocks(self, term: Term, start: int, joints: int) -> None:
        of_all = {"body": self.body, "length": self.lengths, "width": self.widths}
        for block in term.blocks:
            if block.per == "joint":
                self._of_joint += [start + number * joints for number in range(block.count)]
            elif block.per == "role":
                self._of_role.append(range(start, start + block.count))
            elif block.per in of_all:
                of_all[block.per] += range(start, start + block.count)
            else:
                raise _core.ConfigError(
                    f"the observation term {term.term} has numbers per {block.per}, which this version does not know; "
                    f"{_PERCEPTRON}, or the version that it was trained with"
                )
            start += block.size(len(self.roles), joints)

    @property
    def per_role(self) -> int:
        """Numbers of a joint and of its role."""
        return len(self._states) + len(self._of_joint) + sum(len(block) for block in self._of_role)

    def states(self, joint: int) -> list[int]:
        """Columns of the joint's state."""
        return [start + joint for start in self._states]

    def described(self, joint: int, role: str) -> list[int]:
        """Columns that say what the joint and its role are."""
        of_role = [len(block) * self.roles.index(role) + column for block in self._of_role for column in block]
        return [*(start + joint for start in self._of_joint), *of_role]


def _check_size(term: Term, joints: int, roles: int, needed: int) -> None:
    if term.size != needed:
        raise _core.ConfigError(
            f"the observation term {term.term} has {term.size} numbers, but {joints} joints of {roles} roles need "
            f"{needed}; {_PERCEPTRON}"
        )


def _place(side: float, along_body: float, role: str) -> list[float]:
    leg = (1.0, side, along_body, side * along_body)
    return [float(role == other) * value for other in ROLES for value in leg]
