"""Networks for rsl_rl, such as `class_name = "polypod.networks:UrmaModel"`.

Also builds a saved one again.
"""

from collections.abc import Mapping
from typing import Any

import torch
from rsl_rl.models import MLPModel, RNNModel
from tensordict import TensorDict

from polypod import _core
from polypod.networks.clipped import clip_actions
from polypod.networks.masked import ACTION_MASK, MaskedGaussian, MaskedMLPModel
from polypod.networks.urma import JointGaussian, JointNetwork, UrmaModel

__all__ = [
    "ACTION_MASK",
    "NETWORKS",
    "JointGaussian",
    "JointNetwork",
    "MaskedGaussian",
    "MaskedMLPModel",
    "UrmaModel",
    "build_actor",
]

NETWORKS: dict[str, type[MLPModel]] = {
    "MLPModel": MLPModel,
    "RNNModel": RNNModel,
    "polypod.networks:UrmaModel": UrmaModel,
}
"""Networks by the class names of train configs and manifests, in which a masked perceptron is a
`MLPModel`."""


def build_actor(model: Mapping[str, Any]) -> MLPModel:
    """The actor that a manifest's `policy` describes, with new weights.

    Raises:
        ConfigError: for a class of network that is none of `NETWORKS`, and for arguments that it
            does not take.
    """
    arguments = dict(model)
    limit = arguments.pop("clip_actions", None)
    num_obs, num_actions, name = (arguments.pop(key) for key in ("num_obs", "num_actions", "class_name"))
    if name not in NETWORKS:
        raise _core.ConfigError(f"the policy is a {name!r}; this version knows {', '.join(NETWORKS)}")
    like = TensorDict({"policy": torch.zeros(1, num_obs)}, batch_size=[1])
    try:
        network = NETWORKS[name](like, {"actor": ["policy"]}, "actor", num_actions, **arguments)
    except (TypeError, ValueError, RuntimeError, KeyError, AssertionError) as error:
        raise _core.ConfigError(
            f"the manifest's policy is no {name}: {error}; copy the manifest again from the training's run"
        ) from error
    if limit is not None:
        clip_actions(network, limit)
    return network
