"""polypod for Ray RLlib, with its new API stack.

Each env runner steps its share of one batch, in one simulator.

>>> import polypod.rllib
>>> from ray.rllib.algorithms.ppo import PPOConfig
>>> config = (
...     PPOConfig()
...     .environment(polypod.rllib.register(), env_config={"task": "Velocity-Flat-HeteroQuadruped-v0", "seed": 1})
...     .env_runners(env_runner_cls=polypod.rllib.EnvRunner, num_env_runners=2, num_envs_per_env_runner=512)
... )
"""

from collections.abc import Mapping
from typing import Any

import polypod
from polypod._core import ConfigError
from polypod.extras import missing
from polypod.single_env import Env

try:
    from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
    from ray.tune.registry import register_env
except ModuleNotFoundError as error:
    raise missing(error, "polypod.rllib", "learners") from error

NAME = "polypod"
"""Name under which the env is registered by default."""
VECTORIZE_MODE = "vector_entry_point"
"""RLlib's mode for envs that are batches already."""


def make(config: Mapping[str, Any]) -> polypod.VectorEnv | Env:
    """Builds RLlib's env: a batch where `config` has `num_envs`.

    Without it a single env, whose spaces RLlib reads.

    Args:
        config: `task`, and options of `polypod.make`. `num_envs` is the number of the share where
            there is one.

    Raises:
        ConfigError: without a task, with `copy=False`, and as `polypod.make`.
    """
    options = dict(config)
    if "task" not in options:
        raise ConfigError('env_config names no task; write env_config={"task": "velocity_flat"}')
    if not options.get("copy", True):
        raise ConfigError("RLlib keeps what it is handed: leave copy=False out of env_config")
    task, num_envs, runners = options.pop("task"), options.pop("num_envs", None), options.pop("runners", None)
    if num_envs is None:
        return Env(task, **options)
    if runners is not None:
        index, count = runners
        options["share"] = (index * num_envs, (index + 1) * num_envs)
        num_envs *= count
    return polypod.make(task, num_envs, autoreset="next_step", **options)


class EnvRunner(SingleAgentEnvRunner):
    """An env runner whose batch is its share of one batch of all runners.

    Runner `i` of `n` has the envs that follow those of runner `i - 1`: the same robots, seeds and
    commands as in one process. It sets `gym_env_vectorize_mode`, and as many threads as Ray has
    given it cores.
    """

    config: Any

    def make_env(self) -> None:
        """Builds the runner's share of the batch."""
        own: Any = self.config.copy(copy_frozen=False)
        own.gym_env_vectorize_mode = VECTORIZE_MODE
        own.env_config = dict(own.env_config)
        if self.worker_index and self.num_workers:
            own.env_config["runners"] = (self.worker_index - 1, self.num_workers)
            own.env_config.setdefault("threads", max(1, int(own.num_cpus_per_env_runner)))
        own.freeze()
        self.config = own
        super().make_env()


def register(name: str = NAME) -> str:
    """Tells Ray of the env; returns its name for `AlgorithmConfig.environment`.

    `EnvRunner` keeps a batch in one simulator. RLlib's own env runners do so with the vectorisation
    mode `VECTORIZE_MODE`; other modes build one simulator per env.
    """
    register_env(name, make)
    return name


__all__ = ["NAME", "VECTORIZE_MODE", "EnvRunner", "make", "register"]
