"""MuJoCo's model of a robot, from the URDF that polypod reads or from its MJCF file.

MuJoCo itself compiles it.

Settings that differ from MuJoCo's defaults, and the reasons:

- `fusestatic` off: MuJoCo would merge the feet, which hang on fixed joints, into the shanks, and a
  root link without a joint into the world. polypod merges them too but keeps their names as contact
  bodies; links are compared by name.
- Joints that the robot's config locks are taken out, at the position in which they are held.
- A free joint on the root link, unless the base is fixed. qpos and qvel then mean what polypod's
  do: joints may come in another order, which is matched by name.
- Position actuators with the gains of the robot's config, its armature, and their limits of effort.
  The URDF's own `effort` becomes a limit of the joint in MuJoCo; it is taken off, since a robot's
  config may state another.
- Joint damping and dry friction: those of the URDF, as in polypod, unless the robot's config states
  others. Springs: those of the config.
- Dry friction is a soft constraint in MuJoCo: with default settings a joint at rest creeps (up to 8
  mrad in a second). Its time constant is set to two steps and its impedance to 0.9999, which makes
  it Coulomb's.
- Limits of effort, position limits and speed limits, where `bounded`: see
  `polypod.mujoco_model.limits`.
- Shapes touch the ground alone, not each other. A URDF with meshes has polypod's shapes in their
  place: see `polypod.mujoco_model.contact_shapes`.
- Contacts with elliptic cones, the same coefficients on both sides, in three directions (`condim`
  3), with torsional friction in four, with rolling friction in six. A surface of the config has a
  priority above the ground's, and the coefficients that polypod combines. The contact is made as
  stiff as the step allows: time constant 2 steps, impedance 0.99 to 0.999, friction 100 times as
  stiff as the normal direction (`impratio`). With default settings a standing robot's feet creep
  apart and it sinks by centimetres.
- `inertiafromgeom` is off in the URDFs themselves: else MuJoCo would give the massless feet the
  mass of their spheres. `balanceinertia`, `boundmass`, `discardvisual`, `strippath` and `alignfree`
  do not matter: inertias are valid, no mesh is read, visuals have no mass and a free base keeps the
  frame of its link.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod._core import ConfigError
from polypod.add import inertias
from polypod.arrays import Array
from polypod.extras import package
from polypod.mujoco_model import contact_shapes
from polypod.mujoco_model.limits import Limits
from polypod.mujoco_model.origin import Origin
from polypod.mujoco_model.robot import Actuators, Robot, Surface

Integrator = Literal["implicitfast", "RK4"]

GRAVITY = _core.EARTH_GRAVITY
"""Gravity, m/s^2."""


SAME_LIMIT = 1e-6
"""Position limits that differ by less are equal, rad or m."""
FARTHEST = 1e9
"""Position limit of a joint that has none on this side, rad or m."""


@dataclasses.dataclass(frozen=True)
class Heights:
    """Heights of the ground on the points of a grid."""

    heights: npt.NDArray[np.float32]
    """Heights, m, [points along x, points along y]."""
    origin: tuple[float, float]
    """x and y of the first point, m."""
    cell: float
    """Distance of two points, m."""

    def widened(self, by: float) -> "Heights":
        """The map with its edges extended by this much, m: MuJoCo's height fields just end."""
        points = math.ceil(by / self.cell)
        x, y = (start - points * self.cell for start in self.origin)
        return Heights(np.pad(self.heights, points, mode="edge"), (x, y), self.cell)

    def at(self, places: Array) -> Array:
        """Heights below places [..., 2], m, linear in between the points.

        Beyond the grid its edge goes on.
        """
        scaled = (places - self.origin) / self.cell
        last = np.array(self.heights.shape) - 1
        scaled = np.clip(scaled, 0.0, last)
        first = np.minimum(scaled.astype(np.intp), last - 1)
        (i, j), (u, v) = np.moveaxis(first, -1, 0), np.moveaxis(scaled - first, -1, 0)
        near = (1.0 - v) * self.heights[i, j] + v * self.heights[i, j + 1]
        far = (1.0 - v) * self.heights[i + 1, j] + v * self.heights[i + 1, j + 1]
        level: Array = (1.0 - u) * near + u * far
        return level


