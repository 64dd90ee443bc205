"""Differences between a maker's model and polypod's robot, ranked by effect on one response.

polypod's robot in MuJoCo stands, then walks forward. Each item of the model (a mass, the armature,
the friction of the feet) is taken over alone, the same commands are given, and the motions are
compared. Items whose numbers are equal on both sides are no differences.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import rotations
from polypod.arrays import Array
from polypod.mujoco_model.reference import mujoco
from polypod.mujoco_model.robot import Robot
from polypod.sim2sim.driven import Driven
from polypod.sim2sim.maker import Maker, Model, lowest
from polypod.sim2sim.skeleton import BASE, Skeleton, skeleton
from polypod.sim2sim.twin import Twin

STAND_S = 0.5
"""Time of the step response before its command, s."""
WALK_S = 2.0
"""Time after it, s."""
SPEED = 0.8
"""Commanded forward velocity, m/s."""

Change = Callable[[Twin], None]

_SIDES = re.compile(r"^(fl|fr|rl|rr|hl|hr|lf|rf|lh|rh|lr|lm|rm|ml|mr|left|right|l|r|front|rear|hind)$", re.IGNORECASE)


@dataclasses.dataclass(frozen=True)
class Difference:
    """One item. Effects are NaN where polypod's robot cannot take it over."""

    item: str
    ours: str
    theirs: str
    base: float
    """Distance of the base from where it is without the change, root mean square over the response,
    m."""
    heading: float
    """Root mean square difference of the heading, rad."""
    joints: float
    """Root mean square difference of the joints, rad."""
    falls: bool
    """Whether the robot falls with the change."""


@dataclasses.dataclass(frozen=True)
class Item:
    """A difference, and how polypod's robot takes it over; None where it cannot."""

    name: str
    ours: str
    theirs: str
    change: Change | None


@dataclasses.dataclass(frozen=True)
class Response:
    """The motion of one robot."""

    base: Array
    """Positions of the base, m, [steps, 3]."""
    heading: Array
    """Headings of the base, rad, [steps]."""
    joints: Array
    """Joint positions, rad, [steps, joints]."""
    falls: bool


def ranked(
    twin_of: Callable[[], Twin],
    start: tuple[Array, Array],
    on_model: tuple[Maker, tuple[Array, Array]],
    progress: Callable[[str, int, int], None],
) -> list[Difference]:
    """The differences, those with the largest effect on the base first.

    Args:
        twin_of: makes polypod's robot in one env.
        start: its initial positions and velocities.
        on_model: the model in one env, and its own.
        progress: told how many items are done.
    """
    maker, their_start = on_model
    found = items(twin_of(), maker.reference, start[0][0])
    tried = [item for item in found if item.change is not None]
    usual = _response(twin_of(), start)
    differences = []
    for done, item in enumerate(found):
        if item.change is None:
            differences.append(Difference(item.name, item.ours, item.theirs, math.nan, math.nan, math.nan, False))
        else:
            differences.append(_tried(item.name, item.ours, item.theirs, [item.change], twin_of, start, usual))
        progress("differences", done + 1, len(found))
    differences.sort(key=lambda entry: -entry.base if math.isfinite(entry.base) else math.inf)
    together = []
    if len(tried) > 1:
        changes = [item.change for item in tried if item.change is not None]
        together.append(_tried("all of these", "", "", changes, twin_of, start, usual))
    together.append(_compared("the model itself", "", "", _response(maker, their_start), usual))
    return together + differences


def _tried(
    name: str,
    ours: str,
    theirs: str,
    changes: Sequence[Change],
    twin_of: Callable[[], Twin],
    start: tuple[Array, Array],
    usual: Response,
) -> Difference:
    twin = twin_of()
    for change in changes:
        change(twin)
    twin.refresh()
    return _compared(name, ours, theirs, _response(twin, start), usual)


def _compared(name: str, ours: str, theirs: str, response: Response, usual: Response) -> Difference:
    turned = np.angle(np.exp(1j * (response.heading - usual.heading)))
    return Difference(
        item=name,
        ours=ours,
        theirs=theirs,
        base=_rms(np.linalg.norm(response.base - usual.base, axis=1)),
        heading=_rms(turned),
        joints=_rms(response.joints - usual.joints),
        falls=response.falls,
    )


