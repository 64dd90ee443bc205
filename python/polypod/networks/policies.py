"""Policies from checkpoints."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from rsl_rl.models import MLPModel, RNNModel
from tensordict import TensorDict

from polypod import _core
from polypod.networks import build_actor
from polypod.networks.onnx_network import OnnxNetwork
from polypod.tensors import tensor_over

Policy = Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]]
"""Observations [num_envs, num_obs] to actions [num_envs, num_actions], as
`polypod.policy.Policy.act`."""


def load_network(checkpoint: dict[str, Any], model: dict[str, Any]) -> MLPModel:
    """Builds the actor of a checkpoint, ready for inference.

    Args:
        checkpoint: what `run_dir.load_checkpoint` returns.
        model: the manifest's `policy`: sizes and constructor arguments.

    Raises:
        ConfigError: when the weights do not fit the manifest, and for a network that is not known.
    """
    network = build_actor(model)
    try:
        network.load_state_dict(checkpoint["actor_state_dict"])
    except (RuntimeError, TypeError, AttributeError, ValueError, LookupError) as error:
        raise _core.ConfigError(
            f"the checkpoint's weights do not fit its manifest: {str(error).splitlines()[-1].strip()}"
        ) from error
    network.eval()
    return network


def load_policy(checkpoint: dict[str, Any], model: dict[str, Any]) -> Policy:
    """The deterministic policy of a checkpoint.

    Arguments and errors are those of `load_network`.
    """
    return NetworkPolicy(load_network(checkpoint, model), model["num_obs"])


class NetworkPolicy:
    """The deterministic policy of a network. A recurrent one remembers its inputs since `reset`."""

    def __init__(self, network: torch.nn.Module, num_obs: int) -> None:
        """Takes observations of `num_obs` numbers."""
        self.network, self.num_obs = network, num_obs

    def __call__(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Actions for observations. Raises ConfigError for observations of another size."""
        if observations.shape[1] != self.num_obs:
            raise _core.ConfigError(
                f"the policy takes observations of {self.num_obs} numbers, and the task gives "
                f"{observations.shape[1]}; use the task that it was trained on"
            )
        with torch.inference_mode():
            batch = TensorDict({"policy": tensor_over(observations)}, batch_size=[len(observations)])
            actions: npt.NDArray[np.float32] = self.network(batch).numpy()
            return actions

    def reset(self, ends: npt.NDArray[np.bool_] | None = None) -> None:
        """Forgets the past of the envs of the mask, [num_envs]; None: of all, of any number."""
        if isinstance(self.network, RNNModel | OnnxNetwork):
            with torch.inference_mode():
                self.network.reset(None if ends is None else torch.from_numpy(ends.astype(np.int64)))


def reset(policy: Policy, ends: npt.NDArray[np.bool_] | None = None) -> None:
    """Tells a policy that remembers of episodes that have ended; others are left alone."""
    if hasattr(policy, "reset"):
        policy.reset(ends)