@dataclasses.dataclass(frozen=True)
class Ground:
    """A plane through the world's origin, or heights."""

    friction: float
    """Coulomb's coefficient of every contact."""
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Normal of the plane; of unit length."""
    soft: bool = False
    """Contacts with MuJoCo's default time constant and impedance in place of the stiffest ones that
    the step allows."""
    heights: Heights | None = None
    """Heights in place of the plane."""
    torsional_friction: float = 0.0
    """Torque about a contact's normal per normal force, m."""
    rolling_friction: float = 0.0
    """Torque across a contact's normal per normal force, m."""

    @property
    def condim(self) -> int:
        """Number of directions in which MuJoCo's contacts resist."""
        if self.rolling_friction > 0.0:
            return 6
        return 4 if self.torsional_friction > 0.0 else 3


def mujoco() -> Any:
    """The module. Raises ConfigError where it is not installed."""
    return package("mujoco", "comparing with MuJoCo", "bench")


def version() -> str:
    """Version of MuJoCo."""
    return str(mujoco().__version__)


def states(model: Any, count: int, flag: str) -> list[Any]:
    """Makes states of a model.

    Raises ConfigError, which names the flag to lower, where memory is short.
    """
    mj = mujoco()
    try:
        return [mj.MjData(model) for _ in range(count)]
    except (mj.FatalError, MemoryError) as error:
        raise ConfigError(
            f"MuJoCo has no memory for {count} states of this robot ({error}); choose a smaller {flag}"
        ) from error


def damping_rate(model: Any, dofs: npt.NDArray[np.intp], damping: Array) -> float:
    """The fastest rate at which the damping of actuators slows joints down, 1/s.

    Args:
        model: a `mujoco.MjModel`, in the state that it begins in.
        dofs: velocities of the joints.
        damping: of their actuators, N m s/rad.
    """
    mj = mujoco()
    data = mj.MjData(model)
    mj.mj_forward(model, data)
    inverse, roots = np.zeros((model.nv, model.nv)), np.sqrt(damping)
    mj.mj_solveM(model, data, inverse, np.eye(model.nv))
    return float(np.linalg.eigvalsh(roots[:, None] * inverse[np.ix_(dofs, dofs)] * roots)[-1])