def _rms(numbers: Array) -> float:
    return float(np.sqrt(np.mean(np.square(numbers))))


def _response(robots: Driven, start: tuple[Array, Array]) -> Response:
    robots.reset(*start)
    stand, walk = (round(seconds / robots.step_dt) for seconds in (STAND_S, WALK_S))
    base, heading, joints, falls = [], [], [], False
    for step in range(stand + walk):
        command = np.array([[0.0 if step < stand else SPEED, 0.0, 0.0]], dtype=np.float32)
        seen = robots.step(command, np.ones(1, dtype=np.bool_))
        falls |= bool(seen.fell[0])
        qpos = np.nan_to_num(robots.qpos, nan=0.0, posinf=0.0, neginf=0.0)
        base.append(qpos[0, :3] - start[0][0, :3])
        heading.append(float(rotations.heading(qpos[:, 3:7])[0]))
        joints.append(qpos[0, 7:].copy())
        if not np.isfinite(robots.qpos).all():
            robots.reset(*start)
    return Response(np.array(base), np.array(heading), np.array(joints), falls)


def items(twin: Twin, model: Model, pose: Array) -> list[Item]:
    """Differences of the model from polypod's robot, at the positions `pose` [7 + joints]."""
    ours = _Side(twin.reference.model, twin.reference.root, twin.robot, model, pose, is_ours=True)
    theirs = _Side(model.model, model.root, twin.robot, model, pose, is_ours=False)
    return [
        *_masses(ours, theirs),
        *_frames(ours, theirs),
        *_joints(twin, model),
        *_actuators(twin, model),
        *_feet(ours, theirs),
        *_contacts(twin, model, pose),
        *_options(twin, model),
    ]


class _Side:
    """One of both robots, with polypod's joints at zero, in polypod's frame of the base."""

    def __init__(self, model: Any, root: str, robot: Robot, mapped: Model, pose: Array, *, is_ours: bool) -> None:
        mj = mujoco()
        self.model, self.names, self.pose = model, robot.joint_names, pose
        self.root = model.body(root).id
        if is_ours:
            self.ids = np.array([model.joint(name).id for name in robot.joint_names], dtype=np.intp)
            self.signs, self.turn, self.shift = np.ones(len(self.ids)), np.eye(3), np.zeros(3)
            self.offsets = np.zeros(len(self.ids))
        else:
            self.ids, self.signs, self.offsets = mapped.joints, mapped.map.signs, mapped.map.offsets
            self.turn, self.shift = mapped.map.turn, mapped.map.shift
        zeros = self.signs * -self.offsets
        self.lines: Skeleton = skeleton(
            model, self.root, self.ids.tolist(), dict(zip(self.ids.tolist(), zeros, strict=True))
        )
        self.data = mj.MjData(model)
        self.data.qpos[:] = model.qpos0
        self.data.qpos[model.jnt_qposadr[self.ids]] = zeros
        mj.mj_kinematics(model, self.data)
        self.place = self.data.xpos[self.root].copy()
        self.axes = self.data.xmat[self.root].reshape(3, 3).copy()
        """Axes of the model's base in the world."""
        self.anchors = self.lines.anchors @ self.turn.T + self.shift
        self.directions = self.signs[:, None] * (self.lines.axes @ self.turn.T)

    def bodies(self, cluster: int) -> npt.NDArray[np.intp]:
        """Bodies of a cluster, the one that carries its joint first."""
        return np.flatnonzero(self.lines.clusters == cluster)

    def inertial(self, cluster: int) -> tuple[float, Array, Array]:
        """Mass, kg, centre of mass, m, and inertia about it, kg m^2."""
        bodies = self.bodies(cluster)
        masses = self.model.body_mass[bodies]
        mass = float(masses.sum())
        if mass <= 0.0:
            return 0.0, np.zeros(3), np.zeros((3, 3))
        center = masses @ self.data.xipos[bodies] / mass
        inertia = np.zeros((3, 3))
        for body in bodies:
            axes = self.data.ximat[body].reshape(3, 3)
            arm = self.data.xipos[body] - center
            inertia += axes @ np.diag(self.model.body_inertia[body]) @ axes.T
            inertia += self.model.body_mass[body] * ((arm @ arm) * np.eye(3) - np.outer(arm, arm))
        turn = self.turn @ self.axes.T
        return mass, turn @ (center - self.place) + self.shift, turn @ inertia @ turn.T


