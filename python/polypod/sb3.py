"""Adapter for Stable-Baselines3: `VecEnv` is a `stable_baselines3.common.vec_env.VecEnv`.

>>> import polypod, polypod.sb3
>>> from stable_baselines3 import PPO
>>> env = polypod.sb3.VecEnv(polypod.make("Velocity-Flat-HeteroQuadruped-v0", num_envs=256))
>>> PPO("MlpPolicy", env, n_steps=24, batch_size=1536, device="cpu").learn(total_timesteps=1_000_000)
"""

import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode

from polypod._core import ConfigError
from polypod.extras import missing
from polypod.terms import CustomTerms
from polypod.vector_env import FloatArray, VectorEnv

try:
    import torch
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv as BaseVecEnv
except ModuleNotFoundError as error:
    raise missing(error, "polypod.sb3", "learners") from error

Indices = None | int | Iterable[int]


class Actor(torch.nn.Module):
    """The deterministic policy of an algorithm, for `polypod.policy.save_onnx`.

    It normalises observations as the model's `VecNormalize` does, if there is one, and clips or
    rescales actions to the action space as `predict` does.
    """

    low: torch.Tensor
    high: torch.Tensor
    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self, model: BaseAlgorithm) -> None:
        """Shares the weights of `model`."""
        super().__init__()
        self.policy = model.policy
        space: Any = model.action_space
        self.register_buffer("low", torch.as_tensor(space.low))
        self.register_buffer("high", torch.as_tensor(space.high))
        normalizer = model.get_vec_normalize_env()
        self.normalizes = normalizer is not None and normalizer.norm_obs
        if normalizer is not None and normalizer.norm_obs:
            self.limit = float(normalizer.clip_obs)
            deviation = np.sqrt(normalizer.obs_rms.var + normalizer.epsilon)
            self.register_buffer("mean", torch.as_tensor(normalizer.obs_rms.mean, dtype=torch.float32))
            self.register_buffer("std", torch.as_tensor(deviation, dtype=torch.float32))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Actions [batch, num_actions] for observations [batch, num_obs]."""
        if self.normalizes:
            observations = ((observations - self.mean) / self.std).clamp(-self.limit, self.limit)
        actions = self.policy._predict(observations, deterministic=True)
        if self.policy.squash_output:
            return self.low + 0.5 * (actions + 1.0) * (self.high - self.low)
        return actions.clamp(self.low, self.high)


class VecEnv(BaseVecEnv):
    """A polypod vector env as Stable-Baselines3 wants it.

    Episodes are reset in the step in which they end. Their `infos` then hold
    `terminal_observation`, `TimeLimit.truncated`, and `episode` with return `r`, length `l` and
    time `t` (s), as SB3's `Monitor` writes them.
    """

    def __init__(self, env: VectorEnv | CustomTerms) -> None:
        """Wraps `env`.

        Raises:
            ConfigError: for an env with another autoreset than same-step.
        """
        if env.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ConfigError(
                f"this env has {env.autoreset_mode}, but SB3 needs polypod.make(..., autoreset='same_step')"
            )
        self.env = env
        self._actions: FloatArray | None = None
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, dtype=np.int64)
        self._began = time.monotonic()
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> FloatArray:
        """Begins new episodes in all envs, with the seed of `seed`, if there was one.

        Returns [num_envs, num_obs].
        """
        # SB3 counts a seed up from env to env; the envs of polypod draw theirs from one
        observations, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return np.array(observations)

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Takes the actions of the next step, [num_envs, num_actions]."""
        self._actions = np.array(actions, dtype=np.float32)

    def step_wait(self) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Advances every env by one control step.

        Returns:
            Observations [num_envs, num_obs], rewards and dones [num_envs], and one dict per env.
            All are fresh.

        Raises:
            ConfigError: without a `step_async` before it.
        """
        if self._actions is None:
            raise ConfigError("step_wait without step_async; call step(actions)")
        observations, rewards, terminated, truncated, final = self.env.step(self._actions)
        self._actions = None
        self._returns += rewards
        self._lengths += 1
        dones = terminated | truncated
        # such as the masks of a batch of different bodies; what belongs to ends has its place below
        kept = {
            key: value
            for key, value in final.items()
            if isinstance(value, np.ndarray) and len(value) == self.num_envs and "final_" not in key
        }
        infos: list[dict[str, Any]] = [{key: value[row] for key, value in kept.items()} for row in range(self.num_envs)]
        for row in np.flatnonzero(dones):
            infos[row] |= {
                "terminal_observation": final["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
                "episode": {
                    "r": round(float(self._returns[row]), 6),
                    "l": int(self._lengths[row]),
                    "t": round(time.monotonic() - self._began, 6),
                },
            }
        self._returns[dones] = 0.0
        self._lengths[dones] = 0
        return np.array(observations), np.array(rewards), dones, infos

    def close(self) -> None:
        """Closes the wrapped env."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Reads an attribute of the env, once per env of `indices`: the envs share a simulator."""
        return [getattr(self.env, attr_name)] * self._count(indices)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Sets an attribute of the env, for all envs.

        Raises:
            ConfigError: for some of the envs: they share a simulator.
        """
        if self._count(indices) != self.num_envs:
            raise ConfigError(f"set_attr({attr_name!r}): all envs share one simulator; leave indices out")
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Indices = None, **kwargs: Any) -> list[Any]:
        """Calls a method of the env, once; its result stands for each env of `indices`."""
        return [getattr(self.env, method_name)(*args, **kwargs)] * self._count(indices)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Indices = None) -> list[bool]:
        """False for every env: wrappers of single envs are of no use here."""
        return [False] * self._count(indices)

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """A picture of each env, see `VectorEnv.render`."""
        pictures: Any = self.env.render()
        return pictures or [None] * self.num_envs

    def _count(self, indices: Indices) -> int:
        return len(list(self._get_indices(indices)))
