"""Collision shapes for a URDF whose limbs end without any.

Some makers publish links without `<collision>`. Such a robot has nothing to stand on. The box of a
link's inertia takes the place of its shape, as it does where a mesh is missing
(`src/robot/shapes.rs`), in a copy of the file: other readers of a URDF see only what it says.
"""

import math
from collections.abc import Collection
from xml.etree import ElementTree

from polypod.urdf_elements import link_at, mass_of

MOVING = ("revolute", "continuous", "prismatic")
SUBSTANTIAL = 0.1
"""Among links that move together, those lighter than this share of the heaviest are no end."""
TOKEN = 1e-3
"""Links lighter than this have token inertias, kg."""
THINNEST = 0.1
"""Thinnest side of a box, over its longest."""
LARGEST = 5.0
"""Longest side of a box, m."""


def add_boxes(robot: ElementTree.Element, held: Collection[str]) -> list[str]:
    """Gives the ends of a robot's limbs boxes; none where one of them has a `<collision>`.

    Args:
        robot: the tree of a URDF.
        held: names of joints that are locked.

    Returns:
        The links that have a box.

    Raises:
        ValueError: for a number that is none; the reader of URDFs names it.
    """
    links = {str(link.get("name")): link for link in robot.findall("link")}
    above = {link_at(joint, "child"): joint for joint in robot.findall("joint")}

    def moves(joint: ElementTree.Element) -> bool:
        return joint.get("type") in MOVING and joint.find("mimic") is None and joint.get("name") not in held

    def part(name: str) -> str:
        """The first of the links that move together with this one."""
        for _ in links:
            if name not in above or moves(above[name]):
                break
            name = link_at(above[name], "parent")
        return name

    carrying = {part(link_at(joint, "parent")) for joint in above.values() if moves(joint)}
    ends: dict[str, list[str]] = {}
    for name in links:
        first = part(name)
        if first in above and first not in carrying:
            ends.setdefault(first, []).append(name)
    if any(links[name].find("collision") is not None for names in ends.values() for name in names):
        return []
    chosen = []
    for names in ends.values():
        least = SUBSTANTIAL * max(max(mass_of(links[name]) for name in names), TOKEN / SUBSTANTIAL)
        heavy = [name for name in names if mass_of(links[name]) >= least]
        carriers = {other for name in heavy for other in _carriers(name, above)}
        chosen += [name for name in heavy if name not in carriers]
    return [name for name in chosen if _add_box(links[name])]


def note(link: str) -> str:
    """Says what is assumed of a link that has a box."""
    problem = "no limb's end has a <collision>; the box of its inertia takes its place"
    return f'link "{link}": {problem}; write a <collision> with a sphere, box, cylinder or capsule'


def _carriers(name: str, above: dict[str, ElementTree.Element]) -> list[str]:
    """Links between this one and the root."""
    found: list[str] = []
    while name in above and len(found) < len(above):
        name = link_at(above[name], "parent")
        found.append(name)
    return found


def _add_box(link: ElementTree.Element) -> bool:
    """Gives a link the uniform box that has its mass and moments of inertia, where there is one."""
    inertial, inertia = link.find("inertial"), link.find("inertial/inertia")
    if inertial is None or inertia is None:
        return False
    moments = [float(inertia.get(key, 0.0)) for key in ("ixx", "iyy", "izz")]
    squares = [6.0 / mass_of(link) * (sum(moments) - 2.0 * moment) for moment in moments]
    size = [math.sqrt(max(square, 0.0)) for square in squares]
    longest = max(size)
    if not 0.0 < longest <= LARGEST:
        return False
    collision = ElementTree.SubElement(link, "collision")
    origin = inertial.find("origin")
    if origin is not None:
        collision.append(origin)
    sides = " ".join(repr(max(side, THINNEST * longest)) for side in size)
    ElementTree.SubElement(ElementTree.SubElement(collision, "geometry"), "box", {"size": sides})
    return True
