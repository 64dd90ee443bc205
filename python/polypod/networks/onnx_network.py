"""An ONNX model in the place of a network: of another learner, or of an export of polypod."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict

from polypod import _core
from polypod.networks.onnx_session import OnnxSession


def output_of(state: str) -> str:
    """The output that is fed back to an input of a state: `h_out` for `h_in`."""
    return f"{state.removesuffix('_in')}_out"


class OnnxNetwork(torch.nn.Module):
    """The network of an ONNX file, run by onnxruntime.

    Its one input is float32 [batch, num_obs], its first output float32 [batch, num_actions].
    Further inputs are states, which the network gives back: see `polypod.export.states`. It
    remembers them until `reset`.
    """

    def __init__(self, data: bytes, name: str = "the model", threads: int = 1) -> None:
        """Loads a model. `name` stands for it in errors.

        Raises:
            ConfigError: for what is no ONNX model, for other inputs and outputs, and where
                onnxruntime is missing.
        """
        super().__init__()
        self._session = OnnxSession(data, name, "running an ONNX file", threads)
        inputs, outputs = self._session.inputs, self._session.outputs
        given = {entry.name for entry in outputs}
        if not inputs or not all(entry.name.endswith("_in") and output_of(entry.name) in given for entry in inputs[1:]):
            raise _core.ConfigError(
                f"{name} has the inputs {', '.join(entry.name for entry in inputs) or 'none'}; a policy has one, the "
                "observation, and states that it gives back: pass policy.onnx rather than a graph that is folded for a "
                "robot"
            )
        if not outputs:
            raise _core.ConfigError(f"{name} has no output; the first output of a policy is the action")
        self.states = {entry.name: _state(entry, name) for entry in inputs[1:]}
        """Sizes of what it remembers, as in `polypod.export.states`."""
        self._memory: dict[str, npt.NDArray[np.float32]] = {}
        self.data, self.name = data, name
        self.input, self.output = inputs[0].name, outputs[0].name
        """Names of the tensors."""
        self.num_obs = _width(inputs[0], name)
        self.num_actions = _width(outputs[0], name)
        self.metadata: Mapping[str, str] = self._session.metadata
        self.obs_normalizer = torch.nn.Identity()
        """The graph holds its normaliser, if it has one."""

    def forward(self, observations: torch.Tensor | TensorDict) -> torch.Tensor:
        """Actions [batch, num_actions] for observations [batch, num_obs] or the group `policy`."""
        rows = observations if isinstance(observations, torch.Tensor) else observations["policy"]
        for state, shape in self.states.items():
            wanted = (shape[0], len(rows), *shape[1:])
            if state not in self._memory or self._memory[state].shape != wanted:
                self._memory[state] = np.zeros(wanted, dtype=np.float32)
        actions, *after = self.step(rows, self._memory)
        self._memory = {state: value.numpy() for state, value in zip(self.states, after, strict=True)}
        return actions

    def step(self, observations: torch.Tensor, states: Mapping[str, npt.NDArray[np.float32]]) -> list[torch.Tensor]:
        """Actions and next states for observations and states.

        Raises ConfigError for outputs of other sizes.
        """
        feed = {self.input: np.ascontiguousarray(observations.numpy(), dtype=np.float32)}
        rows = len(observations)
        wanted: dict[str, tuple[int, ...]] = {self.output: (rows, self.num_actions)}
        wanted |= {output_of(name): (shape[0], rows, *shape[1:]) for name, shape in self.states.items()}
        found = self._session.run(list(wanted), feed | dict(states))
        for (output, shape), value in zip(wanted.items(), found, strict=True):
            if value.shape != shape or value.dtype != np.float32:
                raise _core.ConfigError(
                    f"{self.name}: {output} is {value.dtype} of shape {value.shape}, but the file declares float32 of "
                    f"shape {shape}"
                )
        return [torch.from_numpy(value) for value in found]

    def reset(self, ends: torch.Tensor | None = None) -> None:
        """Clears the memory of the rows in the mask, [batch]; None: of all rows."""
        if ends is None:
            self._memory = {}
        for memory in self._memory.values():
            memory[:, ends.numpy() == 1] = 0.0  # type: ignore[union-attr]

    def as_jit(self) -> "OnnxNetwork":
        """Itself: other networks return a module that can be traced."""
        return self


def _state(tensor: Any, name: str) -> tuple[int, ...]:
    """The sizes of a [layers, batch, size] tensor, the batch left out. Raises ConfigError."""
    shape = tensor.shape
    sizes = [shape[0], *shape[2:]] if len(shape) == 3 else []
    if tensor.type != "tensor(float)" or not sizes or not all(isinstance(size, int) and size > 0 for size in sizes):
        raise _core.ConfigError(
            f"{name}: {tensor.name} is {tensor.type} of shape {shape}; a state is float32 [layers, batch, size]"
        )
    if isinstance(shape[1], int):
        raise _core.ConfigError(
            f"{name}: {tensor.name} has the fixed shape {shape}; export it with a batch axis of any size"
        )
    return tuple(sizes)


def _width(tensor: Any, name: str) -> int:
    """The size of a [batch, size] tensor. Raises ConfigError."""
    shape = tensor.shape
    if tensor.type != "tensor(float)" or len(shape) != 2 or not isinstance(shape[1], int) or shape[1] < 1:
        raise _core.ConfigError(
            f"{name}: {tensor.name} is {tensor.type} of shape {shape}; a policy takes and gives float32 [batch, size]"
        )
    if isinstance(shape[0], int):
        raise _core.ConfigError(
            f"{name}: {tensor.name} has the fixed shape {shape}; export it with a batch axis of any size"
        )
    return int(shape[1])
