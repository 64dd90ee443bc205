"""Copies of URDFs in which something is put right that drafts of robots need.

Other readers of a URDF see only what the file says, so the config names the copy.
"""

import dataclasses
import re
from collections.abc import Collection
from pathlib import Path
from xml.etree import ElementTree

from polypod.files import read_bytes, real_path, relative_path

MOST_BYTES = 64 << 20
"""Largest file that is read."""
DEEPEST = 64
"""Deepest element of a URDF; copies of deeper trees do not fit the stack."""


@dataclasses.dataclass(frozen=True)
class Copy:
    """Text of a copy."""

    text: str
    name: str
    """Name of its file."""
    notes: list[str]
    """Assumptions, a line each."""


def read(urdf: Path) -> ElementTree.Element | None:
    """The tree of a URDF; None for what is none: the reader of URDFs says what is wrong."""
    try:
        text = read_bytes(urdf, MOST_BYTES).decode("utf-8-sig")
        if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
            return None
        robot = ElementTree.fromstring(text)
        return robot if _is_flat(robot) else None
    except (OSError, ValueError, ElementTree.ParseError):
        return None


def _is_flat(robot: ElementTree.Element) -> bool:
    level, depth = [robot], 0
    while level and depth < DEEPEST:
        level, depth = [child for element in level for child in element], depth + 1
    return not level


def text_of(robot: ElementTree.Element, what: str, urdf: Path, folder: Path, packages: Collection[str]) -> str:
    """The text of a changed tree.

    Args:
        robot: the tree; its names of meshes are changed, too.
        what: a comment on top.
        urdf: the file that it was read from.
        folder: where the copy will lie: relative names of meshes lead from there.
        packages: ROS packages whose folders are known.
    """
    for mesh in robot.iter("mesh"):
        mesh.set("filename", _from(folder, urdf, mesh.get("filename", ""), packages))
    # no comment may hold two dashes
    comment = what.replace("--", "__")
    return f'<?xml version="1.0"?>\n<!-- {comment} -->\n{ElementTree.tostring(robot, encoding="unicode")}\n'


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
