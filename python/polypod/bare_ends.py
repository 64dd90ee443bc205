"""Collision shapes for a URDF whose limbs end without any.

Some makers publish links without `<collision>`. Such a robot has nothing to stand on. The box of a
link's inertia takes the place of its shape, as it does where a mesh is missing
(`src/robot/shapes.rs`), in a copy of the file: other readers of a URDF see only what it says.
"""

import dataclasses
import math
import re
from collections.abc import Collection
from pathlib import Path
from xml.etree import ElementTree

from polypod.files import read_bytes, real_path, relative_path

MOVING = ("revolute", "continuous", "prismatic")
SUBSTANTIAL = 0.1
"""Among links that move together, those lighter than this share of the heaviest are no end."""
TOKEN = 1e-3
"""Links lighter than this have token inertias, kg."""
THINNEST = 0.1
"""Thinnest side of a box, over its longest."""
LARGEST = 5.0
"""Longest side of a box, m."""
MOST_BYTES = 64 << 20
"""Largest file that is read."""


@dataclasses.dataclass(frozen=True)
class Copy:
    """Copy of a URDF with boxes at the ends of its limbs."""

    text: str
    links: list[str]
    """Links that have a box."""

    @property
    def notes(self) -> list[str]:
        """Assumptions of the copy, a line for each link."""
        problem = "no limb's end has a <collision>; the box of its inertia takes its place"
        remedy = "write a <collision> with a sphere, box, cylinder or capsule"
        return [f'link "{link}": {problem}; {remedy}' for link in self.links]


def boxed(urdf: Path, folder: Path, held: Collection[str], packages: Collection[str]) -> Copy | None:
    """Makes the copy of a URDF.

    Args:
        urdf: the file.
        folder: where the copy will lie: relative names of meshes lead from there.
        held: names of joints that are locked.
        packages: ROS packages whose folders are known.

    Returns:
        None for what is no URDF, and where the end of a limb has a `<collision>`.
    """
    try:
        return _boxed(urdf, folder, held, packages)
    except (OSError, ValueError, ElementTree.ParseError):
        # the reader of URDFs says what is wrong
        return None


def _boxed(urdf: Path, folder: Path, held: Collection[str], packages: Collection[str]) -> Copy | None:
    text = read_bytes(urdf, MOST_BYTES).decode("utf-8-sig")
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        return None
    root = ElementTree.fromstring(text)
    links = {str(link.get("name")): link for link in root.findall("link")}
    above = {_link(joint, "child"): joint for joint in root.findall("joint")}

    def moves(joint: ElementTree.Element) -> bool:
        return joint.get("type") in MOVING and joint.find("mimic") is None and joint.get("name") not in held

    def part(name: str) -> str:
        """The first of the links that move together with this one."""
        for _ in links:
            if name not in above or moves(above[name]):
                break
            name = _link(above[name], "parent")
        return name

    carrying = {part(_link(joint, "parent")) for joint in above.values() if moves(joint)}
    ends: dict[str, list[str]] = {}
    for name in links:
        first = part(name)
        if first in above and first not in carrying:
            ends.setdefault(first, []).append(name)
    if any(links[name].find("collision") is not None for names in ends.values() for name in names):
        return None
    chosen = []
    for names in ends.values():
        least = SUBSTANTIAL * max(max(_mass(links[name]) for name in names), TOKEN / SUBSTANTIAL)
        heavy = [name for name in names if _mass(links[name]) >= least]
        carriers = {other for name in heavy for other in _carriers(name, above)}
        chosen += [name for name in heavy if name not in carriers]
    made = [name for name in chosen if _add_box(links[name])]
    if not made:
        return None
    for mesh in root.iter("mesh"):
        mesh.set("filename", _from(folder, urdf, mesh.get("filename", ""), packages))
    # no comment may hold two dashes
    what = f"{urdf.name} with a box at the end of each limb: {', '.join(made)}".replace("--", "__")
    text = ElementTree.tostring(root, encoding="unicode")
    return Copy(f'<?xml version="1.0"?>\n<!-- {what} -->\n{text}\n', made)


def _link(joint: ElementTree.Element, end: str) -> str:
    found = joint.find(end)
    return "" if found is None else found.get("link", "")


def _carriers(name: str, above: dict[str, ElementTree.Element]) -> list[str]:
    """Links between this one and the root."""
    found: list[str] = []
    while name in above and len(found) < len(above):
        name = _link(above[name], "parent")
        found.append(name)
    return found


def _mass(link: ElementTree.Element) -> float:
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else float(mass.get("value", 0.0))


def _add_box(link: ElementTree.Element) -> bool:
    """Gives a link the uniform box that has its mass and moments of inertia, where there is one."""
    inertial, inertia = link.find("inertial"), link.find("inertial/inertia")
    if inertial is None or inertia is None:
        return False
    moments = [float(inertia.get(key, 0.0)) for key in ("ixx", "iyy", "izz")]
    squares = [6.0 / _mass(link) * (sum(moments) - 2.0 * moment) for moment in moments]
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


def _from(folder: Path, urdf: Path, mesh: str, packages: Collection[str]) -> str:
    """The name of a mesh for a URDF in another folder."""
    package = re.match(r"(?:package|model)://([^/]+)/(.+)", mesh)
    near = real_path(urdf).parent
    if package is not None and package[1] in packages:
        return mesh
    if package is not None:
        places = [above / package[1] / package[2] for above in (near, *near.parents)]
        found = next((place for place in places if place.is_file()), None)
    else:
        found = near / mesh.removeprefix("file://")
    if found is None or not found.is_file():
        return mesh
    return relative_path(found, folder)