def _label(names: Sequence[str]) -> str:
    """One name for joints that differ by their side."""
    return "_".join("*" if _SIDES.match(word) else word for word in names[0].removesuffix("_joint").split("_"))


def _groups(names: Sequence[str]) -> dict[str, list[int]]:
    """Clusters by the names of their joints without sides; the base is the trunk."""
    groups: dict[str, list[int]] = {"trunk": [BASE]}
    for index, name in enumerate(names):
        groups.setdefault(_label([name]), []).append(index)
    return groups


def _masses(ours: _Side, theirs: _Side) -> list[Item]:
    found = []
    for label, clusters in _groups(ours.names).items():
        mine = {cluster: ours.inertial(cluster) for cluster in clusters}
        other = {cluster: theirs.inertial(cluster) for cluster in clusters}
        both = [cluster for cluster in clusters if mine[cluster][0] > 0.0 and other[cluster][0] > 0.0]
        if not both:
            continue
        masses = [sum(side[cluster][0] for cluster in both) for side in (mine, other)]

        def change(part: str, both: Sequence[int] = both, mine: Any = mine, other: Any = other) -> Change:
            def apply(twin: Twin) -> None:
                for cluster in both:
                    mass, center, inertia = mine[cluster]
                    if part == "mass":
                        inertia = inertia * (other[cluster][0] / mass)
                        mass = other[cluster][0]
                    elif part == "center":
                        center = other[cluster][1]
                    else:
                        inertia = other[cluster][2] * (mass / other[cluster][0])
                    _set_inertial(ours, twin.reference.model, cluster, mass, center, inertia)

            return apply

        if any(abs(other[cluster][0] / mine[cluster][0] - 1.0) > 0.01 for cluster in both):
            found.append(Item(f"mass, {label}", f"{masses[0]:.3f} kg", f"{masses[1]:.3f} kg", change("mass")))
        away = max(float(np.linalg.norm(other[cluster][1] - mine[cluster][1])) for cluster in both)
        if away > 2e-3:
            found.append(Item(f"centre of mass, {label}", "", f"{1e3 * away:.0f} mm away", change("center")))
        sizes = [
            max(float(np.trace(side[cluster][2])) / side[cluster][0] for cluster in both) for side in (mine, other)
        ]
        spread = max(
            float(np.abs(other[c][2] / other[c][0] - mine[c][2] / mine[c][0]).max() / np.trace(mine[c][2] / mine[c][0]))
            for c in both
            if np.trace(mine[c][2]) > 0.0
        )
        if spread > 0.05:
            radii = [f"{1e3 * math.sqrt(max(0.0, size)):.0f} mm" for size in sizes]
            found.append(Item(f"radius of gyration, {label}", radii[0], radii[1], change("inertia")))
    return found


def _set_inertial(side: _Side, model: Any, cluster: int, mass: float, center: Array, inertia: Array) -> None:
    """Gives all mass of a cluster to its first body; `side` is polypod's own."""
    mj = mujoco()
    bodies = side.bodies(cluster)
    main = int(bodies[0])
    axes = side.axes.T @ side.data.xmat[main].reshape(3, 3)
    place = side.axes.T @ (side.data.xpos[main] - side.place)
    moments, directions = np.linalg.eigh(inertia)
    if np.linalg.det(directions) < 0.0:
        directions[:, 0] *= -1.0
    quaternion = np.zeros(4)
    mj.mju_mat2Quat(quaternion, np.ascontiguousarray(axes.T @ directions).ravel())
    model.body_mass[bodies], model.body_inertia[bodies] = 0.0, 0.0
    model.body_mass[main], model.body_inertia[main] = mass, np.maximum(moments, 1e-12)
    model.body_ipos[main], model.body_iquat[main] = axes.T @ (center - place), quaternion
    model.body_sameframe[main] = model.body_simple[main] = 0


