"""polypod for Ray RLlib: each env runner steps a batch, in one simulator.

>>> import polypod.rllib
>>> from ray.rllib.algorithms.ppo import PPOConfig
>>> config = (
...     PPOConfig()
...     .environment(polypod.rllib.register(), env_config={"task": "Velocity-Flat-HeteroQuadruped-v0"})
...     .env_runners(gym_env_vectorize_mode="vector_entry_point", num_envs_per_env_runner=64)
... )
"""

from collections.abc import Mapping
from typing import Any

from ray.tune.registry import register_env

import polypod
from polypod._core import ConfigError
from polypod.single_env import Env

NAME = "polypod"
"""Under which the env is registered by default."""


def make(config: Mapping[str, Any]) -> polypod.VectorEnv | Env:
    """Builds what RLlib asks for: a batch where `config` has `num_envs`, else a single env, whose spaces it reads.

    Args:
        config: `task`, and options of `polypod.make`. Without a seed, each env runner has another one.

    Raises:
        ConfigError: without a task, and as `polypod.make`.
    """
    options = dict(config)
    if "task" not in options:
        raise ConfigError('env_config names no task; write env_config={"task": "velocity_flat"}')
    task, num_envs = options.pop("task"), options.pop("num_envs", None)
    if num_envs is None:
        return Env(task, **options)
    return polypod.make(task, num_envs, autoreset="next_step", **options)


def register(name: str = NAME) -> str:
    """Tells Ray of the env; returns its name for `AlgorithmConfig.environment`.

    RLlib wants next-step autoreset and the vectorisation mode `vector_entry_point`: others build one simulator per env.
    """
    register_env(name, make)
    return name


__all__ = ["NAME", "make", "register"]
