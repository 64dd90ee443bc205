"""Writes the graphs and manifests of a checkpoint, and compares each graph with torch."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from rsl_rl.modules import EmpiricalNormalization

from polypod import _core, descriptions
from polypod.export import contract, metadata, onnx_graph, states
from polypod.export.robot import OUTPUTS, RobotInterface, changes, interfaces
from polypod.export.runtime import OnnxPolicy
from polypod.export.torch_graph import RobotPolicy, torchscript
from polypod.files import write_bytes, write_text
from polypod.networks.agreement import TOLERANCE, difference, expected, untouched
from polypod.networks.onnx_network import OnnxNetwork, output_of
from polypod.observation import Term, placed
from polypod.policy import METADATA, LoadedPolicy, load, onnx_manifest

Format = Literal["onnx", "torchscript"]

FOLDER = "exported"
"""Folder next to the checkpoint that is the default."""
_ROWS = 256
_NETWORK = ("class_name", "hidden_dims", "activation", "rnn_type", "rnn_hidden_dim", "rnn_num_layers")
"""Keys of the manifest that describe the network."""


@dataclasses.dataclass(frozen=True)
class Export:
    """Files and differences of an export."""

    files: list[Path]
    difference: float
    """Largest difference of an ONNX graph from torch on random inputs, as `agreement.difference`
    counts it; 0 without ONNX."""
    changes: list[str]
    """Changes of the robots since the training."""


def export_checkpoint(
    checkpoint: Path,
    out: Path | None = None,
    robots: Sequence[str] | None = None,
    fold: bool = False,
    formats: Sequence[Format] = ("onnx", "torchscript"),
) -> Export:
    """Writes the policy of a checkpoint, with a graph per robot if named or `fold` is set.

    Args:
        checkpoint: a `model_<n>.pt` next to its manifest, or an ONNX file that says its task.
        out: the directory; None: `exported` next to the checkpoint.
        robots: names or paths of configs to fold the policy for, also of robots that it was not
            trained on.
        fold: fold for all robots of the training, where `robots` are not named.
        formats: kinds of files.

    Raises:
        ConfigError: for a checkpoint, robot or directory that cannot be used, and where a package
            is missing.
        PolypodError: for a graph that does not compute what the checkpoint does.
    """
    policy = load(checkpoint, robots=robots)
    manifest = policy.manifest
    if isinstance(policy.network, OnnxNetwork) and "torchscript" in formats:
        raise _core.ConfigError(f"{checkpoint} is an ONNX file, of which no TorchScript is made; use --formats onnx")
    known = interfaces(manifest)
    asked = known if robots is None and fold else {}
    if robots is not None:
        mine = [robot for robot in robots if robot in known and robot in manifest["robot_sources"]]
        others = [robot for robot in robots if robot not in mine]
        asked = {robot: known[robot] for robot in mine} | (interfaces(manifest, others) if others else {})
    out = checkpoint.parent / FOLDER if out is None else out
    writer = _Writer(policy, out, formats, _distances(policy, checkpoint, robots or ()))
    try:
        writer.write_policy(known | asked)
        for robot in asked.values():
            writer.write_robot(robot)
    except OSError as error:
        raise _core.ConfigError(f"cannot write to {out}: {error.strerror}; choose another --out") from error
    return Export(writer.files, writer.difference, changes(manifest, known | asked))


class _Writer:
    def __init__(
        self,
        policy: LoadedPolicy,
        out: Path,
        formats: Sequence[Format],
        distances: Mapping[str, descriptions.Distance],
    ) -> None:
        manifest = policy.manifest
        self.distances = distances
        self.manifest, self.network, self.out, self.formats = manifest, policy.network, out, formats
        self.terms: tuple[Term, ...] = ()
        self.scan_points: list[list[float]] = []
        self.action_names: list[str] = []
        self.files: list[Path] = []
        self.sums: dict[str, str] = {}
        self.difference = 0.0
        self.origin = {
            "file": policy.file.name,
            "sha256": policy.sha256,
            "iteration": policy.iteration,
        }
        self.run_path = str(policy.file)
        self.num_obs = manifest["policy"]["num_obs"]
        self.num_actions = manifest["policy"]["num_actions"]

    def write_policy(self, robots: dict[str, RobotInterface]) -> None:
        """The network alone, with a manifest about all robots."""
        any_robot = next(iter(robots.values()))
        self.terms = any_robot.terms
        self.scan_points = any_robot.scan_points.tolist()
        self.action_names = list(any_robot.action_names)
        module = states.as_module(self.network)
        sizes = {"obs": self.num_obs}
        memory = states.of_network(self.network)
        if "onnx" in self.formats:
            # gains and poses are one robot's: of several, each graph that is folded for one says
            # its own
            alone = any_robot if len(robots) == 1 else None
            described = self._metadata("policy", alone, memory)
            model = onnx_graph.network_model(self.network, self.num_obs, self.num_actions, described)
            self._write_onnx("policy", model, module, sizes, ["actions"], memory)
        if "torchscript" in self.formats:
            self._write_torchscript("policy", module, sizes, memory)
        self._write_manifest(
            "policy",
            {
                "kind": "policy",
                "inputs": [
                    {
                        **_tensor("obs", self.num_obs, "the observation: see observation_layout"),
                        "columns": metadata.observation_columns(self.terms, self.action_names),
                    }
                ],
                "outputs": [
                    {**_tensor("actions", self.num_actions, "the action"), "columns": self.action_names},
                ],
                "states": states.describe(memory),
                "robots": self.manifest["robot_sources"],
                "robot_info": {name: self._robot(robot) for name, robot in robots.items()},
            },
        )

    def write_robot(self, robot: RobotInterface) -> None:
        """The graph folded for one robot, with a manifest about it."""
        name = f"policy_{robot.name}"
        module = RobotPolicy(self.network, robot).eval()
        sizes, outputs = robot.inputs(), {"joint_pos_target": len(robot.joint_names), "actions": self.num_actions}
        memory = robot.states() | states.of_network(self.network)
        if "onnx" in self.formats:
            described = self._metadata(name, robot, memory, is_folded=True)
            model = onnx_graph.robot_model(self.network, robot, described)
            self._write_onnx(name, model, module, sizes, list(outputs), memory)
        if "torchscript" in self.formats:
            self._write_torchscript(name, module, sizes, memory)
        self._write_manifest(
            name,
            {
                "kind": "robot",
                "inputs": [self._described(key, size, robot.meaning(key), robot) for key, size in sizes.items()],
                "outputs": [self._described(key, size, OUTPUTS[key], robot) for key, size in outputs.items()],
                "states": states.describe(memory),
                "robots": [robot.name],
                "robot_info": {robot.name: self._robot(robot)},
            },
        )

    def _write_onnx(
        self,
        name: str,
        model: Any,
        module: torch.nn.Module,
        sizes: dict[str, int],
        outputs: list[str],
        memory: dict[str, states.Shape],
    ) -> None:
        data = model.SerializeToString()
        found = compare(OnnxPolicy(data), module, sizes, outputs, memory)
        if not found <= TOLERANCE:
            raise _core.PolypodError(
                f"{name}.onnx differs from the checkpoint by {found:.1e} of its outputs, more than {TOLERANCE:g}; "
                "export to torchscript, and report this network"
            )
        self.difference = max(self.difference, found)
        self._write_graph(f"{name}.onnx", data)

    def _write_torchscript(
        self, name: str, module: torch.nn.Module, sizes: dict[str, int], memory: dict[str, states.Shape]
    ) -> None:
        # two rows, so that nothing is taken for a constant
        shapes = [(2, size) for size in sizes.values()] + [states.full_shape(shape, 2) for shape in memory.values()]
        inputs = tuple(torch.zeros(shape) for shape in shapes)
        self._write_graph(f"{name}.pt", torchscript(module, inputs))

    def _write_graph(self, name: str, data: bytes) -> None:
        path = self.out / name
        write_bytes(path, data)
        self.sums[name] = hashlib.sha256(data).hexdigest()
        self.files.append(path)

    def _write_manifest(self, name: str, content: dict[str, Any]) -> None:
        layout = [
            {"term": term.term, "size": term.size, "start": at.start, **dataclasses.asdict(term.treatment)}
            for term, at in placed(self.terms)
        ]
        normalizer: Any = self.network.obs_normalizer
        normalized = isinstance(normalizer, EmpiricalNormalization)
        manifest = {
            "format": 1,
            **content,
            "checkpoint": self.origin,
            "task": self.manifest["task"],
            "overrides": self.manifest["overrides"],
            "step_dt": self.manifest["step_dt"],
            "canonical_joint_names": self.manifest["canonical_joint_names"],
            "observation_layout": layout,
            "height_scan_points": self.scan_points,
            "observation_normalization": {
                "in_graph": True,
                "mean": normalizer.mean.tolist(),
                "std": (normalizer.std + normalizer.eps).tolist(),
            }
            if normalized
            else None,
            "num_obs": self.num_obs,
            "num_actions": self.num_actions,
            "network": {key: value for key, value in self.manifest["policy"].items() if key in _NETWORK},
            "versions": {"polypod": _core.__version__, "torch": torch.__version__},
            "files": {file: digest for file, digest in self.sums.items() if Path(file).stem == name},
        }
        path = self.out / f"{name}.json"
        write_text(path, json.dumps(manifest, indent=2) + "\n")
        self.files.append(path)

    def _robot(self, robot: RobotInterface) -> dict[str, Any]:
        return {
            **robot.info,
            "command_ranges": {key: list(ends) for key, ends in robot.command_ranges.items()},
            "joint_of_slot": robot.joint_of_slot.tolist(),
            "base_com": [float(x) for x in robot.base_com],
            "morphology": [float(x) for value in robot.constants.values() for x in value],
        }

    def _described(self, name: str, size: int, meaning: str, robot: RobotInterface) -> dict[str, Any]:
        """A tensor of a folded graph, with the names of columns that are joints or slots."""
        columns: dict[str, Sequence[str]] = dict.fromkeys(("last_action", "actions"), robot.action_names)
        columns |= dict.fromkeys(("joint_pos", "joint_vel", "joint_pos_target"), robot.joint_names)
        described = _tensor(name, size, meaning)
        return {**described, "columns": list(columns[name])} if name in columns else described

    def _metadata(
        self, name: str, robot: RobotInterface | None, memory: Mapping[str, states.Shape], is_folded: bool = False
    ) -> dict[str, str]:
        return {
            METADATA: json.dumps(onnx_manifest(self.manifest)),
            "name": name,
            "task": self.manifest["task"],
            "checkpoint_sha256": self.origin["sha256"],
            **metadata.of_observation(self.terms, self.action_names, self.run_path, self.manifest["step_dt"]),
            **({} if robot is None else metadata.of_robot(robot)),
            **({} if robot is None else contract.entries(self._contract(name, robot, memory, is_folded))),
        }

    def _contract(
        self, name: str, robot: RobotInterface, memory: Mapping[str, states.Shape], is_folded: bool
    ) -> dict[str, Any]:
        return contract.of(
            robot,
            memory,
            {
                "name": name,
                "task": self.manifest["task"],
                "checkpoint_sha256": self.origin["sha256"],
                "iteration": self.origin["iteration"],
                "polypod": _core.__version__,
            },
            is_folded=is_folded,
            is_normalized=_is_normalized(self.network),
            step_dt=self.manifest["step_dt"],
            description=self._description(robot),
        )

    def _description(self, robot: RobotInterface) -> dict[str, Any] | None:
        """Distance of the robot from those of the training; None where that is not known."""
        if robot.name in self.manifest["robots"]:
            return {"is_trained": True, "distance": 0.0, "nearest": robot.name}
        if (found := self.distances.get(robot.name)) is None:
            return None
        return {"is_trained": False, "distance": found.distance, "nearest": found.nearest}


def _distances(policy: LoadedPolicy, checkpoint: Path, robots: Sequence[str]) -> Mapping[str, descriptions.Distance]:
    """Distances of the robots that the policy was not trained on, where they are known."""
    try:
        return descriptions.distances(policy.manifest, robots, str(checkpoint))
    except _core.PolypodError:
        return {}


def _is_normalized(network: torch.nn.Module) -> bool:
    """Whether the graph normalises its inputs; assumed for files of other learners."""
    if isinstance(network, OnnxNetwork):
        return True
    return any(isinstance(part, EmpiricalNormalization) for part in network.modules())


def compare(
    policy: OnnxPolicy,
    module: torch.nn.Module,
    sizes: dict[str, int],
    outputs: Sequence[str],
    memory: Mapping[str, states.Shape] = {},
) -> float:
    """Largest difference of an ONNX graph from its torch module on random inputs.

    See `agreement.difference`.
    """
    random = np.random.default_rng(0)
    shapes: dict[str, tuple[int, ...]] = {name: (_ROWS, size) for name, size in sizes.items()}
    shapes |= {name: states.full_shape(shape, _ROWS) for name, shape in memory.items()}
    inputs = {name: random.standard_normal(shape, dtype=np.float32) for name, shape in shapes.items()}
    outputs = [*outputs, *map(output_of, memory)]
    with untouched(module):
        wanted = expected(module, [torch.from_numpy(value) for value in inputs.values()], "the checkpoint's network")
    given = policy(**inputs)
    return difference([given[name] for name in outputs], wanted)


def _tensor(name: str, size: int, description: str) -> dict[str, Any]:
    return {"name": name, "dtype": "float32", "shape": ["batch", size], "description": description}
