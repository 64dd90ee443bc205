"""MJCF files as MuJoCo compiles them: links, joints, shapes, drives and a pose to stand in.

MuJoCo itself reads the file. Nobody else knows defaults, classes, frames, replicas, includes and
attachments, and the compiled model has them all resolved. These parts are taken from it:

- A body is a link. A body with several joints is a chain of links, all but the last of which weigh
  `TOKEN`. This mass is taken off the body where it lies, in the anchor of the joint, so that
  anchors in one point change nothing.
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
import functools
import itertools
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np

from polypod import _core
from polypod.add.description import Array, Description, Drive, Joint, Link, Shape, Surface
from polypod.extras import package

TOKEN = 1e-6
"""Mass of a link between two joints of one body, kg: the least that the loader takes."""
TOKEN_INERTIA = 1e-11
"""Its principal moments, kg m^2."""
POSES = ("home", "stand", "standing", "default", "init", "initial")
"""Keyframes that a robot stands in, the first one that is there; else the file's first."""
FOOT_NAMES = re.compile(r"foot|feet|toe|sole|ankle_?roll|^(fl|fr|rl|rr|hl|hr|lf|rf|lh|rh)\d*$", re.IGNORECASE)
"""Names of geoms that stand on the ground."""
SOLE = 0.01
"""Shapes of a limb's end whose lowest points are this close to the lowest one stand on the ground,
m."""
ROUND = 1e-3
"""Relative difference up to which an ellipsoid is a sphere."""
PLAIN = (3, (1.0, 0.005, 0.0001), 0.0, 0.0, 0)
"""`condim`, friction, margin, gap and priority of MuJoCo's default geom."""
CONE_DIMS = {1: 0, 3: 1, 4: 2, 6: 3}
"""By `condim`: how many of sliding, torsional and rolling friction a contact has."""
LISTED = 4
"""Names that a note lists; of more it states the number."""
IMU = ("GYRO", "ACCELEROMETER", "FRAMEQUAT", "VELOCIMETER", "FRAMEANGVEL", "FRAMELINVEL", "MAGNETOMETER")
"""Sensors that make a site an IMU's."""


@dataclasses.dataclass(frozen=True)
class Compiled:
    """A model and the body that is the robot's base."""

    model: Any
    base: int
    name: str
    notes: list[str]
    spec: Any
    """`mujoco.MjSpec` that it is compiled from."""

    def bodies(self) -> list[int]:
        """The robot's bodies, parents before children."""
        inside = {self.base}
        for body in range(self.base + 1, self.model.nbody):
            if int(self.model.body_parentid[body]) in inside:
                inside.add(body)
        return sorted(inside)


def mujoco() -> Any:
    """The module. Raises ConfigError where it is not installed."""
    return package("mujoco", "reading an MJCF file", "add")


def listed(names: list[str]) -> str:
    """Names with commas between; of many the first ones and the number of the others."""
    kept = ", ".join(names[:LISTED])
    return kept if len(names) <= LISTED else f"{kept} and {len(names) - LISTED} more"


def compiled(file: Path, root: str | None = None) -> Compiled:
    """Compiles an MJCF file with MuJoCo.

    The base gets a free joint where the file has none. Textures and skins are left out, and so are
    meshes that neither touch anything nor give a mass, whose files may be missing.

    Args:
        file: the MJCF file.
        root: the body that is the robot's base; None: the one below which the most joints are.

    Raises:
        ConfigError: where MuJoCo refuses the file, or no body or several could be the robot.
    """
    mj = mujoco()
    notes: list[str] = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            spec = mj.MjSpec.from_file(str(file))
            _without_pictures(spec)
            _without_ground(mj, spec, notes)
            _with_ground(mj, spec, notes)
            _without_visuals(mj, spec)
            _check_meshes(spec, file)
            base = _base(mj, spec, file, root)
            _float(mj, base, file, notes)
            model = spec.compile()
    except _core.PolypodError:
        raise
    except (ValueError, mj.FatalError) as error:
        text = " ".join(str(error).split())
        raise _core.ConfigError(f"{file}: MuJoCo does not compile it: {text}; correct the file") from error
    return Compiled(model, base.id, _name_of(spec.modelname, file), notes, spec)


def _name_of(model: str, file: Path) -> str:
    name = re.sub(r"[ _]*scene$", "", model.strip(), flags=re.IGNORECASE)
    if name and name != "MuJoCo Model":
        return name
    generic = ("scene", "robot", "model", "scene_flat", "scene_mjx", "mjx")
    stem = file.stem if file.stem.lower() not in generic else file.resolve().parent.name
    return re.sub(r"^scene_|_scene$|^mjx_|_mjx$", "", stem) or "robot"


def _without_pictures(spec: Any) -> None:
    """Leaves textures out: nothing that is simulated depends on them."""
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in list(spec.textures):
        spec.delete(texture)


