"""Exported policies under onnxruntime."""

import hashlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rsl_rl.models import MLPModel

from polypod import _core
from polypod.arrays import Floats
from polypod.export import onnx_graph
from polypod.export.robot import RobotInterface
from polypod.files import read_bytes
from polypod.networks.onnx_network import OnnxNetwork, output_of
from polypod.networks.onnx_session import OnnxSession
from polypod.runs.manifest import export_sums

MAX_BYTES = 1 << 30
"""Largest size of a graph, bytes: twice that of the largest network that a manifest may
describe."""


class OnnxPolicy:
    """An ONNX graph that can be called."""

    def __init__(self, model: str | os.PathLike[str] | bytes, threads: int = 1) -> None:
        """Loads a file or its bytes.

        Raises:
            ConfigError: for a file that is missing, no ONNX model, or not the one that its manifest
                describes.
        """
        name = "the model" if isinstance(model, bytes) else os.fspath(model)
        source = model if isinstance(model, bytes) else _read(Path(model))
        self._session = OnnxSession(source, name, "running an exported policy", threads)
        self.outputs: list[str] = [entry.name for entry in self._session.outputs]
        entries = self._session.inputs
        self.states = {
            entry.name: tuple(entry.shape)
            for entry in entries
            if entry.name.endswith("_in") and output_of(entry.name) in self.outputs
        }
        """Shapes of what it remembers, the batch as a name; see `polypod.export.states`."""
        self.inputs: dict[str, int] = {
            entry.name: _width(entry, name) for entry in entries if entry.name not in self.states
        }
        """Names and sizes of the others."""
        self._memory: dict[str, Floats] = {}

    @classmethod
    def of(cls, network: MLPModel | OnnxNetwork, interface: RobotInterface) -> "OnnxPolicy":
        """The policy of one robot as it is exported, from its sensors to its targets."""
        return cls(onnx_graph.robot_model(network, interface, {}).SerializeToString())

    def __call__(self, **inputs: npt.ArrayLike) -> dict[str, Floats]:
        """Runs the graph on float32 [batch, size] per input.

        States that are not given are those after the call before, or zeros after `reset`. Raises
        ConfigError for inputs that the graph does not have or of other sizes.
        """
        feeds = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in inputs.items()}
        rows = next((len(feeds[name]) for name in self.inputs if name in feeds), 1)
        for state, shape in self.states.items():
            if state not in feeds:
                wanted = tuple(size if isinstance(size, int) else rows for size in shape)
                kept = self._memory.get(state)
                feeds[state] = kept if kept is not None and kept.shape == wanted else np.zeros(wanted, dtype=np.float32)
        outputs = dict(zip(self.outputs, self._session.run(self.outputs, feeds), strict=True))
        self._memory = {state: outputs[output_of(state)] for state in self.states}
        return outputs

    def reset(self, ends: npt.NDArray[np.bool_] | None = None) -> None:
        """Forgets what the rows of the mask have seen, [batch]; None: all, of whatever number."""
        if ends is None:
            self._memory = {}
        for state, memory in self._memory.items():
            kept = memory.copy()
            kept[(slice(None),) * (not isinstance(self.states[state][0], str)) + (ends,)] = 0.0
            self._memory[state] = kept


def _width(entry: Any, name: str) -> int:
    """The size of a [batch, size] tensor. Raises ConfigError."""
    if entry.type != "tensor(float)" or len(entry.shape) != 2 or not isinstance(entry.shape[1], int):
        raise _core.ConfigError(
            f"{name}: {entry.name} is {entry.type} of shape {entry.shape}; pass the graph of an export: inputs of "
            "float32 [batch, size]"
        )
    return int(entry.shape[1])


def _read(path: Path) -> bytes:
    try:
        data = read_bytes(path, MAX_BYTES)
    except OSError as error:
        raise _core.ConfigError(f"{path} cannot be read: {error.strerror}; pass the graph of an export") from error
    manifest = path.with_suffix(".json")
    if manifest.is_file() and export_sums(manifest).get(path.name) != hashlib.sha256(data).hexdigest():
        raise _core.ConfigError(
            f"{path} is damaged or of another export: its SHA-256 is not that of {manifest.name}; "
            "export the policy again"
        )
    return data
