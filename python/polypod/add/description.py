"""A robot as a tree of links, between the file that it comes from and the URDF that is written."""

import dataclasses
from typing import Literal
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from polypod import rotations
from polypod.arrays import Array

LISTED = 4
"""Names that a note lists; of more it states the number."""


@dataclasses.dataclass(frozen=True)
class Surface:
    """Contact of a shape with the file's ground, by the file's own numbers."""

    friction: float = 1.0
    """Coefficient of sliding friction."""
    torsional_friction: float = 0.0
    rolling_friction: float = 0.0
    """Coefficient of rolling friction, m; `torsional_friction` is that about the normal."""
    contact_margin: float = 0.0
    """Distance from the ground at which contact begins, m."""


@dataclasses.dataclass(frozen=True)
class Shape:
    """Collision shape of a link."""

    kind: Literal["sphere", "capsule", "cylinder", "box", "mesh"]
    size: tuple[float, ...]
    """Radius; radius and length between the caps; radius and length; edges; nothing; m."""
    at: Array
    """Place in the link's frame, m, [3]."""
    turn: Array
    """Axes of the shape in those of the link, [3, 3]."""
    mesh: str = ""
    """Name of the mesh file without its ending."""
    vertices: Array | None = None
    """Vertices of a mesh, in the shape's axes, m, [n, 3]."""
    faces: npt.NDArray[np.intp] | None = None
    """Faces as indices into the vertices, [n, 3]."""
    surface: Surface = Surface()


@dataclasses.dataclass
class Drive:
    """Sum of the file's actuators at one joint."""

    stiffness: float | None = None
    """N m/rad; None where none of them is a position servo."""
    damping: float = 0.0
    """N m s/rad, of the actuators alone."""
    effort: float | None = None
    """Largest effort, N m; None where the file states none."""


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint that turns or slides; positions are those of the file."""

    name: str
    kind: Literal["revolute", "continuous", "prismatic"]
    axis: Array
    """Axis in the link's frame, [3]."""
    lower: float
    upper: float
    """rad or m; infinite where there is no limit."""
    damping: float
    friction: float
    """Viscous and dry friction of the joint itself."""
    armature: float
    """Rotor inertia, kg m^2 or kg."""
    drive: Drive | None
    """None where no actuator of the file acts on it."""
    home: float
    """Position in the pose that the file states, or else where its frames are written down."""
    q: int
    """Index of the joint in MuJoCo's positions."""
    v: int
    """Index of the joint in MuJoCo's velocities."""
    stiffness: float = 0.0
    """Stiffness of the joint's passive spring, N m/rad or N/m; 0: it has none."""
    rest: float = 0.0
    """Position at which the spring is at rest, rad or m."""


@dataclasses.dataclass(frozen=True)
class Link:
    """A rigid part; `parent` is an index into the links, -1 for the base."""

    name: str
    parent: int
    at: Array
    """Place of its frame in that of its parent with the joint at zero, m, [3]."""
    turn: Array
    """Axes of its frame in those of its parent with the joint at zero, [3, 3]."""
    joint: Joint | None
    """Joint that it hangs on; None: it is fixed."""
    mass: float = 0.0
    com: Array = dataclasses.field(default_factory=lambda: np.zeros(3))
    inertia: Array = dataclasses.field(default_factory=lambda: np.zeros((3, 3)))
    """Inertia about the centre of mass, axes of the link, kg m^2."""
    shapes: tuple[Shape, ...] = ()


@dataclasses.dataclass(frozen=True)
class Description:
    """A robot on a floating base; links follow their parents."""

    name: str
    links: list[Link]
    pose: str | None
    """Name of the keyframe that the home positions come from."""
    held: dict[str, float]
    """Joints that do not move in polypod, and where, rad or m."""
    notes: list[str]
    """Features that polypod cannot hold and their treatment, one line each."""

    @property
    def joints(self) -> list[Joint]:
        """Joints that move in the file, parents before children."""
        return [link.joint for link in self.links if link.joint is not None]