def _without_ground(mj: Any, spec: Any, notes: list[str]) -> None:
    """Lets planes stand for the height fields of the scene, whose files may be missing.

    They touch the same.
    """
    for geom in spec.geoms:
        if geom.type == mj.mjtGeom.mjGEOM_HFIELD:
            geom.type, geom.hfieldname = mj.mjtGeom.mjGEOM_PLANE, ""
            geom.size = [0.0, 0.0, 1.0]
    for field in list(spec.hfields):
        spec.delete(field)
        notes.append("height fields of the scene: left out: the task has the ground")


def _with_ground(mj: Any, spec: Any, notes: list[str]) -> None:
    """Adds the ground to a robot's file that only names it, in `<pair>`.

    Such a file leaves the ground itself to the scene that includes it.
    """
    there = {geom.name for geom in spec.geoms}
    pairs = [(pair.geomname1, pair.geomname2) for pair in spec.pairs]
    missing = sorted({name for pair in pairs if there & set(pair) for name in pair} - there)
    for name in missing:
        size = [0.0, 0.0, 1.0]
        spec.worldbody.add_geom(name=name, type=mj.mjtGeom.mjGEOM_PLANE, size=size, contype=0, conaffinity=0)
    if missing:
        notes.append(f"geom {listed(missing)}: in a <pair> and not in the file: replaced by a plane, the ground")


def _without_visuals(mj: Any, spec: Any) -> None:
    """Leaves out meshes that neither touch anything nor give a mass: they take seconds."""
    named = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    named |= {name for sensor in spec.sensors for name in (sensor.objname, sensor.refname)}
    for geom in spec.geoms:
        is_seen = geom.type == mj.mjtGeom.mjGEOM_MESH and not geom.contype and not geom.conaffinity
        if is_seen and geom.parent.explicitinertial and (not geom.name or geom.name not in named):
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if (mesh.name or Path(mesh.file).stem) not in used:
            spec.delete(mesh)
    for skin in list(spec.skins):
        spec.delete(skin)


def _check_meshes(spec: Any, file: Path) -> None:
    """Raises ConfigError for a mesh that is needed and not there."""
    folder = Path(spec.modelfiledir or file.parent) / (spec.compiler.meshdir or spec.meshdir or "")
    for mesh in spec.meshes:
        if mesh.file and not (folder / mesh.file).is_file() and not (file.parent / mesh.file).is_file():
            name = mesh.name or Path(mesh.file).stem
            bodies = [geom.parent.name or "(without a name)" for geom in spec.geoms if geom.meshname == name]
            raise _core.ConfigError(
                f"{file}: mesh {name}: {folder / mesh.file} is not there, and body {listed(bodies)} touches the ground "
                "with it or has its mass from it; put the file there"
            )


def _children(body: Any) -> Iterator[Any]:
    child = body.first_body()
    while child is not None:
        yield child
        child = body.next_body(child)


def _below(body: Any) -> Iterator[Any]:
    yield body
    for child in _children(body):
        yield from _below(child)


def _base(mj: Any, spec: Any, file: Path, root: str | None) -> Any:
    """The body of the scene that is the robot's base. Raises ConfigError."""
    moving = (mj.mjtJoint.mjJNT_HINGE, mj.mjtJoint.mjJNT_SLIDE)
    tops = list(_children(spec.worldbody))
    if root is not None:
        found = [body for body in tops if body.name == root]
        if not found:
            names = listed([body.name or "(without a name)" for body in tops]) or "none"
            raise _core.ConfigError(f"{file}: --root {root}: no body of the scene has this name; there are: {names}")
        return found[0]
    counts = [sum(joint.type in moving for body in _below(top) for joint in body.joints) for top in tops]
    most = max(counts, default=0)
    if most == 0:
        raise _core.ConfigError(f"{file}: <worldbody>: no body has joints that turn or slide; add a robot's file")
    best = [top for top, count in zip(tops, counts, strict=True) if count == most]
    if len(best) > 1:
        names = listed([body.name or "(without a name)" for body in best])
        raise _core.ConfigError(
            f"{file}: <worldbody>: {len(best)} bodies could be the robot, with {most} joints each: {names}; name one "
            "with --root"
        )
    return best[0]


def _float(mj: Any, base: Any, file: Path, notes: list[str]) -> None:
    """Gives the base a free joint, if the file has none.

    Raises ConfigError where it moves on rails.
    """
    joints = list(base.joints)
    if any(joint.type == mj.mjtJoint.mjJNT_FREE for joint in joints):
        return
    name = base.name or "(without a name)"
    if joints:
        rails = listed([joint.name or "(without a name)" for joint in joints])
        raise _core.ConfigError(
            f"{file}: body {name}: its base moves on the joints {rails}, and a robot's base floats; write <freejoint/> "
            "in their place if the body can stand without them"
        )
    base.add_freejoint()
    notes.append(f"the base {name} has no free joint: replaced: it floats")


def read(file: Path, root: str | None = None) -> tuple[Compiled, Description]:
    """Reads an MJCF file.

    Raises ConfigError where it describes no robot that polypod could hold.
    """
    made = compiled(file, root)
    return made, Reader(mujoco(), made, file).description()


