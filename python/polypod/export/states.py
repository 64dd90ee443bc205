"""States of an exported graph from one control step to the next: tensors that it takes and returns.

Inputs of states end in `_in`, and the output that is fed back has the same name with `_out`. All
are zero when an episode begins. A recurrent network has `h_in` and, with LSTM layers, `c_in`, each
[layers, batch, units], as in rsl_rl's own exports. A graph that is folded for a robot has
`history_in`, [batch, 1 + n], where terms of the observation remember past control steps: its first
number tells whether the episode has begun, the others are the terms' past values.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from rsl_rl.models import RNNModel

from polypod.networks.onnx_network import OnnxNetwork, output_of

HISTORY = "history_in"
"""State of a folded graph whose observation remembers."""

Shape = tuple[int, ...]
"""Sizes of a tensor, the batch left out: (size,) is [batch, size], (layers, size) is [layers,
batch, size]."""

MEANINGS = {
    HISTORY: "1 once the episode has begun, then the past values of the terms that remember; zeros at first",
    "h_in": "hidden state of the recurrent layers; zeros at first",
    "c_in": "cell state of the recurrent layers; zeros at first",
}
"""Meanings of the states."""


def of_network(network: torch.nn.Module) -> dict[str, Shape]:
    """The states of a network; none of a perceptron."""
    if isinstance(network, OnnxNetwork):
        return dict(network.states)
    if not isinstance(network, RNNModel):
        return {}
    rnn: Any = network.rnn.rnn
    names = ("h_in", "c_in") if isinstance(rnn, torch.nn.LSTM) else ("h_in",)
    return dict.fromkeys(names, (rnn.num_layers, rnn.hidden_size))


def full_shape(shape: Shape, rows: int) -> tuple[int, ...]:
    """Shape of a state with a number of rows."""
    return (rows, *shape) if len(shape) == 1 else (shape[0], rows, *shape[1:])


def as_module(network: torch.nn.Module) -> torch.nn.Module:
    """The deterministic network: observation and states in, action and next states out."""
    if isinstance(network, RNNModel):
        return _Recurrent(network)
    if isinstance(network, OnnxNetwork) and network.states:
        return _OfFile(network)
    as_jit: Callable[[], torch.nn.Module] = network.as_jit  # type: ignore[assignment]
    return as_jit()


class _Recurrent(torch.nn.Module):
    """rsl_rl's exportable network, with its outputs in a tuple without holes."""

    def __init__(self, network: RNNModel) -> None:
        super().__init__()
        self.network = network.as_onnx(verbose=False).eval()

    def forward(self, observation: torch.Tensor, *states: torch.Tensor) -> tuple[torch.Tensor, ...]:
        outputs: tuple[torch.Tensor | None, ...] = self.network(observation, *states)
        return tuple(output for output in outputs if output is not None)


class _OfFile(torch.nn.Module):
    """A recurrent network of an ONNX file, which remembers nothing by itself."""

    def __init__(self, network: OnnxNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: torch.Tensor, *states: torch.Tensor) -> tuple[torch.Tensor, ...]:
        memory = {name: state.numpy() for name, state in zip(self.network.states, states, strict=True)}
        return tuple(self.network.step(observation, memory))


def describe(states: Mapping[str, Shape]) -> list[dict[str, Any]]:
    """The states for a manifest."""
    return [
        {"input": name, "output": output_of(name), "shape": list(full_shape(shape, 0)), "description": MEANINGS[name]}
        for name, shape in states.items()
    ]