def listed(names: list[str]) -> str:
    """Names with commas between; of many the first ones and the number of the others."""
    kept = ", ".join(names[:LISTED])
    return kept if len(names) <= LISTED else f"{kept} and {len(names) - LISTED} more"


def of_point(at: Array) -> Array:
    """Inertia of a unit point mass about the origin, m^2."""
    turned: Array = (at @ at) * np.eye(3) - np.outer(at, at)
    return turned


def _numbers(values: "Array | tuple[float, ...]") -> str:
    # adding zero takes the sign of a negative zero away
    return " ".join(repr(float(value) + 0.0) for value in values)


def _origin(parent: ElementTree.Element, at: Array, turn: Array) -> None:
    ElementTree.SubElement(parent, "origin", xyz=_numbers(at), rpy=_numbers(rotations.angles(turn)))


def inertial_of(link: ElementTree.Element, mass: float, com: Array, inertia: Array) -> None:
    """Adds an `<inertial>` to a link: centre of mass, m, and the inertia about it, kg m^2.

    The inertia is in axes of the link.
    """
    inertial = ElementTree.SubElement(link, "inertial")
    _origin(inertial, com, np.eye(3))
    ElementTree.SubElement(inertial, "mass", value=repr(float(mass)))
    entries = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    ElementTree.SubElement(inertial, "inertia", {key: repr(float(inertia[at]) + 0.0) for key, at in entries.items()})


def urdf(robot: Description, meshes: str = "meshes") -> str:
    """The text of the robot's URDF; its meshes are `<meshes>/<name>.obj`, relative to it."""
    root = ElementTree.Element("robot", name=robot.name, version="1.2")
    for link in robot.links:
        element = ElementTree.SubElement(root, "link", name=link.name)
        if link.mass > 0.0:
            inertial_of(element, link.mass, link.com, link.inertia)
        for shape in link.shapes:
            collision = ElementTree.SubElement(element, "collision")
            _origin(collision, shape.at, shape.turn)
            geometry = ElementTree.SubElement(collision, "geometry")
            ElementTree.SubElement(geometry, shape.kind, _attributes(shape, meshes))
    for link in robot.links:
        if link.parent >= 0:
            _joint(root, robot.links[link.parent].name, link)
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _joint(root: ElementTree.Element, parent: str, link: Link) -> None:
    joint = link.joint
    name = f"{link.name}_fixed" if joint is None else joint.name
    element = ElementTree.SubElement(root, "joint", name=name, type="fixed" if joint is None else joint.kind)
    _origin(element, link.at, link.turn)
    ElementTree.SubElement(element, "parent", link=parent)
    ElementTree.SubElement(element, "child", link=link.name)
    if joint is None:
        return
    ElementTree.SubElement(element, "axis", xyz=_numbers(joint.axis))
    limit: dict[str, str] = {}
    if joint.kind != "continuous":
        limit |= {
            key: repr(bound) for key, bound in (("lower", joint.lower), ("upper", joint.upper)) if np.isfinite(bound)
        }
    if joint.drive is not None and joint.drive.effort is not None:
        limit["effort"] = repr(joint.drive.effort)
    if limit:
        ElementTree.SubElement(element, "limit", limit)
    ElementTree.SubElement(element, "dynamics", damping=repr(joint.damping), friction=repr(joint.friction))


def _attributes(shape: Shape, meshes: str) -> dict[str, str]:
    if shape.kind == "mesh":
        return {"filename": f"{meshes}/{shape.mesh}.obj"}
    if shape.kind == "box":
        return {"size": _numbers(shape.size)}
    if shape.kind == "sphere":
        return {"radius": repr(shape.size[0])}
    return {"radius": repr(shape.size[0]), "length": repr(shape.size[1])}


def obj(shape: Shape) -> str:
    """The text of a mesh file."""
    if shape.vertices is None or shape.faces is None:
        return ""
    lines = [f"v {_numbers(vertex)}" for vertex in shape.vertices]
    lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in shape.faces]
    return "\n".join(lines) + "\n"
