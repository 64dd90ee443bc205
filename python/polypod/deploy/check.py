"""A file played through the Python loop in polypod and in MuJoCo.

It is compared with the policy that it came from.

The loop knows the file alone. Its observations, actions and joint targets are compared in every
control step with those of the checkpoint, which sees the simulator's own observation: `bounds` says
how far they may be apart.
"""

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from polypod import _core, bundled, rotations, runs
from polypod.arrays import Array, Floats
from polypod.deploy.onboard.policy_contract import Contract, ContractError
from polypod.deploy.onboard.policy_loop import WALK, Command, Loop, Sensors, network_of, open_data
from polypod.evaluation.results import finite
from polypod.export import RobotInterface, interfaces, states
from polypod.export import contract as contracts
from polypod.export.torch_graph import RobotPolicy
from polypod.extras import package
from polypod.files import read_bytes
from polypod.networks.onnx_network import OnnxNetwork
from polypod.networks.onnx_session import check_whole, runtime
from polypod.networks.policies import NetworkPolicy, reset
from polypod.observation import placed
from polypod.policy import METADATA, load
from polypod.runs import manifest as manifests
from polypod.sim2sim import beginning, run
from polypod.sim2sim.commands import Commanded

BOUND = 1e-5
"""Largest difference of an observation and of an action, of 1 or the largest number of its kind in
the step, and of a joint target, rad."""
SIMULATORS = ("polypod", "mujoco")
MAX_BYTES = 1 << 30
"""Largest size of a file, bytes."""
MAX_STEPS = 1_000_000
"""Most control steps of all envs together: each is a run of the graph."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of a check."""

    simulators: Sequence[str] = SIMULATORS
    num_envs: int = 4
    steps: int = 100
    """Control steps of each env."""
    seed: int = 0
    robot: str | None = None
    """Name or path of the robot's config; None: the contract's name, in the library."""
    checkpoint: Path | None = None
    """Policy to compare with; None: the checkpoint that the file names, where it is found, else the
    file's network."""
    overrides: tuple[str, ...] = ()
    """`key=value` changes to the task, on top of the run's own."""


@dataclasses.dataclass
class Played:
    """One simulator. Differences are the largest of all steps; see `BOUND`."""

    steps: int = 0
    """Control steps of all envs."""
    falls: int = 0
    """Envs that fell, which ends them."""
    faults: dict[str, int] = dataclasses.field(default_factory=dict)
    """Envs that a fault of the loop ended, by the fault."""
    observation: float = 0.0
    action: float = 0.0
    target: float = 0.0

    @property
    def holds(self) -> bool:
        """Whether all differences are within the bound."""
        return self.steps > 0 and max(self.observation, self.action, self.target) <= BOUND

    def see(self, key: str, given: npt.ArrayLike, reference: npt.ArrayLike, is_relative: bool = True) -> None:
        """Takes the difference of two rows into account; a value not finite counts as infinite."""
        found, wanted = np.asarray(given, dtype=np.float64), np.asarray(reference, dtype=np.float64)
        scale = max(1.0, float(np.abs(wanted).max(initial=0.0))) if is_relative else 1.0
        off = float(np.abs(found - wanted).max(initial=0.0)) / scale if found.shape == wanted.shape else np.inf
        setattr(self, key, max(getattr(self, key), off if np.isfinite(off) else np.inf))


@dataclasses.dataclass(frozen=True)
class Check:
    """All that was found of a file."""

    file: str
    contract: Contract
    task: str
    reference: str
    """Policy that it was compared with."""
    num_envs: int
    played: dict[str, Played]

    @property
    def holds(self) -> bool:
        """Whether it acts as the policy does in every simulator."""
        return all(played.holds for played in self.played.values())

    def as_dict(self) -> dict[str, Any]:
        """Returns the figures for JSON."""
        rows = {name: {**dataclasses.asdict(of), "holds": of.holds} for name, of in self.played.items()}
        return {
            "file": self.file,
            "robot": self.contract.robot,
            "graph": self.contract.graph,
            "contract_sha256": self.contract.sha256,
            "control_dt": self.contract.control_dt,
            "needs": [*self.contract.estimated, *self.contract.mapped],
            "task": self.task,
            "reference": self.reference,
            "num_envs": self.num_envs,
            "bound": BOUND,
            "simulators": finite(rows),
            "holds": self.holds,
        }


@dataclasses.dataclass(frozen=True)
class File:
    """An exported graph of one robot, and what it says."""

    name: str
    session: Any
    contract: Contract
    text: str
    """Text of the contract."""
    data: bytes
    metadata: Mapping[str, str]

    def loop(self) -> Loop:
        """A loop that knows nothing else."""
        return Loop(self.contract, network_of(self.session))


