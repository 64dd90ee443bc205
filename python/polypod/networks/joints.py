"""Where an observation holds what belongs to which joint."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.observation import Layout, Term, placed, read_layout

_PERCEPTRON = 'use a network that looks at no joints, class_name = "MLPModel"'


@dataclasses.dataclass(frozen=True)
class JointColumns:
    """Columns of an observation by what they belong to.

    Nothing about a term is known by its name.
    """

    states: npt.NDArray[np.int64]
    """[numbers, joints], what a joint does: terms of the kind `per_joint`, such as position,
    velocity, last action.

    Each control step of a term with a history is a number, the oldest first."""
    magnitudes: npt.NDArray[np.float32]
    """[numbers], typical magnitude of each of these."""
    descriptions: npt.NDArray[np.int64]
    """[numbers, joints], what a joint is: terms of the kind `per_joint` that are constants of the
    robot. A joint that a robot lacks has zeros alone, and no joint that it has."""
    general: npt.NDArray[np.int64]
    """[n], columns that belong to no joint."""
    legs: npt.NDArray[np.bool_]
    """[joints], which of the slots are of a leg."""
    num_obs: int

    @property
    def num_joints(self) -> int:
        """Slots of the action."""
        return self.states.shape[1]


def joint_columns(layout: Layout, joint_names: Sequence[str]) -> JointColumns:
    """The columns of an observation.

    Args:
        layout: terms of the observation.
        joint_names: slots of the action.

    Raises:
        ConfigError: for an observation without states or without descriptions, and for a term that
            does not fit the slots.
    """
    num_joints = len(joint_names)
    terms = read_layout(layout)
    states: list[npt.NDArray[np.int64]] = []
    descriptions: list[npt.NDArray[np.int64]] = []
    magnitudes: list[float] = []
    general: list[int] = []
    for term, place in placed(terms):
        columns = np.arange(place.start, place.stop)
        if term.kind != "per_joint":
            general += columns.tolist()
            continue
        _check_size(term, num_joints)
        numbers = columns.reshape(-1, num_joints)
        if term.source == "robot_constant":
            # the past of a constant says nothing new
            descriptions.append(numbers[-(term.width // num_joints) :])
        else:
            states.append(numbers)
            magnitudes += [term.magnitude] * len(numbers)
    for what, example, found in (
        ("what each joint does", "joint_pos_rel", states),
        ("what each joint is", "joint_descriptors", descriptions),
    ):
        if not found:
            raise _core.ConfigError(
                f"a network of joints needs an observation term that says {what}, such as {example}, which the task "
                "lacks; use a task that has it, such as velocity_flat_joints"
            )
    return JointColumns(
        states=np.concatenate(states),
        magnitudes=np.array(magnitudes, dtype=np.float32),
        descriptions=np.concatenate(descriptions),
        general=np.array(general, dtype=np.int64),
        legs=np.array(_core.slots_of_legs(joint_names), dtype=np.bool_),
        num_obs=sum(term.size for term in terms),
    )


def _check_size(term: Term, joints: int) -> None:
    if joints < 1 or term.size % joints != 0:
        raise _core.ConfigError(
            f"the observation term {term.term} has {term.size} numbers, which are no multiple of {joints} joints; "
            f"{_PERCEPTRON}"
        )


def as_range(columns: Sequence[int]) -> range | None:
    """The columns as a range where they follow each other, else None."""
    block = range(columns[0], columns[0] + len(columns)) if len(columns) else range(0)
    return block if list(block) == list(columns) else None
