"""The loop of a policy on a robot: sensors in, commands of motors out, once per control step.

It needs numpy, and onnxruntime to run a graph; it needs no polypod. All that it knows stands in the
file's contract.

    from onboard.policy_loop import open_loop

    loop = open_loop("policy_unitree_go2.onnx")
    loop.stand()
    loop.walk()
    while True:
        command = loop.step(now, sensors, (0.5, 0.0, 0.0))

Interfaces of robots are in `unitree.py` and `ros2_control.py`. `policy_loop.hpp` is the same loop
in C++.
"""

import dataclasses
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .policy_contract import KEY, OF_JOINTS, Contract, ContractError, Term, check_tensors, read_contract

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Network = Callable[[Mapping[str, Floats]], Mapping[str, Floats]]
"""A graph: inputs [1, size] by name, states among them, to outputs by name."""

MAX_FILE = 1 << 30
"""Largest graph, bytes."""
DAMP, STAND, WALK = "damp", "stand", "walk"
"""Modes of a loop."""


@dataclasses.dataclass(frozen=True)
class Sensors:
    """Measurements of a robot; joints in the order of the contract."""

    time: float
    """Time of the measurement, s, on the clock of `Loop.step`."""
    joint_pos: npt.ArrayLike
    joint_vel: npt.ArrayLike
    quaternion: npt.ArrayLike
    """w, x, y, z; base axes to world axes."""
    angular_velocity: npt.ArrayLike
    """Base axes, rad/s."""
    linear_velocity: npt.ArrayLike | None = None
    """Velocity of the base link's origin, base axes, m/s, from an estimator; None without one."""
    height_scan: npt.ArrayLike | None = None
    """Height of the base link's origin above the ground at the contract's points, m; None without a
    map."""
    extra: Mapping[str, npt.ArrayLike] = dataclasses.field(default_factory=dict)
    """Inputs that the robot measures under their own names."""


@dataclasses.dataclass(frozen=True)
class Command:
    """Command that the motors hold until the next control step, in the order of the contract.

    Effort: `tau + kp (q - measured position) + kd (dq - measured velocity)`.
    """

    mode: str
    q: Array
    dq: Array
    kp: Array
    kd: Array
    tau: Array
    fault: str | None = None
    """Name of the fault after which the loop damps; None without one."""
    detail: str = ""

    def efforts(self, joint_pos: npt.ArrayLike, joint_vel: npt.ArrayLike, limit: npt.ArrayLike) -> Array:
        """Efforts within `limit` for an interface without gains, at the rate of the motors."""
        pull = self.kp * (self.q - np.asarray(joint_pos)) + self.kd * (self.dq - np.asarray(joint_vel)) + self.tau
        return np.clip(pull, -np.asarray(limit), limit)