class Reference:
    """One robot in MuJoCo.

    Positions and velocities go in and come out in polypod's order of joints.
    """

    def __init__(
        self,
        urdf: str,
        *,
        joint_names: tuple[str, ...] = (),
        actuators: Actuators | None = None,
        dt: float,
        integrator: Integrator = "implicitfast",
        fixed_base: bool = False,
        ground: Ground | None = None,
        gravity: tuple[float, float, float] = (0.0, 0.0, -GRAVITY),
        locked_joints: Mapping[str, float] | None = None,
        surfaces: tuple[Surface, ...] = (),
        bounded: bool = False,
        joint_range: Array | None = None,
        origin: Origin | None = None,
        outline: Mapping[str, Any] | None = None,
    ) -> None:
        """Compiles the model.

        Args:
            urdf: the URDF's text.
            joint_names: all joints that move, in polypod's order.
            actuators: of these joints; None: none.
            dt: s.
            integrator: MuJoCo's.
            fixed_base: holds the root link.
            ground: what the robot can touch; None: nothing.
            gravity: m/s^2, world axes.
            locked_joints: joints of the URDF that do not move, and their positions, rad or m.
            surfaces: of links that differ from the rest of the robot where they touch the ground.
            bounded: whether `step` holds the limits of the actuators and of the joints.
            joint_range: position limits of these joints in the place of the file's, [joints, 2],
                rad or m.
            origin: the MJCF file that the robot comes from, in the place of the URDF.
            outline: the robot's entry of `VecSim.robot_shapes`, of a URDF without its shapes.
        """
        mj = mujoco()
        self._anchors: Mapping[str, Array] = {}
        if origin is None:
            spec = mj.MjSpec.from_string(urdf)
            spec.compiler.fusestatic = False
            for name, position in (locked_joints or {}).items():
                _lock(mj, spec, name, position)
            if outline is not None:
                contact_shapes.add(mj, spec, outline)
        else:
            spec = origin.spec(functools.partial(_lock, mj), locked_joints or {})
            self._anchors = origin.anchors
        root = spec.worldbody.first_body()
        if not fixed_base:
            root.add_freejoint()
        _add_ground(mj, spec, ground, dt)
        if ground is not None:
            _add_surfaces(spec, ground, surfaces, origin)
        if actuators is not None:
            _add_actuators(spec, joint_names, actuators)
        spec.option.timestep = dt
        spec.option.integrator = getattr(mj.mjtIntegrator, f"mjINT_{integrator.upper()}")
        spec.option.gravity = gravity
        self.spec = spec
        """`mujoco.MjSpec` of the model."""
        self.model = inertias.compiled(spec)
        self.data = mj.MjData(self.model)
        if actuators is not None:
            _set_springs(self.model, joint_names, actuators)
        links = [
            self.model.body(body).name if origin is None else origin.link_of_geom(self.model.geom(geom).name)
            for geom, body in enumerate(self.model.geom_bodyid)
        ]
        of_geom = [surface_of(link, surfaces) for link in links]
        self.friction_factor = np.array([1.0 if surface is None else surface.friction for surface in of_geom])
        """Factors of the coefficient of sliding friction of robot and ground, [geoms]."""
        self.root = root.name
        self.actuators = actuators
        self._mj = mj
        # dry friction as near to Coulomb's as the step allows
        self.model.dof_solref[:] = [2.0 * dt, 1.0]
        self.model.dof_solimp[:] = [0.9999, 0.9999, 0.001, 0.5, 2.0]
        joints = [self.model.joint(name) for name in joint_names]
        if joint_range is not None:
            _narrow(self.model, [joint.id for joint in joints], joint_range)
        free_q, free_v = (0, 0) if fixed_base else (7, 6)
        self.q = np.array([*range(free_q), *(joint.qposadr[0] for joint in joints)], dtype=np.intp)
        self.v = np.array([*range(free_v), *(joint.dofadr[0] for joint in joints)], dtype=np.intp)
        self.num_joints = len(joints)
        self._limits: Limits | None = None
        if bounded and actuators is not None:
            self._limits = Limits(mj, self.model, actuators, [joint.id for joint in joints])

    @classmethod
    def of(cls, robot: Robot, **options: Any) -> "Reference":
        """A robot, from its MJCF file if it has one; `options` as in the constructor.

        Raises ConfigError where MuJoCo refuses the robot's file.
        """
        try:
            return cls(
                robot.urdf,
                joint_names=robot.joint_names,
                actuators=robot.actuators,
                locked_joints=robot.locked_joints,
                surfaces=robot.surfaces,
                joint_range=robot.joint_range,
                origin=robot.origin,
                outline=robot.outline,
                **options,
            )
        except ConfigError:
            raise
        except (ValueError, mujoco().FatalError) as error:
            problem = " ".join(str(error).split())
            raise ConfigError(
                f"{robot.source}: MuJoCo does not compile {robot.urdf_file}: {problem}; correct this in the file"
            ) from error

    @property
    def qpos(self) -> Array:
        """A copy of MuJoCo's positions, [nq]."""
        return np.array(self.data.qpos[self.q])

    @property
    def qvel(self) -> Array:
        """A copy of MuJoCo's velocities, [nv]."""
        return np.array(self.data.qvel[self.v])

    def set_state(self, qpos: Array, qvel: Array | None = None) -> None:
        """Resets to a state; without velocity, at rest."""
        self._mj.mj_resetData(self.model, self.data)
        self.data.qpos[self.q] = qpos
        self.data.qvel[self.v] = 0.0 if qvel is None else qvel
        self._mj.mj_forward(self.model, self.data)

    def step(self, targets: Array | None = None, n: int = 1) -> None:
        """`n` physics steps towards position targets."""
        if targets is not None:
            self.data.ctrl[:] = targets
        if self._limits is None:
            self._mj.mj_step(self.model, self.data, n)
            return
        for _ in range(n):
            self._limits.step(self.data)

    def mass_matrix(self) -> Array:
        """Mass matrix of the present state, [nv, nv]."""
        matrix = np.zeros((self.model.nv, self.model.nv))
        # MuJoCo 3 and 4 differ in the arguments of mj_fullM
        for column, unit in zip(matrix, np.eye(self.model.nv), strict=True):
            self._mj.mj_mulM(self.model, self.data, column, unit)
        return matrix[np.ix_(self.v, self.v)]

    def bias_force(self) -> Array:
        """Coriolis, centrifugal and gravity forces, [nv]."""
        return np.array(self.data.qfrc_bias[self.v])

    def center_of_mass(self) -> Array:
        """Centre of mass of the robot, world axes, [3]."""
        return np.array(self.data.subtree_com[self.model.body(self.root).id])

    def link_pose(self, links: list[str]) -> tuple[Array, Array]:
        """Positions [links, 3] and rotation matrices [links, 3, 3], world."""
        ids = [self.model.body(name).id for name in links]
        at, turned = np.array(self.data.xpos[ids]), np.array(self.data.xmat[ids]).reshape(-1, 3, 3)
        for place, name in enumerate(links):
            if name in self._anchors:
                at[place] += turned[place] @ self._anchors[name]
        return at, turned

    def has_link(self, name: str) -> bool:
        """Whether a link is a body."""
        return bool(self._mj.mj_name2id(self.model, int(self._mj.mjtObj.mjOBJ_BODY), name) >= 0)

    def contact_forces(self, links: list[str]) -> Array:
        """Net force [links, 3] of the ground on each link with its fixed parts, world axes, N."""
        forces = np.zeros((len(links), 3))
        wrench = np.zeros(6)
        for index in range(self.data.ncon):
            contact = self.data.contact[index]
            self._mj.mj_contactForce(self.model, self.data, index, wrench)
            force = np.reshape(contact.frame, (3, 3)).T @ wrench[:3]
            # the force acts on the second geom; the ground may be either
            for geom, sign in ((contact.geom1, -1.0), (contact.geom2, 1.0)):
                link = self._kept(int(self.model.geom_bodyid[geom]), links)
                if link is not None:
                    forces[link] += sign * force
        return forces

    def _kept(self, body: int, links: list[str]) -> int | None:
        while body != 0:
            name = self.model.body(body).name
            if name in links:
                return links.index(name)
            body = int(self.model.body_parentid[body])
        return None


