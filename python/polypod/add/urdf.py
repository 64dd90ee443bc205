"""A URDF made part of a library: its text without what is only shown, and the collision meshes next to it."""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from polypod import _core
from polypod.accuracy.robot import rooted
from polypod.add.description import Description, Joint, Link
from polypod.add.mjcf import mujoco
from polypod.add.sources import MOST_BYTES
from polypod.files import read_bytes, real_path

MOST_MESH = 256 << 20
"""Bytes of a mesh."""
MOST_MESHES = 1 << 30
"""Bytes of all meshes of a robot."""


@dataclasses.dataclass(frozen=True)
class Copy:
    """What is written of a URDF."""

    text: str
    meshes: dict[str, bytes]
    """By file name."""
    name: str
    notes: list[str]


def read(file: Path) -> str:
    """The text of a URDF. Raises ConfigError."""
    try:
        text = read_bytes(file, MOST_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise _core.ConfigError(f"{file}: {error.strerror}; name a file that can be read") from error
    except UnicodeDecodeError as error:
        raise _core.ConfigError(f"{file}: it is not text in UTF-8; name the robot's URDF") from error
    return text


def copied(text: str, file: Path, package_dirs: Mapping[str, Path]) -> Copy:
    """Makes the copy of a URDF that a library holds.

    Args:
        text: the URDF's.
        file: the file that its relative mesh names are relative to.
        package_dirs: ROS package -> folder.

    Raises:
        ConfigError: for what is no XML or has a document type, and for meshes that are too large.
    """
    root = _parsed(text, file)
    meshes: dict[str, bytes] = {}
    names: dict[Path, str] = {}
    shown = sum(len(link.findall("visual")) for link in root.iter("link"))
    missing = 0
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for mesh in link.iter("mesh"):
            place = _resolved(mesh.get("filename", ""), file, package_dirs)
            if place is None:
                missing += 1
                continue
            if place not in names:
                names[place] = _new_name(place, meshes)
                meshes[names[place]] = read_bytes(place, MOST_MESH)
                if sum(map(len, meshes.values())) > MOST_MESHES:
                    raise _core.ConfigError(f"{file}: its meshes have more than {MOST_MESHES >> 20} MiB; simplify them")
            mesh.set("filename", f"meshes/{names[place]}")
    for tag in ("gazebo", "transmission", "material"):
        for element in root.findall(tag):
            root.remove(element)
    notes = [f"{shown} visuals: left out"] if shown else []
    if missing:
        notes.append(f"{missing} collision meshes are not found: see the warnings; --package-dir names their package")
    ElementTree.indent(root)
    return Copy(
        '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n",
        meshes,
        root.get("name", ""),
        notes,
    )


def _parsed(text: str, file: Path) -> ElementTree.Element:
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise _core.ConfigError(f"{file}: it has a document type, which a URDF does not need; remove <!DOCTYPE>")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise _core.ConfigError(f"{file}: it is no XML: {error}; correct the file") from error
    if root.tag != "robot":
        raise _core.ConfigError(f"{file}: <{root.tag}>: the root element of a URDF is <robot>; name the robot's file")
    return root


def _resolved(name: str, file: Path, package_dirs: Mapping[str, Path]) -> Path | None:
    """The file of a mesh, looked for as the loader does; None where it is not there."""
    package = re.match(r"(?:package|model)://([^/]+)/(.+)", name)
    folder = file.absolute().parent
    if package is None:
        places = [folder / name.removeprefix("file://")]
    elif package[1] in package_dirs:
        places = [package_dirs[package[1]] / package[2]]
    else:
        places = [above / package[1] / package[2] for above in (folder, *folder.parents)]
    try:
        found = next((place for place in places if place.is_file()), None)
    except (OSError, ValueError):
        return None
    return None if found is None or not name else real_path(found)


def _new_name(place: Path, taken: Mapping[str, bytes]) -> str:
    stem, suffix = re.sub(r"[^A-Za-z0-9_.-]", "_", place.stem)[:80], place.suffix.lower()
    name, number = f"{stem}{suffix}", 2
    while name in taken:
        name, number = f"{stem}_{number}{suffix}", number + 1
    return name


def reference(text: str, base: str, held: Mapping[str, float]) -> tuple[Any, int, Description]:
    """MuJoCo's model of a URDF, the base's body in it, and what to compare.

    Only what moves is compiled: shapes have no mass in a URDF whose links have one.

    Args:
        text: the URDF's, unchanged.
        base: the link that is polypod's base.
        held: joints that do not move.

    Raises:
        ConfigError: where MuJoCo refuses the file.
    """
    mj = mujoco()
    root = ElementTree.fromstring(rooted(text, base))
    for tag in ("mujoco", "gazebo", "transmission", "material"):
        for element in root.findall(tag):
            root.remove(element)
    for link in root.iter("link"):
        for tag in ("visual", "collision"):
            for element in link.findall(tag):
                link.remove(element)
    for joint in root.iter("joint"):
        for element in joint.findall("mimic"):
            joint.remove(element)
    try:
        spec = mj.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        spec.compiler.fusestatic = False
        spec.worldbody.first_body().add_freejoint()
        model = spec.compile()
    except (ValueError, mj.FatalError) as error:
        raise _core.ConfigError(f"MuJoCo does not compile it: {' '.join(str(error).split())}") from error
    links = [Link(base, -1, np.zeros(3), np.eye(3), None)]
    moving = (int(mj.mjtJoint.mjJNT_HINGE), int(mj.mjtJoint.mjJNT_SLIDE))
    for index in range(model.njnt):
        if int(model.jnt_type[index]) in moving:
            links.append(Link(f"link_{index}", 0, np.zeros(3), np.eye(3), _joint(model, index)))
    return model, int(model.body(base).id), Description("", links, None, dict(held), [])


def _joint(model: Any, index: int) -> Joint:
    lower, upper = (float(bound) for bound in model.jnt_range[index])
    v = int(model.jnt_dofadr[index])
    return Joint(
        name=model.joint(index).name,
        kind="revolute",
        axis=np.array(model.jnt_axis[index]),
        lower=lower,
        upper=upper,
        damping=float(model.dof_damping[v]),
        friction=float(model.dof_frictionloss[v]),
        armature=float(model.dof_armature[v]),
        drive=None,
        home=0.0,
        q=int(model.jnt_qposadr[index]),
        v=v,
    )