class Reader:
    """Writes a compiled model down."""

    def __init__(self, mj: Any, made: Compiled, file: Path) -> None:
        """Takes a model and the file that it comes from, for errors."""
        self.mj, self.model, self.file = mj, made.model, file
        self.made = made
        self.bodies = made.bodies()
        self.inside = set(self.bodies)
        self.notes = list(made.notes)
        self._taken: set[str] = set()
        self._ellipsoids: dict[str, float] = {}
        self._place: dict[int, tuple[int, Array]] = {}
        self.link_of_geom: dict[int, str] = {}
        """Link that has the shape of a geom; after `description`."""
        self.link_of: dict[int, tuple[str, Array]] = {}
        """Link that carries what hangs on a body, and its origin in the body's frame, m; after
        `description`."""
        self.data = mj.MjData(self.model)
        self.key, self.home = self._home()
        self.data.qpos[:] = self.home
        mj.mj_kinematics(self.model, self.data)
        self.joints = [joint for joint in range(self.model.njnt) if int(self.model.jnt_bodyid[joint]) in self.inside]
        self.names = {joint: self._unique(self.named("JOINT", joint), "joint", joint) for joint in self.joints}

    def description(self) -> Description:
        """The robot. Raises ConfigError."""
        drives = self._drives()
        held = self._held(drives)
        springs = [name for joint, name in self.names.items() if name in held and self.model.jnt_stiffness[joint] > 0.0]
        if springs:
            self.notes.append(f"joint {listed(springs)}: a spring pulls it: left out, as it is locked")
        links = self._links(drives)
        self._left_out()
        return Description(self.made.name, links, self.key, held, self.notes)

    def named(self, kind: str, index: int) -> str:
        """Name of an object of a kind such as JOINT; nothing where the file has none."""
        return self.mj.mj_id2name(self.model, getattr(self.mj.mjtObj, f"mjOBJ_{kind}"), index) or ""

    def _unique(self, name: str, kind: str, index: int) -> str:
        """A name that neither a link nor a joint has yet."""
        name = name or f"{kind}_{index}"
        for number in itertools.count(2):
            if name not in self._taken:
                break
            name = f"{name}_{kind}" if number == 2 else f"{name}_{number}"
        self._taken.add(name)
        return name

    def _home(self) -> tuple[str | None, Array]:
        """Name and positions of the keyframe that the robot stands in.

        Without any, the written positions.
        """
        names = [self.named("KEY", key) for key in range(self.model.nkey)]
        found = [names.index(name) for name in POSES if name in names] or list(range(len(names)))
        if not found:
            return None, np.array(self.model.qpos0)
        return names[found[0]] or str(found[0]), np.array(self.model.key_qpos[found[0]])

    def _moves(self, joint: int) -> bool:
        kinds = (self.mj.mjtJoint.mjJNT_HINGE, self.mj.mjtJoint.mjJNT_SLIDE)
        return int(self.model.jnt_type[joint]) in (int(kind) for kind in kinds)

    # Drives

    def _drives(self) -> dict[int, Drive]:
        """Drives of the joints; notes joints that are driven otherwise."""
        mj, model = self.mj, self.model
        drives: dict[int, Drive] = {}
        odd: dict[str, list[str]] = {}
        at_joint = (int(mj.mjtTrn.mjTRN_JOINT), int(mj.mjtTrn.mjTRN_JOINTINPARENT))
        for index in range(model.nu):
            name = self.named("ACTUATOR", index) or f"actuator_{index}"
            target, kind = int(model.actuator_trnid[index][0]), int(model.actuator_trntype[index])
            if kind == int(mj.mjtTrn.mjTRN_TENDON):
                for joint in self._tendon_joints(target):
                    drives.setdefault(joint, Drive())
                    odd.setdefault("acts on a tendon: replaced by a position actuator at each of its joints", [])
                    odd["acts on a tendon: replaced by a position actuator at each of its joints"].append(name)
                continue
            if kind not in at_joint:
                odd.setdefault("acts on no joint: left out", []).append(name)
                continue
            if target not in self.names or not self._moves(target):
                continue
            self._add_drive(index, name, drives.setdefault(target, Drive()), odd)
        for what, names in odd.items():
            unique = list(dict.fromkeys(names))
            self.notes.append(f"actuator {listed(unique)}: {what}")
        for joint, drive in drives.items():
            limit = self._joint_effort(joint)
            drive.effort = (
                limit if drive.effort is None else drive.effort if limit is None else min(drive.effort, limit)
            )
        return drives

    def _add_drive(self, index: int, name: str, drive: Drive, odd: dict[str, list[str]]) -> None:
        mj, model = self.mj, self.model
        gear = float(model.actuator_gear[index][0])
        gain, bias = float(model.actuator_gainprm[index][0]), model.actuator_biasprm[index]
        fixed = int(model.actuator_gaintype[index]) == int(mj.mjtGain.mjGAIN_FIXED)
        kinds = {
            int(mj.mjtBias.mjBIAS_NONE): (0.0, 0.0),
            int(mj.mjtBias.mjBIAS_AFFINE): (float(bias[1]), float(bias[2])),
        }
        terms = kinds.get(int(model.actuator_biastype[index]))
        if not fixed or terms is None:
            odd.setdefault("is no position, velocity or motor actuator: replaced by a position actuator", []).append(
                name
            )
            terms = (0.0, 0.0)
        if int(model.actuator_dyntype[index]) != int(mj.mjtDyn.mjDYN_NONE):
            odd.setdefault("has an activation state: left out, it acts at once", []).append(name)
        pull, brake = (-term * gear * gear for term in terms)
        if pull > 0.0:
            drive.stiffness = (drive.stiffness or 0.0) + pull
        elif brake > 0.0:
            odd.setdefault("is a velocity actuator: replaced by a position actuator", []).append(name)
        if pull > 0.0:
            drive.damping += max(brake, 0.0)
        limits = []
        if model.actuator_forcelimited[index]:
            limits.append(float(np.abs(model.actuator_forcerange[index]).max()) * abs(gear))
        if terms == (0.0, 0.0) and fixed and model.actuator_ctrllimited[index]:
            limits.append(float(np.abs(model.actuator_ctrlrange[index]).max()) * abs(gain * gear))
        if limits and min(limits) > 0.0:
            drive.effort = (drive.effort or 0.0) + min(limits)

    def _joint_effort(self, joint: int) -> float | None:
        if not self.model.jnt_actfrclimited[joint]:
            return None
        most = float(np.abs(self.model.jnt_actfrcrange[joint]).max())
        return most if most > 0.0 else None

    def _tendon_joints(self, tendon: int) -> list[int]:
        model, wrap = self.model, int(self.mj.mjtWrap.mjWRAP_JOINT)
        first = int(model.tendon_adr[tendon])
        wraps = range(first, first + int(model.tendon_num[tendon]))
        joints = [int(model.wrap_objid[at]) for at in wraps if int(model.wrap_type[at]) == wrap]
        return [joint for joint in joints if joint in self.names and self._moves(joint)]

    # Joints that do not move

    def _held(self, drives: dict[int, Drive]) -> dict[str, float]:
        """Joints that equality constraints tie, and undriven joints where others are driven."""
        mj, model = self.mj, self.model
        held: dict[int, float] = {}
        tied, loops, tendons = [], [], []
        for index in range(model.neq):
            if not model.eq_active0[index]:
                continue
            kind = int(model.eq_type[index])
            name = self.named("EQUALITY", index) or f"equality_{index}"
            if kind == int(mj.mjtEq.mjEQ_JOINT):
                joint, other = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
                if joint in self.names and self._moves(joint):
                    held[joint] = self._tied(index, joint, other)
                    tied.append(self.names[joint])
            elif kind == int(mj.mjtEq.mjEQ_TENDON):
                tendons.append(name)
            elif self._concerns(index):
                loops.append(name)
        if tied:
            self.notes.append(f"joint {listed(tied)}: tied by an equality constraint: locked")
        if loops:
            self.notes.append(f"equality {listed(loops)}: closes a loop: left out")
        if tendons:
            self.notes.append(f"equality {listed(tendons)}: ties a tendon: left out")
        if drives:
            idle = [joint for joint in self.joints if self._moves(joint) and joint not in drives and joint not in held]
            held |= {joint: float(self.home[model.jnt_qposadr[joint]]) for joint in idle}
            if idle:
                names = listed([self.names[joint] for joint in idle])
                self.notes.append(f"joint {names}: no actuator acts on it: locked")
        else:
            self.notes.append("the file has no actuators: replaced by position actuators, with gains by weight")
        return {self.names[joint]: self._within(joint, position) for joint, position in sorted(held.items())}

    def _within(self, joint: int, position: float) -> float:
        lower, upper = self._range(joint)
        return float(np.clip(position, lower, upper))

    def _range(self, joint: int) -> tuple[float, float]:
        if not self.model.jnt_limited[joint]:
            return -np.inf, np.inf
        lower, upper = (float(bound) for bound in self.model.jnt_range[joint])
        return lower, upper

    def _tied(self, index: int, joint: int, other: int) -> float:
        """Where an equality constraint holds a joint in the home pose."""
        model = self.model
        at = 0.0
        if other >= 0:
            address = model.jnt_qposadr[other]
            at = float(self.home[address] - model.qpos0[address])
        polynomial = np.polynomial.Polynomial(model.eq_data[index][:5])
        return float(model.qpos0[model.jnt_qposadr[joint]] + polynomial(at))

    def _concerns(self, index: int) -> bool:
        """Whether an equality constraint between bodies or sites holds a part of the robot."""
        model = self.model
        is_site = int(model.eq_objtype[index]) == int(self.mj.mjtObj.mjOBJ_SITE)
        ends = [int(model.eq_obj1id[index]), int(model.eq_obj2id[index])]
        return any(end >= 0 and int(model.site_bodyid[end] if is_site else end) in self.inside for end in ends)

    # Links

    def _links(self, drives: dict[int, Drive]) -> list[Link]:
        model = self.model
        links: list[Link] = []
        place = self._place
        floor = self.floor()
        balls = []
        for body in self.bodies:
            at, turn = np.array(model.body_pos[body]), matrix(model.body_quat[body])
            if body == self.made.base:
                parent, at, turn = -1, np.zeros(3), np.eye(3)
            else:
                parent, offset = place[int(model.body_parentid[body])]
                at = at - offset
            first = int(model.body_jntadr[body])
            own = range(first, first + int(model.body_jntnum[body]))
            balls += [joint for joint in own if int(model.jnt_type[joint]) == int(self.mj.mjtJoint.mjJNT_BALL)]
            moving = [joint for joint in own if self._moves(joint)]
            name = self._unique(self.named("BODY", body), "body", body)
            anchor = np.zeros(3)
            tokens = []
            for number, joint in enumerate(moving):
                at, turn, anchor = self._before(joint, at, turn, anchor)
                is_last = number + 1 == len(moving)
                link_name = name if is_last else self._unique(f"{name}_{self.names[joint]}_link", "body", body)
                link = Link(link_name, parent, at, turn, self._joint(joint, drives))
                if not is_last:
                    moments = np.eye(3) * TOKEN_INERTIA
                    link = dataclasses.replace(link, mass=TOKEN, inertia=moments)
                    tokens.append(anchor)
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
        if int(model.jnt_type[joint]) == int(self.mj.mjtJoint.mjJNT_SLIDE):
            return at + turn @ (-rest * axis), turn, anchor
        here = np.array(model.jnt_pos[joint])
        quaternion = np.zeros(4)
        self.mj.mju_axisAngle2Quat(quaternion, axis, -rest)
        return at + turn @ (here - anchor), turn @ matrix(quaternion), here

    def _joint(self, joint: int, drives: dict[int, Drive]) -> Joint:
        model = self.model
        v, q = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
        lower, upper = self._range(joint)
        kind: Literal["revolute", "continuous", "prismatic"] = "revolute" if np.isfinite(lower) else "continuous"
        if int(model.jnt_type[joint]) == int(self.mj.mjtJoint.mjJNT_SLIDE):
            kind = "prismatic"
        armature = float(model.dof_armature[v])
        for index in self._actuators_of(joint):
            armature += self._of_actuator("actuator_armature", index)
        return Joint(
            name=self.names[joint],
            kind=kind,
            axis=np.array(model.jnt_axis[joint]),
            lower=lower,
            upper=upper,
            damping=float(model.dof_damping[v])
            + sum(self._of_actuator("actuator_damping", index) for index in self._actuators_of(joint)),
            friction=float(model.dof_frictionloss[v]),
            armature=armature,
            drive=drives.get(joint),
            home=self._within(joint, float(self.home[q])),
            q=q,
            v=v,
            stiffness=float(model.jnt_stiffness[joint]),
            rest=float(model.qpos_spring[q]),
        )

    def _actuators_of(self, joint: int) -> list[int]:
        kinds = (int(self.mj.mjtTrn.mjTRN_JOINT), int(self.mj.mjtTrn.mjTRN_JOINTINPARENT))
        return [
            index
            for index in range(self.model.nu)
            if int(self.model.actuator_trntype[index]) in kinds and int(self.model.actuator_trnid[index][0]) == joint
        ]

    def _of_actuator(self, key: str, index: int) -> float:
        """A number of an actuator at its joint; MuJoCo before 4 has none of them."""
        numbers = getattr(self.model, key, None)
        return 0.0 if numbers is None else float(numbers[index]) * float(self.model.actuator_gear[index][0]) ** 2

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

    # Shapes

    def floor(self) -> tuple[int, int]:
        """`contype` and `conaffinity` of the file's ground.

        Without ground, those of a plane that touches everything.
        """
        model, ground = self.model, self._ground()
        return (1, 1) if ground is None else (int(model.geom_contype[ground]), int(model.geom_conaffinity[ground]))

    def _ground(self) -> int | None:
        """The geom that is the file's ground, if it has one."""
        model = self.model
        kinds = (int(self.mj.mjtGeom.mjGEOM_PLANE), int(self.mj.mjtGeom.mjGEOM_HFIELD))
        for geom in range(model.ngeom):
            is_ground = int(model.geom_type[geom]) in kinds and int(model.geom_bodyid[geom]) not in self.inside
            if is_ground and (model.geom_contype[geom] or model.geom_conaffinity[geom]):
                return geom
        return None

    def touches(self, geom: int, floor: tuple[int, int]) -> bool:
        """Whether a geom can touch a ground with these `contype` and `conaffinity`."""
        model = self.model
        if (int(model.geom_contype[geom]) & floor[1]) or (floor[0] & int(model.geom_conaffinity[geom])):
            return True
        return self._pair(geom) is not None

    def _pair(self, geom: int) -> int | None:
        """The `<pair>` of a geom and something of the scene, if there is one."""
        model = self.model
        for pair, (one, other) in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True)):
            if geom in (one, other):
                partner = int(other if geom == one else one)
                if int(model.geom_bodyid[partner]) not in self.inside:
                    return pair
        return None

    def _surface(self, geom: int) -> Surface:
        """How a geom touches the ground: as MuJoCo mixes the two."""
        model, pair = self.model, self._pair(geom)
        if pair is not None:
            of_pair = ("dim", "friction", "margin", "gap")
            return mixed(tuple(_plain(getattr(model, f"pair_{number}")[pair]) for number in of_pair), None)
        numbers = ("condim", "friction", "margin", "gap", "priority")
        sides = [
            tuple(_plain(getattr(model, f"geom_{number}")[each]) for number in numbers)
            for each in (geom, self._ground())
            if each is not None
        ]
        return mixed(sides[0], sides[1] if len(sides) > 1 else PLAIN)

    def _touch(self, links: list[Link], body: int, anchor: Array, floor: tuple[int, int]) -> None:
        """Gives the body's last link its shapes; foot and other surfaces get separate links."""
        model = self.model
        first = int(model.body_geomadr[body])
        geoms = [
            geom
            for geom in range(first, first + int(model.body_geomnum[body]))
            if first >= 0 and self.touches(geom, floor)
        ]
        shapes = [(geom, shape) for geom in geoms if (shape := self._shape(geom, anchor)) is not None]
        standing = self._standing([geom for geom, _ in shapes], body)
        parent, name = len(links) - 1, links[-1].name
        of_body, *others = by_surface([shape for geom, shape in shapes if geom not in standing])
        links[-1] = dataclasses.replace(links[-1], shapes=of_body)
        place = {id(shape): geom for geom, shape in shapes}
        self.link_of_geom |= {place[id(shape)]: name for shape in of_body}
        parts = [(f"{name}_surface", own) for own in others]
        if standing:
            feet = by_surface([shape for geom, shape in shapes if geom in standing])
            parts += [(f"{name}_foot", own) for own in feet]
        for part, own in parts:
            link = self._unique(part, "body", body)
            self.link_of_geom |= {place[id(shape)]: link for shape in own}
            at = own[0].at if len(own) == 1 else np.zeros(3)
            own = tuple(dataclasses.replace(shape, at=shape.at - at) for shape in own)
            links.append(Link(link, parent, at, np.eye(3), None, shapes=own))

    def _standing(self, geoms: list[int], body: int) -> set[int]:
        """Shapes of a limb's end that stand on the ground; empty where all of them do."""
        model = self.model
        if len(geoms) < 2 or any(self._moving_below(child) for child in self._children(body)):
            return set()
        named = {geom for geom in geoms if FOOT_NAMES.search(self.named("GEOM", geom))}
        first = {geom for geom in geoms if int(model.geom_priority[geom]) > 0}
        depth = {geom: self._lowest(geom) for geom in geoms}
        low = {geom for geom in geoms if depth[geom] <= min(depth.values()) + SOLE}
        chosen = next((some for some in (named, first, low) if 0 < len(some) < len(geoms)), set())
        return chosen

    def _children(self, body: int) -> list[int]:
        return [child for child in self.bodies if int(self.model.body_parentid[child]) == body and child != body]

    def _moving_below(self, body: int) -> bool:
        first = int(self.model.body_jntadr[body])
        own = range(first, first + int(self.model.body_jntnum[body]))
        return any(self._moves(joint) for joint in own) or any(map(self._moving_below, self._children(body)))

    def _lowest(self, geom: int) -> float:
        """Lowest point of a geom in the home pose, m."""
        model = self.model
        body = int(model.geom_bodyid[geom])
        turn = matrix(self.data.xquat[body]) @ matrix(model.geom_quat[geom])
        middle = self.data.xpos[body] + matrix(self.data.xquat[body]) @ model.geom_pos[geom]
        down = turn.T @ np.array([0.0, 0.0, -1.0])
        kind, size = int(model.geom_type[geom]), model.geom_size[geom]
        types = self.mj.mjtGeom
        if kind == int(types.mjGEOM_MESH):
            return float(middle[2] - (self.vertices(geom)[0] @ down).max())
        reach = {
            int(types.mjGEOM_SPHERE): size[0],
            int(types.mjGEOM_CAPSULE): size[0] + size[1] * abs(down[2]),
            int(types.mjGEOM_CYLINDER): size[0] * np.hypot(down[0], down[1]) + size[1] * abs(down[2]),
            int(types.mjGEOM_ELLIPSOID): np.linalg.norm(size * down),
        }.get(kind, float(np.abs(size * down).sum()))
        return float(middle[2] - reach)

    def _shape(self, geom: int, anchor: Array) -> Shape | None:
        model, types = self.model, self.mj.mjtGeom
        at, turn = np.array(model.geom_pos[geom]) - anchor, matrix(model.geom_quat[geom])
        kind, size = int(model.geom_type[geom]), [float(edge) for edge in model.geom_size[geom]]
        name = self.named("GEOM", geom) or f"geom_{geom}"
        surface = self._surface(geom)
        if kind == int(types.mjGEOM_SPHERE):
            return Shape("sphere", (size[0],), at, turn, surface=surface)
        if kind == int(types.mjGEOM_CAPSULE):
            return Shape("capsule", (size[0], 2.0 * size[1]), at, turn, surface=surface)
        if kind == int(types.mjGEOM_CYLINDER):
            return Shape("cylinder", (size[0], 2.0 * size[1]), at, turn, surface=surface)
        if kind == int(types.mjGEOM_BOX):
            return Shape("box", tuple(2.0 * edge for edge in size), at, turn, surface=surface)
        if kind == int(types.mjGEOM_ELLIPSOID):
            if max(size) - min(size) <= ROUND * max(size):
                return Shape("sphere", (max(size),), at, turn, surface=surface)
            self._ellipsoids[name] = BALL_ERROR * max(size)
            vertices, faces = ball(np.array(size))
            return Shape("mesh", (), at, turn, _file_name(name), vertices, faces, surface)
        if kind == int(types.mjGEOM_MESH):
            vertices, faces = self.vertices(geom)
            return Shape("mesh", (), at, turn, _file_name(f"{name}_{geom}"), vertices, faces, surface)
        self.notes.append(f"geom {name}: a plane, height field or distance field on the robot: left out")
        return None

    def vertices(self, geom: int) -> tuple[Array, Any]:
        """Corners and faces of the convex hull of a geom's mesh.

        All corners where MuJoCo has made no hull.
        """
        model = self.model
        mesh = int(model.geom_dataid[geom])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        vertices = np.array(model.mesh_vert[first : first + count], dtype=np.float64)
        graph = int(model.mesh_graphadr[mesh])
        if graph < 0:
            every = np.arange(len(vertices))
            return vertices, np.stack([every] * 3, axis=1)
        points, sides = int(model.mesh_graph[graph]), int(model.mesh_graph[graph + 1])
        ids = np.array(model.mesh_graph[graph + 2 + points : graph + 2 + 2 * points])
        end = graph + 2 + 3 * points + 3 * sides
        corners = np.array(model.mesh_graph[end : end + 3 * sides]).reshape(-1, 3)
        places = np.full(len(vertices), -1)
        places[ids] = np.arange(points)
        return vertices[ids], places[corners]

    # Sites

    def _sites(self, links: list[Link], place: dict[int, tuple[int, Array]]) -> None:
        """Adds the frames of IMUs and feet as empty links."""
        mj, model = self.mj, self.model
        kinds = [getattr(mj.mjtSensor, f"mjSENS_{kind}", None) for kind in IMU]
        wanted = set()
        for sensor in range(model.nsensor):
            is_imu = any(kind is not None and int(model.sensor_type[sensor]) == int(kind) for kind in kinds)
            is_touch = int(model.sensor_type[sensor]) == int(mj.mjtSensor.mjSENS_TOUCH)
            if (is_imu or is_touch) and int(model.sensor_objtype[sensor]) == int(mj.mjtObj.mjOBJ_SITE):
                wanted.add(int(model.sensor_objid[sensor]))
        for site in range(model.nsite):
            name = self.named("SITE", site)
            body = int(model.site_bodyid[site])
            if body not in self.inside or not (site in wanted or re.search("imu|foot", name, re.IGNORECASE)):
                continue
            parent, anchor = place[body]
            at, turn = np.array(model.site_pos[site]) - anchor, matrix(model.site_quat[site])
            links.append(Link(self._unique(name, "site", site), parent, at, turn, None))

    # Other data of the file

    def _left_out(self) -> None:
        """Notes what has no place in a robot of polypod's."""
        model = self.model
        if self._ellipsoids:
            self.notes.append(
                f"geom {listed(list(self._ellipsoids))}: an ellipsoid: replaced by a convex hull of "
                f"{BALL_POINTS} points, which is at most {1e3 * max(self._ellipsoids.values()):.2g} mm off"
            )
        first = int(model.jnt_dofadr[model.body_jntadr[self.made.base]])
        free = slice(first, first + 6)
        if model.dof_armature[free].any() or model.dof_damping[free].any() or model.dof_frictionloss[free].any():
            self.notes.append("armature, damping and friction of the free joint: left out")
        dofs = [int(model.jnt_dofadr[joint]) for joint in self.joints if self._moves(joint)]
        bent = getattr(model, "jnt_stiffnesspoly", None)
        if bent is not None and np.any(np.asarray(bent)[self.joints]):
            self.notes.append("springs whose force is no multiple of the way: left out but for its linear part")
        curved = getattr(model, "dof_dampingpoly", None)
        if curved is not None and np.any(np.asarray(curved)[dofs]):
            self.notes.append("damping that is no multiple of the speed: left out but for its linear part")
        if model.ntendon:
            names = [self.named("TENDON", tendon) or f"tendon_{tendon}" for tendon in range(model.ntendon)]
            self.notes.append(f"tendon {listed(names)}: left out")
        if getattr(model, "nflex", 0) or getattr(model, "nskin", 0):
            self.notes.append("flexible bodies and skins: left out")
        if np.any(np.asarray(model.body_gravcomp)[self.bodies]):
            self.notes.append("gravity compensation: left out")
        if model.opt.density or model.opt.viscosity or np.any(model.opt.wind):
            self.notes.append("the medium's density, viscosity and wind: left out")
        others = [
            self.named("BODY", body) or f"body_{body}"
            for body in range(1, model.nbody)
            if int(model.body_parentid[body]) == 0 and body not in self.inside and int(model.body_dofnum[body])
        ]
        if others:
            self.notes.append(f"body {listed(others)}: moves beside the robot: left out")
        if not np.allclose(model.opt.gravity, [0.0, 0.0, -_core.EARTH_GRAVITY]):
            self.notes.append("gravity is not the Earth's along -z: left out: the task has it")


