"""MJCF files as MuJoCo compiles them: links, joints, shapes, drives and a pose to stand in.

`compiling` has MuJoCo compile the file. `Reader` writes the tree of links down, with `actuators`,
`held` joints, `shapes` and `surfaces`, and notes the data that is `left_out`:

- A body is a link. A body with several joints is a chain of links, all but the last of which weigh
  `TOKEN`. This mass is taken off the body where it lies. It lies in the anchor of the hinges that
  follow, which moves with the body, so that nothing changes. Where these have several anchors, it
  lies in the anchor of the link's own joint.
- A joint away from its body's origin moves the link's frame to the joint.
- A joint's zero is MuJoCo's: where `ref` puts the written frames elsewhere, the link's frame is
  turned back by it.
- Springs of joints are written down with the position at which they are at rest.
- Geoms that a floor can touch become collision shapes: the file's own floor if it has one, or else
  one with `contype` and `conaffinity` 1, and what `<pair>` names together with something of the
  scene. Friction, `condim`, `priority`, `margin` and `gap` are mixed with those of the ground by
  MuJoCo itself; shapes of one body that differ in the result become separate links.
- Shapes at a limb's end that stand on the ground become a separate link, the foot, where there are
  others.
- Actuators at one joint are added up. Gains and limits are those at the joint: both count `gear`.
"""

import dataclasses
import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from polypod.add import geared
from polypod.add.actuators import actuators_of, drives_of, of_actuator
from polypod.add.compiling import Compiled, compiled, matrix, mujoco
from polypod.add.description import Description, Drive, Joint, Link, listed, of_point
from polypod.add.held import held_in
from polypod.add.left_out import left_out
from polypod.add.shapes import shape_of, standing
from polypod.add.surfaces import by_surface, floor_of, touches
from polypod.arrays import Array

TOKEN = 1e-6
"""Mass of a link between two joints of one body, kg: the least that the loader takes."""
TOKEN_INERTIA = 1e-11
"""Principal moments of inertia, kg m^2."""
IMU = ("GYRO", "ACCELEROMETER", "FRAMEQUAT", "VELOCIMETER", "FRAMEANGVEL", "FRAMELINVEL", "MAGNETOMETER")
"""Sensors that make a site an IMU's."""


def read(file: Path, root: str | None = None) -> tuple[Compiled, Description]:
    """Reads an MJCF file.

    Raises ConfigError where it describes no robot that polypod could hold.
    """
    made = compiled(file, root)
    return made, Reader(made).description()


