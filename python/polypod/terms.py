"""Terms of a task in Python: observations, commands, rewards, terminations, events, curricula.

A file declares them. `polypod train --terms my_task.py` and `polypod.make(..., terms="my_task.py")`
add them to a task:

>>> import numpy as np
>>> from polypod import terms
>>> @terms.reward(weight=-10.0)
... def base_height_l2(env):
...     return (env.base_height - 0.3) ** 2
>>> @terms.observation(size=1, units="m", history_length=3)
... def base_height(env):
...     return env.base_height
>>> import polypod
>>> env = polypod.make("velocity_flat", 4, robots=["unitree_go2"], terms=[base_height_l2, base_height])

`CustomTerms` adds rewards, terminations and observations to an env that is made without.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorWrapper
from gymnasium.vector.utils import batch_space

from polypod._core import ConfigError, UnknownNameError, VecSim
from polypod.python_terms.checks import LARGEST, Checks
from polypod.python_terms.declarations import (
    Command,
    Curriculum,
    Event,
    Memory,
    Metric,
    Observation,
    Reward,
    Termination,
    Terms,
    command,
    curriculum,
    event,
    memory,
    metric,
    observation,
    reward,
    termination,
)
from polypod.python_terms.env import TermEnv
from polypod.python_terms.file import load
from polypod.python_terms.random import EnvRandom
from polypod.state import State
from polypod.vector_env import VectorEnv

__all__ = [
    "Command",
    "Curriculum",
    "CustomTerms",
    "EnvRandom",
    "Event",
    "Memory",
    "Metric",
    "Observation",
    "Reward",
    "TermEnv",
    "Termination",
    "Terms",
    "command",
    "curriculum",
    "event",
    "load",
    "memory",
    "metric",
    "observation",
    "reward",
    "termination",
]

FloatArray = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]


if TYPE_CHECKING:
    _VectorWrapper = VectorWrapper[FloatArray, FloatArray, FloatArray, FloatArray, npt.NDArray[Any]]
else:
    _VectorWrapper = VectorWrapper  # Gymnasium before 1.3 has no generic one


class CustomTerms(_VectorWrapper):
    """A polypod env with custom terms in addition to those of its task.

    A term is a function of `polypod.State`, called once per step with the state that the step has
    led to, before any env is reset. The wrapped env leaves resets to this one, which behaves as
    with same-step autoreset: an episode that ends, by the task's terminations or by one's own, is
    reset in the same step, and its last observation is in `infos["final_obs"]`. Envs whose state
    broke get no reward, and are ended by the task.

    Observation terms follow the task's own in the observation, without noise. All arrays that are
    handed out are fresh. Infos are those of the wrapped env; of an episode that has ended they are
    in `infos["final_info"]`.

    A term gives finite numbers that float32 holds, or its name and the number are in a ConfigError.
    Rows whose state broke (`State.valid`) may hold anything.
    """

    env: VectorEnv

    def __init__(
        self,
        env: VectorEnv,
        rewards: Mapping[str, Reward] | None = None,
        terminations: Mapping[str, Callable[[State], npt.ArrayLike]] | None = None,
        observations: Mapping[str, Callable[[State], npt.ArrayLike]] | None = None,
        source: str = "",
    ) -> None:
        """Adds terms to an env.

        Args:
            env: made with `autoreset="disabled"`.
            rewards: by name.
            terminations: by name; each gives a bool per env, [num_envs], True where the episode has
                failed.
            observations: by name; each gives float32 [num_envs, n] or [num_envs], as many numbers
                in each call.
            source: where the terms come from; errors begin with it.

        Raises:
            ConfigError: for an env that resets by itself, for a weight that is not finite, and for
                a term that gives another shape or type, or a number that is not finite.
            UnknownNameError: for a reward's robot that is not in the env.
        """
        super().__init__(env)
        if env.autoreset_mode is not AutoresetMode.DISABLED:
            raise ConfigError(
                f"this env has {env.autoreset_mode}, which resets before a term could see the last state; "
                "build it with polypod.make(..., autoreset='disabled')"
            )
        self._checks = Checks(source)
        self._source = self._checks.begin
        self.rewards = dict(rewards or {})
        self.terminations = dict(terminations or {})
        self.observations = dict(observations or {})
        self.autoreset_mode = AutoresetMode.SAME_STEP
        self.metadata = {**env.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}
        for name, term in self.rewards.items():
            if not isinstance(term, Reward):
                raise ConfigError(
                    f"{self._source}rewards[{name!r}] is a {type(term).__name__}; write "
                    "polypod.terms.Reward(function, weight=1.0)"
                )
        self._state = env.state
        self._factor = {name: self._factors(name, term) for name, term in self.rewards.items()}
        self._sums = {name: np.zeros(env.num_envs) for name in self.rewards}
        self._finished: dict[str, list[float]] = {}
        self._causes: dict[str, BoolArray] = {}
        self._ends: dict[str, int] = {}
        self.final_mask: BoolArray = np.zeros(env.num_envs, dtype=np.bool_)
        self._widths: dict[str, int] = {}
        extra = self._observe_terms()
        low = np.full(env.sim.num_obs + extra.shape[1], -np.inf, dtype=np.float32)
        self.single_observation_space = gymnasium.spaces.Box(low, -low, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self.observation = self._extended(env.sim.observation, extra)
        self.reward = env.sim.reward.copy()
        self.terminated: BoolArray = env.sim.terminated.copy()
        self.truncated: BoolArray = env.sim.truncated.copy()

    @property
    def sim(self) -> VecSim:
        """The simulator underneath."""
        return self.env.sim

    @property
    def state(self) -> State:
        """The robots' state as dense arrays."""
        return self._state

    @property
    def observation_layout(self) -> list[tuple[str, int]]:
        """(term, size) of an observation, in order."""
        return self.env.observation_layout + list(self._widths.items())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begins new episodes, see `VectorEnv.reset`."""
        observations, infos = self.env.reset(seed=seed, options=options)
        mask = (options or {}).get("reset_mask", slice(None))
        for sums in self._sums.values():
            sums[mask] = 0.0
        self.observation = self._extended(observations, self._observe_terms())
        return self.observation, infos

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Advances every env by one control step, like `VectorEnv.step` in same-step autoreset."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        self.reward = self._add_rewards(rewards)
        ends = self._ended()
        if ends.any():
            self.sim.terminate(ends)
        self.terminated = terminated | ends
        self.truncated = truncated & ~ends
        done = self.terminated | self.truncated
        self.final_mask = done
        self.observation = self._extended(observations, self._observe_terms())
        if not done.any():
            return self.observation, self.reward, self.terminated, self.truncated, infos
        final = self._final_infos(done, infos)
        self._log(done)
        observations, of_reset = self.env.reset(options={"reset_mask": done})
        fresh = self._extended(observations, self._observe_terms())
        self.observation[done] = fresh[done]
        infos = {**self._rows_replaced(infos, of_reset, done), **final}
        return self.observation, self.reward, self.terminated, self.truncated, infos

    def send(self, actions: FloatArray) -> None:
        """Raises ConfigError: terms in Python are computed after the step."""
        raise ConfigError("terms in Python are computed between steps: call step in the place of send and recv")

    def recv(self) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """See `send`. Raises ConfigError."""
        raise ConfigError("terms in Python are computed between steps: call step in the place of send and recv")

    def refresh(self) -> None:
        """Observes the present state: after `sim.restore`, which changes it without a step."""
        self.observation = self._extended(self.sim.observation, self._observe_terms())

    def log(self) -> dict[str, float]:
        """The log of the task and of the custom terms, over episodes ended since the last call.

        `Episode_Reward/<robot>/<term>`: mean sum of the weighted term over an episode, divided by
        the full episode's length in seconds. `Episode_Termination/<robot>/<term>`: how many
        episodes the term ended.
        """
        own = {name: float(np.mean(values)) for name, values in self._finished.items()}
        own |= {name: float(count) for name, count in self._ends.items()}
        self._finished, self._ends = {}, {}
        return {**self.sim.log(), **own}

    def _factors(self, name: str, term: Reward) -> npt.NDArray[np.float64]:
        what = f"rewards[{name!r}].weight"
        weight = self._checks.numbers(what, term.weight)
        if weight.ndim:
            raise ConfigError(f"{self._source}{what} is an array of shape {weight.shape}; pass one number")
        self._checks.finite(what, weight)
        factors = np.full(self.env.num_envs, float(weight) * self.env.step_dt)
        if term.robots is not None:
            rewarded = np.zeros(self.env.num_envs, dtype=np.bool_)
            for robot in term.robots:
                if robot not in self.env.robots:
                    raise UnknownNameError(
                        f"{self._source}rewards[{name!r}].robots: there is no {robot!r} in this env; use "
                        f"{', '.join(self.env.robots)}"
                    )
                rewarded[self.env.env_ids(robot)] = True
            factors[~rewarded] = 0.0
        return factors

    def _add_rewards(self, rewards: FloatArray) -> FloatArray:
        total = rewards.astype(np.float64)
        if self.rewards:
            valid = self._state.valid
            for name, term in self.rewards.items():
                what = f"rewards[{name!r}]"
                # a broken robot is worth nothing, nor is one whom the term does not reward
                value = self._checks.per_env(what, term.function(self._state), valid & (self._factor[name] != 0.0))
                value *= self._factor[name]
                self._checks.finite(f"{what} times its weight and step_dt", value)
                self._sums[name] += value
                total += value
            self._checks.finite("the sum of rewards", total)
        return total.astype(np.float32)

    def _ended(self) -> BoolArray:
        ends = np.zeros(self.env.num_envs, dtype=np.bool_)
        for name, term in self.terminations.items():
            what = f"terminations[{name!r}]"
            mine = self._checks.flags(what, term(self._state), self.env.num_envs)
            self._causes[name] = mine
            ends |= mine
        return ends

    def _observe_terms(self) -> FloatArray:
        columns = [self._columns(name, term) for name, term in self.observations.items()]
        return np.concatenate([np.empty((self.env.num_envs, 0), dtype=np.float32), *columns], axis=1)

    def _columns(self, name: str, term: Callable[[State], npt.ArrayLike]) -> FloatArray:
        what = f"observations[{name!r}]"
        values = self._checks.numbers(what, term(self._state))
        if values.ndim == 1:
            values = values[:, np.newaxis]
        if values.ndim != 2:
            raise ConfigError(f"{self._source}{what} gives {values.ndim} dimensions; return [num_envs, n]")
        self._checks.shape(what, values.shape, (self.env.num_envs, self._widths.setdefault(name, values.shape[1])))
        if not (np.abs(values) <= LARGEST).all():
            # a broken robot has nothing to observe
            values = np.where(self._state.valid[:, np.newaxis], values, 0.0)
            self._checks.finite(what, values)
        return values.astype(np.float32)

    def _rows_replaced(self, infos: dict[str, Any], others: dict[str, Any], rows: BoolArray) -> dict[str, Any]:
        """Infos with the rows of the mask from others; entries without rows are the others'."""
        replaced = {**infos, **others}
        for key, value in others.items():
            old = infos.get(key)
            if not isinstance(value, np.ndarray) or not isinstance(old, np.ndarray):
                continue
            if old.shape == value.shape and old.shape[:1] == rows.shape:
                replaced[key] = old.copy()
                replaced[key][rows] = value[rows]
        return replaced

    @staticmethod
    def _extended(observations: FloatArray, extra: FloatArray) -> FloatArray:
        return np.concatenate([observations, extra], axis=1)

    def _final_infos(self, done: BoolArray, infos: dict[str, Any]) -> dict[str, Any]:
        final_obs = np.full(self.env.num_envs, None, dtype=object)
        for row in np.flatnonzero(done):
            final_obs[row] = self.observation[row].copy()
        return {
            "final_obs": final_obs,
            "_final_obs": done.copy(),
            "final_info": dict(infos),
            "_final_info": done.copy(),
        }

    def _log(self, done: BoolArray) -> None:
        full = self.env.max_episode_length * self.env.step_dt
        for name, term in self.rewards.items():
            for robot in term.robots or self.env.robots:
                ids = self.env.env_ids(robot)
                sums = self._sums[name][ids[done[ids]]]
                if sums.size:
                    self._finished.setdefault(f"Episode_Reward/{robot}/{name}", []).extend(sums / full)
            self._sums[name][done] = 0.0
        for robot in self.env.robots:
            ids = self.env.env_ids(robot)
            if done[ids].any():
                for name, cause in self._causes.items():
                    key = f"Episode_Termination/{robot}/{name}"
                    self._ends[key] = self._ends.get(key, 0) + int(cause[ids].sum())
