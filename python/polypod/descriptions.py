"""Distances of a body's description from those that a policy was trained on.

A body is described by the numbers of the observation term `joint_descriptors`: `DESCRIPTORS` of
each joint, in the nominal body. A network of joints reads each number x in three ways, and so does
the distance:

- x in deviations from the mean over all joints of the training bodies,
- log(|x| + 0.01), in the same way,
- how x differs from the mean of the robot's own joints, in deviations within the robot.

Deviations count at least `LEAST_DEVIATION`. Two joints differ by the root of the mean square of
their features' differences. Two bodies differ by the root of the mean square over the joints of one
of the distance to the most similar joint of the other, the larger of both directions. The distance
of a body is that to the nearest training body: 0 for a training body.
"""

import base64
import binascii
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.arrays import Array
from polypod.observation import placed, terms_of

TASK = "velocity_flat_any_legged"
"""Task whose observation describes every joint of any body."""
TERM = "joint_descriptors"
DESCRIPTORS = (
    *(f"position {axis}" for axis in "xyz"),
    *(f"axis {axis}" for axis in "xyz"),
    *("default position", "lower limit", "upper limit"),
    *("largest effort", "largest speed", "stiffness", "damping", "rotor inertia", "dry friction"),
    *("inertia that hangs on it", "share of the mass that hangs on it", "action scale", "mass of the robot"),
)
"""Names of a joint's numbers, in order; docs/task.md has their units."""
LEAST_DEVIATION = 0.1
"""Deviation of a feature that counts, at least, so that numbers which all training bodies share can
be compared."""
LOG_FLOOR = 0.01
"""Least magnitude that a logarithm tells from zero, here and in networks of joints."""


@dataclasses.dataclass(frozen=True)
class Body:
    """The description of a body."""

    joints: tuple[str, ...]
    """Slots of the joints."""
    numbers: npt.NDArray[np.float32]
    """Descriptions of the joints, [joints, descriptors]."""


@dataclasses.dataclass(frozen=True)
class Distance:
    """How far a body is from the nearest training body."""

    distance: float
    """Distance in deviations of the training's joints."""
    nearest: str
    """Name of the training body."""
    joint: str
    """The joint that is farthest from the nearest body's most similar joint."""
    descriptor: str
    """The number of the joint that differs most."""
    value: float
    nearest_value: float
    """The same number of the nearest body's most similar joint."""

    def __str__(self) -> str:
        """The distance in words."""
        return (
            f"{self.distance:.2f} deviations from the nearest training body ({self.nearest}); farthest is "
            f"{self.joint}, {self.descriptor} {self.value:.3g} (there {self.nearest_value:.3g})"
        )


def describe(robots: Sequence[str], task: str = TASK, overrides: Sequence[str] = ()) -> dict[str, Body]:
    """The nominal descriptions of robots, by their names.

    Args:
        robots: names, or paths of configs.
        task: whose robots they are; one that does not describe joints is replaced by `TASK`.
        overrides: `key=value` pairs of the task.

    Raises:
        ConfigError: for a robot or a task that cannot be used.
    """
    play = _core.play_task(task)
    sim = _core.VecSim(play, len(robots), robots=list(robots), seed=0, threads=1, overrides=for_one_env_each(overrides))
    columns = next((at for term, at in placed(terms_of(sim)) if term.term == TERM), None)
    if columns is None:
        return describe(robots)
    sim.reset(0)
    count, slots = len(DESCRIPTORS), sim.canonical_joint_names
    # a term with a history: its present numbers
    numbers = sim.observation[:, columns].reshape(len(robots), -1, count, len(slots))[:, -1]
    bodies = {}
    for robot in sim.robots:
        row, _ = sim.env_ids(robot)
        here = np.flatnonzero(sim.action_mask[row])
        bodies[robot] = Body(tuple(slots[slot] for slot in here), numbers[row][:, here].T.copy())
    return bodies


def without_shares(overrides: Sequence[str]) -> list[str]:
    """`key=value` pairs of a task without those that share out its envs."""
    return [change for change in overrides if not change.startswith("env_shares.")]


def for_one_env_each(overrides: Sequence[str]) -> list[str]:
    """`key=value` pairs with which a task has one env of each robot.

    They hold for any shares that the task or the pairs ask for.
    """
    return [*without_shares(overrides), "env_shares=null"]


