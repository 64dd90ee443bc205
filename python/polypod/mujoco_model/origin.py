"""The file that a robot comes from, as MuJoCo compiles it.

`polypod add` keeps the model of an MJCF file next to the robot's URDF (`polypod.add.kept`). A robot
with such a file is compared with this model: its bodies, joints, armature, damping, dry friction
and shapes are the file's. The compared settings are the same for all robots, see
`polypod.mujoco_model.reference`: actuators and their limits, friction and stiffness of contacts,
springs, surfaces of links, held joints. Features that polypod leaves out are off: tendons, equality
constraints, the medium, and shapes that the ground does not touch. All other robots are compared
with MuJoCo's model of their URDF.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from polypod.add import compiling, kept, mjcf, surfaces, urdf
from polypod.add.description import Description
from polypod.arrays import Array
from polypod.robot_files import urdf_file


@dataclasses.dataclass(frozen=True)
class Origin:
    """An MJCF file of one robot."""

    file: Path
    made: compiling.Compiled
    described: Description
    links: Mapping[int, tuple[str, Array]]
    """Link of each body of the robot, by the body's number, and its origin in the body's frame,
    m."""
    joints: Mapping[int, str]
    """Names of the robot's joints by their numbers."""
    touching: Mapping[int, str]
    """Links of the geoms that the ground can touch, by their numbers."""

    @property
    def base(self) -> str:
        """The link of the body that is the base."""
        return self.links[self.made.base][0]

    @property
    def anchors(self) -> dict[str, Array]:
        """Origins of the links in the frames of their bodies, by link, m."""
        return dict(self.links.values())

    @staticmethod
    def link_of_geom(name: str) -> str:
        """The link of a geom of `spec`, by the geom's name."""
        return name.rpartition("/")[0]

    def spec(self, lock: Callable[[Any, str, float], None], held: Mapping[str, float]) -> Any:
        """`mujoco.MjSpec` of the robot alone at the world's origin, its base fixed.

        It has no actuators and no ground.

        Args:
            lock: holds a joint of a spec, by its name, at a position.
            held: joints that polypod holds, and where, rad or m.
        """
        mj = compiling.mujoco()
        spec = mj.MjSpec.from_file(str(self.file))
        spec.compile()
        # numbers are those of the compiled model until something is deleted
        base = next(body for body in spec.bodies if body.id == self.made.base)
        moving: list[Any] = []
        stiff: list[Any] = []
        for body in spec.bodies:
            if body.id in self.links:
                body.name, body.gravcomp = self.links[body.id][0], 0.0
        for joint in spec.joints:
            if joint.id in self.joints:
                is_held = joint.type in (mj.mjtJoint.mjJNT_FREE, mj.mjtJoint.mjJNT_BALL)
                (stiff if is_held else moving).append(joint)
                joint.name = self.joints[joint.id]
        unseen = [geom for geom in spec.geoms if geom.id not in self.touching]
        for geom in spec.geoms:
            if geom.id in self.touching:
                geom.name = f"{self.touching[geom.id]}/{geom.id}"
        others = [body for body in _tops(spec) if body.id != base.id]
        for joint in moving:
            joint.stiffness = 0.0 * np.asarray(joint.stiffness)
            # only what grows with the speed itself is damping in polypod
            linear = np.array(joint.damping)
            linear.ravel()[1:] = 0.0
            joint.damping = linear
        for parts in (
            spec.keys,
            spec.actuators,
            spec.sensors,
            spec.equalities,
            spec.tendons,
            spec.pairs,
            spec.excludes,
        ):
            for part in list(parts):
                spec.delete(part)
        for part in (*stiff, *unseen, *others):
            spec.delete(part)
        base.pos, base.quat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
        option, usual = spec.option, mj.MjSpec().option
        for name in (
            "density",
            "viscosity",
            "wind",
            "disableflags",
            "enableflags",
            "solver",
            "iterations",
            "tolerance",
        ):
            setattr(option, name, getattr(usual, name))
        for name, position in held.items():
            if name in self.joints.values():
                lock(spec, name, position)
        return spec


def _tops(spec: Any) -> list[Any]:
    found, body = [], spec.worldbody.first_body()
    while body is not None:
        found.append(body)
        body = spec.worldbody.next_body(body)
    return found


def origin_of(source: str, urdf_key: str, base: str) -> Origin | None:
    """The MJCF file of a robot; None without one, or if its base is another body than polypod's.

    Args:
        source: name of the robot, or path of its config.
        urdf_key: `urdf` of its config.
        base: the link that is polypod's base.

    Raises:
        ConfigError: where MuJoCo does not compile the file.
    """
    place = urdf_file(source, urdf_key)
    file = None if place is None else place.with_name(kept.NAME)
    if place is None or file is None or not file.is_file():
        return None
    found = read(file, urdf.root_link(urdf.read(place), place))
    return found if found.base == base else None


@functools.cache
def read(file: Path, root: str) -> Origin:
    """Reads a file that `add` kept; `root` is the link that its base became. Raises ConfigError."""
    spec = compiling.mujoco().MjSpec.from_file(str(file))
    named = any(body.name == root for body in _tops(spec))
    made = compiling.compiled(file, root if named else None)
    reader = mjcf.Reader(made)
    described = reader.description()
    floor = surfaces.floor_of(made)
    return Origin(
        file=file,
        made=made,
        described=described,
        links=dict(reader.link_of),
        joints=dict(reader.names),
        touching={
            geom: reader.link_of_geom.get(geom, "")
            for geom in range(made.model.ngeom)
            if int(made.model.geom_bodyid[geom]) in made.inside and surfaces.touches(made, geom, floor)
        },
    )
