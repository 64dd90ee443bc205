"""Rewards, terminations and observations of one's own, written in Python.

>>> import polypod
>>> from polypod.terms import CustomTerms, Reward
>>> def base_height_l2(state):
...     return (state.base_height - 0.3) ** 2
>>> env = polypod.make("velocity_flat", num_envs=256, robots=["unitree_go2"], autoreset="disabled")
>>> env = CustomTerms(env, rewards={"base_height_l2": Reward(base_height_l2, weight=-10.0)})
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorWrapper
from gymnasium.vector.utils import batch_space

from polypod._core import ConfigError, UnknownNameError, VecSim
from polypod.state import State
from polypod.vector_env import VectorEnv

FloatArray = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Reward:
    """A reward term: `weight * function(state) * step_dt` is added to the reward of each step.

    Attributes:
        function: the unweighted value per second, a number per env: [num_envs].
        weight: its factor.
        robots: names of the robots that are rewarded by it; None: all.
    """

    function: Callable[[State], npt.ArrayLike]
    weight: float
    robots: Sequence[str] | None = None


if TYPE_CHECKING:
    _VectorWrapper = VectorWrapper[FloatArray, FloatArray, FloatArray, FloatArray, npt.NDArray[Any]]
else:
    _VectorWrapper = VectorWrapper  # of Gymnasium before 1.3 it is not generic


class CustomTerms(_VectorWrapper):
    """A polypod env with terms of one's own beside those of its task.

    A term is a function of `polypod.State`, called once per step with the state that the step has led to, before any
    env is reset. The wrapped env leaves resets to this one, which behaves as with same-step autoreset: an episode that
    ends, by the task's terminations or by one's own, is reset in the same step, and its last observation is in
    `infos["final_obs"]`. Envs whose state broke get no reward, and are ended by the task.

    Observation terms follow the task's own in the observation, without noise. All arrays that are handed out are fresh.
    """

    env: VectorEnv

    def __init__(
        self,
        env: VectorEnv,
        rewards: Mapping[str, Reward] | None = None,
        terminations: Mapping[str, Callable[[State], npt.ArrayLike]] | None = None,
        observations: Mapping[str, Callable[[State], npt.ArrayLike]] | None = None,
    ) -> None:
        """Adds terms to an env.

        Args:
            env: made with `autoreset="disabled"`.
            rewards: by name.
            terminations: by name; each gives a bool per env, [num_envs], True where the episode has failed.
            observations: by name; each gives float32 [num_envs, n] or [num_envs].

        Raises:
            ConfigError: for an env that resets by itself, and for a term that gives another shape or type.
            UnknownNameError: for a reward's robot that is not in the env.
        """
        super().__init__(env)
        if env.autoreset_mode is not AutoresetMode.DISABLED:
            raise ConfigError(
                f"this env has {env.autoreset_mode}, which resets before a term could see the last state; "
                "build it with polypod.make(..., autoreset='disabled')"
            )
        self.rewards = dict(rewards or {})
        self.terminations = dict(terminations or {})
        self.observations = dict(observations or {})
        self.autoreset_mode = AutoresetMode.SAME_STEP
        self.metadata = {**env.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}
        self._state = env.state
        self._factor = {name: self._factors(name, term) for name, term in self.rewards.items()}
        self._sums = {name: np.zeros(env.num_envs) for name in self.rewards}
        self._finished: dict[str, list[float]] = {}
        self._causes: dict[str, BoolArray] = {}
        self._ends: dict[str, int] = {}
        self.final_mask: BoolArray = np.zeros(env.num_envs, dtype=np.bool_)
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
        own = [(name, self._columns(name, term).shape[1]) for name, term in self.observations.items()]
        return self.env.observation_layout + own

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
        """Advances every env by one control step, see `VectorEnv.step` under same-step autoreset."""
        observations, rewards, terminated, truncated, _ = self.env.step(actions)
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
            return self.observation, self.reward, self.terminated, self.truncated, {}
        infos = self._final_infos(done)
        self._log(done)
        observations, _ = self.env.reset(options={"reset_mask": done})
        fresh = self._extended(observations, self._observe_terms())
        self.observation[done] = fresh[done]
        return self.observation, self.reward, self.terminated, self.truncated, infos

    def refresh(self) -> None:
        """Observes the present state: after `sim.restore`, which changes it without a step."""
        self.observation = self._extended(self.sim.observation, self._observe_terms())

    def log(self) -> dict[str, float]:
        """The task's log with that of one's own terms, over the episodes that ended since the last call.

        `Episode_Reward/<robot>/<term>`: mean sum of the weighted term over an episode, divided by the full episode's
        length in seconds. `Episode_Termination/<robot>/<term>`: how many episodes the term ended.
        """
        own = {name: float(np.mean(values)) for name, values in self._finished.items()}
        own |= {name: float(count) for name, count in self._ends.items()}
        self._finished, self._ends = {}, {}
        return {**self.sim.log(), **own}

    def _factors(self, name: str, term: Reward) -> npt.NDArray[np.float64]:
        factors = np.full(self.env.num_envs, term.weight * self.env.step_dt)
        if term.robots is not None:
            rewarded = np.zeros(self.env.num_envs, dtype=np.bool_)
            for robot in term.robots:
                if robot not in self.env.robots:
                    raise UnknownNameError(
                        f"rewards[{name!r}].robots: there is no {robot!r} in this env; use {', '.join(self.env.robots)}"
                    )
                rewarded[self.env.env_ids(robot)] = True
            factors[~rewarded] = 0.0
        return factors

    def _add_rewards(self, rewards: FloatArray) -> FloatArray:
        total = rewards.astype(np.float64)
        if self.rewards:
            valid = self._state.valid
            for name, term in self.rewards.items():
                value = np.asarray(term.function(self._state), dtype=np.float64)
                self._check("rewards", name, value.shape, (self.env.num_envs,))
                # a broken robot is worth nothing, nor is one whom the term does not reward
                value = np.where(valid & (self._factor[name] != 0.0), self._factor[name] * value, 0.0)
                self._sums[name] += value
                total += value
        return total.astype(np.float32)

    def _ended(self) -> BoolArray:
        ends = np.zeros(self.env.num_envs, dtype=np.bool_)
        for name, term in self.terminations.items():
            mine = np.asarray(term(self._state))
            self._check("terminations", name, mine.shape, (self.env.num_envs,))
            if mine.dtype != np.bool_:
                raise ConfigError(f"terminations[{name!r}] gives {mine.dtype}; return bools, e.g. of a comparison")
            self._causes[name] = mine
            ends |= mine
        return ends

    def _observe_terms(self) -> FloatArray:
        columns = [self._columns(name, term) for name, term in self.observations.items()]
        return np.concatenate([np.empty((self.env.num_envs, 0), dtype=np.float32), *columns], axis=1)

    def _columns(self, name: str, term: Callable[[State], npt.ArrayLike]) -> FloatArray:
        values = np.asarray(term(self._state), dtype=np.float32)
        if values.ndim == 1:
            values = values[:, np.newaxis]
        if values.ndim != 2:
            raise ConfigError(f"observations[{name!r}] gives {values.ndim} dimensions; return [num_envs, n]")
        self._check("observations", name, values.shape[:1], (self.env.num_envs,))
        return values

    @staticmethod
    def _check(kind: str, name: str, found: tuple[int, ...], wanted: tuple[int, ...]) -> None:
        if found != wanted:
            raise ConfigError(f"{kind}[{name!r}] gives shape {found}; return one row per env, {wanted}")

    @staticmethod
    def _extended(observations: FloatArray, extra: FloatArray) -> FloatArray:
        return np.concatenate([observations, extra], axis=1)

    def _final_infos(self, done: BoolArray) -> dict[str, Any]:
        final_obs = np.full(self.env.num_envs, None, dtype=object)
        for row in np.flatnonzero(done):
            final_obs[row] = self.observation[row].copy()
        return {"final_obs": final_obs, "_final_obs": done, "final_info": {}, "_final_info": done}

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
