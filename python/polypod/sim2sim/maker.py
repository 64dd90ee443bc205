"""Envs of a robot in a maker's MuJoCo model of it.

Masses, contacts, joints and actuators are the model's.

The model stays as its file says, but for what is needed to stand on the ground and to follow the
policy:

- A base without a free joint gets one; a world without ground gets a plane, with MuJoCo's default
  friction.
- A joint that the policy does not drive is held at its position in the first keyframe, or at zero,
  unless a spring, an equality or an actuator for positions holds it already.
- An actuator for positions gets the policy's targets. A motor gets the torque of the policy's
  gains, within the motor's limits. A joint without an actuator gets the policy's. By choice all
  joints get the policy's.
- Contacts stay, or are made as stiff as those of polypod's twin, or slide alone (`condim` 3).
"""

import copy
import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from polypod import _core, rotations
from polypod.arrays import Array
from polypod.mujoco_model.reference import Heights, Reference, damping_rate, mujoco
from polypod.mujoco_model.robot import Robot
from polypod.sim2sim import mapping, mjcf
from polypod.sim2sim.driven import Drive, Driven
from polypod.sim2sim.mapping import Given, JointMap
from polypod.sim2sim.skeleton import BASE, Skeleton, is_below, joints_below, skeleton

Actuation = Literal["model", "policy", "motors"]
Contacts = Literal["asis", "stiff", "condim3"]

TILT = 1.2
"""Tilt from which a robot has fallen where no shape of the model's base touches, rad."""
SUNK = 0.5
"""Share of its height below which such a base has fallen."""
REACH = 12.0
"""Half the side of the ground whose heights are read off a scene, m."""
CELL = 0.1
"""Distance of these heights, m."""
HIGH = 100.0
"""Height from which they are looked for, m."""
STABLE = 1.0
"""Largest product of step, damping and inverse inertia of joints that the policy's gains drive;
from 2 an explicit integrator shakes them."""
_LEVEL = 1e-6
"""Heights that differ by less count as equal, m."""


@dataclasses.dataclass(frozen=True)
class Choices:
    """Choices of actuators and contacts with which a model is played."""

    actuators: Actuation = "model"
    """`model`: its own; `policy`: the policy's gains, limits and delays; `motors`: with the rotors'
    inertia, too."""
    contact: Contacts = "asis"
    """`asis`: its own; `stiff`: as stiff as the step allows; `condim3`: its own without torsional
    and rolling friction.
    """
    dt: float | None = None
    """Physics step, s; None: the file's."""
    integrator: str | None = None
    """None: the file's."""
    friction: float | None = None
    """Sliding friction of all contacts; None: the file's."""