class Training:
    """The bodies that a policy was trained on."""

    def __init__(self, bodies: Mapping[str, Body]) -> None:
        """Compares with these bodies, at least one."""
        self.bodies = dict(bodies)
        numbers = np.concatenate([body.numbers for body in bodies.values()]).astype(np.float64)
        both = np.concatenate([numbers, _logarithms(numbers)], axis=1)
        self._mean, self._deviation = both.mean(axis=0), np.maximum(both.std(axis=0), LEAST_DEVIATION)
        self._features = {name: self._features_of(body) for name, body in self.bodies.items()}

    def distance(self, body: Body) -> Distance:
        """How far a body is from the nearest training body."""
        mine = self._features_of(body)
        found = {name: _distance(mine, other) for name, other in self._features.items()}
        nearest = min(found, key=lambda name: found[name])
        squares = np.square(mine[:, None] - self._features[nearest][None])
        similar = squares.mean(axis=2).argmin(axis=1)
        apart = squares[np.arange(len(mine)), similar]
        joint = int(apart.mean(axis=1).argmax())
        descriptor = int(apart[joint].reshape(3, -1).sum(axis=0).argmax())
        return Distance(
            distance=found[nearest],
            nearest=nearest,
            joint=body.joints[joint],
            descriptor=DESCRIPTORS[descriptor],
            value=float(body.numbers[joint, descriptor]),
            nearest_value=float(self.bodies[nearest].numbers[similar[joint], descriptor]),
        )

    def nearest(self, body: Body) -> list[str]:
        """Names of the training bodies, the nearest to a body first."""
        mine = self._features_of(body)
        found = {name: _distance(mine, other) for name, other in self._features.items()}
        return sorted(found, key=lambda name: found[name])

    def _features_of(self, body: Body) -> Array:
        """Numbers of joints, their logarithms and differences, [joints, 3 x descriptors]."""
        numbers = body.numbers.astype(np.float64)
        both = (np.concatenate([numbers, _logarithms(numbers)], axis=1) - self._mean) / self._deviation
        absolute = both[:, : numbers.shape[1]]
        relative = (absolute - absolute.mean(axis=0)) / (absolute.std(axis=0) + LEAST_DEVIATION)
        features: Array = np.concatenate([both, relative], axis=1)
        return features


def _logarithms(numbers: Array) -> Array:
    logarithms: Array = np.log(np.abs(numbers) + LOG_FLOOR)
    return logarithms


def _distance(mine: Array, other: Array) -> float:
    """Distance of two bodies by the features of their joints."""
    squares = (
        np.square(mine).mean(axis=1)[:, None]
        + np.square(other).mean(axis=1)[None]
        - 2.0 * mine @ other.T / mine.shape[1]
    )
    squares = np.maximum(squares, 0.0)
    return float(np.sqrt(max(squares.min(axis=1).mean(), squares.min(axis=0).mean())))


def to_manifest(bodies: Mapping[str, Body]) -> list[dict[str, Any]]:
    """Bodies as a manifest holds them: slots, and little-endian float32 numbers in Base64."""
    return [
        {
            "name": name,
            "joints": list(body.joints),
            "numbers": base64.b64encode(body.numbers.astype("<f4").tobytes()).decode(),
        }
        for name, body in bodies.items()
    ]


def from_manifest(entries: Sequence[Mapping[str, Any]], where: str) -> dict[str, Body]:
    """The reverse of `to_manifest`. Raises ConfigError, which begins with `where`."""
    bodies = {}
    for entry in entries:
        joints = tuple(entry["joints"])
        try:
            numbers = np.frombuffer(base64.b64decode(entry["numbers"], validate=True), dtype="<f4")
            numbers = numbers.reshape(len(joints), len(DESCRIPTORS)).astype(np.float32)
        except (binascii.Error, ValueError) as error:
            raise _core.ConfigError(
                f"{where}: trained_bodies {entry['name'][:80]!r}: {len(joints)} joints do not have {len(DESCRIPTORS)} "
                "numbers each; copy the manifest again from the training's run"
            ) from error
        if not np.isfinite(numbers).all():
            raise _core.ConfigError(
                f"{where}: trained_bodies {entry['name'][:80]!r} holds a number that is not finite; copy the manifest "
                "again from the training's run"
            )
        bodies[entry["name"]] = Body(joints, numbers)
    return bodies


def training_of(manifest: Mapping[str, Any], where: str = "manifest") -> Training | None:
    """The bodies that a policy was trained on: its manifest's, else the robots that it names.

    Returns:
        None where the manifest holds no bodies and its robots are not on this machine.
    """
    if manifest.get("trained_bodies"):
        return Training(from_manifest(manifest["trained_bodies"], where))
    try:
        return Training(describe(manifest["robot_sources"]))
    except _core.PolypodError:
        return None


def distances(manifest: Mapping[str, Any], robots: Sequence[str], where: str = "manifest") -> dict[str, Distance]:
    """Distances of robots that a policy was not trained on from its training bodies, by name.

    Args:
        manifest: of the policy.
        robots: names, or paths of configs.
        where: what errors call the manifest.
    """
    trained = set(manifest["robot_sources"]) | {entry["name"] for entry in manifest.get("trained_bodies", ())}
    others = [robot for robot in robots if robot not in trained]
    training = training_of(manifest, where) if others else None
    if training is None:
        return {}
    return {name: training.distance(body) for name, body in describe(others).items()}