def open_file(path: Path) -> File:
    """Reads a file, and compares what it says. Raises ConfigError."""
    runtime("running an exported policy")
    try:
        data = read_bytes(path, MAX_BYTES)
    except OSError as error:
        raise _core.ConfigError(f"{path} cannot be read: {error.strerror}; pass the graph of an export") from error
    check_whole(data, str(path))
    try:
        session, contract = open_data(data, str(path))
    except ContractError as error:
        raise _core.ConfigError(str(error)) from error
    metadata = dict(session.get_modelmeta().custom_metadata_map)
    return File(str(path), session, contract, metadata[contracts.KEY], data, metadata)


def check(path: Path, options: Options | None = None) -> Check:
    """Plays a file.

    Raises:
        ConfigError: for a file, robot, checkpoint or option that cannot be used, and where a
            package is missing.
    """
    options = options or Options()
    unknown = [name for name in options.simulators if name not in SIMULATORS]
    if unknown or not options.simulators:
        raise _core.ConfigError(f"--simulators names {', '.join(unknown) or 'none'}; choose {', '.join(SIMULATORS)}")
    for flag, count in (("--num-envs", options.num_envs), ("--steps", options.steps)):
        if count < 1:
            raise _core.ConfigError(f"{flag} {count} must be at least 1")
    if options.num_envs * options.steps > MAX_STEPS:
        raise _core.ConfigError(
            f"{options.num_envs} envs of {options.steps} control steps are more than {MAX_STEPS:,} steps; choose "
            "smaller --steps or --num-envs"
        )
    file = open_file(path)
    manifest = _manifest(file)
    source = options.robot or file.contract.robot
    if options.robot is None and source not in {entry["name"] for entry in _core.robots()}:
        raise _core.ConfigError(
            f"{path}: contract.robot.name is {source[:80]!r}, which is no robot of the library; name its config with "
            "--robot FILE.toml"
        )
    changed = {**manifest, "overrides": [*manifest["overrides"], *options.overrides]}
    ((_, interface),) = interfaces(changed, [source]).items()
    _check_robot(file, interface, manifest)
    network, reference = _network(file, manifest, source, options.checkpoint)
    settings = beginning.Options(options.num_envs, options.steps, options.seed, overrides=options.overrides)
    played = {}
    for simulator in dict.fromkeys(options.simulators):
        episode = run.Episode(manifest, [source], settings)
        if simulator == "mujoco":
            package("mujoco", "playing a policy in MuJoCo", "bench")
            played[simulator] = _in_mujoco(file, episode, source, interface, network)
        else:
            played[simulator] = _in_polypod(file, episode, interface, network)
    return Check(file.name, file.contract, manifest["task"], reference, options.num_envs, played)


def _manifest(file: File) -> dict[str, Any]:
    """The file's record of its training, compared with its contract. Raises ConfigError."""
    if METADATA not in file.metadata:
        raise _core.ConfigError(f"{file.name}: metadata {METADATA} is missing; export the policy again")
    manifest = manifests.read_onnx(file.metadata[METADATA], f"{file.name}: metadata {METADATA}")
    contract = file.contract
    terms = [{"term": term.name, "size": term.size} for term in contract.terms]
    for key, found, wanted in (
        ("canonical_joint_names", manifest["canonical_joint_names"], list(contract.columns)),
        ("observation_layout", manifest["observation_layout"], terms),
        ("step_dt", manifest["step_dt"], contract.control_dt),
    ):
        if found != wanted:
            raise _core.ConfigError(
                f"{file.name}: metadata {METADATA}: {key} is not what the contract says; export the policy again"
            )
    return manifest


def _check_robot(file: File, interface: RobotInterface, manifest: Mapping[str, Any]) -> None:
    """Raises ConfigError for a robot that is no longer the one of the contract."""
    present = contracts.of(interface, {}, {}, is_folded=True, is_normalized=True, step_dt=float(manifest["step_dt"]))[
        "joints"
    ]
    if [joint["name"] for joint in present] != file.contract.joint_names:
        raise _core.ConfigError(
            f"{file.name}: contract.joints are not those of {interface.name}; name its config with --robot"
        )
    for row, joint in zip(present, file.contract.joints, strict=True):
        for key in ("default_pos", "stiffness", "damping", "action_scale", "column"):
            if row[key] != getattr(joint, key):
                raise _core.ConfigError(
                    f"{file.name}: contract.joints: {joint.name}: {key} is {getattr(joint, key)}, but {interface.name} "
                    f"has {row[key]}; export the policy again, or name the robot's config with --robot"
                )


