"""An ONNX model in the place of a network: of another learner, or of an export of polypod."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from polypod import _core
from polypod.extras import package


class OnnxNetwork(torch.nn.Module):
    """The network of an ONNX file, run by onnxruntime.

    Its one input is float32 [batch, num_obs], its first output float32 [batch, num_actions].
    """

    def __init__(self, data: bytes, name: str = "the model", threads: int = 1) -> None:
        """Loads a model. `name` stands for it in errors.

        Raises:
            ConfigError: for what is no ONNX model, for other inputs and outputs, and where onnxruntime is missing.
        """
        super().__init__()
        runtime = package("onnxruntime", "running an ONNX file", "export")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        try:
            self._session = runtime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises classes of its compiled half
            reason = next((line for line in str(error).splitlines() if line), type(error).__name__)
            raise _core.ConfigError(f"{name} is not loaded by onnxruntime: {reason}") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1:
            raise _core.ConfigError(
                f"{name} has the inputs {', '.join(entry.name for entry in inputs) or 'none'}; a policy has one, the "
                "observation: pass policy.onnx rather than a graph that is folded for a robot"
            )
        self.data, self.name = data, name
        self.input, self.output = inputs[0].name, outputs[0].name
        """Names of the tensors."""
        self.num_obs = _width(inputs[0], name)
        self.num_actions = _width(outputs[0], name)
        self.metadata: Mapping[str, str] = self._session.get_modelmeta().custom_metadata_map
        self.obs_normalizer = torch.nn.Identity()
        """What is in the graph is not known apart from it."""

    def forward(self, observations: torch.Tensor | TensorDict) -> torch.Tensor:
        """Actions [batch, num_actions] for observations [batch, num_obs], or for their group `policy`."""
        rows = observations if isinstance(observations, torch.Tensor) else observations["policy"]
        feed = {self.input: np.ascontiguousarray(rows.numpy(), dtype=np.float32)}
        return torch.from_numpy(self._session.run([self.output], feed)[0])

    def as_jit(self) -> "OnnxNetwork":
        """Itself: other networks return a module that can be traced."""
        return self


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
