"""MJCF files compiled by MuJoCo, ready to be written down.

MuJoCo itself reads the file. It resolves defaults, classes, frames, replicas, includes and
attachments.
"""

import contextlib
import dataclasses
import functools
import re
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from polypod import _core
from polypod.add import child
from polypod.add.description import listed
from polypod.arrays import Array
from polypod.extras import package

POSES = ("home", "stand", "standing", "default", "init", "initial")
"""Keyframes that a robot stands in, the first one that is there; else the file's first."""
SECONDS = 60
"""Computing time that MuJoCo may take to compile a file."""
LARGEST = 1e15
"""Largest number that is read: squares and products of such numbers are finite."""
_NUMBERED = {
    "body": ("mass", "pos", "quat", "ipos", "iquat", "inertia", "gravcomp"),
    "jnt": ("pos", "axis", "stiffness"),
    "geom": ("pos", "quat", "size", "friction", "margin", "gap"),
    "site": ("pos", "quat"),
    "eq": ("data",),
    "actuator": ("gear", "gainprm", "biasprm", "forcerange", "ctrlrange", "armature", "damping"),
    "key": ("qpos",),
}
"""Numbers of a model by sort of element; each element has a name."""
_KINDS = {"jnt": "JOINT", "eq": "EQUALITY"}
_ELEMENTS = {"jnt": "joint", "eq": "equality"}


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

    @functools.cached_property
    def inside(self) -> frozenset[int]:
        """The robot's bodies."""
        return frozenset(self.bodies())

    def joints(self) -> list[int]:
        """The robot's joints, those of the base too."""
        return [joint for joint in range(self.model.njnt) if int(self.model.jnt_bodyid[joint]) in self.inside]

    def joints_of(self, body: int) -> range:
        """Joints between a body and its parent."""
        first = int(self.model.body_jntadr[body])
        return range(first, first + int(self.model.body_jntnum[body]))

    def named(self, kind: str, index: int) -> str:
        """Name of an object of a kind such as JOINT; nothing where the file has none."""
        return mujoco().mj_id2name(self.model, getattr(mujoco().mjtObj, f"mjOBJ_{kind}"), index) or ""

    def moves(self, joint: int) -> bool:
        """Whether a joint turns about an axis or slides along one."""
        kinds = (mujoco().mjtJoint.mjJNT_HINGE, mujoco().mjtJoint.mjJNT_SLIDE)
        return int(self.model.jnt_type[joint]) in (int(kind) for kind in kinds)

    def range_of(self, joint: int) -> tuple[float, float]:
        """Lowest and highest position of a joint, rad or m; infinite without limits."""
        if not self.model.jnt_limited[joint]:
            return -np.inf, np.inf
        lower, upper = (float(bound) for bound in self.model.jnt_range[joint])
        return lower, upper

    def within(self, joint: int, position: float) -> float:
        """The position in a joint's range that is closest to this one."""
        return float(np.clip(position, *self.range_of(joint)))

    def home(self) -> tuple[str | None, Array]:
        """Name and positions of the keyframe that the robot stands in.

        Without any, the written positions.
        """
        names = [self.named("KEY", key) for key in range(self.model.nkey)]
        found = [names.index(name) for name in POSES if name in names] or list(range(len(names)))
        if not found:
            return None, np.array(self.model.qpos0)
        return names[found[0]] or str(found[0]), np.array(self.model.key_qpos[found[0]])


def mujoco() -> Any:
    """The module of MuJoCo. Raises ConfigError where it is not installed."""
    return package("mujoco", "reading an MJCF file", "add")


def matrix(quaternion: Any) -> Array:
    """Rotation matrix of a unit quaternion (w, x, y, z)."""
    out = np.zeros(9)
    mujoco().mju_quat2Mat(out, np.array(quaternion, dtype=np.float64))
    return out.reshape(3, 3)


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
        with _warned() as said:
            spec = mj.MjSpec.from_file(str(file))
            _without_pictures(spec)
            _without_ground(mj, spec, notes)
            _with_ground(mj, spec, notes)
            _without_visuals(mj, spec)
            base = _base(mj, spec, file, root)
            _without_lost(mj, spec, base, file, notes)
            _check_meshes(spec, file)
            _float(mj, spec, base, file, notes)
            model = spec.compile()
            model.names.decode("utf-8")
    except _core.PolypodError:
        raise
    except UnicodeDecodeError as error:
        raise _core.ConfigError(f"{file}: a name in it is not text in UTF-8; save the file in UTF-8") from error
    except (ValueError, RuntimeError, mj.FatalError) as error:
        text = " ".join(str(error).split())
        raise _core.ConfigError(f"{file}: MuJoCo does not compile it: {text}; correct the file") from error
    made = Compiled(model, base.id, _name_of(spec.modelname, file), notes, spec)
    _check_numbers(made, file)
    if any("NaN" in text for text in said):
        raise _core.ConfigError(f"{file}: a number in it is NaN, which MuJoCo takes as absent; write the number")
    return made


