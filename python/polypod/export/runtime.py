"""Exported policies under onnxruntime."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.extras import package

Array = npt.NDArray[np.float32]


class OnnxPolicy:
    """An ONNX graph that can be called."""

    def __init__(self, model: Path | bytes, threads: int = 1) -> None:
        """Loads a file or its bytes.

        Raises:
            ConfigError: for a file that is missing or no ONNX model.
        """
        runtime = package("onnxruntime", "running an exported policy", "export")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        try:
            source = model if isinstance(model, bytes) else str(model)
            self._session = runtime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises classes of its compiled half
            name = "the model" if isinstance(model, bytes) else str(model)
            raise _core.ConfigError(f"{name} is not loaded by onnxruntime: {str(error).splitlines()[0]}") from error
        self.inputs: dict[str, int] = {entry.name: entry.shape[1] for entry in self._session.get_inputs()}
        """Names and sizes."""
        self.outputs: list[str] = [entry.name for entry in self._session.get_outputs()]

    def __call__(self, **inputs: npt.ArrayLike) -> dict[str, Array]:
        """Runs the graph on float32 [batch, size] per input."""
        feeds = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in inputs.items()}
        return dict(zip(self.outputs, self._session.run(self.outputs, feeds), strict=True))
