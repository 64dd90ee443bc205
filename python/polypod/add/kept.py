"""The model that MuJoCo makes of an MJCF file, as one MJCF file without others that it needs.

`polypod add` keeps it next to the robot: `polypod accuracy` compares the robot with it, and
`sim2sim --model` plays policies on it. MuJoCo writes its own files with six digits; here every
number of what moves, touches or pulls is the compiled one, to the last digit. Visual parts are left
out: pictures, materials, lights, cameras and shapes that touch nothing. Shapes of meshes are the
convex hulls that MuJoCo touches with. The text is compiled again and compared before it is kept.
"""

from collections.abc import Iterable, Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np

from polypod.add.compiling import mujoco
from polypod.add.mjcf import Reader
from polypod.add.shapes import hull_of

NAME = "mujoco.xml"
"""Name of the file, next to the robot's URDF."""
EXACT = 1e-9
"""Largest relative difference of a number of the file, compiled again."""
_SHOWN = ("visual", "statistic", "asset", "sensor", "custom", "size")
"""Sections that are left out."""
_COMPARED = (
    *("nq", "nv", "nu", "nbody", "njnt", "neq", "ntendon", "nkey"),
    *("body_pos", "body_quat", "body_mass", "body_ipos", "body_inertia", "body_gravcomp"),
    *("jnt_type", "jnt_pos", "jnt_axis", "jnt_limited", "jnt_range", "jnt_stiffness", "qpos0", "qpos_spring"),
    *("dof_armature", "dof_damping", "dof_frictionloss"),
    *("actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange", "actuator_forcerange"),
)
"""Numbers of a model that have to be equal."""


def text(reader: Reader) -> str | None:
    """The file of a model.

    None where it cannot be written so that MuJoCo compiles the same model from it.
    """
    made = reader.made
    try:
        root = ElementTree.fromstring(made.spec.to_xml())
        _rewrite(root, reader)
        ElementTree.indent(root)
        written = ElementTree.tostring(root, encoding="unicode") + "\n"
        again = mujoco().MjSpec.from_string(written).compile()
    except (ValueError, mujoco().FatalError, ElementTree.ParseError, IndexError, KeyError):
        return None
    return written if _is_same(made.model, again) else None


def _is_same(model: Any, again: Any) -> bool:
    for name in _COMPARED:
        one, other = np.asarray(getattr(model, name, 0)), np.asarray(getattr(again, name, 0))
        if one.shape != other.shape:
            return False
        if not np.allclose(one, other, rtol=EXACT, atol=EXACT * max(1e-6, float(np.abs(one).max(initial=0.0)))):
            return False
    # principal axes may be in another order where moments are equal: their tensors count
    return bool(np.allclose(_tensors(model), _tensors(again), rtol=0.0, atol=EXACT * np.abs(_tensors(model)).max()))


def _tensors(model: Any) -> Any:
    turns = np.zeros((model.nbody, 9))
    for turn, quaternion in zip(turns, model.body_iquat, strict=True):
        mujoco().mju_quat2Mat(turn, quaternion)
    axes = turns.reshape(-1, 3, 3)
    return np.einsum("bij,bj,bkj->bik", axes, model.body_inertia, axes)


def _rewrite(root: ElementTree.Element, reader: Reader) -> None:
    for tag in _SHOWN:
        for section in root.findall(tag):
            root.remove(section)
    compiler = root.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(root, "compiler")
    compiler.attrib.clear()
    compiler.attrib.update({"angle": "radian", "inertiafromgeom": "false", "autolimits": "false"})
    for parent in root.iter("default"):
        for element in list(parent):
            # every joint and geom states its own numbers, and MuJoCo's writer leaves angles here in
            # degrees
            if element.tag in ("joint", "geom", "mesh", "material"):
                parent.remove(element)
            elif element.tag == "site":
                element.attrib.pop("material", None)
    assets = ElementTree.Element("asset")
    named = {
        value
        for section in ("tendon", "contact", "equality")
        for element in root.iter(section)
        for each in element.iter()
        for key, value in each.attrib.items()
        if key.startswith("geom") or key == "name"
    }
    world = root.find("worldbody")
    if world is not None:
        _bodies(world, reader, assets, named)
    if len(assets):
        root.insert(1, assets)
    _actuators(root, reader.model)
    _equalities(root, reader.model)
    _keys(root, reader)