class Loop:
    """A policy in its loop. It never raises in `step`: what goes wrong ends in the damping mode."""

    def __init__(self, contract: Contract, network: Network) -> None:
        """Begins in the damping mode; `stand` and `walk` leave it."""
        self.contract, self.network = contract, network
        joints = contract.joints

        def of(key: str) -> Array:
            return np.array([getattr(joint, key) for joint in joints], dtype=np.float64)

        self.default_pos, self.lower, self.upper = of("default_pos"), of("lower"), of("upper")
        self.stiffness, self.damping, self.effort_limit = of("stiffness"), of("damping"), of("effort_limit")
        self.action_scale, self.sign = of("action_scale"), of("sign")
        self.mode = DAMP
        self.fault: str | None = None
        self.detail = ""
        self.action: Floats = np.zeros(len(contract.columns), dtype=np.float32)
        """The last action."""
        self.inputs: dict[str, Floats] = {}
        """Inputs and states that the graph was last given."""
        self.readings: dict[str, Array] = {}
        """Readings of the last step in which the policy acted, by name, as `observe` takes them."""
        self._held = self.default_pos.copy()
        self._from: Array | None = None
        self._begun = 0.0
        self._walks_next = False
        self.reset()

    def reset(self) -> None:
        """Forgets what the policy has seen: an episode begins."""
        self.action = np.zeros(len(self.contract.columns), dtype=np.float32)
        self._memory = {name: np.zeros(shape, dtype=np.float32) for name, (_, shape) in self.contract.states.items()}
        self._past: dict[str, Array] = {}

    def stand(self) -> None:
        """Moves to the default pose, and clears a fault.

        If its cause is still there, the next step damps again.
        """
        self.mode, self.fault, self.detail, self._from, self._walks_next = STAND, None, "", None, False

    def walk(self, at_once: bool = False) -> None:
        """Lets the policy act when the robot stands, or `at_once`.

        Does nothing in the damping mode without it.
        """
        if at_once:
            self.fault, self.detail = None, ""
            self._walk()
        elif self.mode == STAND:
            self._walks_next = True

    def damp(self) -> None:
        """Lets the robot sink: the operator's stop."""
        self.mode, self._walks_next = DAMP, False

    def step(self, now: float, sensors: Sensors, command: Sequence[float] = (0.0, 0.0, 0.0)) -> Command:
        """The command of the next control step.

        Args:
            now: s, on the clock of `sensors.time`.
            sensors: the newest measurement.
            command: forward and left velocity, m/s, and yaw rate, rad/s; it is kept within the
                contract's ranges.
        """
        try:
            return self._step(float(now), sensors, command)
        except Exception as error:  # whatever a driver gives: motors must not keep the last command
            return self._fail("sensor_size", f"{type(error).__name__}: {error}")

    def _step(self, now: float, sensors: Sensors, command: Sequence[float]) -> Command:
        read, fault = self._read(now, sensors)
        if fault is not None:
            return self._fail(*fault)
        self._held = read["joint_pos"]
        if self.mode == DAMP:
            return self._damped()
        wanted = np.asarray(command, dtype=np.float64)
        if wanted.shape != (3,):
            return self._fail("sensor_size", "the command is no velocity forward, velocity left and yaw rate")
        if not np.isfinite(wanted).all():
            return self._fail("command_not_finite", "the command holds a number that is not finite")
        read["velocity_commands"] = np.clip(wanted, self.contract.command_low, self.contract.command_high)
        if self.mode == STAND:
            targets = self._standing(now)
            if self.mode == STAND:
                return self._command(targets)
        return self._walking(read)

    def _standing(self, now: float) -> Array:
        """Targets between the pose in which standing began and the default pose."""
        if self._from is None:
            self._from, self._begun = self._held.copy(), now
        share = (now - self._begun) / self.contract.safety.stand_time
        if share >= 1.0 and self._walks_next:
            self._walk()
        share = min(max(share, 0.0), 1.0)
        return self._from + (0.5 - 0.5 * math.cos(math.pi * share)) * (self.default_pos - self._from)

    def _walk(self) -> None:
        self.mode, self._walks_next = WALK, False
        self.reset()

    def _walking(self, read: dict[str, Array]) -> Command:
        contract = self.contract
        read["last_action"] = self.action.astype(np.float64)
        self.readings = read
        if contract.graph == "folded":
            given = {name: read[name] for name in contract.inputs}
        else:
            given = {next(iter(contract.inputs)): self.observe(read)}
        self.inputs = {name: np.asarray(value, dtype=np.float32).reshape(1, -1) for name, value in given.items()}
        self.inputs |= self._memory
        try:
            found = self.network(self.inputs)
        except Exception as error:  # a runtime raises classes unknown here; motors must not keep the last command
            return self._fail("action_not_finite", f"the graph is not run: {type(error).__name__}: {error}")
        actions = np.asarray(found["actions"], dtype=np.float32).reshape(-1)
        if actions.shape != self.action.shape:
            return self._fail("action_not_finite", f"the graph gives {actions.size} actions, not {self.action.size}")
        targets = self.decode(actions)
        if contract.graph == "folded":
            targets = np.asarray(found["joint_pos_target"], dtype=np.float64).reshape(-1)
        memory = {name: np.asarray(found[output]) for name, (output, _) in contract.states.items()}
        sound = [np.isfinite(actions).all(), np.isfinite(targets).all(), targets.shape == self.default_pos.shape]
        sound += [value.shape == self._memory[name].shape for name, value in memory.items()]
        if not all(sound) or not all(np.isfinite(value).all() for value in memory.values()):
            return self._fail("action_not_finite", "the graph gives a number that is not finite, or another size")
        mask = np.array([joint is not None for joint in contract.joint_of_column])
        self.action, self._memory = np.where(mask, actions, np.float32(0.0)), memory
        return self._command(targets)

    def decode(self, actions: npt.ArrayLike) -> Array:
        """Joint targets [joints] of an action [columns], before the limits."""
        targets, actions = self.default_pos.copy(), np.asarray(actions, dtype=np.float64)
        for index, joint in enumerate(self.contract.joints):
            if joint.column is not None:
                targets[index] += self.action_scale[index] * actions[joint.column]
        return targets

    def observe(self, read: Mapping[str, Array]) -> Array:
        """The observation [size] of readings by name.

        It remembers past ones for terms with a history.
        """
        values = []
        for term in self.contract.terms:
            if term.constant is not None:
                values.append(np.array(term.constant, dtype=np.float64))
                continue
            now = self._term(term, [read[name] for name in term.inputs]) - term.offset
            if term.clip is not None:
                now = np.clip(now, *term.clip)
            now = now * term.scale
            if term.history > 1:
                past = self._past.get(term.name)
                past = np.tile(now, term.history - 1) if past is None else past
                now = np.concatenate([past, now])
                self._past[term.name] = now[term.width :]
            values.append(now)
        return np.concatenate(values)

    def _term(self, term: Term, given: Sequence[Array]) -> Array:
        if term.source == "center_of_mass_velocity":
            return given[0] + np.cross(given[1], self.contract.base_com)
        if term.source in OF_JOINTS:
            joints = given[0] - self.default_pos if term.source == "joint_position_minus_default" else given[0]
            return np.array(
                [0.0 if joint is None else self.sign[joint] * joints[joint] for joint in self.contract.joint_of_column]
            )
        return given[0]

    def _read(self, now: float, sensors: Sensors) -> tuple[dict[str, Array], tuple[str, str] | None]:
        """Readings by name, or the first fault."""
        contract, safety, count = self.contract, self.contract.safety, len(self.contract.joints)
        given: dict[str, tuple[Any, int]] = {
            "joint_pos": (sensors.joint_pos, count),
            "joint_vel": (sensors.joint_vel, count),
            "quaternion": (sensors.quaternion, 4),
            "base_ang_vel": (sensors.angular_velocity, 3),
        }
        asked = [*contract.inputs, *contract.sensed]
        if "base_lin_vel" in asked:
            given["base_lin_vel"] = (sensors.linear_velocity, 3)
        if "height_scan" in asked:
            given["height_scan"] = (sensors.height_scan, contract.num_rays)
        sizes = {name: size for name, size in contract.inputs.items() if contract.graph == "folded"}
        for term in contract.terms:
            sizes |= {name: term.width for name in term.inputs if name not in sizes}
        for name in sensors.extra:
            if name in sizes and name not in given:
                given[name] = (sensors.extra[name], sizes[name])
        known = {*given, "projected_gravity", "velocity_commands", "last_action"}
        needed = contract.inputs if contract.graph == "folded" else contract.sensed
        absent = [name for name in needed if name not in known] + [n for n, (v, _) in given.items() if v is None]
        if absent:
            return {}, ("sensor_missing", f"{absent[0]} is not measured")
        read = {}
        for name, (value, size) in given.items():
            read[name] = np.array(value, dtype=np.float64).reshape(-1)
            if read[name].size != size:
                return {}, ("sensor_size", f"{name} has {read[name].size} numbers, not {size}")
        if not math.isfinite(now) or not math.isfinite(sensors.time):
            return {}, ("sensor_not_finite", "the time is not finite")
        for name, value in read.items():
            if not np.isfinite(value).all():
                return {}, ("sensor_not_finite", f"{name} holds a number that is not finite")
        age = now - sensors.time
        if not abs(age) <= safety.stale_after:
            return {}, ("sensor_stale", f"the measurement is {age:.3f} s old")
        length = float(np.linalg.norm(read["quaternion"]))
        if abs(length - 1.0) > safety.quaternion_tolerance:
            return {}, ("quaternion_not_unit", f"the quaternion has the length {length:.3f}")
        read["projected_gravity"] = gravity_of(read.pop("quaternion") / length)
        tilt = math.acos(min(max(-read["projected_gravity"][2], -1.0), 1.0))
        if tilt > safety.max_tilt:
            return {}, ("tilt", f"the base leans {tilt:.2f} rad")
        beyond = np.maximum(read["joint_pos"] - self.upper, self.lower - read["joint_pos"])
        if beyond.max(initial=-np.inf) > safety.joint_margin:
            joint = contract.joints[int(beyond.argmax())].name
            return {}, ("joint_limit", f"{joint} is {beyond.max():.2f} beyond its limit")
        return read, None

    def _command(self, targets: Array) -> Command:
        zeros = np.zeros(len(targets))
        held = np.clip(targets, self.lower, self.upper)
        return Command(self.mode, held, zeros, self.stiffness.copy(), self.damping.copy(), zeros)

    def _damped(self) -> Command:
        zeros = np.zeros(len(self.default_pos))
        damping = np.array(self.contract.safety.damping)
        return Command(DAMP, self._held.copy(), zeros, zeros, damping, zeros, self.fault, self.detail)

    def _fail(self, fault: str, detail: str) -> Command:
        """Damps until `stand` or `walk(at_once=True)` is called."""
        self.damp()
        if self.fault is None:
            self.fault, self.detail = fault, detail
        return self._damped()