def matrix(quaternion: Any) -> Array:
    """Rotation matrix of a unit quaternion (w, x, y, z)."""
    out = np.zeros(9)
    mujoco().mju_quat2Mat(out, np.array(quaternion, dtype=np.float64))
    return out.reshape(3, 3)


def of_point(at: Array) -> Array:
    """Inertia of a unit point mass about the origin, m^2."""
    turned: Array = (at @ at) * np.eye(3) - np.outer(at, at)
    return turned


def _file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:80]


def _plain(value: Any) -> Any:
    """A number or a list of a model as plain Python values, to be looked up by."""
    return tuple(float(each) for each in value) if np.ndim(value) else value.item()


@functools.cache
def mixed(geom: tuple[Any, ...], ground: tuple[Any, ...] | None) -> Surface:
    """Surface of a geom on the ground, as MuJoCo mixes the numbers of the two.

    It does so in a scene with a ball that has the geom's numbers.

    Args:
        geom: `condim`, friction, margin, gap and priority of one side; of a `<pair>` all but the
            priority.
        ground: of the other side; None for a pair.
    """
    mj = mujoco()
    spec = mj.MjSpec()
    plane = spec.worldbody.add_geom(name="plane", type=mj.mjtGeom.mjGEOM_PLANE, size=[1.0, 1.0, 1.0])
    # in the ground, whatever the margins
    body = spec.worldbody.add_body(pos=[0.0, 0.0, 0.0])
    body.add_freejoint()
    ball = body.add_geom(name="ball", type=mj.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0.0, 0.0], mass=1.0)
    if ground is None:
        dim, friction, margin, gap = geom
        spec.add_pair(geomname1="plane", geomname2="ball", condim=dim, friction=friction, margin=margin, gap=gap)
    else:
        for each, (dim, friction, margin, gap, priority) in ((ball, geom), (plane, ground)):
            each.condim, each.friction, each.margin, each.gap, each.priority = dim, friction, margin, gap, priority
    model = spec.compile()
    data = mj.MjData(model)
    mj.mj_forward(model, data)
    contact = data.contact[0]
    count = CONE_DIMS[int(contact.dim)]
    sliding, _, torsional, rolling, _ = (float(number) for number in contact.friction)
    return Surface(
        friction=sliding if count > 0 else 0.0,
        torsional_friction=torsional if count > 1 else 0.0,
        rolling_friction=rolling if count > 2 else 0.0,
        contact_margin=max(float(contact.includemargin), 0.0),
    )


