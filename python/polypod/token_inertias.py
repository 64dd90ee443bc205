"""Inertias for links of a URDF that state a placeholder.

Makers who have no inertias write the same moments into every link, often 1 kg m^2, with different
masses. A link of 0.4 kg then turns as heavily as a ball of 4 m; others write 0 or 1e-6. In a
copy of the file such a link gets the moments of a bar from its joint to the end of the link: other
readers of a URDF see only what it says.
"""

import math
from xml.etree import ElementTree

import numpy as np

from polypod.arrays import Array
from polypod.bare_ends import MOVING
from polypod.urdf_elements import and_more, link_at, mass_of

LEAST_LINKS = 3
"""Number of links with the same moments, which are placeholders if one of them is too large or too
small."""
SMALLEST = 0.01
"""Diameter of the smallest ball, over the size of the robot."""
NONE = 1e-12
"""Largest moment that counts as 0 with the errors of a converter, kg m^2."""
SAME = 1e-9
"""Largest relative difference of moments that count as the same."""
WIDTH = 0.3
"""Width of a bar, over its length."""
SHORTEST = 0.02
"""Shortest bar, m."""


def replace(robot: ElementTree.Element) -> list[str]:
    """Gives links with placeholders the moments of bars.

    Args:
        robot: the tree of a URDF.

    Returns:
        The links.

    Raises:
        ValueError: for a number that is none; the reader of URDFs names it.
    """
    alike: dict[float, list[ElementTree.Element]] = {}
    for link in robot.findall("link"):
        moment = _moment(link)
        if moment is not None:
            alike.setdefault(moment, []).append(link)
    size = _size(robot)
    tokens = [
        link
        for moment, links in alike.items()
        if len(links) >= LEAST_LINKS
        and any(not SMALLEST * size <= _ball(moment, mass_of(link)) <= size for link in links)
        for link in links
    ]
    return _write_bars(robot, tokens)


def replace_impossible(robot: ElementTree.Element) -> list[str]:
    """Gives moving links whose inertia is not positive definite the moments of bars.

    Args:
        robot: the tree of a URDF.

    Returns:
        The links.

    Raises:
        ValueError: for a number that is none; the reader of URDFs names it.
    """
    moving = {link_at(joint, "child") for joint in robot.findall("joint") if joint.get("type") in MOVING}
    found = [link for link in robot.findall("link") if link.get("name") in moving and _is_impossible(link)]
    return _write_bars(robot, found)


def write_bar(robot: ElementTree.Element, link: ElementTree.Element) -> None:
    """Gives a link that has a mass the moments of a bar from its joint to its end."""
    inertia = link.find("inertial/inertia")
    if inertia is None:
        return
    tip, mass = _tip(robot, link), mass_of(link)
    length = float(np.linalg.norm(tip))
    along = tip / length
    across, about = (mass / 12.0 * factor * length**2 for factor in (1.0 + WIDTH**2, 2.0 * WIDTH**2))
    tensor = across * np.eye(3) + (about - across) * np.outer(along, along)
    for row, first in enumerate("xyz"):
        for column, second in enumerate("xyz"):
            if row <= column:
                inertia.set(f"i{first}{second}", repr(float(tensor[row, column])))
    origin = link.find("inertial/origin")
    if origin is not None:
        # the tensor is along the axes of the link
        origin.set("rpy", "0 0 0")


def notes(tokens: list[str], impossible: list[str]) -> list[str]:
    """Says what is assumed of links with placeholders, and of those that no body can be."""
    found = []
    if tokens:
        found.append(
            f'link "{tokens[0]}": its moments of inertia are a placeholder (as of {len(tokens) - 1} more links); those '
            "of a bar to its end take their place: write the inertias about the centres of mass, in kg m^2"
        )
    if impossible:
        found.append(
            f'link "{impossible[0]}": its inertia is not positive definite{and_more(impossible)}; that of a bar to its '
            "end takes its place: write the inertia about the centre of mass, in kg m^2"
        )
    return found


def _write_bars(robot: ElementTree.Element, links: list[ElementTree.Element]) -> list[str]:
    """Gives each of these links the moments of its bar; returns their names."""
    for link in links:
        write_bar(robot, link)
    return [str(link.get("name")) for link in links]


def _moment(link: ElementTree.Element) -> float | None:
    """The moment of a link that has the same about all axes, kg m^2."""
    inertia = link.find("inertial/inertia")
    if inertia is None or not mass_of(link) > 0.0:
        return None
    moments = [float(inertia.get(key, 0.0)) for key in ("ixx", "iyy", "izz")]
    products = [float(inertia.get(key, 0.0)) for key in ("ixy", "ixz", "iyz")]
    if max(map(abs, [*moments, *products])) <= NONE:
        return 0.0
    is_same = max(moments) - min(moments) <= SAME * max(moments) and not any(products)
    return moments[0] if is_same and moments[0] > 0.0 else None


def _is_impossible(link: ElementTree.Element) -> bool:
    """Whether no body has the moments of a link."""
    inertia = link.find("inertial/inertia")
    if inertia is None or not mass_of(link) > 0.0:
        return False
    xx, yy, zz, xy, xz, yz = (float(inertia.get(key, 0.0)) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return float(moments[0]) <= SAME * float(moments[-1])


def _ball(moment: float, mass: float) -> float:
    """Diameter of the uniform ball of a moment, m."""
    return 2.0 * math.sqrt(2.5 * moment / mass)


def _size(robot: ElementTree.Element) -> float:
    """The farthest end of a link from the root, m: a chain's last length counts twice."""
    above = {link_at(joint, "child"): joint for joint in robot.findall("joint")}
    farthest = 0.0
    for name in above:
        lengths: list[float] = []
        while name in above and len(lengths) <= len(above):
            lengths.append(float(np.linalg.norm(_place(above[name]))))
            name = link_at(above[name], "parent")
        farthest = max(farthest, sum(lengths) + lengths[0])
    return farthest


def _tip(robot: ElementTree.Element, link: ElementTree.Element) -> Array:
    """The end of a link's bar in its frame, m: the farthest joint below, or beyond its centre."""
    places = [_place(joint) for joint in robot.findall("joint") if link_at(joint, "parent") == link.get("name")]
    origin = link.find("inertial/origin")
    places.append(2.0 * (np.zeros(3) if origin is None else _numbers(origin)))
    tip = max(places, key=lambda place: float(np.linalg.norm(place)))
    length = float(np.linalg.norm(tip))
    return tip if length >= SHORTEST else np.array([0.0, 0.0, SHORTEST])


def _place(joint: ElementTree.Element) -> Array:
    origin = joint.find("origin")
    return np.zeros(3) if origin is None else _numbers(origin)


def _numbers(origin: ElementTree.Element) -> Array:
    numbers = np.array([float(word) for word in origin.get("xyz", "0 0 0").split()])
    if numbers.shape != (3,):
        raise ValueError("three numbers are needed")
    return numbers