def _keys(root: ElementTree.Element, reader: Reader) -> None:
    """Writes all keyframes; MuJoCo's writer leaves out those that equal the initial state."""
    model = reader.model
    for section in root.findall("keyframe"):
        root.remove(section)
    section = ElementTree.SubElement(root, "keyframe")
    for key in range(model.nkey):
        name = reader.made.named("KEY", key)
        element = ElementTree.SubElement(section, "key", {"name": name} if name else {})
        _set(element, time=model.key_time[key], qpos=model.key_qpos[key], qvel=model.key_qvel[key])
        _set(element, ctrl=model.key_ctrl[key], act=model.key_act[key])


def _set(element: ElementTree.Element, **numbers: Any) -> None:
    """Writes numbers to the last digit."""
    for key, value in numbers.items():
        values = np.atleast_1d(np.asarray(value))
        if len(values):
            element.set(key, " ".join(repr(each.item()) for each in values))


def _bodies(world: ElementTree.Element, reader: Reader, assets: ElementTree.Element, named: Iterable[str]) -> None:
    """Rewrites bodies and what they carry, in the order of the model's numbers."""
    model, kinds = reader.model, mujoco().mjtObj
    geoms = _numbers(model.body_geomadr, model.body_geomnum)
    joints = _numbers(model.body_jntadr, model.body_jntnum)
    unnamed = iter([body for body in range(1, model.nbody) if not reader.made.named("BODY", body)])

    def visit(element: ElementTree.Element, body: int) -> None:
        _unwrap(element)
        for tag in ("camera", "light", "inertial", "plugin"):
            for each in element.findall(tag):
                element.remove(each)
        element.attrib.pop("childclass", None)
        if body:
            _set(element, pos=model.body_pos[body], quat=model.body_quat[body], gravcomp=model.body_gravcomp[body])
        found = [each for each in element if each.tag in ("joint", "freejoint")]
        for each, joint in zip(found, joints[body], strict=True):
            _joint(each, reader, joint)
        for each, geom in zip(element.findall("geom"), geoms[body], strict=True):
            is_seen = not model.geom_contype[geom] and not model.geom_conaffinity[geom]
            if is_seen and reader.made.named("GEOM", geom) not in named:
                element.remove(each)
            else:
                _geom(each, reader, geom, assets)
        for each in element.findall("site"):
            each.attrib.pop("material", None)
            site = mujoco().mj_name2id(model, int(kinds.mjOBJ_SITE), each.get("name", ""))
            if site >= 0 and int(model.site_bodyid[site]) == body:
                _set(each, pos=model.site_pos[site], quat=model.site_quat[site])
        if body and model.body_mass[body] > 0.0:
            inertial = ElementTree.Element("inertial")
            _set(inertial, mass=model.body_mass[body], pos=model.body_ipos[body], quat=model.body_iquat[body])
            _set(inertial, diaginertia=model.body_inertia[body])
            element.insert(0, inertial)
        children = {}
        for each in element.findall("body"):
            element.remove(each)
            name = each.get("name")
            children[mujoco().mj_name2id(model, int(kinds.mjOBJ_BODY), name) if name else next(unnamed)] = each
        for child, each in sorted(children.items()):
            element.append(each)
            visit(each, child)

    visit(world, 0)


def _unwrap(element: ElementTree.Element) -> None:
    """Moves the content of frames into the body: numbers of the compiled model count from it."""
    while (frame := element.find("frame")) is not None:
        element.remove(frame)
        element.extend(list(frame))


def _numbers(first: Any, count: Any) -> list[range]:
    return [range(max(int(at), 0), max(int(at), 0) + int(number)) for at, number in zip(first, count, strict=True)]


