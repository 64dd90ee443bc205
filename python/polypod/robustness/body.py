"""Numbers of a robot that a condition needs to say how it changes it."""

import dataclasses
from collections.abc import Iterable, Mapping
from xml.etree import ElementTree

from polypod import _core, simulated

UPRIGHT = ("biped", "humanoid")
"""Classes of robots that are allowed twice the bounds."""


@dataclasses.dataclass(frozen=True)
class Body:
    """A robot of the battery."""

    name: str
    source: str
    """Name of the robot in the library, or the path of its config."""
    kind: str
    """Class of the body: quadruped, biped, humanoid, hexapod ..."""
    actuator_groups: tuple[str, ...]
    """Names of its groups of actuators."""
    trunk_mass: float
    """Mass of the base with all that is fixed to it, kg."""
    height: float
    """Height at which it stands in the default pose, m: of its base, or of its hips where the frame
    of the base lies low."""
    ranges: Mapping[str, tuple[float, float]]
    """Command box of the robot: `lin_vel_x`, `lin_vel_y` (m/s) and `ang_vel_z` (rad/s)."""

    @property
    def is_upright(self) -> bool:
        """Whether it is a biped or a humanoid."""
        return self.kind in UPRIGHT


def bodies(sim: _core.VecSim, sources: Iterable[str]) -> dict[str, Body]:
    """The robots of a simulation by name, in its order.

    `sources` are what they were made from, in the same order.
    """
    infos, configs = simulated.robots(sim), simulated.config(sim)["robots"]
    ranges = sim.command_ranges()
    return {
        name: Body(
            name=name,
            source=source,
            kind=infos[name]["class"],
            actuator_groups=tuple(configs[name]["actuators"]),
            trunk_mass=trunk_mass(_core.robot_urdf(source), sim.link_names(name)[0], infos[name]["joint_names"]),
            height=simulated.standing_height(infos[name]),
            ranges={key: (low, high) for key, (low, high) in ranges[name].items()},
        )
        for name, source in zip(sim.robots, sources, strict=True)
    }


def trunk_mass(urdf: str, base: str, moving: Iterable[str]) -> float:
    """Mass of a URDF's link `base` and of all links that no joint of `moving` lies between, kg."""
    tree, moves = ElementTree.fromstring(urdf), set(moving)
    neighbours: dict[str, list[str]] = {}
    for joint in tree.findall("joint"):
        if joint.get("name") in moves:
            continue
        ends = [element.get("link", "") for tag in ("parent", "child") for element in joint.findall(tag)]
        for one, other in (ends, ends[::-1]):
            neighbours.setdefault(one, []).append(other)
    found, open_ = {base}, [base]
    while open_:
        for link in neighbours.get(open_.pop(), []):
            if link not in found:
                found.add(link)
                open_.append(link)
    masses = (
        mass.get("value", "0")
        for link in tree.findall("link")
        if link.get("name") in found
        for mass in link.findall("inertial/mass")
    )
    return sum(map(float, masses))
