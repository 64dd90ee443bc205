"""Envs of one robot in MuJoCo, driven like a real robot.

From its sensors through the exported policy.

Nothing of polypod's simulator is used but its description of the robot. Sensors, actuators and
terminations are computed here from MuJoCo's state. The model comes from `polypod.sim2sim.twin` or
from `polypod.sim2sim.maker`.

- Delays and the limits of effort of the policy's actuators (the torque-speed line of DC motors,
  tables over the joint angle) are applied here, in every physics step.
- Where a network gives the torque, it is evaluated as polypod does it, at the task's physics step,
  and limited here.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from polypod import _core, rotations
from polypod.arrays import Array, Floats
from polypod.export.robot import RobotInterface
from polypod.mujoco_model.reference import GRAVITY, Heights, mujoco, states
from polypod.mujoco_model.robot import Robot

FALL_FORCE = 1.0
"""Normal force on a shape of the base from which a robot has fallen, N: the task's own
threshold."""


NetworkTorques = Callable[[Floats, Floats, Floats | None], tuple[Floats, Floats]]
"""`VecSim.network_torques` of a robot: from errors, velocities and memory to torques and memory."""


class FoldedPolicy(Protocol):
    """A policy folded for a robot, such as `OnnxPolicy`."""

    @property
    def inputs(self) -> Mapping[str, int]:
        """Names and sizes of the inputs."""

    def __call__(self, **inputs: npt.ArrayLike) -> dict[str, Floats]:
        """Outputs for inputs [envs, size]."""

    def reset(self) -> None:
        """Forgets what all envs have seen."""


@dataclasses.dataclass(frozen=True)
class Observed:
    """Motion and falls of one control step, per env."""

    velocity: Array
    """Velocity of the base's centre of mass, base axes, m/s, [envs, 2]."""
    yaw_rate: Array
    """Yaw rate of the base, rad/s, [envs]."""
    fell: npt.NDArray[np.bool_]
    """Whether robots fell in this control step, [envs]."""


class Body(Protocol):
    """A compiled model of a robot, and where the robot's numbers are in it."""

    model: Any
    """`mujoco.MjModel`."""
    root: str
    """Name of the base's body."""
    q: npt.NDArray[np.intp]
    """Places of polypod's positions (base, then joints) in those of the model."""
    v: npt.NDArray[np.intp]
    """Places of polypod's velocities in those of the model."""


@dataclasses.dataclass(frozen=True)
class Drive:
    """A policy that drives a robot, and when it has fallen, on any model of the robot."""

    interface: RobotInterface
    """Interface between policy and robot."""
    policy: FoldedPolicy
    """Folded for the robot."""
    step_dt: float
    """Control step, s."""
    physics_dt: float
    """The physics step that delays are counted in, s."""
    delays: Array
    """Delays of the targets, physics steps, [envs, joints]."""
    network_torques: NetworkTorques | None = None
    """Torques of the robot's actuator networks, one physics step of `physics_dt` after the
    other."""
    heights: Heights | None = None
    """Heights of the ground; None: a plane."""
    places: Array | None = None
    """Places of the envs' origins on it, m, [envs, 3]; None: the world's origin."""
    gravity: tuple[float, float, float] = (0.0, 0.0, -GRAVITY)
    """Gravity, m/s^2, world axes."""
    least_height: float = -np.inf
    """See `Driven.base_height`; a base that is lower has fallen, m."""
    most_tilt: float = np.pi
    """Tilt of the base's z axis from the direction against gravity; one that is farther has fallen,
    rad."""


