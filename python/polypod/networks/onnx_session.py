"""onnxruntime, imported here and nowhere else, and graphs that it runs.

onnxruntime tells its maker of each graph that it loads, and keeps an id of the machine for that in
the user's cache. It asks once, when it is imported, whether it may: here it may not.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any

from polypod import _core
from polypod.arrays import Floats
from polypod.extras import package

TELEMETRY = "ORT_DISABLE_TELEMETRY"
"""Environment variable that onnxruntime reads when it is imported."""
_FATAL = 4
"""Severity from which on onnxruntime writes to standard error: what goes wrong is raised."""


def runtime(purpose: str) -> Any:
    """Imports onnxruntime, without telemetry.

    Raises ConfigError, which begins with `purpose`, where it is missing.
    """
    os.environ.setdefault(TELEMETRY, "1")
    return package("onnxruntime", purpose, "export")


class OnnxSession:
    """A graph under onnxruntime, on the CPU."""

    def __init__(self, data: bytes, name: str, purpose: str, threads: int = 1) -> None:
        """Loads the bytes of a graph.

        Args:
            data: an ONNX model that is whole: a file that holds a part of its weights elsewhere is
                refused.
            name: of the file, in errors.
            purpose: what needs onnxruntime, in errors.
            threads: number of threads that compute.

        Raises:
            ConfigError: for what is no such model, and where a package is missing.
        """
        ort = runtime(purpose)
        self.name = name
        check_whole(data, name)
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        options.log_severity_level = _FATAL
        try:
            self._session = ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises classes of its compiled half
            raise _core.ConfigError(f"{name} is not loaded by onnxruntime: {_reason(error)}") from error
        self.inputs: list[Any] = self._session.get_inputs()
        self.outputs: list[Any] = self._session.get_outputs()
        """Each with `name`, `type` and `shape`."""
        self.metadata: Mapping[str, str] = self._session.get_modelmeta().custom_metadata_map

    def run(self, outputs: Sequence[str], feeds: Mapping[str, Floats]) -> list[Floats]:
        """The outputs for inputs. Raises ConfigError for what the graph does not compute."""
        try:
            found: list[Floats] = self._session.run(list(outputs), dict(feeds))
        except Exception as error:  # onnxruntime raises classes that it does not export
            raise _core.ConfigError(f"{self.name} is not run by onnxruntime: {_reason(error)}") from error
        return found


def check_whole(data: bytes, name: str) -> None:
    """Raises ConfigError for what is no ONNX model, and for one whose weights lie in other files.

    onnxruntime would read them relative to the current directory, and no checksum covers them.
    """
    onnx = package("onnx", "reading an ONNX file", "export")
    try:
        model = onnx.load_model_from_string(data)
    except Exception as error:  # a class of protobuf's
        raise _core.ConfigError(f"{name} is no ONNX model: {_reason(error)}") from error
    tensor = onnx.TensorProto
    messages = [model]
    while messages:
        message = messages.pop()
        if isinstance(message, tensor) and (message.data_location == tensor.EXTERNAL or message.external_data):
            raise _core.ConfigError(
                f"{name} keeps {message.name or 'a tensor'} in another file; write the model with all of its weights "
                "inside (onnx.save_model without save_as_external_data)"
            )
        for field, value in message.ListFields():
            if field.message_type is not None:
                messages += [value] if hasattr(value, "ListFields") else list(value)


def _reason(error: Exception) -> str:
    """The first line of an error."""
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
