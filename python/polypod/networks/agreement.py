"""Whether a graph computes what its torch module does, as far as float32 can tell.

An output is a sum of numbers that may be much larger than it. Two runtimes add them in different
orders, so their results differ by the rounding of these numbers, however small the output is. The
same module in float64 tells how large that rounding is.
"""

import contextlib
import copy
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from polypod import _core

TOLERANCE = 1e-5
"""Largest difference of a graph from its module, see `difference`."""
ROUNDING = 10.0
"""Largest error of a graph against float64, over that of torch in float32. Runtimes sum in
different orders and approximate exponentials differently, which makes a factor of 2 or 3."""
_SMALLEST = float(np.finfo(np.float32).tiny)


@dataclasses.dataclass(frozen=True)
class Expected:
    """An output of a module."""

    value: npt.NDArray[np.float64]
    """Outputs, computed in float64 where the module allows it, [..., columns]."""
    scale: npt.NDArray[np.float64]
    """Magnitudes that differences are relative to, [columns]."""


def expected(module: torch.nn.Module, inputs: Sequence[torch.Tensor], name: str) -> list[Expected]:
    """The outputs of a module for float32 inputs; `name` stands for it in errors.

    The scale of a column is its largest number, or, where rounding is larger than that allows for,
    the number whose `TOLERANCE` is `ROUNDING` times the rounding.

    Raises:
        ConfigError: for outputs that are not finite.
    """
    with torch.no_grad():
        single = _outputs(module(*inputs))
        for index, output in enumerate(single):
            wrong = output[~np.isfinite(output)]
            if wrong.size:
                raise _core.ConfigError(
                    f"{name} gives {wrong[0]} in output {index} for random inputs of deviation 1; it has diverged: use "
                    "one from an earlier iteration"
                )
        double = _in_double(module, inputs)
    if double is None:
        # one scale for all: what rounds to which column is not known
        return [Expected(value, np.full(value.shape[-1], np.abs(value).max(initial=0.0))) for value in single]
    return [
        Expected(exact, np.maximum(_largest(exact), _largest(exact - value) * (ROUNDING / TOLERANCE)))
        for exact, value in zip(double, single, strict=True)
    ]


def difference(given: Sequence[npt.NDArray[np.float32]], wanted: Sequence[Expected]) -> float:
    """Largest difference of a graph's outputs from its module's, relative to the columns' scales.

    It is infinite for other shapes, and NaN or infinite for numbers that are not finite.
    """
    found = 0.0
    for output, of in zip(given, wanted, strict=True):
        if output.shape != of.value.shape:
            return float("inf")
        off = _largest(output - of.value) / np.maximum(of.scale, _SMALLEST)
        found = max(found, float(off.max(initial=0.0))) if np.isfinite(off).all() else float("inf")
    return found


@contextlib.contextmanager
def untouched(module: torch.nn.Module) -> Iterator[None]:
    """Lends a module for evaluation on the CPU, and gives it back as it was, also after an error.

    It puts back the mode of each of its parts, devices, gradients, the values of buffers, and
    torch's random streams.
    """
    modes = [(part, part.training) for part in module.modules()]
    tensors = [*module.parameters(), *module.buffers()]
    moved = [(tensor, tensor.data, tensor.grad) for tensor in tensors if tensor.device.type != "cpu"]
    # a compiled part has no tables, and replaces none of its tensors
    parts = [part for part in module.modules() if not isinstance(part, torch.jit.ScriptModule)]
    places: list[tuple[Any, dict[str, Any]]] = [
        (table, dict(table)) for part in parts for table in (part._parameters, part._buffers)
    ]
    learnt = [(tensor, tensor.requires_grad) for tensor in tensors]
    buffers = [(buffer, buffer.detach().clone()) for buffer in module.buffers()]
    devices = sorted({tensor.device.index or 0 for tensor, _, _ in moved if tensor.device.type == "cuda"})
    try:
        with torch.random.fork_rng(devices=devices), torch.no_grad():
            module.eval()
            if moved:
                module.to("cpu")
            yield
    finally:
        for table, entries in places:
            table.update(entries)
        for tensor, data, gradient in moved:
            tensor.data, tensor.grad = data, gradient
        for tensor, requires_grad in learnt:
            if tensor.requires_grad != requires_grad:
                tensor.requires_grad_(requires_grad)
        for buffer, before in buffers:
            if not torch.equal(buffer, before):
                with torch.no_grad():
                    buffer.copy_(before)
        for part, training in modes:
            part.training = training


def _outputs(found: "torch.Tensor | tuple[torch.Tensor, ...]") -> list[npt.NDArray[np.float64]]:
    outputs = (found,) if isinstance(found, torch.Tensor) else found
    return [output.double().numpy() for output in outputs]


def _in_double(module: torch.nn.Module, inputs: Sequence[torch.Tensor]) -> list[npt.NDArray[np.float64]] | None:
    """The outputs in float64; None for a float32-only module, such as an ONNX file."""
    try:
        found = copy.deepcopy(module).double()(*(value.double() for value in inputs))
    except Exception:  # from the module's own code, which need not know of float64
        return None
    outputs = (found,) if isinstance(found, torch.Tensor) else found
    return _outputs(outputs) if all(output.dtype is torch.float64 for output in outputs) else None


def _largest(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Largest size of the numbers of each column, [columns]."""
    largest: npt.NDArray[np.float64] = np.abs(values).reshape(-1, values.shape[-1]).max(axis=0, initial=0.0)
    return largest