def _network(
    file: File, manifest: Mapping[str, Any], source: str, checkpoint: Path | None
) -> tuple[torch.nn.Module, str]:
    """Returns the network to compare the file with, and its description. Raises ConfigError."""
    digest = file.metadata.get("checkpoint_sha256", "")
    if checkpoint is not None:
        policy = load(runs.resolve(checkpoint), robots=[source])
        if policy.sha256 != digest:
            raise _core.ConfigError(
                f"{file.name} was not exported of {checkpoint}: metadata checkpoint_sha256 is another; name its "
                "checkpoint"
            )
        return policy.network, bundled.shown(policy.file)
    for place in (*(bundled.checkpoint(name) for name in bundled.FOLDERS), Path(file.metadata.get("run_path", ""))):
        if _sum(place) != digest:
            continue
        policy = load(place, robots=[source])
        if policy.manifest["canonical_joint_names"] == manifest["canonical_joint_names"]:
            return policy.network, f"the checkpoint {bundled.shown(place)}"
    return _network_within(file), "the network in the file"


def _sum(path: Path) -> str | None:
    """SHA-256 of a file that is there."""
    try:
        return hashlib.sha256(read_bytes(path, MAX_BYTES)).hexdigest() if path.is_file() else None
    except (OSError, ValueError, _core.ConfigError):
        return None


def _network_within(file: File) -> torch.nn.Module:
    """The part of the graph from the observation to the action. Raises ConfigError."""
    onnx = package("onnx", "reading an ONNX file", "export")
    states = [name for name in file.contract.states if name != "history_in"]
    inputs, outputs = ["obs", *states], ["actions", *(file.contract.states[name][0] for name in states)]
    try:
        whole = onnx.load_model_from_string(file.data)
        size = sum(term.size for term in file.contract.terms)
        observation = onnx.helper.make_tensor_value_info("obs", onnx.TensorProto.FLOAT, ["batch", size])
        whole.graph.value_info.append(observation)
        part = onnx.utils.Extractor(whole).extract_model(inputs, outputs)
    except Exception as error:  # from onnx, for a graph without these tensors
        raise _core.ConfigError(
            f"{file.name}: the graph has no tensors obs and actions to compare with; name the --checkpoint"
        ) from error
    return OnnxNetwork(part.SerializeToString(), file.name)


def _begun(file: File, count: int) -> list[Loop]:
    """Loops that walk at once: the simulators begin near the default pose."""
    loops = [file.loop() for _ in range(count)]
    for loop in loops:
        loop.walk(at_once=True)
    return loops


def _sensors(
    time: float, qpos: Array, qvel: Array, heights: Array | None, given: Mapping[str, npt.ArrayLike]
) -> Sensors:
    """Measurements of the robot in a simulated state [nq], [nv]."""
    turn = rotations.matrix(qpos[3:7])
    return Sensors(
        time=time,
        joint_pos=qpos[7:],
        joint_vel=qvel[6:],
        quaternion=qpos[3:7],
        angular_velocity=qvel[3:6],
        linear_velocity=turn.T @ qvel[:3],
        height_scan=heights,
        extra=given,
    )


def _observed(loop: Loop) -> Array:
    """The observation of the loop's graph in the present step, by the contract alone."""
    if loop.contract.graph == "network":
        return loop.inputs[next(iter(loop.contract.inputs))][0].astype(np.float64)
    return loop.observe(loop.readings)


def _in_polypod(file: File, episode: run.Episode, interface: RobotInterface, network: torch.nn.Module) -> Played:
    """Polypod drives its robots with the loop's actions."""
    sim, played = episode.sim, Played()
    (name,) = sim.robots
    policy = NetworkPolicy(network, sim.num_obs)
    reset(policy)
    commanded = Commanded(sim)
    own = _own_terms(interface)
    loops, active = _begun(file, sim.num_envs), np.ones(sim.num_envs, dtype=np.bool_)
    for step in range(episode.steps):
        qpos, qvel = sim.qpos(name), sim.qvel(name)
        commands = episode.commands.at(step, rotations.heading(qpos[:, 3:7]))
        observation = commanded.observation(commands)
        wanted = np.where(sim.action_mask > 0, policy(observation), np.float32(0.0))
        heights = qpos[:, 2:3] - sim.height_scan()[:, :, 2] if len(interface.scan_points) else None
        actions = np.zeros_like(wanted)
        for env in np.flatnonzero(active):
            now = step * episode.step_dt
            extra = {term: observation[env, place] for term, place in own.items()}
            sensors = _sensors(now, qpos[env], qvel[env], None if heights is None else heights[env], extra)
            command = loops[env].step(now, sensors, tuple(commands[env]))
            if _ended(command, played):
                active[env] = False
                continue
            played.steps += 1
            played.see("observation", _observed(loops[env]), observation[env])
            played.see("action", loops[env].action, wanted[env])
            played.see("target", command.q, _targets(interface, wanted[env]), is_relative=False)
            actions[env] = loops[env].action
        sim.step(actions)
        fell = active & sim.terminated
        played.falls += int(fell.sum())
        active &= ~(fell | sim.truncated)
        if not active.any():
            break
    return played