def _joint(element: ElementTree.Element, reader: Reader, joint: int) -> None:
    model, types = reader.model, mujoco().mjtJoint
    q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    kind = int(model.jnt_type[joint])
    name = reader.made.named("JOINT", joint)
    element.attrib.clear()
    element.tag = "joint"
    if name:
        element.set("name", name)
    kinds = {types.mjJNT_FREE: "free", types.mjJNT_BALL: "ball", types.mjJNT_SLIDE: "slide", types.mjJNT_HINGE: "hinge"}
    element.set("type", {int(each): word for each, word in kinds.items()}[kind])
    _set(element, armature=model.dof_armature[v], frictionloss=model.dof_frictionloss[v])
    _set(element, damping=_polynomial(model, "dof_damping", v), stiffness=_polynomial(model, "jnt_stiffness", joint))
    _set(element, solreffriction=model.dof_solref[v], solimpfriction=model.dof_solimp[v])
    if kind == int(types.mjJNT_FREE):
        return
    _set(element, pos=model.jnt_pos[joint], margin=model.jnt_margin[joint])
    _set(element, solreflimit=model.jnt_solref[joint], solimplimit=model.jnt_solimp[joint])
    element.set("limited", "true" if model.jnt_limited[joint] else "false")
    if model.jnt_limited[joint]:
        _set(element, range=model.jnt_range[joint])
    if kind == int(types.mjJNT_BALL):
        return
    _set(element, axis=model.jnt_axis[joint], ref=model.qpos0[q], springref=model.qpos_spring[q])
    element.set("actuatorfrclimited", "true" if model.jnt_actfrclimited[joint] else "false")
    if model.jnt_actfrclimited[joint]:
        _set(element, actuatorfrcrange=model.jnt_actfrcrange[joint])
    if model.jnt_actgravcomp[joint]:
        element.set("actuatorgravcomp", "true")


def _polynomial(model: Any, name: str, index: int) -> Any:
    """A number of a joint; from MuJoCo 4 on with the coefficients of higher powers, if any."""
    higher = getattr(model, f"{name}poly", None)
    linear = np.atleast_1d(getattr(model, name)[index])
    return linear if higher is None or not np.any(higher[index]) else np.concatenate([linear, higher[index]])


_SIZES = {"SPHERE": 1, "CAPSULE": 2, "CYLINDER": 2, "ELLIPSOID": 3, "BOX": 3, "PLANE": 3}
"""Numbers that a shape has."""


def _geom(element: ElementTree.Element, reader: Reader, geom: int, assets: ElementTree.Element) -> None:
    model = reader.model
    kind = str(mujoco().mjtGeom(int(model.geom_type[geom])).name).removeprefix("mjGEOM_")
    name = reader.made.named("GEOM", geom)
    element.attrib.clear()
    element.attrib.update({"name": name} if name else {})
    element.set("type", kind.lower())
    _set(element, group=model.geom_group[geom])
    if kind == "MESH":
        vertices, _ = hull_of(reader.made, geom)
        hull = f"hull_{geom}"
        _set(ElementTree.SubElement(assets, "mesh", name=hull), vertex=vertices.ravel())
        element.set("mesh", hull)
    else:
        _set(element, size=model.geom_size[geom][: _SIZES[kind]])
    _set(element, pos=model.geom_pos[geom], quat=model.geom_quat[geom], friction=model.geom_friction[geom])
    for key in ("contype", "conaffinity", "condim", "priority", "solmix", "solref", "solimp", "margin", "gap"):
        _set(element, **{key: getattr(model, f"geom_{key}")[geom]})


def _actuators(root: ElementTree.Element, model: Any) -> None:
    elements: Sequence[ElementTree.Element] = root.findall("actuator/*")
    for index, element in enumerate(elements):
        _set(
            element,
            gear=model.actuator_gear[index],
            gainprm=model.actuator_gainprm[index],
            biasprm=model.actuator_biasprm[index],
        )
        for key, limited in (("ctrlrange", "ctrllimited"), ("forcerange", "forcelimited")):
            is_limited = bool(getattr(model, f"actuator_{limited}")[index])
            element.set(limited, "true" if is_limited else "false")
            _set(element, **{key: getattr(model, f"actuator_{key}")[index]})


def _equalities(root: ElementTree.Element, model: Any) -> None:
    for index, element in enumerate(root.findall("equality/*")):
        if element.tag in ("joint", "tendon"):
            _set(element, polycoef=model.eq_data[index][:5])
        _set(element, solref=model.eq_solref[index], solimp=model.eq_solimp[index])
