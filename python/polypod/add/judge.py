"""Whether a robot in polypod moves as MuJoCo's model of the file that it comes from.

Compared at random states: masses, joint limits, mass matrix, bias forces, accelerations under
random torques, and one physics step with the joints' damping, springs and dry friction. Features
that polypod leaves out are switched off in MuJoCo's model: contacts, equality constraints, tendons,
the medium, and resistance and spring of the free joint. Joints that polypod holds carry an infinite
rotor there.
"""

import copy
import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import polypod
from polypod import _core
from polypod.add.compiling import matrix, mujoco
from polypod.add.description import Description
from polypod.arrays import Array
from polypod.compat import tomllib

BOUNDS = {"float64": 1e-6, "float32": 1e-4}
"""Largest relative error of each precision."""
HEAVY = 1e12
"""Armature of a joint that is held, kg m^2."""
DT = 1e-5
"""Physics step of the comparison, s: so short that no joint turns round or reaches a limit in
it."""
FASTEST = 5.0
"""Largest speed of a joint, rad/s or m/s."""
MARGIN = 0.05
"""Distance of the drawn positions from the joints' limits, as a share of the range."""
PUSH = 200.0
"""Acceleration of a joint alone under the largest torque that is drawn, rad/s^2 or m/s^2."""


@dataclasses.dataclass(frozen=True)
class Errors:
    """Relative errors, the worst of all states.

    The largest difference over the largest entry of MuJoCo's.
    """

    total_mass: float
    center_of_mass: float
    """Distance over the robot's size."""
    joint_limits: float
    """Largest difference, rad or m."""
    mass_matrix: float
    bias_force: float
    forward_dynamics: float
    physics_step: float
    """Error of the velocity change in one step with damping, springs and dry friction; over the
    velocity in float32."""

    def worst(self) -> float:
        """The largest of the errors."""
        return max(dataclasses.astuple(self))


def compare(
    robot: Path | str,
    description: Description,
    model: Any,
    base: int,
    *,
    dtype: str = "float64",
    states: int = 8,
    seed: int = 0,
    speed_limits: Sequence[float] | None = None,
    narrowed: Sequence[Sequence[float]] | None = None,
) -> Errors:
    """Compares a robot with MuJoCo's model of its file.

    Args:
        robot: the robot's TOML, or its name.
        description: what was written down.
        model: MuJoCo's; it is not changed.
        base: the base's body in it.
        dtype: precision of polypod's side.
        states: random states.
        seed: of the states.
        speed_limits: of the actuators, rad/s or m/s; None: those of the TOML.
        narrowed: position limits that the config states in the place of the file's; None: those of
            the TOML.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sim = polypod.Simulation(robot, states, ground=None, dtype=dtype, self_collision=False, threads=1, dt=DT)
    theirs = _Reference(description, copy.copy(model), base, list(sim.joint_names), str(sim.link_names[0]))
    rng = np.random.default_rng(seed)
    joints = sim.num_joints
    lower, upper = np.clip(sim.joint_range, -np.pi, np.pi).T
    inset = MARGIN * (upper - lower)
    quaternion = rng.standard_normal((states, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    qpos = np.hstack(
        [rng.uniform(-1.0, 1.0, (states, 3)), quaternion, rng.uniform(lower + inset, upper - inset, (states, joints))]
    )
    limits = _speed_limits(Path(robot)) if speed_limits is None else speed_limits
    if narrowed is None:
        config = tomllib.loads(Path(robot).read_text(encoding="utf-8"))
        narrowed = list(config.get("joint_limits", {}).values())
    fastest = min([FASTEST, *(0.9 * limit for limit in limits)])
    speeds = rng.uniform(0.4 * fastest, fastest, (states, joints)) * rng.choice([-1.0, 1.0], (states, joints))
    qvel = np.hstack([rng.uniform(-1.0, 1.0, (states, 3)), rng.uniform(-3.0, 3.0, (states, 3)), speeds])
    sim.set_state(qpos, qvel)
    alone = np.diagonal(sim.mass_matrix(), axis1=1, axis2=2)[:, 6:]
    torque = rng.uniform(-1.0, 1.0, (states, joints)) * np.minimum(sim.effort_limit, PUSH * alone)
    ours: dict[str, Array] = {
        "center_of_mass": sim.center_of_mass(),
        "mass_matrix": sim.mass_matrix(),
        "bias_force": sim.bias_force(),
        "forward_dynamics": sim.forward_dynamics(torque),
    }
    before = sim.qvel
    sim.step(torque=torque)
    ours["physics_step"] = sim.qvel - before
    errors = dict.fromkeys(ours, 0.0)
    for state in range(states):
        for name, value in theirs.at(qpos[state], qvel[state], torque[state]).items():
            scale = float(np.abs(value).max())
            if name == "center_of_mass":
                scale = theirs.size
            elif name == "physics_step" and dtype == "float32":
                scale = float(np.abs(qvel[state]).max())
            error = float(np.abs(ours[name][state] - value).max()) / scale
            errors[name] = max(errors[name], error)
    mass = float(model.body_subtreemass[base])
    return Errors(
        total_mass=abs(sim.total_mass - mass) / mass, joint_limits=theirs.limits(sim.joint_range, narrowed), **errors
    )


def _speed_limits(robot: Path) -> list[float]:
    """Speed limits of the actuators of a robot's TOML, rad/s or m/s."""
    groups = tomllib.loads(robot.read_text(encoding="utf-8"))["actuators"].values()
    return [float(group["velocity_limit"]) for group in groups if group.get("velocity_limit", 0.0) > 0.0]