def _lock(mj: Any, spec: Any, name: str, position: float) -> None:
    """Holds a joint at a position: its body becomes part of its parent.

    Joints before it in the body turn too. It mimics no joint any more.
    """
    joint = spec.joint(name)
    for equality in list(spec.equalities):
        if equality.type == mj.mjtEq.mjEQ_JOINT and name in (equality.name1, equality.name2):
            spec.delete(equality)
    body, axis = joint.parent, np.array(joint.axis) / np.linalg.norm(joint.axis)
    turn, moved = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    if joint.type == mj.mjtJoint.mjJNT_SLIDE:
        shift = (position - joint.ref) * axis
    else:
        mj.mju_axisAngle2Quat(turn, axis, position - joint.ref)
        at = np.array(joint.pos)
        mj.mju_rotVecQuat(moved, at, turn)
        shift = at - moved
    back = np.zeros(4)
    mj.mju_negQuat(back, turn)
    for other in list(body.joints):
        if other.name == name:
            break
        for key, point in (("axis", np.array(other.axis)), ("pos", np.array(other.pos) - shift)):
            mj.mju_rotVecQuat(moved, point, back)
            setattr(other, key, moved.copy())
    turned = np.zeros(4)
    mj.mju_rotVecQuat(moved, shift, np.array(body.quat))
    body.pos = np.array(body.pos) + moved
    mj.mju_mulQuat(turned, np.array(body.quat), turn)
    body.quat = turned
    spec.delete(joint)


def _narrow(model: Any, joints: Sequence[int], ranges: Array) -> None:
    """Sets position limits that differ from the file's.

    A config may narrow them in `[joint_limits]`.
    """
    for joint, (lower, upper) in zip(joints, ranges, strict=True):
        own = model.jnt_range[joint] if model.jnt_limited[joint] else np.array([-np.inf, np.inf])
        if np.isfinite([lower, upper]).any() and not np.allclose(own, [lower, upper], rtol=0.0, atol=SAME_LIMIT):
            model.jnt_limited[joint] = 1
            model.jnt_range[joint] = np.clip([lower, upper], -FARTHEST, FARTHEST)