def _frames(ours: _Side, theirs: _Side) -> list[Item]:
    gaps = theirs.anchors - ours.anchors
    gaps -= (gaps * ours.directions).sum(axis=1, keepdims=True) * ours.directions
    steps = np.array(
        [gap - (gaps[parent] if parent != BASE else 0.0) for gap, parent in zip(gaps, ours.lines.parents, strict=True)]
    )
    found = []
    for label, joints in _groups(ours.names).items():
        if joints == [BASE]:
            continue
        away = max(float(np.linalg.norm(steps[joint])) for joint in joints)
        if away > 1e-3:

            def apply(twin: Twin, joints: Sequence[int] = joints) -> None:
                model = twin.reference.model
                for joint in joints:
                    body = int(model.jnt_bodyid[ours.ids[joint]])
                    parent = int(model.body_parentid[body])
                    axes = ours.axes.T @ ours.data.xmat[parent].reshape(3, 3)
                    model.body_pos[body] += axes.T @ steps[joint]
                    model.body_sameframe[body] = model.body_simple[body] = 0

            found.append(Item(f"place, {label}", "", f"{1e3 * away:.1f} mm away", apply))
        cosines = [float(np.clip(ours.directions[j] @ theirs.directions[j], -1.0, 1.0)) for j in joints]
        tilt = math.degrees(max(math.acos(cosine) for cosine in cosines))
        if tilt > 0.5:

            def turn(twin: Twin, joints: Sequence[int] = joints) -> None:
                model = twin.reference.model
                for joint in joints:
                    axes = ours.axes.T @ ours.data.xmat[int(model.jnt_bodyid[ours.ids[joint]])].reshape(3, 3)
                    model.jnt_axis[ours.ids[joint]] = axes.T @ theirs.directions[joint]

            found.append(Item(f"axis, {label}", "", f"{tilt:.1f} degrees away", turn))
    return found


def _joints(twin: Twin, model: Model) -> list[Item]:
    found = []
    mine, other = twin.reference.model, model.model
    dofs, their_dofs = twin.reference.v[6:], model.v[6:]
    for name, key, unit in (
        ("armature", "dof_armature", "kg m^2"),
        ("joint damping", "dof_damping", "N m s/rad"),
        ("dry friction", "dof_frictionloss", "N m"),
    ):
        ours, theirs = _first(getattr(mine, key)[dofs]), _first(getattr(other, key)[their_dofs])
        if np.allclose(ours, theirs, rtol=0.01, atol=1e-6):
            continue

        def apply(twin: Twin, key: str = key, theirs: Array = theirs) -> None:
            of = getattr(twin.reference.model, key)
            of[(dofs, 0) if of.ndim > 1 else dofs] = theirs
            if key == "dof_frictionloss":
                for softness in ("dof_solref", "dof_solimp"):
                    getattr(twin.reference.model, softness)[dofs] = getattr(other, softness)[their_dofs]

        found.append(Item(name, f"{_span(ours)} {unit}", f"{_span(theirs)} {unit}", apply))
    ids = [mine.joint(name).id for name in twin.robot.joint_names]
    ours, theirs = _ranges(mine, ids), _ranges(other, model.joints)
    mapped = np.sort(model.map.signs[:, None] * theirs + model.map.offsets[:, None], axis=1)
    is_open = ~np.isfinite(mapped) & ~np.isfinite(ours)
    if not (np.isclose(ours, mapped, rtol=0.0, atol=0.02) | is_open).all():

        def limit(twin: Twin) -> None:
            of = twin.reference.model
            for joint, (low, high) in zip(ids, mapped, strict=True):
                of.jnt_limited[joint] = bool(np.isfinite([low, high]).all())
                if of.jnt_limited[joint]:
                    of.jnt_range[joint] = low, high

        change = np.abs(np.where(np.isfinite(ours - mapped), ours - mapped, np.inf)).max(axis=1)
        worst = int(change.argmax())
        texts = [f"{low:.2f} to {high:.2f}" for low, high in (ours[worst], mapped[worst])]
        found.append(Item(f"range, {twin.robot.joint_names[worst]} and others", texts[0], texts[1], limit))
    stiffness, own_stiffness = _first(other.jnt_stiffness[model.joints]), _first(mine.jnt_stiffness[ids])
    rests = model.map.signs * other.qpos_spring[model.q[7:]] + model.map.offsets
    is_like = np.isclose(rests, mine.qpos_spring[twin.reference.q[7:]], rtol=0.0, atol=0.01) | (stiffness == 0.0)
    if not (np.isclose(stiffness, own_stiffness, rtol=0.01, atol=1e-6) & is_like).all():

        def spring(twin: Twin) -> None:
            of = twin.reference.model
            of.jnt_stiffness[ids] = other.jnt_stiffness[model.joints]
            of.qpos_spring[twin.reference.q[7:]] = rests

        found.append(Item("joint springs", f"{_span(own_stiffness)} N m/rad", f"{_span(stiffness)} N m/rad", spring))
    return found