def check(file: Path, root: str | None = None) -> None:
    """Lets another process compile an MJCF file first, within bounds of time and memory.

    Raises ConfigError where `compiled` would, and for a file at which MuJoCo hangs, ends or takes
    too much memory.
    """
    mujoco()
    place = file.absolute()
    path = [str(Path(entry).absolute()) for entry in sys.path]
    request = {"file": str(place), "root": root, "path": path, "seconds": SECONDS}
    try:
        problem = child.ask(str(Path(__file__).with_name("compiling_child.py")), request, SECONDS)
    except child.UnansweredError as error:
        raise _core.ConfigError(f"{file}: MuJoCo {error}; correct or simplify the file") from None
    if problem is not None:
        folder = "" if file.parent == Path() else f"{file.parent}/"
        raise _core.ConfigError(str(problem).replace(str(place), str(file)).replace(f"{place.parent}/", folder))


@contextlib.contextmanager
def _warned() -> Iterator[list[str]]:
    """Collects the warnings of MuJoCo, which writes them into a file of the user's folder else."""
    said: list[str] = []
    before = mujoco().get_mju_user_warning()
    mujoco().set_mju_user_warning(said.append)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield said
    finally:
        mujoco().set_mju_user_warning(before)


def _check_numbers(made: Compiled, file: Path) -> None:
    """Raises ConfigError for a number that is not finite, or too large to compute with."""
    model = made.model
    for sort, names in _NUMBERED.items():
        for name in names:
            numbers = getattr(model, f"{sort}_{name}", None)
            if numbers is None or not len(numbers):
                continue
            rows = np.asarray(numbers, dtype=np.float64).reshape(len(numbers), -1)
            wrong = np.flatnonzero(~(np.abs(rows) <= LARGEST).all(axis=1))
            if wrong.size:
                raise _number(file, _element(made, sort, int(wrong[0])), name)
    moved = ("damping", "armature", "frictionloss")
    for joint in range(model.njnt):
        v = int(model.jnt_dofadr[joint])
        for name in moved:
            if not abs(float(getattr(model, f"dof_{name}")[v])) <= LARGEST:
                raise _number(file, f"joint {made.named('JOINT', joint) or joint}", name)
        lower, upper = (float(bound) for bound in model.jnt_range[joint])
        if not (np.isfinite(lower) and np.isfinite(upper)):
            raise _number(file, f"joint {made.named('JOINT', joint) or joint}", "range")
    for name in ("qpos0", "qpos_spring"):
        if not (np.abs(getattr(model, name)) <= LARGEST).all():
            raise _number(file, "<joint>", "ref" if name == "qpos0" else "springref")
    if not np.isfinite(model.opt.gravity).all():
        raise _number(file, "<option>", "gravity")


def _element(made: Compiled, sort: str, index: int) -> str:
    """An element of a file: by name, or by number and what it belongs to."""
    element = _ELEMENTS.get(sort, sort)
    name = made.named(_KINDS.get(sort, sort.upper()), index)
    if name:
        return f"{element} {name}"
    owner = ""
    if sort in ("geom", "site", "jnt"):
        owner = f" of body {made.named('BODY', int(getattr(made.model, f'{sort}_bodyid')[index]))}"
    elif sort == "actuator" and 0 <= int(made.model.actuator_trnid[index][0]) < made.model.njnt:
        owner = f" at joint {made.named('JOINT', int(made.model.actuator_trnid[index][0]))}"
    return f"{element} {index}{owner}"


def _number(file: Path, element: str, name: str) -> _core.ConfigError:
    return _core.ConfigError(
        f"{file}: {element}: {name} has a number that is not finite, or beyond {LARGEST:g}; correct it"
    )


def _name_of(model: str, file: Path) -> str:
    name = re.sub(r"[ _]*scene$", "", model.strip(), flags=re.IGNORECASE)
    if name and name != "MuJoCo Model":
        return name
    generic = ("scene", "robot", "model", "scene_flat", "scene_mjx", "mjx")
    stem = file.stem if file.stem.lower() not in generic else file.resolve().parent.name
    return re.sub(r"^scene_|_scene$|^mjx_|_mjx$", "", stem) or "robot"