def gravity_of(quaternion: Array) -> Array:
    """The unit vector of gravity in base axes, of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return np.array([-2.0 * (x * z - w * y), -2.0 * (y * z + w * x), 2.0 * (x * x + y * y) - 1.0])


def open_loop(path: str | os.PathLike[str]) -> Loop:
    """The loop of a file, with onnxruntime under it. Raises ContractError."""
    session, contract = open_file(path)
    return Loop(contract, network_of(session))


def network_of(session: Any) -> Network:
    """A session of onnxruntime as the loop calls it."""
    names = [output.name for output in session.get_outputs()]

    def run(inputs: Mapping[str, Floats]) -> Mapping[str, Floats]:
        return dict(zip(names, session.run(names, dict(inputs)), strict=True))

    return run


def open_file(path: str | os.PathLike[str]) -> tuple[Any, Contract]:
    """The session of a file and its contract, which are compared. Raises ContractError."""
    name = os.fspath(path)
    try:
        with Path(name).open("rb") as file:
            data = file.read(MAX_FILE + 1)
    except OSError as error:
        raise ContractError(f"{name} cannot be read: {error.strerror}; pass the graph of an export") from error
    if len(data) > MAX_FILE:
        raise ContractError(f"{name} has more than {MAX_FILE >> 20} MiB; pass the graph of an export")
    return open_data(data, name)


def open_data(data: bytes, name: str) -> tuple[Any, Contract]:
    """Opens the bytes of a file as `open_file` does; `name` stands for it in errors."""
    # onnxruntime reports its use to its maker unless this is set before it is imported
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises classes of its compiled half
        reason = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise ContractError(f"{name} is not loaded by onnxruntime: {reason[:300]}") from error
    said = session.get_modelmeta().custom_metadata_map
    contract = read_contract(said.get(KEY), name, said)
    check_tensors(contract, session.get_inputs(), session.get_outputs(), name)
    return session, contract