def _first(numbers: Array) -> Array:
    """One number per joint; MuJoCo 4 has polynomials, whose first number is the linear one."""
    return np.array(numbers if numbers.ndim == 1 else numbers[:, 0])


def _ranges(model: Any, joints: Sequence[int] | npt.NDArray[np.intp]) -> Array:
    limited = model.jnt_limited[joints].astype(bool)
    return np.where(limited[:, None], model.jnt_range[joints], [-np.inf, np.inf])


def _span(numbers: Array) -> str:
    low, high = float(np.min(numbers)), float(np.max(numbers))
    return f"{low:.3g}" if math.isclose(low, high, rel_tol=1e-6) else f"{low:.3g} to {high:.3g}"


def _actuators(twin: Twin, model: Model) -> list[Item]:
    own = np.flatnonzero(~model.is_policys)
    if not len(own):
        return []
    found, actuators = [], twin.robot.actuators
    numbers = model.model.actuator_gainprm[model.actuators, 0] * model.gears**2
    damping = 0.0 - model.model.actuator_biasprm[model.actuators, 2] * model.gears**2
    for name, key, theirs, unit in (
        ("stiffness", "stiffness", numbers, "N m/rad"),
        ("damping of the gains", "damping", damping, "N m s/rad"),
    ):
        ours = getattr(actuators, key)
        if np.allclose(ours[own], theirs[own], rtol=0.01, atol=1e-6):
            continue

        def apply(twin: Twin, key: str = key, theirs: Array = theirs) -> None:
            of = twin.reference.model
            if key == "stiffness":
                of.actuator_gainprm[own, 0], of.actuator_biasprm[own, 1] = theirs[own], -theirs[own]
            else:
                of.actuator_biasprm[own, 2] = -theirs[own]

        found.append(Item(name, f"{_span(ours[own])} {unit}", f"{_span(theirs[own])} {unit}", apply))
    limits = np.abs(model.effort_ranges()).max(axis=1) * np.abs(model.gears)
    is_other = ~(np.isclose(actuators.effort_limit, limits, rtol=0.01) | (limits == actuators.effort_limit))
    is_other |= np.isfinite(actuators.saturation_effort)
    is_other |= np.array([table is not None for table in actuators.effort_tables])
    if is_other[own].any():

        def weaken(twin: Twin) -> None:
            of = twin.robot.actuators
            effort, stall, tables = of.effort_limit.copy(), of.saturation_effort.copy(), list(of.effort_tables)
            effort[own], stall[own] = limits[own], np.inf
            for joint in own:
                tables[joint] = None
            changed = dataclasses.replace(of, effort_limit=effort, saturation_effort=stall, effort_tables=tuple(tables))
            twin.robot = dataclasses.replace(twin.robot, actuators=changed)

        kinds = " of DC motors" if np.isfinite(actuators.saturation_effort[own]).any() else ""
        texts = (f"{_span(actuators.effort_limit[own])} N m{kinds}", f"{_span(limits[own])} N m")
        found.append(Item("effort limit", *texts, weaken))
    if np.any(twin.delays[:, own] > 0.0):

        def hasten(twin: Twin) -> None:
            twin.delays[:, own] = 0.0

        found.append(Item("delay", f"up to {1e3 * twin.delays.max():.0f} ms", "0 ms", hasten))
    return found


