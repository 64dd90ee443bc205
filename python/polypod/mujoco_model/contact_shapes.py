"""polypod's contact shapes in MuJoCo's model of a URDF with meshes.

MuJoCo and polypod read meshes in different ways. polypod finds them without ROS, takes their convex
hulls with few points, leaves missing ones out and puts a box in the place of a missing foot. So
that both simulators touch the ground with the same shapes, the model gets polypod's, and those of
the URDF are left out. They have no mass: masses and inertias are those that the URDF states. Links
on fixed joints pass theirs to the link that moves them, as in polypod: some frames of such files
have token inertias that MuJoCo refuses.
"""

from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree

import numpy as np

from polypod import rotations
from polypod.add.urdf import merge
from polypod.arrays import Array

THINNEST = 1e-4
"""Least thickness of a hull, m. MuJoCo refuses flat ones."""


def without_shapes(urdf: str) -> str | None:
    """The URDF without shapes and settings for MuJoCo; None where no link has a mesh."""
    tree = ElementTree.fromstring(urdf)
    links = tree.findall("link")
    if not any(link.find(f"{kind}/geometry/mesh") is not None for link in links for kind in ("visual", "collision")):
        return None
    for element in tree.findall("mujoco"):
        tree.remove(element)
    for link in links:
        for kind in ("visual", "collision"):
            for element in link.findall(kind):
                link.remove(element)
    merge(tree)
    return ElementTree.tostring(tree, encoding="unicode")


def add(mj: Any, spec: Any, outline: Mapping[str, Any]) -> None:
    """Adds a robot's contact shapes to its bodies.

    Args:
        mj: the module.
        spec: the model of the URDF without shapes; joints that are held are taken out.
        outline: the robot's entry of `VecSim.robot_shapes`.
    """
    spec.compiler.inertiafromgeom = mj.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    for contact_body in outline["bodies"]:
        name = contact_body["name"]
        body = spec.body(name)
        place, turn = _pose_in(body, outline["links"][contact_body["link"]])
        for index, shape in enumerate(contact_body["shapes"]):
            geom = body.add_geom(mass=0.0)
            geom.pos = rotations.matrix(turn).T @ (np.array(shape["position"]) - place)
            geom.quat = rotations.product(rotations.inverse(turn), shape["quaternion"])
            match shape["shape"]:
                case "sphere":
                    geom.type, geom.size = mj.mjtGeom.mjGEOM_SPHERE, [shape["radius"], 0.0, 0.0]
                case "box":
                    geom.type, geom.size = mj.mjtGeom.mjGEOM_BOX, 0.5 * np.array(shape["size"])
                case "cylinder":
                    geom.type, geom.size = mj.mjtGeom.mjGEOM_CYLINDER, [shape["radius"], 0.5 * shape["length"], 0.0]
                case "capsule":
                    geom.type, geom.size = mj.mjtGeom.mjGEOM_CAPSULE, [shape["radius"], 0.5 * shape["length"], 0.0]
                case "hull":
                    mesh = spec.add_mesh(name=f"{name} {index}", uservert=_solid(np.array(shape["points"])).ravel())
                    mesh.inertia = mj.mjtMeshInertia.mjMESH_INERTIA_CONVEX
                    geom.type, geom.meshname = mj.mjtGeom.mjGEOM_MESH, mesh.name


def _pose_in(body: Any, link: str) -> tuple[Array, Array]:
    """Position, m, and quaternion of a body in the frame of a link that carries it."""
    place, turn = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    while body.name != link:
        own = np.array(body.quat)
        place = np.array(body.pos) + rotations.matrix(own) @ place
        turn = rotations.product(own, turn)
        body = body.parent
    return place, turn


def _solid(points: Array) -> Array:
    """Points of a hull that is at least `THINNEST` thick in every direction."""
    axes = np.linalg.svd(points - points.mean(axis=0))[2]
    for axis in axes:
        if np.ptp(points @ axis) < THINNEST:
            points = np.concatenate([points + side * THINNEST * axis for side in (-0.5, 0.5)])
    return points