class Reader:
    """Writes a compiled model down."""

    def __init__(self, made: Compiled) -> None:
        """Takes a model in the pose that its file states."""
        self.made, self.model = made, made.model
        self.notes = list(made.notes)
        self._taken: set[str] = set()
        self._ellipsoids: dict[str, float] = {}
        self._place: dict[int, tuple[int, Array]] = {}
        self.link_of_geom: dict[int, str] = {}
        """Link that has the shape of a geom; after `description`."""
        self.link_of: dict[int, tuple[str, Array]] = {}
        """Link that carries what hangs on a body, and its origin in the body's frame, m; after
        `description`."""
        self._geared = geared.shares(made)
        self.data = mujoco().MjData(self.model)
        self.key, self.home = made.home()
        self.data.qpos[:] = self.home
        mujoco().mj_kinematics(self.model, self.data)
        self.names = {joint: self._unique(made.named("JOINT", joint), "joint", joint) for joint in made.joints()}
        """The robot's joints by number."""

    def description(self) -> Description:
        """The robot. Raises ConfigError."""
        drives = drives_of(self.made, self.names, self.notes)
        held = held_in(self.made, self.names, self.home, drives, self.notes)
        springs = [name for joint, name in self.names.items() if name in held and self.model.jnt_stiffness[joint] > 0.0]
        if springs:
            self.notes.append(f"joint {listed(springs)}: a spring pulls it: left out, as it is locked")
        links = self._links(drives)
        self.notes += [*geared.notes(self.made), *left_out(self.made, self._ellipsoids)]
        moving = [link.joint for link in links if link.joint is not None and link.joint.name not in held]
        light = [joint.name for joint in moving if not joint.armature]
        if light:
            self.notes.append(
                f"joint {listed(light)}: the file has no armature: the rotor has no inertia; write the motor's"
            )
        return Description(self.made.name, links, self.key, held, self.notes)

    def _unique(self, name: str, kind: str, index: int) -> str:
        """A name that neither a link nor a joint has yet."""
        name = name or f"{kind}_{index}"
        for number in itertools.count(2):
            if name not in self._taken:
                break
            name = f"{name}_{kind}" if number == 2 else f"{name}_{number}"
        self._taken.add(name)
        return name

    def _links(self, drives: dict[int, Drive]) -> list[Link]:
        """Links, parents before children."""
        made, model = self.made, self.model
        links: list[Link] = []
        place = self._place
        floor = floor_of(made)
        balls = []
        for body in made.bodies():
            at, turn = np.array(model.body_pos[body]), matrix(model.body_quat[body])
            if body == made.base:
                parent, at, turn = -1, np.zeros(3), np.eye(3)
            else:
                parent, offset = place[int(model.body_parentid[body])]
                at = at - offset
            own = made.joints_of(body)
            balls += [joint for joint in own if int(model.jnt_type[joint]) == int(mujoco().mjtJoint.mjJNT_BALL)]
            moving = [joint for joint in own if made.moves(joint)]
            name = self._unique(made.named("BODY", body), "body", body)
            anchor = last = np.zeros(3)
            tokens = []
            for number, joint in enumerate(moving):
                at, turn, anchor = self._before(joint, at, turn, anchor)
                if number:
                    is_still = self._turn_about_one_point(moving[number:])
                    tokens.append(anchor if is_still else last)
                    links[-1] = dataclasses.replace(links[-1], com=at if is_still else np.zeros(3))
                last = anchor
                is_last = number + 1 == len(moving)
                link_name = name if is_last else self._unique(f"{name}_{self.names[joint]}_link", "body", body)
                link = Link(link_name, parent, at, turn, self._joint(joint, drives))
                if not is_last:
                    moments = np.eye(3) * TOKEN_INERTIA
                    link = dataclasses.replace(link, mass=TOKEN, inertia=moments)
                links.append(link)
                parent, at, turn = len(links) - 1, np.zeros(3), np.eye(3)
            if not moving:
                links.append(Link(name, parent, at, turn, None))
            place[body] = (len(links) - 1, anchor)
            self.link_of[body] = (links[-1].name, anchor)
            links[-1] = self._with_mass(links[-1], body, anchor, tokens)
            self._touch(links, body, anchor, floor)
        if balls:
            names = listed([self.names[joint] for joint in balls])
            self.notes.append(f"ball joint {names}: locked where the file's frames are written down")
        self._sites(links, place)
        return links

    def _before(self, joint: int, at: Array, turn: Array, anchor: Array) -> tuple[Array, Array, Array]:
        """Frame of a joint's link in the link before, at zero.

        Returns it with the joint's anchor in its body's frame.
        """
        model = self.model
        axis, rest = np.array(model.jnt_axis[joint]), float(model.qpos0[model.jnt_qposadr[joint]])
        if int(model.jnt_type[joint]) == int(mujoco().mjtJoint.mjJNT_SLIDE):
            return at + turn @ (-rest * axis), turn, anchor
        here = np.array(model.jnt_pos[joint])
        quaternion = np.zeros(4)
        mujoco().mju_axisAngle2Quat(quaternion, axis, -rest)
        return at + turn @ (here - anchor), turn @ matrix(quaternion), here

    def _turn_about_one_point(self, joints: Sequence[int]) -> bool:
        """Whether joints of one body are hinges with the same anchor."""
        hinge, anchors = int(mujoco().mjtJoint.mjJNT_HINGE), self.model.jnt_pos[joints]
        return all(int(self.model.jnt_type[joint]) == hinge for joint in joints) and bool((anchors == anchors[0]).all())

    def _joint(self, joint: int, drives: dict[int, Drive]) -> Joint:
        """A joint with the numbers of the actuators that act on it."""
        made, model = self.made, self.model
        v, q = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
        lower, upper = made.range_of(joint)
        kind: Literal["revolute", "continuous", "prismatic"] = "revolute" if np.isfinite(lower) else "continuous"
        if int(model.jnt_type[joint]) == int(mujoco().mjtJoint.mjJNT_SLIDE):
            kind = "prismatic"
        armature = float(model.dof_armature[v]) + self._geared.get(joint, 0.0)
        for index in actuators_of(made, joint):
            armature += of_actuator(made, "actuator_armature", index)
        return Joint(
            name=self.names[joint],
            kind=kind,
            axis=np.array(model.jnt_axis[joint]),
            lower=lower,
            upper=upper,
            damping=float(model.dof_damping[v])
            + sum(of_actuator(made, "actuator_damping", index) for index in actuators_of(made, joint)),
            friction=float(model.dof_frictionloss[v]),
            armature=armature,
            drive=drives.get(joint),
            home=made.within(joint, float(self.home[q])),
            q=q,
            v=v,
            stiffness=float(model.jnt_stiffness[joint]),
            rest=float(model.qpos_spring[q]),
        )

    def _with_mass(self, link: Link, body: int, anchor: Array, tokens: list[Array]) -> Link:
        """The link with the mass of its body, less point masses `TOKEN` at these points."""
        model = self.model
        turn = matrix(model.body_iquat[body])
        inertia = turn @ np.diag(model.body_inertia[body]) @ turn.T
        mass, com = float(model.body_mass[body]), np.array(model.body_ipos[body])
        if tokens:
            left = mass - len(tokens) * TOKEN
            middle = (mass * com - TOKEN * np.sum(tokens, axis=0)) / left
            inertia = inertia + mass * of_point(com - middle) - TOKEN * sum(of_point(at - middle) for at in tokens)
            mass, com = left, middle
        return dataclasses.replace(link, mass=mass, com=com - anchor, inertia=0.5 * (inertia + inertia.T))

    def _touch(self, links: list[Link], body: int, anchor: Array, floor: tuple[int, int]) -> None:
        """Gives the body's last link its shapes; foot and other surfaces get separate links."""
        model = self.model
        first = int(model.body_geomadr[body])
        geoms = [
            geom
            for geom in range(first, first + int(model.body_geomnum[body]))
            if first >= 0 and touches(self.made, geom, floor)
        ]
        shapes = [
            (geom, shape)
            for geom in geoms
            if (shape := shape_of(self.made, geom, anchor, self._ellipsoids, self.notes)) is not None
        ]
        feet = standing(self.made, self.data, [geom for geom, _ in shapes], body)
        parent, name = len(links) - 1, links[-1].name
        of_body, *others = by_surface([shape for geom, shape in shapes if geom not in feet])
        links[-1] = dataclasses.replace(links[-1], shapes=of_body)
        place = {id(shape): geom for geom, shape in shapes}
        self.link_of_geom |= {place[id(shape)]: name for shape in of_body}
        parts = [(f"{name}_surface", own) for own in others]
        if feet:
            of_feet = by_surface([shape for geom, shape in shapes if geom in feet])
            parts += [(f"{name}_foot", own) for own in of_feet]
        for part, own in parts:
            link = self._unique(part, "body", body)
            self.link_of_geom |= {place[id(shape)]: link for shape in own}
            at = own[0].at if len(own) == 1 else np.zeros(3)
            own = tuple(dataclasses.replace(shape, at=shape.at - at) for shape in own)
            links.append(Link(link, parent, at, np.eye(3), None, shapes=own))

    def _sites(self, links: list[Link], place: dict[int, tuple[int, Array]]) -> None:
        """Adds the frames of IMUs and feet as empty links."""
        mj, made, model = mujoco(), self.made, self.model
        kinds = [getattr(mj.mjtSensor, f"mjSENS_{kind}", None) for kind in IMU]
        wanted = set()
        for sensor in range(model.nsensor):
            is_imu = any(kind is not None and int(model.sensor_type[sensor]) == int(kind) for kind in kinds)
            is_touch = int(model.sensor_type[sensor]) == int(mj.mjtSensor.mjSENS_TOUCH)
            if (is_imu or is_touch) and int(model.sensor_objtype[sensor]) == int(mj.mjtObj.mjOBJ_SITE):
                wanted.add(int(model.sensor_objid[sensor]))
        for site in range(model.nsite):
            name = made.named("SITE", site)
            body = int(model.site_bodyid[site])
            if body not in made.inside or not (site in wanted or re.search("imu|foot", name, re.IGNORECASE)):
                continue
            parent, anchor = place[body]
            at, turn = np.array(model.site_pos[site]) - anchor, matrix(model.site_quat[site])
            links.append(Link(self._unique(name, "site", site), parent, at, turn, None))
