"""The makers' meshes of robots, out of the package robot_descriptions.

The package clones a maker's repository into the user's cache when a description is used first.
Nothing of it is part of polypod. A description is shown if its links are where the robot's own are;
`descriptions.toml` says which module belongs to which robot.
"""

import functools
import importlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from polypod import _core
from polypod.arrays import Array
from polypod.compat import tomllib
from polypod.extras import package
from polypod.play.looks import Model
from polypod.rotations import matrix, matrix_of_angles

TOLERANCE = 0.02
"""Links of a description may be so far from the robot's, m; joints at zero."""
_PREFIX = "package://"


def check() -> None:
    """Raises ConfigError where robot_descriptions is missing."""
    package("robot_descriptions", "--meshes", "meshes")


@functools.cache
def modules() -> dict[str, str]:
    """Returns each robot's module of robot_descriptions."""
    return tomllib.loads((Path(__file__).parent / "descriptions.toml").read_text(encoding="utf-8"))


def models(robot: str, links: Sequence[str], rest: tuple[Array, Array]) -> list[Model]:
    """The meshes of a robot, by link.

    Args:
        robot: its name.
        links: its links that move, the base first.
        rest: their positions [links, 3], m, and quaternions [links, 4] with all joints at zero,
            base axes.

    Raises:
        ConfigError: for a robot without a description, one that cannot be downloaded or read, and
            one whose links are not the robot's.
    """
    name = modules().get(robot)
    if name is None:
        raise _core.ConfigError(f"descriptions.toml has no meshes of {robot!r}")
    try:
        # this is where the package downloads
        module = importlib.import_module(f"robot_descriptions.{name}")
        urdf = Path(module.URDF_PATH)
        tree = ElementTree.parse(urdf).getroot()
    except Exception as error:
        line = (str(error).splitlines() or [type(error).__name__])[0]
        raise _core.ConfigError(f"robot_descriptions.{name} cannot be had: {line}") from error
    parents = _parents(tree)
    poses: dict[str, Array] = {}
    for element in tree.iter("link"):
        _pose(element.get("name", ""), parents, poses)
    if links[0] not in poses:
        raise _core.ConfigError(f"{urdf}: there is no link {links[0]!r}")
    base = np.linalg.inv(poses[links[0]])
    own = {link: _matrix(place, matrix(turn)) for link, place, turn in zip(links, *rest, strict=True)}
    for link in links:
        if link not in poses:
            raise _core.ConfigError(f"{urdf}: there is no link {link!r}")
        away = float(np.linalg.norm((base @ poses[link] - own[link])[:3, 3]))
        if away > TOLERANCE:
            raise _core.ConfigError(f"{urdf}: the link {link!r} is {away:.3f} m from where the robot has it")
    folders = [Path(module.PACKAGE_PATH), Path(module.PACKAGE_PATH).parent, Path(module.REPOSITORY_PATH), urdf.parent]
    folders.append(Path(module.REPOSITORY_PATH).parent)
    parts: dict[str, list[tuple[Any, Array]]] = {}
    for element in tree.iter("link"):
        holder = _holder(element.get("name", ""), parents, own)
        if holder is None:
            continue
        place = np.linalg.inv(own[holder]) @ base @ poses[element.get("name", "")]
        for visual in element.iter("visual"):
            geometry = _geometry(visual, folders, urdf)
            if geometry is not None:
                parts.setdefault(holder, []).append((geometry, place @ _origin(visual)))
    return [_model(list(links).index(link), pieces) for link, pieces in parts.items()]


def _model(link: int, pieces: list[tuple[Any, Array]]) -> Model:
    trimesh = package("trimesh", "the viewer", "play")
    scene = trimesh.Scene()
    for geometry, place in pieces:
        for mesh in geometry.dump() if isinstance(geometry, trimesh.Scene) else [geometry]:
            scene.add_geometry(mesh, transform=place)
    return Model(link, scene.export(file_type="glb"), float(scene.bounds[1, 2]))