def _add_ground(mj: Any, spec: Any, ground: Ground | None, dt: float) -> None:
    for geom in spec.geoms:
        geom.contype, geom.conaffinity = (0 if ground is None else 1), 0
    if ground is None:
        return
    if ground.heights is None:
        surface = spec.worldbody.add_geom(type=mj.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
        surface.quat = _turn_z_to(np.array(ground.normal))
    else:
        surface = _height_field(mj, spec, ground.heights)
        # the default search of MuJoCo 4.0 gives wrong normals for soles on the prisms of level
        # heights: robots spin
        spec.option.disableflags |= int(mj.mjtDisableBit.mjDSBL_NATIVECCD)
    surface.contype, surface.conaffinity = 0, 1
    for geom in spec.geoms:
        geom.condim = ground.condim
        geom.friction = [ground.friction, ground.torsional_friction, ground.rolling_friction]
        if ground.soft:
            continue
        geom.solref = [2.0 * dt, 1.0]
        geom.solimp = [0.99, 0.999, 0.001, 0.5, 2.0]
    spec.option.cone = mj.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 100.0  # feet do not creep


def ground_alone(heights: Heights | None) -> Any:
    """A compiled model of heights, or of a plane at height 0, and nothing else."""
    mj = mujoco()
    spec = mj.MjSpec()
    if heights is None:
        spec.worldbody.add_geom(type=mj.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
    else:
        _height_field(mj, spec, heights)
    return spec.compile()


def surface_of(link: str, surfaces: tuple[Surface, ...]) -> Surface | None:
    """The surface of a link, if it differs from the rest of the robot."""
    found = (each for each in surfaces if any(fnmatchcase(link, pattern) for pattern in each.bodies))
    return next(found, None)


def _set_springs(model: Any, joint_names: tuple[str, ...], actuators: Actuators) -> None:
    """Sets the joints' springs in a compiled model.

    Its angles are in rad, whatever those of the file are in.
    """
    for name, (stiffness, rest) in zip(joint_names, actuators.spring, strict=True):
        joint, numbers = model.joint(name), model.jnt_stiffness
        # a polynomial in some versions, whose first number is the linear one
        numbers[(joint.id, 0) if numbers.ndim > 1 else joint.id] = stiffness
        model.qpos_spring[joint.qposadr[0]] = rest


def _add_surfaces(spec: Any, ground: Ground, surfaces: tuple[Surface, ...], origin: Origin | None) -> None:
    """Gives geoms the surfaces of their links.

    Each decides alone: the ground's numbers are in its own already.
    """
    for geom in spec.geoms:
        link = geom.parent.name if origin is None else origin.link_of_geom(geom.name)
        surface = surface_of(link, surfaces)
        if surface is None:
            continue
        combined = dataclasses.replace(
            ground,
            friction=surface.friction * ground.friction,
            torsional_friction=max(surface.torsional_friction, ground.torsional_friction),
            rolling_friction=max(surface.rolling_friction, ground.rolling_friction),
        )
        geom.friction = [combined.friction, combined.torsional_friction, combined.rolling_friction]
        geom.condim, geom.priority, geom.margin = combined.condim, 1, surface.contact_margin


def _height_field(mj: Any, spec: Any, heights: Heights) -> Any:
    half = 0.5 * heights.cell * (np.array(heights.heights.shape) - 1)
    lowest = float(heights.heights.min())
    # more than nothing, as MuJoCo wants it
    rise = max(float(heights.heights.max()) - lowest, 1e-3)
    columns, rows = heights.heights.shape
    # rows of a height field run along x, one after the other along y
    data = ((heights.heights.T - lowest) / rise).ravel()
    spec.add_hfield(name="ground", nrow=rows, ncol=columns, size=[*half, rise, 1.0], userdata=data)
    return spec.worldbody.add_geom(
        type=mj.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", pos=[*(half + heights.origin), lowest]
    )


def _turn_z_to(normal: Array) -> Array:
    """The quaternion of the shortest turn from the z axis to `normal`."""
    quaternion = np.array([1.0 + normal[2], -normal[1], normal[0], 0.0])
    return quaternion / np.linalg.norm(quaternion)


def _set_linear(joint: Any, key: str, value: float) -> None:
    """Sets the first, linear number of a joint quantity that is a polynomial in MuJoCo 4."""
    numbers = getattr(joint, key)
    if np.ndim(numbers):
        numbers[0] = value
    else:
        setattr(joint, key, value)


def _add_actuators(spec: Any, joint_names: tuple[str, ...], actuators: Actuators) -> None:
    mj = mujoco()
    for index, name in enumerate(joint_names):
        joint = spec.joint(name)
        joint.armature = actuators.armature[index]
        joint.actfrclimited = mj.mjtLimited.mjLIMITED_FALSE
        if not np.isnan(actuators.joint_damping[index]):
            _set_linear(joint, "damping", actuators.joint_damping[index])
        if not np.isnan(actuators.friction[index]):
            joint.frictionloss = actuators.friction[index]
        actuator = spec.add_actuator(name=name, target=name, trntype=mj.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=actuators.stiffness[index], kv=actuators.damping[index])
