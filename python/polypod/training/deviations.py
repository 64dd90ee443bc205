"""Standard deviations of the actions stay where the policy can act with them.

They are free parameters, and an optimiser knows no bounds: with a small deviation and a large rate
a step ends below 0. rsl_rl limits them where they are used, so that checkpoints and curves would
say another number than the policy acts with, and the gradient below the limit is 0.
"""

from typing import Any

import torch


def limit(distribution: Any) -> None:
    """Moves the learnt deviations of a distribution into the range that it acts with.

    Nothing waits for a GPU.
    """
    if (learnt := _learnt(distribution)) is not None:
        parameter, low, high = learnt
        with torch.no_grad():
            parameter.clamp_(low, high)


def outside(distribution: Any) -> tuple[int, int]:
    """Number of a distribution's learnt deviations outside that range, and number of all."""
    if (learnt := _learnt(distribution)) is None:
        return 0, 0
    parameter, low, high = learnt
    return int(((parameter < low) | (parameter > high)).sum()), parameter.numel()


def of(distribution: Any) -> torch.Tensor | None:
    """A distribution's learnt deviations, [num_actions].

    None where they are a network's output.
    """
    if (learnt := _learnt(distribution)) is None:
        return None
    parameter, low, high = learnt
    limited = parameter.detach().clamp(low, high)
    return limited if hasattr(distribution, "std_param") else limited.exp()


def _learnt(distribution: Any) -> tuple[torch.nn.Parameter, float, float] | None:
    """The parameter and its range; None for deviations that are a network's output."""
    for name, bounds in (("std_param", "std_range"), ("log_std_param", "log_std_range")):
        parameter = getattr(distribution, name, None)
        if isinstance(parameter, torch.nn.Parameter):
            low, high = getattr(distribution, bounds)
            return parameter, low, high
    return None