def _geometry(visual: ElementTree.Element, folders: Sequence[Path], urdf: Path) -> Any:
    """Returns trimesh's geometry of a visual; None for a kind that it does not know."""
    trimesh = package("trimesh", "the viewer", "play")
    color = visual.find("material/color")
    rgba = None if color is None else [float(value) for value in color.get("rgba", "0.7 0.7 0.7 1").split()]
    for kind in visual.iterfind("geometry/*"):
        if kind.tag == "mesh":
            file = _file(kind.get("filename", ""), folders, urdf)
            try:
                loaded = trimesh.load(file)
            except Exception as error:
                remedy = "; install 'polypod[meshes]'" if file.suffix == ".dae" else ""
                raise _core.ConfigError(f"{file} cannot be read: {error}{remedy}") from error
            loaded.apply_scale([float(value) for value in kind.get("scale", "1 1 1").split()])
        elif kind.tag == "box":
            loaded = trimesh.creation.box([float(value) for value in kind.get("size", "").split()])
        elif kind.tag == "sphere":
            loaded = trimesh.creation.icosphere(radius=float(kind.get("radius", "")))
        elif kind.tag == "cylinder":
            loaded = trimesh.creation.cylinder(float(kind.get("radius", "")), float(kind.get("length", "")))
        else:
            return None
        if rgba is not None and isinstance(loaded, trimesh.Trimesh) and not _has_colors(loaded):
            loaded.visual = trimesh.visual.TextureVisuals(
                material=trimesh.visual.material.PBRMaterial(baseColorFactor=rgba, metallicFactor=0.1)
            )
        return loaded
    return None


def _has_colors(mesh: Any) -> bool:
    return mesh.visual.kind == "texture" or bool(mesh.visual.defined)


def _file(name: str, folders: Sequence[Path], urdf: Path) -> Path:
    """The file that a mesh's name in a URDF stands for."""
    if name.startswith(_PREFIX):
        first, _, rest = name.removeprefix(_PREFIX).partition("/")
        candidates = [folder / rest for folder in folders if folder.name == first]
        candidates += [folder / part for folder in folders for part in (f"{first}/{rest}", rest)]
    else:
        candidates = [urdf.parent / name, *(folder / name for folder in folders)]
    for file in candidates:
        if file.is_file():
            return file
    raise _core.ConfigError(f"{urdf}: there is no file {name!r}")


def _parents(tree: ElementTree.Element) -> dict[str, tuple[str, Array]]:
    """Returns each link's parent, and its place in the parent's frame with the joint at zero."""
    parents = {}
    for joint in tree.iterfind("joint"):
        child, parent = joint.find("child"), joint.find("parent")
        if child is not None and parent is not None:
            parents[child.get("link", "")] = (parent.get("link", ""), _origin(joint))
    return parents


def _pose(link: str, parents: dict[str, tuple[str, Array]], poses: dict[str, Array]) -> Array:
    """Pose of a link in the root's frame with all joints at zero, [4, 4]."""
    chain: list[str] = []
    while link not in poses and link in parents and len(chain) <= len(parents):
        chain.append(link)
        link = parents[link][0]
    pose = poses.setdefault(link, np.eye(4))
    for below in reversed(chain):
        pose = poses[below] = pose @ parents[below][1]
    return pose


def _holder(link: str, parents: dict[str, tuple[str, Array]], own: dict[str, Array]) -> str | None:
    """The nearest link of the robot at or above a link of the description."""
    for _ in range(len(parents) + 1):
        if link in own:
            return link
        if link not in parents:
            return None
        link = parents[link][0]
    return None


def _origin(element: ElementTree.Element) -> Array:
    """Pose of an element's `origin`, [4, 4]."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    roll, pitch, yaw = (float(value) for value in origin.get("rpy", "0 0 0").split())
    place = np.array([float(value) for value in origin.get("xyz", "0 0 0").split()])
    return _matrix(place, matrix_of_angles(roll, pitch, yaw))


def _matrix(place: Array, turn: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, place
    return matrix