def _leaves(side: _Side) -> dict[int, int]:
    """Lowest touching shape of each cluster at a limb's end, in the default pose, by cluster."""
    mj, model = mujoco(), side.model
    data = mj.MjData(model)
    data.qpos[:] = model.qpos0
    data.qpos[model.jnt_qposadr[side.ids]] = side.signs * (side.pose[7:] - side.offsets)
    mj.mj_kinematics(model, data)
    # polypod's z axis is up
    up = side.data.xmat[side.root].reshape(3, 3) @ side.turn.T @ np.array([0.0, 0.0, 1.0])
    touch = (model.geom_contype | model.geom_conaffinity) != 0
    found = {}
    for cluster in range(len(side.ids)):
        if side.lines.children(cluster):
            continue
        geoms = [geom for geom in np.flatnonzero(touch) if int(side.lines.clusters[model.geom_bodyid[geom]]) == cluster]
        if geoms:
            level = up[2] > 0.99
            heights = [
                lowest(model, data, np.array([geom])) if level else float(up @ data.geom_xpos[geom]) for geom in geoms
            ]
            found[cluster] = int(geoms[int(np.argmin(heights))])
    return found


def _feet(ours: _Side, theirs: _Side) -> list[Item]:
    mj = mujoco()
    sphere = int(mj.mjtGeom.mjGEOM_SPHERE)
    mine, other = _leaves(ours), _leaves(theirs)
    shared = [cluster for cluster in mine if cluster in other]
    if not shared:
        return []
    # arms end in hands: feet are the lowest of all
    heights = {cluster: float(ours.data.geom_xpos[mine[cluster], 2]) for cluster in shared}
    low = min(heights.values())
    feet = [cluster for cluster in shared if heights[cluster] < low + 0.3 * ours.lines.size]
    are_spheres = all(
        int(side.model.geom_type[geoms[cluster]]) == sphere
        for cluster in feet
        for side, geoms in ((ours, mine), (theirs, other))
    )
    kinds = [
        ", ".join(
            sorted(
                {
                    str(mj.mjtGeom(int(side.model.geom_type[geoms[c]])).name).removeprefix("mjGEOM_").lower()
                    for c in feet
                }
            )
        )
        for side, geoms in ((ours, mine), (theirs, other))
    ]
    if not are_spheres:
        return [Item("shape of the feet", kinds[0], kinds[1], None)] if kinds[0] != kinds[1] else []
    found = []
    radii = [
        np.array([side.model.geom_size[geoms[c], 0] for c in feet]) for side, geoms in ((ours, mine), (theirs, other))
    ]
    if np.abs(radii[0] - radii[1]).max() > 5e-4:

        def resize(twin: Twin) -> None:
            for cluster, radius in zip(feet, radii[1], strict=True):
                twin.reference.model.geom_size[mine[cluster], 0] = radius

        found.append(
            Item("radius of the feet", f"{1e3 * radii[0].max():.1f} mm", f"{1e3 * radii[1].max():.1f} mm", resize)
        )
    centers = np.array(
        [theirs.turn @ theirs.axes.T @ (theirs.data.geom_xpos[other[c]] - theirs.place) + theirs.shift for c in feet]
    )
    own = np.array([ours.axes.T @ (ours.data.geom_xpos[mine[c]] - ours.place) for c in feet])
    away = float(np.linalg.norm(centers - own, axis=1).max())
    if away > 1e-3:

        def move(twin: Twin) -> None:
            model = twin.reference.model
            for cluster, center in zip(feet, centers, strict=True):
                body = int(model.geom_bodyid[mine[cluster]])
                axes = ours.axes.T @ ours.data.xmat[body].reshape(3, 3)
                place = ours.axes.T @ (ours.data.xpos[body] - ours.place)
                model.geom_pos[mine[cluster]] = axes.T @ (center - place)
                model.geom_sameframe[mine[cluster]] = 0

        found.append(Item("place of the feet", "", f"{1e3 * away:.1f} mm away", move))
    return found


