"""Links, joints and drives of drawn bodies, and draws that their kinds share."""

import dataclasses
import math

import numpy as np

Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Link:
    """A solid of uniform density with what it touches the world with."""

    name: str
    mass: float
    """Mass of the link, kg."""
    shape: str
    """box, cylinder (along z) or sphere."""
    size: tuple[float, ...]
    """Edges; radius and length; radius; m."""
    at: Vector = (0.0, 0.0, 0.0)
    """Middle of the shape in the link's frame, m."""
    along: str = "z"
    """Axis of a cylinder: x or z."""
    turned: Vector = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the shape in the link's frame, rad."""

    def inertia(self) -> Vector:
        """Inertia of the solid about its middle, link axes (its own, if it is turned), kg m^2."""
        if self.shape == "box":
            x, y, z = (edge * edge for edge in self.size)
            return self.mass / 12 * (y + z), self.mass / 12 * (z + x), self.mass / 12 * (x + y)
        if self.shape == "sphere":
            same = 0.4 * self.mass * self.size[0] ** 2
            return same, same, same
        radius, length = self.size
        across = self.mass * (radius**2 / 4 + length**2 / 12)
        own = self.mass * radius**2 / 2
        return (own, across, across) if self.along == "x" else (across, across, own)


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint that turns; its canonical name, and its angle in the default pose."""

    name: str
    parent: str
    child: str
    at: Vector
    axis: str | Vector
    """Axis about which the joint turns: x, y, z, or a unit vector."""
    lower: float
    upper: float
    group: str
    """Group of actuators."""
    angle: float = 0.0
    """Angle in the default pose, rad."""
    yaw: float = 0.0
    """Angle of the joint's frame in its parent's, rad."""


@dataclasses.dataclass(frozen=True)
class Drive:
    """Drive of a joint, as shares of weight times leg length."""

    stiffness: float
    """Stiffness, 1/rad."""
    effort: float
    damping_time: float
    """Damping over stiffness, s."""
    armature: float
    """Rotor inertia, s^2."""
    speed: float = 1.0
    """Factor on the group's speed limit."""


@dataclasses.dataclass(frozen=True)
class Body:
    """A robot that was drawn."""

    name: str
    kind: str
    links: list[Link]
    """The base first."""
    joints: list[Joint]
    feet: list[tuple[str, str, Vector, float]]
    """Massless spheres: name, link, place in its frame, radius, m. Bodies with soles have none."""
    leg_length: float
    """Length of a leg, m."""
    reward_set: str
    drives: dict[str, "Drive"]
    """Drive of each group of actuators."""
    action_scale: float
    """rad per unit of action."""
    speed: float = 1.0
    """Factor on the speed limits, which are otherwise those of like motion."""
    friction: float = 0.0
    """Dry friction of all joints, as a share of weight times leg length."""

    @property
    def mass(self) -> float:
        """Mass of all links, kg."""
        return sum(link.mass for link in self.links)


HIP_ORDERS = ("yaw roll pitch", "pitch roll yaw", "roll yaw pitch", "roll pitch yaw", "pitch yaw roll")
"""Orders of the hip's joints from the base to the thigh."""


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


_AROUND = 0.2
"""Joints can move at least this far to either side of the default pose, rad."""


def around(angle: float, lower: float, upper: float) -> tuple[float, float]:
    """Limits that leave room about an angle."""
    return min(lower, angle - _AROUND), max(upper, angle + _AROUND)


def bent(ahead: float, below: float, thigh: float, shank: float) -> tuple[float, float]:
    """Angles of hip and knee about y that put the end of a leg there from its hip.

    Knees bend by a negative angle.
    """
    square = ahead**2 + below**2
    bend = math.acos(max(-1.0, min(1.0, (square - thigh**2 - shank**2) / (2 * thigh * shank))))
    inner = math.acos(max(-1.0, min(1.0, (square + thigh**2 - shank**2) / (2 * math.sqrt(square) * thigh))))
    return math.atan2(-ahead, below) + inner, -bend


def rod(name: str, mass: float, length: float, radius: float, ahead: float = 0.0) -> Link:
    """A link that hangs from its frame, to a place ahead of it."""
    return Link(name, mass, "cylinder", (radius, length), (ahead / 2, 0.0, -length / 2))


def drive_of_legs(rng: np.random.Generator, stiffness: tuple[float, float]) -> Drive:
    """A drive of the legs, with a stiffness within a range."""
    return Drive(
        stiffness=log_uniform(rng, *stiffness),
        effort=log_uniform(rng, 0.18, 1.4),
        damping_time=log_uniform(rng, 1 / 60, 1 / 18),
        armature=log_uniform(rng, 2e-5, 4e-4),
    )


def softer(drive: Drive, stiffness: float, effort: float) -> Drive:
    """Returns a drive with these shares of stiffness and effort."""
    return dataclasses.replace(
        drive,
        stiffness=drive.stiffness * stiffness,
        effort=max(drive.effort * effort, 0.05),
        armature=drive.armature * effort,
    )