def by_surface(shapes: list[Shape]) -> list[tuple[Shape, ...]]:
    """Shapes by what their surfaces are, most shapes first; one empty list without any."""
    groups: dict[Surface, list[Shape]] = {}
    for shape in shapes:
        groups.setdefault(shape.surface, []).append(shape)
    return [tuple(group) for group in sorted(groups.values(), key=len, reverse=True)] or [()]


BALL_POINTS = 32
"""Points that stand for an ellipsoid: the most that the loader keeps of a mesh."""
_COSINE = 0.922602
"""Cosine of the largest angle between a direction and the nearest of the points on a sphere."""
BALL_ERROR = (1.0 - _COSINE) / (1.0 + _COSINE)
"""Largest error of the height over the ground at which an ellipsoid touches it, as a share of the
longest half axis."""


def ball(size: Array) -> tuple[Array, Any]:
    """Corners and faces of a polyhedron for an ellipsoid with these half axes.

    It is as far within the ellipsoid as beyond it.

    A linear map of a sphere keeps shares: the corners are those of an icosahedron and a
    dodecahedron on a sphere.
    """
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    signs = [-1.0, 1.0]
    tips = [np.roll([0.0, a, b * golden], turn) for turn in range(3) for a in signs for b in signs]
    rest = [np.array([a, b, c]) for a in signs for b in signs for c in signs]
    rest += [np.roll([0.0, a * golden, b / golden], turn) for turn in range(3) for a in signs for b in signs]
    points = np.array([point / np.linalg.norm(point) for point in (*tips, *rest)])
    faces = []
    for tip in range(len(tips)):
        up = points[tip]
        near = len(tips) + np.argsort(points[len(tips) :] @ up)[-5:]
        along = np.cross(up, points[near[0]])
        across = np.cross(up, along)
        around = near[np.argsort(np.arctan2(points[near] @ across, points[near] @ along))]
        faces += [[tip, int(one), int(next_one)] for one, next_one in zip(around, np.roll(around, -1), strict=True)]
    return points * size * (2.0 / (1.0 + _COSINE)), np.array(faces)
