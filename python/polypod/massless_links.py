"""Mass for links of a URDF that move and have none.

A link that a joint moves needs a mass. Fingertips and frames of sensors at the end of a chain often
have none; neither do the links between the joints of a ball joint or a cross that is written as two
or three hinges. In a copy of the file the joints of the first become fixed, and the second get a
small share of the mass that they carry: other readers of a URDF see only what it says.
"""

from collections.abc import Collection
from xml.etree import ElementTree

from polypod.bare_ends import MOVING
from polypod.token_inertias import write_bar
from polypod.urdf_elements import and_more, link_at, mass_of

SHARE = 0.01
"""Mass of a link between joints, over that of the parts which it carries. Their inertia turns with
it, so that it needs little."""


def settle(robot: ElementTree.Element, held: Collection[str]) -> tuple[list[str], list[str]]:
    """Gives the moving links of a robot a mass, or nothing that moves them.

    Args:
        robot: the tree of a URDF.
        held: names of joints that are locked.

    Returns:
        The links whose joints became fixed, and those with a mass.

    Raises:
        ValueError: for a number that is none; the reader of URDFs names it.
    """
    links = {str(link.get("name")): link for link in robot.findall("link")}
    below: dict[str, list[ElementTree.Element]] = {}
    for joint in robot.findall("joint"):
        below.setdefault(link_at(joint, "parent"), []).append(joint)

    def moves(joint: ElementTree.Element) -> bool:
        return joint.get("type") in MOVING and joint.find("mimic") is None and joint.get("name") not in held

    def part(name: str) -> list[str]:
        """A link and those that are fixed to it."""
        names, at = [name], 0
        while at < len(names) <= len(links):
            names += [link_at(joint, "child") for joint in below.get(names[at], []) if not moves(joint)]
            at += 1
        return names

    def mass(names: Collection[str]) -> float:
        return sum(mass_of(links[name]) for name in names if name in links)

    def carried(names: Collection[str]) -> float:
        """Mass of the nearest parts below that have one, kg."""
        total, at, ends = 0.0, 0, list(names)
        while at < len(ends) <= len(links):
            for joint in below.get(ends[at], []):
                own = part(link_at(joint, "child")) if moves(joint) else []
                total += mass(own)
                ends += own if mass(own) <= 0.0 else []
            at += 1
        return total

    fixed: list[str] = []
    weights: dict[str, float] = {}
    for joint in robot.findall("joint"):
        name = link_at(joint, "child")
        own = part(name)
        if not moves(joint) or name not in links or mass(own) > 0.0:
            continue
        if (weight := SHARE * carried(own)) > 0.0:
            weights[name] = weight
        else:
            joint.set("type", "fixed")
            fixed.append(name)
    for name, weight in weights.items():
        _fill(links[name], weight)
        write_bar(robot, links[name])
    return fixed, list(weights)


def notes(fixed: list[str], filled: list[str]) -> list[str]:
    """Says what is assumed of these links."""
    what = [
        (fixed, "the joint that moves it is fixed"),
        (filled, f"it gets {SHARE:.0%} of the mass that it carries"),
    ]
    return [
        f'link "{links[0]}": it moves and has no mass{and_more(links)}; {how}: write an <inertial>'
        for links, how in what
        if links
    ]


def _fill(link: ElementTree.Element, mass: float) -> None:
    """Gives a link a mass at its joint, without moments of inertia."""
    for inertial in link.findall("inertial"):
        link.remove(inertial)
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "mass", {"value": repr(mass)})
    ElementTree.SubElement(inertial, "inertia", dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0"))
