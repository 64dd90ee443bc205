"""Actions within limits, as `[run] clip_actions` of a training has them.

The deterministic network clips what it gives, and so do the modules and graphs that are made of it:
whoever runs a policy feeds the clipped actions back as `last_action`, as the training did.
"""

from typing import Any

import torch


class Clip(torch.nn.Module):
    """Limits the magnitude of actions."""

    def __init__(self, limit: float) -> None:
        """Clips to `limit`, above 0."""
        super().__init__()
        self.limit = limit

    def forward(self, actions: torch.Tensor) -> torch.Tensor:
        """Actions of the same shape."""
        return actions.clamp(-self.limit, self.limit)


def clip_actions(network: Any, limit: float) -> None:
    """Lets an actor clip its deterministic actions, and the modules that are made of it.

    Actions that it draws are not clipped.
    """
    of, clip = network.distribution, Clip(limit)
    plain, module = of.deterministic_output, of.as_deterministic_output_module
    of.deterministic_output = lambda output: clip(plain(output))
    of.as_deterministic_output_module = lambda: torch.nn.Sequential(module(), clip)
    network.clip_actions = limit


def limit_of(network: torch.nn.Module) -> float | None:
    """Limit of an actor's actions; None: it has none."""
    return getattr(network, "clip_actions", None)