def _contacts(twin: Twin, model: Model, pose: Array) -> list[Item]:
    """Differences of the contact between a foot and the ground."""
    mj = mujoco()
    own = twin.reference.model
    state = pose.copy()
    data, least = model.data_of(state), np.inf
    touch = (model.model.geom_contype | model.model.geom_conaffinity) != 0
    robot = np.flatnonzero((model.skeleton.clusters[model.model.geom_bodyid] >= BASE) & touch)
    least = lowest(model.model, data, robot)
    ground = 0.0 if model.heights is None else float(model.heights.at(state[None, :2])[0])
    state[2] += ground - least - 2e-3
    data = model.data_of(state)
    mj.mj_forward(model.model, data)
    row = next(
        (
            index
            for index in range(data.ncon)
            if model.is_static[data.contact[index].geom].any() and not model.is_static[data.contact[index].geom].all()
        ),
        None,
    )
    if row is None:
        return []
    contact = data.contact[row]
    dim, friction = int(contact.dim), np.array(contact.friction)
    spin, rolling = (float(friction[2]) if dim >= 4 else 0.0), (float(friction[3]) if dim >= 6 else 0.0)
    solref, solimp = np.array(contact.solref), np.array(contact.solimp)
    found = []
    mine = own.geom_friction[-1]
    if abs(mine[0] - friction[0]) > 1e-3:

        def slide(twin: Twin) -> None:
            twin.reference.model.geom_friction[:, 0] = friction[0]

        found.append(Item("friction", f"{mine[0]:.3g}", f"{friction[0]:.3g}", slide))
    own_dim = int(own.geom_condim[-1])
    own_spin = (float(mine[1]) if own_dim >= 4 else 0.0, float(mine[2]) if own_dim >= 6 else 0.0)
    if max(abs(own_spin[0] - spin), abs(own_spin[1] - rolling)) > 1e-6 or own_dim != dim:

        def resist(twin: Twin) -> None:
            of = twin.reference.model
            of.geom_condim[:] = dim
            of.geom_friction[:, 1:] = [spin, rolling]

        texts = (
            f"condim {own_dim}: {own_spin[0]:.3g}, {own_spin[1]:.3g} m",
            f"condim {dim}: {spin:.3g}, {rolling:.3g} m",
        )
        found.append(Item("torsional, rolling friction", *texts, resist))
    if not (
        np.allclose(own.geom_solref[-1], solref, rtol=0.05) and np.allclose(own.geom_solimp[-1], solimp, rtol=0.05)
    ):

        def soften(twin: Twin) -> None:
            twin.reference.model.geom_solref[:], twin.reference.model.geom_solimp[:] = solref, solimp

        ours, theirs = (
            f"{ref[0]:.3g} s, {imp[0]:.3g} to {imp[1]:.4g}"
            for ref, imp in ((own.geom_solref[-1], own.geom_solimp[-1]), (solref, solimp))
        )
        found.append(Item("softness of contacts", ours, theirs, soften))
    cones = [
        f"{'elliptic' if int(of.opt.cone) == int(mj.mjtCone.mjCONE_ELLIPTIC) else 'pyramid'}, {of.opt.impratio:g}"
        for of in (own, model.model)
    ]
    if cones[0] != cones[1]:

        def cone(twin: Twin) -> None:
            twin.reference.model.opt.cone = int(model.model.opt.cone)
            twin.reference.model.opt.impratio = float(model.model.opt.impratio)

        found.append(Item("cone, impratio", cones[0], cones[1], cone))
    return found


def _options(twin: Twin, model: Model) -> list[Item]:
    mj, own, found = mujoco(), twin.reference.model, []

    def name(of: Any) -> str:
        method = str(mj.mjtIntegrator(int(of.opt.integrator)).name).removeprefix("mjINT_")
        return f"{method}, {1e3 * of.opt.timestep:g} ms"

    if name(own) != name(model.model):

        def step(twin: Twin) -> None:
            of = twin.reference.model
            of.opt.timestep, of.opt.integrator = model.dt, int(model.model.opt.integrator)
            twin.substeps = round(twin.step_dt / model.dt)

        found.append(Item("integrator, step", name(own), name(model.model), step))
    if not np.allclose(own.opt.gravity, model.model.opt.gravity, atol=1e-3):

        def fall(twin: Twin) -> None:
            twin.reference.model.opt.gravity[:] = model.model.opt.gravity

        ours, theirs = (f"{np.linalg.norm(of.opt.gravity):.3f} m/s^2" for of in (own, model.model))
        found.append(Item("gravity", ours, theirs, fall))
    return found