class Model:
    """A compiled model of a file with its map to a robot of polypod.

    It is a `polypod.sim2sim.driven.Body`.
    """

    def __init__(
        self, reading: mjcf.Reading, file: str, robot: Robot, given: Given | None = None, choices: Choices | None = None
    ) -> None:
        """Compiles the model. Its spec is changed.

        Args:
            reading: of the file.
            file: its name, for messages.
            robot: of polypod.
            given: content of a map file.
            choices: options of playing the model.

        Raises:
            ConfigError: for a model that is not of this robot, or that cannot be driven.
        """
        given, choices = given or Given(), choices or Choices()
        self.file, self.robot, self.choices = file, robot, choices
        self.notes = list(reading.left_out)
        """Parts that were added, left out or replaced, one line each."""
        self._mj = mujoco()
        self._spec = reading.spec
        first = self._compiled()
        self._find_base(first, given)
        first = self._compiled()
        ours = Reference.of(robot, dt=0.005)
        root = first.body(self.root).id
        self.ours = skeleton(
            ours.model, ours.model.body(ours.root).id, [ours.model.joint(name).id for name in robot.joint_names]
        )
        locked = {
            joint: robot.locked_joints[first.joint(joint).name]
            for joint in joints_below(first, root)
            if first.joint(joint).name in robot.locked_joints
        }
        whole = skeleton(first, root, [joint for joint in joints_below(first, root) if joint not in locked], locked)
        self.map: JointMap = mapping.find(self.ours, whole, given, file)
        paired = [whole.ids[whole.names.index(pair.theirs)] for pair in self.map.pairs]
        self._complete(first, root, [int(joint) for joint in paired], locked)
        model = self.model = self._compiled()
        self.joints = np.array(paired, dtype=np.intp)
        """Numbers of the joints, in polypod's order, [joints]."""
        root = model.body(self.root).id
        self.skeleton: Skeleton = skeleton(model, root, self.joints.tolist(), locked)
        self.map = mapping.compared(self.map, self.ours, ours.model, self.skeleton, model, root, locked)
        free = int(model.body_jntadr[root])
        q, v = int(model.jnt_qposadr[free]), int(model.jnt_dofadr[free])
        self.q = np.array([*range(q, q + 7), *model.jnt_qposadr[self.joints]], dtype=np.intp)
        self.v = np.array([*range(v, v + 6), *model.jnt_dofadr[self.joints]], dtype=np.intp)
        self.is_static = model.body_weldid[model.geom_bodyid] == 0
        """Whether geoms belong to the world, [geoms]."""
        self._set_options()
        self._set_actuators()
        self._set_step()
        self._set_contacts()
        self.heights = self._ground()

    def _compiled(self) -> Any:
        try:
            return self._spec.compile()
        except Exception as error:
            raise _core.ConfigError(f"{self.file}: MuJoCo does not compile it: {mjcf.one_line(error)}") from error

    def _find_base(self, model: Any, given: Given) -> None:
        """Names the body that is the robot's base, and frees it."""
        mj, need = self._mj, self.robot.num_joints
        free = int(mj.mjtJoint.mjJNT_FREE)
        tops = [body for body in range(1, model.nbody) if int(model.body_parentid[body]) == 0]
        if given.base is not None:
            names = [model.body(body).name for body in tops]
            if given.base not in names:
                raise _core.ConfigError(
                    f"--map: base: {self.file} has no body {given.base[:80]!r} in its world; bodies: {', '.join(names)}"
                )
            tops = [tops[names.index(given.base)]]
        counts = {body: len(joints_below(model, body)) for body in tops}
        enough = [body for body in tops if counts[body] >= need]
        if not enough:
            most = max(counts.values(), default=0)
            raise _core.ConfigError(
                f"{self.file}: {self.robot.name} has {need} joints, and no body of the model has more than {most}; "
                "name a model of this robot, or another --robot"
            )
        is_free = {
            body: any(
                int(model.jnt_type[joint]) == free
                for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
            )
            for body in enough
        }
        if len(enough) > 1:
            fewest = [body for body in enough if counts[body] == need]
            if len(fewest) != 1:
                names = [model.body(body).name or f"body {body}" for body in enough]
                raise _core.ConfigError(
                    f"{self.file}: {len(enough)} bodies may be the robot: {', '.join(names)}; say which in a "
                    '--map FILE with base = "..."'
                )
            enough = fewest
        root = enough[0]
        body = self._spec.bodies[root]
        if not body.name:
            body.name = "polypod_base"
        self.root = body.name
        if not is_free[root]:
            if int(model.body_jntnum[root]):
                raise _core.ConfigError(
                    f"{self.file}: body {self.root} is the robot's base and moves by joints of other kinds than free; "
                    "give it a <freejoint/>"
                )
            body.add_freejoint()
            self._drop_keys()
            self.notes.append(f"{self.root} has no free joint: one is added")

    def _drop_keys(self) -> None:
        """Keyframes no longer fit a model that gets joints or actuators."""
        for key in list(self._spec.keys):
            self._spec.delete(key)

    def _complete(self, model: Any, root: int, paired: Sequence[int], locked: dict[int, float]) -> None:
        """Adds to the spec what the model lacks."""
        mj = self._mj
        self._own: list[int | None] = []
        kinds = [_kind(mj, model, actuator) for actuator in range(model.nu)]
        of_joint: dict[int, list[int]] = {}
        for actuator in range(model.nu):
            if int(model.actuator_trntype[actuator]) in (
                int(mj.mjtTrn.mjTRN_JOINT),
                int(mj.mjtTrn.mjTRN_JOINTINPARENT),
            ):
                of_joint.setdefault(int(model.actuator_trnid[actuator, 0]), []).append(actuator)
        self._kinds = kinds
        home = model.key_qpos[0] if model.nkey else model.qpos0
        self._silent: list[int] = []
        """Actuators that give no force."""
        added, lacking, motors = [], [], []
        for joint, name in zip(paired, self.robot.joint_names, strict=True):
            mine = of_joint.get(joint, [])
            servos = [actuator for actuator in mine if kinds[actuator] == "position"]
            torques = [actuator for actuator in mine if kinds[actuator] == "motor"]
            if self.choices.actuators != "model":
                self._silent += mine
                chosen = None
            elif len(servos) == 1:
                chosen = servos[0]
            elif not servos and len(torques) == 1 and len(mine) == 1:
                chosen = torques[0]
                motors.append(name)
            elif not mine:
                chosen = None
                lacking.append(name)
            else:
                names = ", ".join(model.actuator(actuator).name or f"actuator {actuator}" for actuator in mine)
                raise _core.ConfigError(
                    f"{self.file}: joint {model.joint(joint).name} is driven by {names}, of which no single one takes "
                    "a position or a torque; pass --actuators policy"
                )
            self._own.append(chosen)
            if chosen is None:
                added.append((joint, name))
        for number, (joint, _) in enumerate(added):
            self._add_actuator(model, joint, number)
        held = []
        for joint in joints_below(model, root):
            if joint in paired:
                continue
            where = locked.get(joint, float(home[model.jnt_qposadr[joint]]))
            if joint not in locked and self._is_held(model, joint, of_joint.get(joint, [])):
                continue
            self._hold(joint, where)
            held.append(f"{model.joint(joint).name or joint} at {where:.3g}")
        self.resting = {
            actuator: float(model.actuator_gear[actuator, 0] * home[model.jnt_qposadr[joint]])
            for joint, mine in of_joint.items()
            if joint not in paired
            for actuator in mine
            if kinds[actuator] == "position"
        }
        self._first_added = model.nu
        if added:
            self._drop_keys()
        if lacking:
            self.notes.append(f"{len(lacking)} joints have no actuator: the policy's gains and limits drive them")
        if motors:
            self.notes.append(
                f"{len(motors)} joints have motors: the policy's gains set their torque, within their limits"
            )
        if held:
            self.notes.append(f"the policy does not drive {len(held)} joints: held {', '.join(held)}")
        if not self._has_ground(model, root):
            self._add_ground(model, root)

    def _is_held(self, model: Any, joint: int, actuators: Sequence[int]) -> bool:
        mj = self._mj
        body = int(model.jnt_bodyid[joint])
        equalities = [
            row
            for row in range(model.neq)
            if (
                int(model.eq_type[row]) == int(mj.mjtEq.mjEQ_JOINT)
                and joint in (int(model.eq_obj1id[row]), int(model.eq_obj2id[row]))
            )
            or (
                int(model.eq_type[row]) in (int(mj.mjtEq.mjEQ_CONNECT), int(mj.mjtEq.mjEQ_WELD))
                and any(is_below(model, int(end[row]), body) for end in (model.eq_obj1id, model.eq_obj2id))
            )
        ]
        has_spring = float(np.abs(model.jnt_stiffness[joint]).max()) > 0.0
        return bool(equalities) or has_spring or any(self._kinds[actuator] == "position" for actuator in actuators)

    def _add_actuator(self, model: Any, joint: int, number: int) -> None:
        self._spec.joints[joint].name = self._spec.joints[joint].name or f"polypod_joint_{joint}"
        target = self._spec.joints[joint].name
        actuator = self._spec.add_actuator(name=f"polypod_{number}", target=target, trntype=self._mj.mjtTrn.mjTRN_JOINT)
        index = self._own_index(number)
        gains = self.robot.actuators
        actuator.set_to_position(kp=gains.stiffness[index], kv=gains.damping[index])

    def _own_index(self, number: int) -> int:
        """The joint of the `number`-th actuator that is added."""
        return [index for index, own in enumerate(self._own) if own is None][number]

    def _hold(self, joint: int, where: float) -> None:
        self._spec.joints[joint].name = self._spec.joints[joint].name or f"polypod_joint_{joint}"
        equality = self._spec.add_equality(type=self._mj.mjtEq.mjEQ_JOINT, name1=self._spec.joints[joint].name)
        reference = float(self._spec.joints[joint].ref)
        equality.data[0] = where - reference

    def _has_ground(self, model: Any, root: int) -> bool:
        """Whether the world has a shape that a shape of the robot touches."""
        world = np.flatnonzero(model.body_weldid[model.geom_bodyid] == 0)
        robot = [geom for geom in range(model.ngeom) if is_below(model, int(model.geom_bodyid[geom]), root)]
        types, affinities = model.geom_contype, model.geom_conaffinity
        touches = (types[world][:, None] & affinities[robot]) | (affinities[world][:, None] & types[robot])
        pairs = {int(geom) for pair in (model.pair_geom1, model.pair_geom2) for geom in pair}
        return bool(touches.any()) or any(geom in pairs for geom in world.tolist())

    def _add_ground(self, model: Any, root: int) -> None:
        robot = [geom for geom in range(model.ngeom) if is_below(model, int(model.geom_bodyid[geom]), root)]
        types = int(np.bitwise_or.reduce(model.geom_contype[robot], initial=0))
        affinities = int(np.bitwise_or.reduce(model.geom_conaffinity[robot], initial=0))
        if not types | affinities:
            raise _core.ConfigError(
                f"{self.file}: no shape of {self.root} touches anything: every geom has contype and conaffinity 0, or "
                "its mesh is missing; give its feet shapes that touch"
            )
        ground = self._spec.worldbody.add_geom(type=self._mj.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
        ground.contype, ground.conaffinity = affinities or types, types or affinities
        self.notes.append("the world has no ground: a plane with friction 1 is added")

    def _set_options(self) -> None:
        model, choices, mj = self.model, self.choices, self._mj
        if choices.dt is not None:
            model.opt.timestep = choices.dt
        if choices.integrator is not None:
            model.opt.integrator = int(getattr(mj.mjtIntegrator, f"mjINT_{choices.integrator.upper()}"))
        if not 1e-5 <= float(model.opt.timestep) <= 0.1:
            raise _core.ConfigError(
                f"{self.file}: its timestep {model.opt.timestep} must be from 1e-5 to 0.1 s; pass --dt"
            )

    def _set_actuators(self) -> None:
        model, actuators = self.model, self.robot.actuators
        for actuator in self._silent:
            model.actuator_gaintype[actuator] = int(self._mj.mjtGain.mjGAIN_FIXED)
            model.actuator_biastype[actuator] = int(self._mj.mjtBias.mjBIAS_NONE)
            model.actuator_gainprm[actuator] = 0.0
            model.actuator_biasprm[actuator] = 0.0
        added = iter(range(self._first_added, model.nu))
        self.actuators = np.array([next(added) if own is None else own for own in self._own], dtype=np.intp)
        """Actuator that follows the targets of each joint, [joints]."""
        self.is_policys = np.array([own is None for own in self._own])
        """Whether that actuator is one of the policy, [joints]."""
        self.gears = model.actuator_gear[self.actuators, 0].copy()
        policys = self.joints[self.is_policys]
        model.jnt_actfrclimited[policys] = 0
        model.actuator_forcelimited[self.actuators[self.is_policys]] = 1
        if self.choices.actuators == "motors":
            model.dof_armature[self.v[6:]] = actuators.armature
        for index, own in enumerate(self._own):
            if own is None or self._kinds[own] != "motor":
                continue
            gear, gain = float(self.gears[index]), float(model.actuator_gainprm[own, 0])
            low, high = -np.inf, np.inf
            if model.actuator_forcelimited[own]:
                low, high = model.actuator_forcerange[own]
            if model.actuator_ctrllimited[own]:
                ends = gain * model.actuator_ctrlrange[own]
                low, high = max(low, ends.min()), min(high, ends.max())
            model.actuator_ctrllimited[own] = 0
            model.actuator_gainprm[own, 0] = actuators.stiffness[index] / gear**2
            model.actuator_biastype[own] = int(self._mj.mjtBias.mjBIAS_AFFINE)
            model.actuator_biasprm[own, :3] = [
                0.0,
                -actuators.stiffness[index] / gear**2,
                -actuators.damping[index] / gear**2,
            ]
            if np.isfinite([low, high]).all():
                model.actuator_forcelimited[own] = 1
                model.actuator_forcerange[own] = [low, high]

    def _set_step(self) -> None:
        """Shortens the file's step where the policy's damping would shake light joints.

        An explicit integrator doubles a joint's speed where step, damping and the inverse of its
        inertia multiply to more than 2; some files leave a program to add the inertia of rotors.
        """
        model, mj = self.model, self._mj
        implicit = (int(mj.mjtIntegrator.mjINT_IMPLICIT), int(mj.mjtIntegrator.mjINT_IMPLICITFAST))
        is_ours = self.is_policys | np.array([own is not None and self._kinds[own] == "motor" for own in self._own])
        if self.choices.dt is not None or int(model.opt.integrator) in implicit or not is_ours.any():
            return
        rate = damping_rate(model, self.v[6:][is_ours], self.robot.actuators.damping[is_ours])
        parts = int(np.ceil(self.dt * rate / STABLE))
        if parts > 1:
            model.opt.timestep = self.dt / parts
            self.notes.append(
                f"the policy's damping would shake light joints in the file's steps of {self.dt * parts:g} s: they are "
                f"{self.dt:.3g} s; --dt gives others"
            )

    def effort_ranges(self) -> Array:
        """Least and most force of the model's own actuators, [joints, 2].

        Infinite without limits.
        """
        model = self.model
        ranges = np.tile([-np.inf, np.inf], (len(self.joints), 1))
        limited = model.actuator_forcelimited[self.actuators].astype(bool)
        ranges[limited] = model.actuator_forcerange[self.actuators][limited]
        by_joint = model.jnt_actfrclimited[self.joints].astype(bool)
        scaled = model.jnt_actfrcrange[self.joints] / np.abs(self.gears)[:, None]
        ranges[by_joint, 0] = np.maximum(ranges[by_joint, 0], scaled[by_joint, 0])
        ranges[by_joint, 1] = np.minimum(ranges[by_joint, 1], scaled[by_joint, 1])
        return ranges

    def _set_contacts(self) -> None:
        model, choices, mj = self.model, self.choices, self._mj
        if choices.contact == "stiff":
            reference = [2.0 * float(model.opt.timestep), 1.0]
            model.geom_solref[:], model.geom_solimp[:] = reference, [0.99, 0.999, 0.001, 0.5, 2.0]
            model.pair_solref[:], model.pair_solimp[:] = reference, [0.99, 0.999, 0.001, 0.5, 2.0]
            model.opt.cone = int(mj.mjtCone.mjCONE_ELLIPTIC)
            model.opt.impratio = 100.0
        elif choices.contact == "condim3":
            model.geom_condim[:] = np.minimum(model.geom_condim, 3)
            model.pair_dim[:] = np.minimum(model.pair_dim, 3)
        if choices.friction is not None:
            model.geom_friction[:, 0] = choices.friction
            model.pair_friction[:, :2] = choices.friction

    def _ground(self) -> Heights | None:
        """Heights of the ground; None for the plane at height zero."""
        mj, model = self._mj, self.model
        touch = self.is_static & ((model.geom_contype | model.geom_conaffinity) != 0)
        shapes = np.flatnonzero(touch)
        data = mj.MjData(model)
        mj.mj_kinematics(model, data)
        is_plane = [
            int(model.geom_type[geom]) == int(mj.mjtGeom.mjGEOM_PLANE)
            and abs(data.geom_xpos[geom, 2]) < _LEVEL
            and data.geom_xmat[geom, 8] > 1.0 - _LEVEL
            for geom in shapes
        ]
        if all(is_plane):
            return None
        seen = copy.copy(model)
        seen.geom_group[:] = np.where(touch, 5, 0)
        groups = np.array([0, 0, 0, 0, 0, 1], dtype=np.uint8)
        hit, down = np.zeros(1, dtype=np.int32), np.array([0.0, 0.0, -1.0])
        count = round(2.0 * REACH / CELL) + 1
        heights = np.zeros((count, count), dtype=np.float32)
        for i, j in np.ndindex(count, count):
            above = np.array([i * CELL - REACH, j * CELL - REACH, HIGH])
            distance = mj.mj_ray(seen, data, above, down, groups, 1, -1, hit, None)
            heights[i, j] = HIGH - distance if distance >= 0.0 else -HIGH
        if heights.min() <= -HIGH:
            known = heights[heights > -HIGH]
            if not len(known):
                raise _core.ConfigError(f"{self.file}: there is no ground below the world's origin; add a plane")
            heights[heights <= -HIGH] = known.min()
        return Heights(heights, (-REACH, -REACH), CELL)

    @property
    def dt(self) -> float:
        """Physics step, s."""
        return float(self.model.opt.timestep)

    @property
    def integrator(self) -> str:
        """Name of MuJoCo's integrator."""
        return str(self._mj.mjtIntegrator(int(self.model.opt.integrator)).name).removeprefix("mjINT_")

    def base_geoms(self, clusters: Sequence[int]) -> npt.NDArray[np.bool_]:
        """Whether geoms belong to these clusters and touch, [geoms]."""
        model = self.model
        of = self.skeleton.clusters[model.geom_bodyid]
        touch = (model.geom_contype | model.geom_conaffinity) != 0
        return np.isin(of, list(clusters)) & touch

    def data_of(self, qpos: Array) -> Any:
        """MuJoCo's data of a state of polypod's, with its kinematics."""
        data = self._mj.MjData(self.model)
        write(self, data, np.zeros(3), qpos, np.zeros(len(self.v)))
        self._mj.mj_kinematics(self.model, data)
        return data


def _kind(mj: Any, model: Any, actuator: int) -> str:
    """Input of an actuator of a joint: `position`, `motor` (a torque) or `other`."""
    if int(model.actuator_gaintype[actuator]) != int(mj.mjtGain.mjGAIN_FIXED):
        return "other"
    dynamics = int(model.actuator_dyntype[actuator])
    filters = (int(mj.mjtDyn.mjDYN_FILTER), int(mj.mjtDyn.mjDYN_FILTEREXACT))
    gain, bias = float(model.actuator_gainprm[actuator, 0]), model.actuator_biasprm[actuator, :3]
    bias_type = int(model.actuator_biastype[actuator])
    if bias_type == int(mj.mjtBias.mjBIAS_NONE) and dynamics == int(mj.mjtDyn.mjDYN_NONE) and gain != 0.0:
        return "motor"
    is_affine = bias_type == int(mj.mjtBias.mjBIAS_AFFINE)
    follows = is_affine and gain > 0.0 and abs(bias[1] + gain) <= 1e-9 * gain
    if follows and (dynamics == int(mj.mjtDyn.mjDYN_NONE) or dynamics in filters):
        return "position"
    return "other"


def lowest(model: Any, data: Any, geoms: npt.NDArray[np.intp]) -> float:
    """Height of the lowest point of these shapes, m; infinite without any."""
    mj = mujoco()
    kinds = mj.mjtGeom
    least = np.inf
    for geom in geoms.tolist():
        kind, size = int(model.geom_type[geom]), model.geom_size[geom]
        up, height = data.geom_xmat[geom].reshape(3, 3)[2], float(data.geom_xpos[geom, 2])
        if kind == int(kinds.mjGEOM_SPHERE):
            reach = size[0]
        elif kind == int(kinds.mjGEOM_CAPSULE):
            reach = size[0] + size[1] * abs(up[2])
        elif kind == int(kinds.mjGEOM_CYLINDER):
            reach = size[1] * abs(up[2]) + size[0] * np.sqrt(max(0.0, 1.0 - up[2] ** 2))
        elif kind == int(kinds.mjGEOM_BOX):
            reach = float(np.abs(up) @ size)
        elif kind == int(kinds.mjGEOM_ELLIPSOID):
            reach = float(np.linalg.norm(up * size))
        elif kind == int(kinds.mjGEOM_MESH):
            mesh = int(model.geom_dataid[geom])
            start = int(model.mesh_vertadr[mesh])
            vertices = model.mesh_vert[start : start + int(model.mesh_vertnum[mesh])]
            reach = -float((vertices @ up).min())
        else:
            box = model.geom_aabb[geom]
            reach = float(np.abs(up) @ box[3:] - up @ box[:3])
        least = min(least, height - float(reach))
    return float(least)


def write(body: Model, data: Any, place: Array, qpos: Array, qvel: Array) -> None:
    """Puts the model into a state of polypod's."""
    turn, shift = body.map.turn, body.map.shift
    joints = body.map.signs * (qpos[7:] - body.map.offsets)
    velocities = body.map.signs * qvel[6:]
    base, motion = qpos[:7].copy(), qvel[:6].copy()
    if not body.map.is_equal:
        rotation = rotations.matrix(qpos[3:7])
        base[:3] = qpos[:3] + rotation @ shift
        base[3:] = mapping.times(qpos[3:7], mapping.quaternion_of(turn))
        motion[:3] = qvel[:3] + np.cross(rotation @ qvel[3:6], rotation @ shift)
        motion[3:] = turn.T @ qvel[3:6]
    data.qpos[body.q] = np.concatenate([base, joints])
    data.qvel[body.v] = np.concatenate([motion, velocities])
    data.qpos[body.q[:3]] += place


class Maker(Driven):
    """`num_envs` robots of a maker's model, each in a separate world."""

    reference: Model

    def __init__(self, model: Model, base: Sequence[int], drive: Drive) -> None:
        """Makes the states.

        Args:
            model: of the file.
            base: clusters that must not touch the ground.
            drive: the policy, and how it drives; ground and gravity are the file's, and delays are
                of the policy's actuators alone.
        """
        is_base = model.base_geoms(base)
        if not is_base.any():
            least_height = max(drive.least_height, SUNK * model.robot.base_height)
            drive = dataclasses.replace(drive, least_height=least_height, most_tilt=min(drive.most_tilt, TILT))
            model.notes.append(
                f"no shape of {model.root} touches: a fall is a tilt above {TILT:g} rad or a base below {SUNK:.0%} of "
                "its height"
            )
        drive = dataclasses.replace(
            drive,
            delays=np.where(model.is_policys, drive.delays, 0.0),
            network_torques=drive.network_torques if model.is_policys.all() else None,
            heights=model.heights,
            places=None,
            gravity=tuple(model.model.opt.gravity),
        )
        super().__init__(model, model.robot, is_base, float(model.model.opt.timestep), drive)
        self._signs, self._offsets = model.map.signs, model.map.offsets
        self.base_axes = model.map.turn.T
        self._own_range = model.effort_ranges()
        self._policys = model.actuators[model.is_policys]
        self._force = [data.actuator_force for data in self._data]
        self.saturated = np.zeros((self.num_envs, model.robot.num_joints))
        """Physics steps in which the actuator was at its limit, since this was set to zero, [envs,
        joints]."""
        self.watched = np.zeros(self.num_envs)
        """Physics steps since `saturated` was set to zero, [envs]."""

    def _inputs(self, targets: Array, ranges: Array) -> tuple[Array, Array]:
        efforts = np.sort(self._signs[:, None] * ranges, axis=2)[:, self.reference.is_policys]
        return self.reference.gears * (self._signs * (targets - self._offsets)), efforts

    def _drive(self, data: Any, control: Array, forces: Array) -> None:
        if len(self._policys):
            self.reference.model.actuator_forcerange[self._policys] = forces
        data.ctrl[self.reference.actuators] = control

    def _push_joints(self, data: Any, effort: Array) -> None:
        data.qfrc_applied[self.reference.v[6:]] = self._signs * effort

    def _watch(self, envs: Sequence[int], ranges: Array) -> None:
        if not len(envs):
            return
        body = self.reference
        force = np.array([self._force[env] for env in envs])[:, body.actuators]
        efforts = np.sort(self._signs[:, None] * ranges[envs], axis=2)
        limits = np.where(body.is_policys[:, None], efforts, self._own_range)
        slack = 1e-3 * (limits[..., 1] - limits[..., 0])
        at_limit = (force <= limits[..., 0] + slack) | (force >= limits[..., 1] - slack)
        self.saturated[envs] += at_limit & np.isfinite(slack)
        self.watched[envs] += 1

    def _contacts_of_base(self, data: Any) -> npt.NDArray[np.intp]:
        geoms = data.contact.geom
        of_base = self._is_base[geoms]
        if not of_base.any():
            return np.zeros(0, dtype=np.intp)
        static = self.reference.is_static[geoms]
        return np.flatnonzero((of_base & static[:, ::-1]).any(axis=1))

    def _write(self, data: Any, place: Array, qpos: Array, qvel: Array) -> None:
        write(self.reference, data, place, qpos, qvel)
        for actuator, rest in self.reference.resting.items():
            data.ctrl[actuator] = rest

    def _states(self, envs: Sequence[int]) -> tuple[Array, Array]:
        body = self.reference
        qpos, qvel = super()._states(envs)
        if not body.map.is_equal:
            turn, shift = body.map.turn, body.map.shift
            for q, v in zip(qpos, qvel, strict=True):
                q[3:7] = mapping.times(q[3:7], mapping.quaternion_of(turn.T))
                rotation = rotations.matrix(q[3:7])
                q[:3] -= rotation @ shift
                v[3:6] = turn @ v[3:6]
                v[:3] -= np.cross(rotation @ v[3:6], rotation @ shift)
        qpos[:, 7:] = self._signs * qpos[:, 7:] + self._offsets
        qvel[:, 6:] *= self._signs
        return qpos, qvel


def clusters_of(groups: Sequence[str], ours: Reference, outlines: Sequence[Any], joints: Sequence[int]) -> list[int]:
    """Clusters of polypod's robot that have bodies of these groups, `BASE` among them."""
    model = ours.model
    of = skeleton(model, model.body(ours.root).id, joints).clusters
    names = [body["name"] for body in outlines if body["group"] in groups]
    found = {int(of[model.body(name).id]) for name in names}
    return sorted(found | {BASE})