def base_link(robot: Path) -> str:
    """The link that is the base of the robot of a TOML."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return str(polypod.Simulation(robot, ground=None, threads=1).link_names[0])


class _Reference:
    """MuJoCo's model, in polypod's order of joints and about polypod's base."""

    def __init__(self, description: Description, model: Any, base: int, joints: list[str], link: str) -> None:
        self.mj = mujoco()
        self.model, self.base = model, base
        self.data = self.mj.MjData(model)
        by_name = {joint.name: joint for joint in description.joints}
        self.joints = [by_name[name] for name in joints]
        free = int(model.body_jntadr[base])
        q, v = int(model.jnt_qposadr[free]), int(model.jnt_dofadr[free])
        self.q = [*range(q, q + 7), *(joint.q for joint in self.joints)]
        self.v = [*range(v, v + 6), *(joint.v for joint in self.joints)]
        self.at_base, self.turn_base = _place(description, link)
        self.rest = np.array(model.qpos0)
        moving = set(joints)
        for joint in description.joints:
            if joint.name not in moving:
                self.rest[joint.q] = description.held.get(joint.name, joint.home)
        self._switch_off()
        self.size = max(float(model.stat.extent), 1e-3)

    def _switch_off(self) -> None:
        model, bit = self.model, self.mj.mjtDisableBit
        for name in ("CONTACT", "EQUALITY", "LIMIT", "ACTUATION"):
            model.opt.disableflags |= int(getattr(bit, f"mjDSBL_{name}"))
        model.opt.disableflags &= ~int(bit.mjDSBL_GRAVITY) & ~int(bit.mjDSBL_FRICTIONLOSS) & ~int(bit.mjDSBL_CONSTRAINT)
        model.opt.gravity[:] = [0.0, 0.0, -_core.EARTH_GRAVITY]
        model.opt.density = model.opt.viscosity = 0.0
        model.opt.wind[:] = 0.0
        model.opt.timestep = DT
        model.opt.integrator = int(self.mj.mjtIntegrator.mjINT_IMPLICITFAST)
        model.opt.tolerance, model.opt.iterations = 0.0, 200
        model.opt.solver = int(self.mj.mjtSolver.mjSOL_NEWTON)
        model.body_gravcomp[:] = 0.0
        model.dof_armature[:] += self._without_tendons_armature()
        for name in (
            "tendon_stiffness",
            "tendon_damping",
            "tendon_frictionloss",
            "dof_dampingpoly",
            "jnt_stiffnesspoly",
        ):
            numbers = getattr(model, name, None)
            if numbers is not None:
                numbers[:] = 0.0
        for numbers in (model.dof_armature, model.dof_damping, model.dof_frictionloss):
            numbers[self.v[:6]] = 0.0
        model.jnt_stiffness[int(model.body_jntadr[self.base])] = 0.0
        # as near to Coulomb's as the step allows
        model.dof_solref[:] = [2.0 * DT, 1.0]
        model.dof_solimp[:] = [0.9999, 0.9999, 0.001, 0.5, 2.0]
        held = np.ones(model.nv, dtype=np.bool_)
        held[self.v] = False
        self._held = held
        self._armature = np.array(model.dof_armature)

    def _without_tendons_armature(self) -> Array:
        """Takes the armature of tendons off the model.

        Returns what fixed tendons have added to the mass matrix of each coordinate itself.
        """
        model, data = self.model, self.mj.MjData(self.model)
        joint, tendon = int(self.mj.mjtWrap.mjWRAP_JOINT), int(self.mj.mjtTrn.mjTRN_TENDON)
        spatial = np.array([int(model.wrap_type[at]) != joint for at in model.tendon_adr], dtype=np.bool_)
        on_tendons = np.asarray(model.actuator_trntype) == tendon
        on_spatial = on_tendons.copy()
        on_spatial[on_tendons] = spatial[model.actuator_trnid[on_tendons, 0]]

        def own(tendons: Any, actuators: Any) -> Array:
            for name, chosen in (("tendon_armature", tendons), ("actuator_armature", actuators)):
                if hasattr(model, name):
                    getattr(model, name)[chosen] = 0.0
            self.mj.mj_forward(model, data)
            full = np.zeros((model.nv, model.nv))
            for column, unit in zip(full, np.eye(model.nv), strict=True):
                self.mj.mj_mulM(model, data, column, unit)
            return np.diagonal(full).copy()

        if not model.ntendon:
            return np.zeros(model.nv)
        added: Array = own(spatial, on_spatial) - own(np.ones_like(spatial), on_tendons)
        if hasattr(model, "actuator_damping"):
            model.actuator_damping[on_tendons] = 0.0
        return np.maximum(added, 0.0)

    def limits(self, ours: Array, narrowed: Sequence[Sequence[float]]) -> float:
        """Largest difference of the joints' limits from the file's, as the config narrows them."""
        stated = [np.array(each) for lower, upper in narrowed for each in ((lower, upper), (-upper, -lower))]
        worst = 0.0
        for joint, bounds in zip(self.joints, ours, strict=True):
            index = int(np.flatnonzero(np.asarray(self.model.jnt_qposadr) == joint.q)[0])
            theirs = self.model.jnt_range[index] if self.model.jnt_limited[index] else np.array([-np.inf, np.inf])
            left = [np.array([max(theirs[0], low), min(theirs[1], high)]) for low, high in stated]
            worst = max(worst, min(_apart(bounds, each) for each in (theirs, *left)))
        return worst

    def at(self, qpos: Array, qvel: Array, torque: Array) -> dict[str, Array]:
        """MuJoCo's results in a state of polypod's."""
        mj, model, data = self.mj, self.model, self.data
        mj.mj_resetData(model, data)
        turn = matrix(qpos[3:7]) @ self.turn_base.T
        lever = turn @ self.at_base
        to_root = np.eye(len(self.v))
        # the base's velocity is that of a point of the root, and its angular velocity is in axes of
        # the base
        to_root[:3, 3:6] = _cross(lever) @ turn @ self.turn_base
        to_root[3:6, 3:6] = self.turn_base
        data.qpos[:] = self.rest
        quaternion = np.zeros(4)
        mj.mju_mat2Quat(quaternion, np.ascontiguousarray(turn).ravel())
        data.qpos[self.q] = [*(qpos[:3] - lever), *quaternion, *qpos[7:]]
        data.qvel[:] = 0.0
        data.qvel[self.v] = to_root @ qvel
        data.qfrc_applied[:] = 0.0
        data.qfrc_applied[self.v[6:]] = torque
        model.dof_armature[:] = self._armature
        mj.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        for column, unit in zip(full, np.eye(model.nv), strict=True):
            mj.mj_mulM(model, data, column, unit)
        inertia = to_root.T @ full[np.ix_(self.v, self.v)] @ to_root
        mine = np.array(data.qfrc_bias[self.v])
        # the map itself turns with the base
        drift = np.zeros(len(self.v))
        spin = turn @ self.turn_base @ qvel[3:6]
        drift[:3] = -np.cross(spin, np.cross(spin, lever))
        bias = to_root.T @ (mine + full[np.ix_(self.v, self.v)] @ drift)
        force = np.concatenate([np.zeros(6), torque])
        com = np.array(data.subtree_com[self.base])
        model.dof_armature[self._held] = HEAVY
        mj.mj_step(model, data)
        after = np.linalg.solve(to_root, data.qvel[self.v] - DT * drift)
        return {
            "center_of_mass": com,
            "mass_matrix": inertia,
            "bias_force": bias,
            "forward_dynamics": np.linalg.solve(inertia, force - bias),
            "physics_step": after - qvel,
        }


def _apart(bounds: Array, others: Array) -> float:
    """Largest difference of two pairs of limits; equal infinite ones are no difference."""
    return max(0.0 if one == other else abs(float(one - other)) for one, other in zip(bounds, others, strict=True))


def _place(description: Description, link: str) -> tuple[Array, Array]:
    """Position and axes of polypod's base in the root of the file."""
    names = [each.name for each in description.links]
    at, turn = np.zeros(3), np.eye(3)
    index = names.index(link)
    while index > 0:
        own = description.links[index]
        at, turn = own.at + own.turn @ at, own.turn @ turn
        index = own.parent
    return at, turn


def _cross(vector: Array) -> Array:
    """The matrix of w -> velocity of the root's origin under w, for a base `vector` from it."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
