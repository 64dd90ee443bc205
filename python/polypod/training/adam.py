"""Adam whose steps CUDA graphs hold, and its exchange with the optimiser that checkpoints know."""

import inspect
from collections.abc import Callable, Iterable
from typing import Any

import torch


class _Adam(torch.optim.Adam):
    """Adam whose steps do not import torch's compiler, which takes seconds."""

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """A step of torch's, without the wrappers that speak to its compiler."""
        return inspect.unwrap(torch.optim.Adam.step)(self, closure)


def graph_adam(parameters: Iterable[torch.nn.Parameter], rate: torch.Tensor) -> torch.optim.Adam:
    """Adam over parameters, with moments at zero.

    Args:
        parameters: what it moves.
        rate: the learning rate, a tensor without dimensions on the learner's device. A graph reads
            it at each replay.
    """
    device = rate.device
    is_cuda = device.type == "cuda"
    moved = list(parameters)
    optimizer = _Adam(moved, lr=rate, capturable=is_cuda, fused=is_cuda or None)
    for parameter in moved:
        optimizer.state[parameter] = {
            "step": torch.zeros((), device=device),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
        }
    return optimizer


def tensors_of(optimizer: torch.optim.Optimizer) -> list[torch.Tensor]:
    """Parameters and moments: what a step changes."""
    return [tensor for parameter, state in optimizer.state.items() for tensor in (parameter.data, *state.values())]


def take_moments(optimizer: torch.optim.Adam, other: torch.optim.Optimizer) -> None:
    """Goes on with the moments of another Adam of the same parameters."""
    for parameter, state in optimizer.state.items():
        others = other.state.get(parameter, {})
        for key, tensor in state.items():
            tensor.copy_(others[key]) if key in others else tensor.zero_()


def give_moments(optimizer: torch.optim.Adam, other: torch.optim.Optimizer) -> None:
    """The reverse of `take_moments`."""
    for parameter, state in optimizer.state.items():
        other.state[parameter] = {
            "step": state["step"].cpu().clone(),
            "exp_avg": state["exp_avg"].clone(),
            "exp_avg_sq": state["exp_avg_sq"].clone(),
        }
