"""Formulas of exported graphs: one for each source that a term may state.

The sources are those of `TermSource` in Rust, see `VecSim.observation_terms`. A formula is written
once; it computes with torch's tensors, and it adds nodes to an ONNX graph.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeVar

from polypod import _core
from polypod.observation import Term

Value = TypeVar("Value")


class Operations(Protocol[Value]):
    """Operations of the formulas on tensors [batch, n]."""

    def robot_constant(self, term: str) -> Value:
        """Values of a term that describes the robot, for every row of the batch."""

    def plus(self, a: Value, b: Value) -> Value:
        """Sum of two values."""

    def about_center_of_mass(self, rate: Value) -> Value:
        """Velocity of the centre of mass about the base link's origin, by the angular velocity."""

    def less_default_pose(self, positions: Value) -> Value:
        """Joint positions less the default pose, the robot's own order."""

    def canonical(self, joints: Value) -> Value:
        """Numbers of the robot's own joints in canonical order."""


def _as_it_is(do: Operations[Value], term: str, value: Value) -> Value:
    return value


def _robot_constant(do: Operations[Value], term: str) -> Value:
    return do.robot_constant(term)


def _center_of_mass_velocity(do: Operations[Value], term: str, velocity: Value, rate: Value) -> Value:
    return do.plus(velocity, do.about_center_of_mass(rate))


def _joints(do: Operations[Value], term: str, joints: Value) -> Value:
    return do.canonical(joints)


def _joints_less_default(do: Operations[Value], term: str, positions: Value) -> Value:
    return do.canonical(do.less_default_pose(positions))


_FORMULAS: Mapping[str, Callable[..., Any]] = {
    "measured": _as_it_is,
    "robot_constant": _robot_constant,
    "center_of_mass_velocity": _center_of_mass_velocity,
    "base_angular_velocity": _as_it_is,
    "projected_gravity": _as_it_is,
    "velocity_command": _as_it_is,
    "joint_position": _joints,
    "joint_position_minus_default": _joints_less_default,
    "joint_velocity": _joints,
    "last_action": _as_it_is,
    "height_scan": _as_it_is,
}


def check(term: Term, given: Mapping[str, str]) -> None:
    """Checks that a graph can compute a term.

    Args:
        term: the term.
        given: inputs of other terms, with their meanings; no term that is measured may have the
            name of one.

    Raises:
        ConfigError: for a source without a formula, and for a name that is an input's.
    """
    if term.source not in _FORMULAS:
        raise _core.ConfigError(
            f"the observation term {term.term} is computed from {term.source!r}, for which this version has no "
            f"formula; register it with one of {', '.join(_FORMULAS)}, or add the formula to polypod.export.sources"
        )
    if term.source == "measured" and term.term in given:
        raise _core.ConfigError(
            f"the observation term {term.term} is measured by itself, but {term.term} is an input of another meaning "
            f"({given[term.term]}); state its source where it is registered, or rename it"
        )


def compute(do: Operations[Value], term: Term, inputs: Sequence[Value]) -> Value:
    """The term before the task's treatment.

    `inputs` are the values of `term.inputs`, each [batch, n].
    """
    value: Value = _FORMULAS[term.source](do, term.term, *inputs)
    return value