def _own_terms(interface: RobotInterface) -> dict[str, slice]:
    """Columns of the terms that a robot measures under their own names.

    The simulator's values are their measurement.
    """
    return {
        term.term: slice(at.stop - term.width, at.stop)
        for term, at in placed(interface.terms)
        if term.source == "measured"
    }


def _targets(interface: RobotInterface, actions: npt.NDArray[np.float32]) -> Array:
    """Joint targets of an action within the joint limits of the simulator's config."""
    targets = interface.default_pose.astype(np.float64) + actions.astype(np.float64) @ interface.spread()
    info = interface.info
    lower = np.array([-np.inf if limit is None else limit for limit in info["lower"]])
    upper = np.array([np.inf if limit is None else limit for limit in info["upper"]])
    return np.clip(targets, lower, upper)


def _ended(command: Command, played: Played) -> bool:
    """Counts the fault that ended an env, if there is one."""
    if command.mode == WALK:
        return False
    fault = command.fault or command.mode
    played.faults[fault] = played.faults.get(fault, 0) + 1
    return True


class _Driver:
    """The loops of all envs, in the place of the policy that drives robots in MuJoCo."""

    inputs: Mapping[str, int] = {"velocity_commands": 3}

    def __init__(self, file: File, interface: RobotInterface, network: torch.nn.Module, count: int) -> None:
        self.loops, self.interface, self.played = _begun(file, count), interface, Played()
        self.reference = RobotPolicy(network, interface).eval()
        self.memory = self._begin(file, network)
        self.last = np.zeros((count, interface.num_actions), dtype=np.float32)
        self.active = np.ones(count, dtype=np.bool_)
        self.twin: Any = None
        self.time = 0.0

    def _begin(self, file: File, network: torch.nn.Module) -> list[torch.Tensor]:
        shapes = self.interface.states() | states.of_network(network)
        return [torch.zeros(states.full_shape(shape, len(self.loops))) for shape in shapes.values()]

    def reset(self) -> None:
        """The loops begin when they are made."""

    def __call__(self, **inputs: npt.ArrayLike) -> dict[str, Floats]:
        commands = np.asarray(inputs["velocity_commands"], dtype=np.float32)
        twin, count = self.twin, len(self.loops)
        read = twin.sensors() | {"velocity_commands": commands, "last_action": self.last}
        tensors = [torch.from_numpy(np.asarray(read[name], dtype=np.float32)) for name in self.interface.inputs()]
        with torch.no_grad():
            seen = self.reference._observe(tuple(tensors), self.memory[0] if self.interface.states() else None)[0]
            _, wanted, *after = self.reference(*tensors, *self.memory)
        self.memory = list(after)
        targets = np.tile(self.interface.default_pose, (count, 1))
        actions = np.zeros_like(self.last)
        for env in np.flatnonzero(self.active):
            heights = read["height_scan"][env] if len(self.interface.scan_points) else None
            sensors = _sensors(self.time, twin.qpos[env], twin.qvel[env], heights, {})
            command = self.loops[env].step(self.time, sensors, tuple(commands[env]))
            if _ended(command, self.played):
                self.active[env] = False
                continue
            self.played.steps += 1
            self.played.see("observation", _observed(self.loops[env]), seen[env].numpy())
            self.played.see("action", self.loops[env].action, wanted[env].numpy())
            aim = _targets(self.interface, wanted[env].numpy())
            self.played.see("target", command.q, aim, is_relative=False)
            targets[env], actions[env] = command.q, self.loops[env].action
        self.last = actions
        self.time += twin.step_dt
        return {"joint_pos_target": targets.astype(np.float32), "actions": actions}


def _in_mujoco(
    file: File, episode: run.Episode, source: str, interface: RobotInterface, network: torch.nn.Module
) -> Played:
    """MuJoCo drives its robots with the loop's joint targets."""
    name = interface.name
    beginning.check_steps(episode.physics, episode.step_dt, name)
    if own := _own_terms(interface):
        raise _core.ConfigError(
            f"the policy takes {', '.join(own)}, which no sensor gives in MuJoCo; choose --simulators polypod"
        )
    driver = _Driver(file, interface, network, episode.envs_per_robot)
    driver.twin = twin = beginning.twin_of(episode, name, source, interface, driver)
    twin.reset(*episode.start[name])
    for step in range(episode.steps):
        commands = episode.commands.at(step, rotations.heading(twin.qpos[:, 3:7]))
        seen = twin.step(commands, driver.active.copy())
        fell = driver.active & seen.fell
        driver.played.falls += int(fell.sum())
        driver.active &= ~fell
        if not driver.active.any():
            break
    return driver.played