class Driven:
    """`num_envs` robots of one kind, each in a separate world."""

    def __init__(self, reference: Body, robot: Robot, is_base: npt.NDArray[np.bool_], dt: float, drive: Drive) -> None:
        """Makes the states.

        Args:
            reference: the model.
            robot: URDF and actuators.
            is_base: [geoms of the model], which must not touch the ground: those of base and torso,
                and what else ends episodes.
            dt: MuJoCo's physics step, s.
            drive: the policy, and how it drives.
        """
        self.reference = reference
        free_fall = float(np.linalg.norm(drive.gravity))
        self._down = np.array(drive.gravity) / (free_fall or 1.0)
        self.robot, self.interface, self.policy = robot, drive.interface, drive.policy
        self.step_dt, self.physics_dt = drive.step_dt, drive.physics_dt
        self.substeps = round(self.step_dt / dt)
        self.delays = drive.delays * self.physics_dt
        self.num_envs = len(self.delays)
        self.heights = drive.heights
        self.least_height, self.least_upright = drive.least_height, np.cos(drive.most_tilt)
        self.places = np.zeros((self.num_envs, 3)) if drive.places is None else drive.places
        self._network_torques = drive.network_torques if robot.actuators.networks.any() else None
        self._network_memory: Floats | None = None
        self._network_output = np.zeros((self.num_envs, robot.num_joints), dtype=np.float32)
        self._mj = mujoco()
        self._is_base = is_base
        self._data = states(reference.model, self.num_envs, "--num-envs")
        # views of their memory
        self._qpos, self._qvel = [data.qpos for data in self._data], [data.qvel for data in self._data]
        self._wrench = np.zeros(6)
        ages = 1 + int(np.ceil(self.delays.max(initial=0.0) / self.step_dt - 1e-9))
        self._targets = np.zeros((ages, self.num_envs, robot.num_joints))
        self._fresh = True
        self.actions = np.zeros((self.num_envs, self.interface.num_actions), dtype=np.float32)
        self.qpos = np.zeros((self.num_envs, 7 + robot.num_joints))
        """Positions in polypod's order of joints, about the envs' origins."""
        self.qvel = np.zeros((self.num_envs, 6 + robot.num_joints))
        self.base_axes: Array = np.eye(3)
        """Matrix that turns vectors of polypod's base frame into that of the model's base, [3,
        3]."""

    def reset(self, qpos: Array, qvel: Array) -> None:
        """Begins in these states, [envs, nq] and [envs, nv]."""
        for data, place, q, v in zip(self._data, self.places, qpos, qvel, strict=True):
            self._mj.mj_resetData(self.reference.model, data)
            self._write(data, place, q, v)
            self._mj.mj_forward(self.reference.model, data)
        self.actions[:] = 0.0
        self.policy.reset()
        self._network_memory = None
        self._fresh = True
        self._read(range(self.num_envs))

    def step(self, commands: npt.NDArray[np.float32], active: npt.NDArray[np.bool_]) -> Observed:
        """One control step towards `commands` [envs, 3].

        Envs that are not `active` are left alone.
        """
        given = self.sensors() | {"velocity_commands": commands}
        if unknown := [name for name in self.policy.inputs if name not in given]:
            raise _core.ConfigError(
                f"the policy takes {', '.join(unknown)}, which no sensor gives in MuJoCo; state the source of the term "
                "where it is registered, or add the sensor to polypod.sim2sim.twin"
            )
        outputs = self.policy(**{name: given[name] for name in self.policy.inputs})
        targets = outputs["joint_pos_target"]
        if not np.isfinite(targets[active]).all():
            row, joint = np.argwhere(~np.isfinite(targets) & active[:, None])[0]
            raise _core.ConfigError(
                f"the policy gives {targets[row, joint]} as target of {self.interface.joint_names[joint]}; it has "
                "diverged: use an earlier checkpoint"
            )
        self.actions = outputs["actions"]
        self._targets = np.roll(self._targets, 1, axis=0)
        self._targets[0] = outputs["joint_pos_target"]
        if self._fresh:
            self._targets[:] = self._targets[0]
            self._fresh = False
        fell = np.zeros(self.num_envs, dtype=np.bool_)
        envs = np.flatnonzero(active)
        for substep in range(self.substeps):
            self._physics_step(substep, envs, fell)
        # as the task's terminations, once in a control step
        fell[envs] |= (self.base_height() < self.least_height)[envs]
        if self._down.any():
            fell[envs] |= (-self.projected_gravity()[:, 2] < self.least_upright)[envs]
        velocity, rate = self.base_velocity()
        return Observed(velocity[:, :2] + (rate @ self.interface.lever())[:, :2], rate[:, 2], fell)

    def refresh(self) -> None:
        """Recomputes the constants that MuJoCo derives from the model, after a change of it."""
        model = self.reference.model
        self._mj.mj_setConst(model, self._mj.MjData(model))

    def push(self, velocity: npt.NDArray[np.float32]) -> None:
        """Adds velocities [envs, 3] to the bases, world axes, m/s."""
        for env, (data, added) in enumerate(zip(self._data, velocity, strict=True)):
            data.qvel[self.reference.v[:3]] += added
            self._read([env])

    def sensors(self) -> dict[str, Array]:
        """Readings of the robot's sensors, named as the folded graph's inputs, [envs, size]."""
        velocity, rate = self.base_velocity()
        return {
            "base_lin_vel": velocity,
            "base_ang_vel": rate,
            "projected_gravity": self.projected_gravity(),
            "joint_pos": self.qpos[:, 7:],
            "joint_vel": self.qvel[:, 6:],
            "last_action": self.actions.astype(np.float64),
            "height_scan": self.height_scan(),
        }

    def projected_gravity(self) -> Array:
        """Unit vector of gravity, base axes, [envs, 3]; zeros without gravity."""
        return np.einsum("eji,j->ei", rotations.matrix(self.qpos[:, 3:7]), self._down)

    def base_height(self) -> Array:
        """Heights of the base's origin above the ground below it, m, [envs].

        Where the task has a height scanner: above the mean of the ground below its rays, as
        `State.base_height`.
        """
        if len(self.interface.scan_points):
            return self.height_scan().mean(axis=1)
        at = self.qpos[:, :3] + self.places
        ground = 0.0 if self.heights is None else self.heights.at(at[:, None, :2])[:, 0]
        return at[:, 2] - ground

    def height_scan(self) -> Array:
        """Height of the base's origin above the scanned points of the ground, m, [envs, rays]."""
        heading = rotations.heading(self.qpos[:, 3:7])
        (cos, sin), points = (np.cos(heading)[:, None], np.sin(heading)[:, None]), self.interface.scan_points
        x, y = cos * points[:, 0] - sin * points[:, 1], sin * points[:, 0] + cos * points[:, 1]
        at = self.qpos[:, :3] + self.places
        below = np.stack([at[:, :1] + x, at[:, 1:2] + y], axis=-1)
        ground = np.zeros_like(x) if self.heights is None else self.heights.at(below)
        return at[:, 2:] - ground

    def base_velocity(self) -> tuple[Array, Array]:
        """Velocity of the base's origin, m/s, and angular velocity, rad/s, [envs, 3], base axes."""
        velocity = np.einsum("eji,ej->ei", rotations.matrix(self.qpos[:, 3:7]), self.qvel[:, :3])
        return velocity, self.qvel[:, 3:6]

    def joint_effort(self) -> Array:
        """Actuators' efforts in the last physics step, N m, [envs, joints]; 0 after a reset."""
        if self._fresh:
            return np.zeros((self.num_envs, self.robot.num_joints))
        joints = self.reference.v[6:]
        return np.stack([data.qfrc_actuator[joints] + data.qfrc_applied[joints] for data in self._data])

    def _physics_step(self, substep: int, envs: npt.NDArray[np.intp], fell: npt.NDArray[np.bool_]) -> None:
        model = self.reference.model
        since = substep * self.step_dt / self.substeps
        # a target that is late by less than the time since it was given is seen
        age = np.ceil(np.maximum(self.delays - since, 0.0) / self.step_dt - 1e-9).astype(np.intp)
        targets = np.take_along_axis(self._targets, age[None], axis=0)[0]
        ranges = self.robot.actuators.effort_range(self.qpos[:, 7:], self.qvel[:, 6:])
        # in MuJoCo's smaller steps the torque of a network is held
        before = (substep - 1) * self.step_dt / self.substeps
        is_due = substep == 0 or int(since / self.physics_dt + 1e-6) > int(before / self.physics_dt + 1e-6)
        if self._network_torques is not None and is_due:
            error = (targets - self.qpos[:, 7:]).astype(np.float32)
            velocity = self.qvel[:, 6:].astype(np.float32)
            self._network_output, self._network_memory = self._network_torques(error, velocity, self._network_memory)
        rows: list[int] = envs.tolist()
        inputs = self._inputs(targets, ranges)
        for env in rows:
            data = self._data[env]
            self._drive(data, *(each[env] for each in inputs))
            if self._network_torques is not None:
                self._push_joints(data, np.clip(self._network_output[env], *ranges[env].T))
            self._mj.mj_step(model, data)
            fell[env] |= self._touches_with_base(data)
        self._read(rows)
        self._watch(rows, ranges)
        # a state that is not finite is a fall
        fell |= ~np.isfinite(self.qpos).all(axis=1)

    def _inputs(self, targets: Array, ranges: Array) -> tuple[Array, Array]:
        """Controls [envs, joints] and ranges of force [envs, joints, 2] of the actuators.

        Args:
            targets: [envs, joints], rad.
            ranges: of effort, [envs, joints, 2], N m.
        """
        return targets, ranges

    def _drive(self, data: Any, control: Array, forces: Array) -> None:
        """Sets the controls [joints] and ranges of force [joints, 2] of an env's actuators."""
        self.reference.model.actuator_forcerange[:] = forces
        data.ctrl[:] = control

    def _push_joints(self, data: Any, effort: Array) -> None:
        """Applies efforts [joints] to the joints of an env, N m."""
        data.qfrc_applied[self.reference.v[6:]] = effort

    def _watch(self, envs: Sequence[int], ranges: Array) -> None:
        """Sees envs after a physics step, with their ranges of effort [envs, joints, 2]."""

    def _touches_with_base(self, data: Any) -> bool:
        """Whether the base pressed on the ground in the last physics step."""
        contacts = self._contacts_of_base(data) if data.ncon else ()
        for index in contacts:
            self._mj.mj_contactForce(self.reference.model, data, index, self._wrench)
            if self._wrench[0] > FALL_FORCE:
                return True
        return False

    def _contacts_of_base(self, data: Any) -> npt.NDArray[np.intp]:
        """Indices of the contacts between the base and the ground."""
        return np.flatnonzero(self._is_base[data.contact.geom].any(axis=1))

    def _write(self, data: Any, place: Array, qpos: Array, qvel: Array) -> None:
        """Puts an env at `place` into a state."""
        data.qpos[self.reference.q], data.qvel[self.reference.v] = qpos, qvel
        data.qpos[:3] += place

    def _states(self, envs: Sequence[int]) -> tuple[Array, Array]:
        """Positions and velocities of the model's base and joints, a row for each of `envs`."""
        qpos = np.array([self._qpos[env] for env in envs]).reshape(len(envs), -1)[:, self.reference.q]
        return qpos, np.array([self._qvel[env] for env in envs]).reshape(len(envs), -1)[:, self.reference.v]

    def _read(self, envs: Sequence[int]) -> None:
        """Reads the states of envs."""
        if len(envs):
            self.qpos[envs], self.qvel[envs] = self._states(envs)
            self.qpos[envs, :3] -= self.places[envs]
