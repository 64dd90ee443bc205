"""A URDF made part of a library: its text without visuals, and the collision meshes next to it."""

import dataclasses
import functools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from polypod import _core, rotations
from polypod.add import inertias
from polypod.add.compiling import mujoco
from polypod.add.description import Description, Joint, Link, inertial_of, listed, of_point
from polypod.add.root import rooted
from polypod.add.sources import MOST_BYTES
from polypod.arrays import Array
from polypod.files import read_bytes, real_path

MOST_MESH = 256 << 20
"""Bytes of a mesh."""
MESHES = (".stl", ".obj", ".dae")
"""Endings of meshes; no other file is copied."""
MOST_MESHES = 1 << 30
"""Bytes of all meshes of a robot."""
MOST_PACKAGE = 1 << 20
"""Bytes of a `package.xml`."""
PACKAGE_ABOVE = 6
"""Folders above a URDF in which its `package.xml` is looked for."""


@dataclasses.dataclass(frozen=True)
class Copy:
    """Copy of a URDF as it is written."""

    text: str
    meshes: dict[str, bytes]
    """Meshes of the description, by file name."""
    name: str
    notes: list[str]
    missing: str | None = None
    """Collision meshes that are not found, and the remedy."""


def read(file: Path) -> str:
    """The text of a URDF. Raises ConfigError."""
    try:
        text = read_bytes(file, MOST_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise _core.ConfigError(f"{file}: {error.strerror}; name a file that can be read") from error
    except UnicodeDecodeError as error:
        raise _core.ConfigError(f"{file}: it is not text in UTF-8; name the robot's URDF") from error
    return text


def copied(text: str, file: Path, package_dirs: Mapping[str, Path], within: Path | None = None) -> Copy:
    """Makes the copy of a URDF that a library holds.

    Args:
        text: the URDF's.
        file: the file that its relative mesh names are relative to.
        package_dirs: ROS package -> folder.
        within: folder of an archive, beyond which only those of `package_dirs` are read; None: it
            is in no archive.

    Raises:
        ConfigError: for what is no XML or has a document type, and for meshes that are too large or
            outside of the archive.
    """
    root = _parsed(text, file)
    meshes: dict[str, bytes] = {}
    names: dict[Path, str] = {}
    shown = sum(len(link.findall("visual")) for link in root.iter("link"))
    missing: list[str] = []
    odd: list[str] = []
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for mesh in link.iter("mesh"):
            place = _resolved(mesh.get("filename", ""), file, package_dirs)
            if place is None:
                missing.append(mesh.get("filename", ""))
                continue
            if place.suffix.lower() not in MESHES:
                odd.append(mesh.get("filename", ""))
                mesh.set("filename", f"meshes/{_new_name(place, meshes)}")
                continue
            if within is not None and not any(place.is_relative_to(each) for each in (within, *package_dirs.values())):
                raise _core.ConfigError(
                    f"{file}: link {link.get('name')}: mesh {mesh.get('filename', '')[:200]} leads out of the archive; "
                    "unpack what you need, and name the folder"
                )
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
    lost = _lost(missing)
    if lost is not None:
        notes.append(lost)
    if odd:
        names_of = listed([name[:200] for name in dict.fromkeys(odd)])
        notes.append(f"collision mesh {names_of}: is none of {', '.join(MESHES)}: left out; write it as one of them")
    ElementTree.indent(root)
    return Copy(
        '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n",
        meshes,
        root.get("name", ""),
        notes,
        lost,
    )


def _lost(meshes: list[str]) -> str | None:
    """Note on meshes that are not found, with the remedy; None where there are none."""
    if not meshes:
        return None
    named = (re.match(r"(?:package|model)://([^/]+)/", name) for name in meshes)
    packages = list(dict.fromkeys(found[1] for found in named if found))
    remedy = f"name the package's folder: --package-dir {packages[0]}=FOLDER" if packages else "put the file there"
    return f"collision mesh {listed([name[:200] for name in dict.fromkeys(meshes)])}: not found: left out; {remedy}"


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


def root_link(text: str, file: Path) -> str:
    """Name of the link of a URDF that hangs on no joint. Raises ConfigError for what is no URDF."""
    root = _parsed(text, file)
    below = {_end(joint, "child") for joint in root.findall("joint")}
    return next((str(link.get("name")) for link in root.findall("link") if link.get("name") not in below), "")


def _resolved(name: str, file: Path, package_dirs: Mapping[str, Path]) -> Path | None:
    """The file of a mesh; None where it is not there.

    A package's folder is one of `package_dirs`, or above the URDF: one of the package's name, whose
    `package.xml` has the name, or else one that has the mesh.
    """
    name = name.replace("\\", "/")
    package = re.match(r"(?:package|model)://([^/]+)/(.+)", name)
    folder = file.absolute().parent
    if package is None:
        places = [folder / name.removeprefix("file://")]
    elif package[1] in package_dirs:
        places = [package_dirs[package[1]] / package[2]]
    else:
        above = (folder, *folder.parents)
        places = [each / package[1] / package[2] for each in above]
        places += [each / package[2] for each in above[:PACKAGE_ABOVE] if _package_name(each) == package[1]]
        places += [each / package[2] for each in above[:2]]
    try:
        found = next((place for place in places if place.is_file()), None)
    except (OSError, ValueError):
        return None
    return None if found is None or not name else real_path(found)


@functools.cache
def _package_name(folder: Path) -> str | None:
    """Name in the `package.xml` of a folder."""
    try:
        root = ElementTree.fromstring(read_bytes(folder / "package.xml", MOST_PACKAGE))
    except (OSError, ValueError, ElementTree.ParseError, _core.ConfigError):
        return None
    return (root.findtext("name") or "").strip()


def _new_name(place: Path, taken: Mapping[str, bytes]) -> str:
    stem, suffix = re.sub(r"[^A-Za-z0-9_.-]", "_", place.stem)[:80], place.suffix.lower()
    name, number = f"{stem}{suffix}", 2
    while name in taken:
        name, number = f"{stem}_{number}{suffix}", number + 1
    return name


def reference(text: str, base: str, held: Mapping[str, float]) -> tuple[Any, int, Description]:
    """MuJoCo's model of a URDF, the base's body in it, and what to compare.

    Only what moves is compiled: shapes have no mass in a URDF whose links have one. Where MuJoCo
    refuses the inertia of a link, links on fixed joints are merged into those that move them first:
    as in polypod, only the sum counts.

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
        model = _compiled(mj, root)
    except (ValueError, mj.FatalError):
        merge(root)
        try:
            model = _compiled(mj, root)
        except (ValueError, mj.FatalError) as error:
            raise _core.ConfigError(f"MuJoCo does not compile it: {' '.join(str(error).split())}") from error
    links = [Link(base, -1, np.zeros(3), np.eye(3), None)]
    moving = (int(mj.mjtJoint.mjJNT_HINGE), int(mj.mjtJoint.mjJNT_SLIDE))
    for index in range(model.njnt):
        if int(model.jnt_type[index]) in moving:
            links.append(Link(f"link_{index}", 0, np.zeros(3), np.eye(3), _joint(model, index)))
    return model, int(model.body(base).id), Description("", links, None, dict(held), [])


def _compiled(mj: Any, root: ElementTree.Element) -> Any:
    spec = mj.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.compiler.fusestatic = False
    spec.worldbody.first_body().add_freejoint()
    return inertias.compiled(spec)


def merge(root: ElementTree.Element) -> None:
    """Adds the inertias of links on fixed joints to the links that move them.

    Goes from the leaves to the base.
    """
    links = {link.get("name"): link for link in root.findall("link")}
    above = {_end(joint, "child"): joint for joint in root.findall("joint")}

    def depth(name: str | None) -> int:
        return 0 if name not in above else 1 + depth(_end(above[name], "parent"))

    for name in sorted(above, key=depth, reverse=True):
        joint = above[name]
        if joint.get("type") != "fixed":
            continue
        mass, com, inertia = _inertial(links[name])
        at, turn = _pose(joint.find("origin"))
        moved = mass, at + turn @ com, turn @ inertia @ turn.T
        parent = links[_end(joint, "parent")]
        _set_inertial(parent, *_sum(_inertial(parent), moved))
        for element in links[name].findall("inertial"):
            links[name].remove(element)


Inertial = tuple[float, Array, Array]
"""Mass, centre of mass and inertia about it, in one frame."""


def _sum(one: Inertial, other: Inertial) -> Inertial:
    mass = one[0] + other[0]
    com = (one[0] * one[1] + other[0] * other[1]) / mass if mass > 0.0 else np.zeros(3)
    first, second = (part[2] + part[0] * of_point(part[1] - com) for part in (one, other))
    return mass, com, first + second


def _inertial(link: ElementTree.Element) -> Inertial:
    inertial = link.find("inertial")
    if inertial is None:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    at, turn = _pose(inertial.find("origin"))
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    own = {} if tensor is None else {key: float(value) for key, value in tensor.attrib.items()}
    xx, yy, zz, xy, xz, yz = (own.get(key, 0.0) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return 0.0 if mass is None else float(mass.get("value", "0")), at, turn @ matrix @ turn.T


def _set_inertial(link: ElementTree.Element, mass: float, com: Array, inertia: Array) -> None:
    for element in link.findall("inertial"):
        link.remove(element)
    if mass > 0.0:
        inertial_of(link, mass, com, inertia)


def _pose(origin: ElementTree.Element | None) -> tuple[Array, Array]:
    """Position and axes of an `<origin>`."""
    attributes = {} if origin is None else origin.attrib
    at = np.array([float(number) for number in attributes.get("xyz", "0 0 0").split()])
    roll, pitch, yaw = (float(number) for number in attributes.get("rpy", "0 0 0").split())
    return at, rotations.matrix_of_angles(roll, pitch, yaw)


def _end(joint: ElementTree.Element, tag: str) -> str | None:
    end = joint.find(tag)
    return None if end is None else end.get("link")


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