def _without_pictures(spec: Any) -> None:
    """Leaves textures and materials out: nothing that is simulated depends on them."""
    for geom in spec.geoms:
        geom.material = ""
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


def _without_lost(mj: Any, spec: Any, base: Any, file: Path, notes: list[str]) -> None:
    """Leaves out missing meshes of other bodies, and sensors of missing elements."""
    folder = _mesh_folder(spec, file)
    lost = {name for name, mesh in _meshes(spec) if _is_lost(mesh, folder, file)}
    lost -= {geom.meshname for body in _below(base) for geom in body.geoms}
    bare = [geom for geom in spec.geoms if geom.meshname in lost]
    for geom in bare:
        # its body is no part of the robot, and is left out later
        geom.type, geom.meshname, geom.size = mj.mjtGeom.mjGEOM_SPHERE, "", [0.01, 0.0, 0.0]
        geom.contype = geom.conaffinity = 0
    for name, mesh in _meshes(spec):
        if name in lost:
            spec.delete(mesh)
    if lost:
        notes.append(f"mesh {listed(sorted(lost))}: its file is not there, and no part of the robot: left out")
    there = {mj.mjtObj.mjOBJ_BODY: spec.bodies, mj.mjtObj.mjOBJ_XBODY: spec.bodies}
    there |= {mj.mjtObj.mjOBJ_GEOM: spec.geoms, mj.mjtObj.mjOBJ_SITE: spec.sites, mj.mjtObj.mjOBJ_JOINT: spec.joints}
    named = {kind: {element.name for element in elements} for kind, elements in there.items()}
    blind = [sensor for sensor in spec.sensors if sensor.objname not in named.get(sensor.objtype, {sensor.objname})]
    if blind:
        names = [sensor.name or sensor.objname for sensor in blind]
        notes.append(f"sensor {listed(names)}: the file has no element of the name that it states: left out")
    for sensor in blind:
        spec.delete(sensor)


def _meshes(spec: Any) -> list[tuple[str, Any]]:
    """Meshes by the name that geoms state."""
    return [(mesh.name or Path(mesh.file).stem, mesh) for mesh in spec.meshes]


def _mesh_folder(spec: Any, file: Path) -> Path:
    return Path(spec.modelfiledir or file.parent) / (spec.compiler.meshdir or spec.meshdir or "")


def _is_lost(mesh: Any, folder: Path, file: Path) -> bool:
    return bool(mesh.file) and not (folder / mesh.file).is_file() and not (file.parent / mesh.file).is_file()


def _check_meshes(spec: Any, file: Path) -> None:
    """Raises ConfigError for a mesh that is needed and not there."""
    folder = _mesh_folder(spec, file)
    for name, mesh in _meshes(spec):
        if _is_lost(mesh, folder, file):
            bodies = [geom.parent.name or "(without a name)" for geom in spec.geoms if geom.meshname == name]
            raise _core.ConfigError(
                f"{file}: mesh {name}: {folder / mesh.file} is not there, and body {listed(bodies)} touches the ground "
                "with it or has its mass from it; put the file there"
            )


def children(body: Any) -> Iterator[Any]:
    """The bodies that hang on a body of a spec."""
    child = body.first_body()
    while child is not None:
        yield child
        child = body.next_body(child)


def _below(body: Any) -> Iterator[Any]:
    yield body
    for each in children(body):
        yield from _below(each)


def _base(mj: Any, spec: Any, file: Path, root: str | None) -> Any:
    """The body of the scene that is the robot's base. Raises ConfigError."""
    moving = (mj.mjtJoint.mjJNT_HINGE, mj.mjtJoint.mjJNT_SLIDE)
    tops = list(children(spec.worldbody))
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


def _float(mj: Any, spec: Any, base: Any, file: Path, notes: list[str]) -> None:
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
    _make_room(spec, base)
    base.add_freejoint()
    notes.append(f"the base {name} has no free joint: replaced: it floats")


def _make_room(spec: Any, base: Any) -> None:
    """Lets keyframes begin with the place of a base that gets a free joint."""
    keys = list(spec.keys)
    if not keys:
        return
    model = spec.compile()
    first = sum(int(body) < base.id for body in model.jnt_bodyid)
    q, v = (
        int([*places, size][first]) for places, size in ((model.jnt_qposadr, model.nq), (model.jnt_dofadr, model.nv))
    )
    place = [*model.body_pos[base.id], *model.body_quat[base.id]]
    for key in keys:
        if len(key.qpos):
            key.qpos = np.insert(np.asarray(key.qpos), q, place)
        if len(key.qvel):
            key.qvel = np.insert(np.asarray(key.qvel), v, np.zeros(6))
