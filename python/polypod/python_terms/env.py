"""View of all envs for terms in Python: state, commands, memory and random streams."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.python_terms.random import EnvRandom
from polypod.state import State


class Rewards(Protocol):
    """Reward terms of the task and of the file."""

    def episode_reward(self, term: str) -> npt.NDArray[np.float64]:
        """See `TermEnv.episode_reward`."""

    def set_weight(self, term: str, weight: float) -> None:
        """See `TermEnv.set_weight`."""


class _Gathered:
    """State fields that are gathered once and read by several terms: read-only arrays."""

    def __init__(self, sim: _core.VecSim) -> None:
        self._sim = sim
        self._fields: dict[str, npt.NDArray[np.float32]] = {}
        self._action_mask: npt.NDArray[np.bool_] | None = None
        self._length: npt.NDArray[np.int64] | None = None

    def clear(self) -> None:
        """Gathers everything again."""
        self._fields = {}
        self._length = None

    def state(self, field: str) -> npt.NDArray[np.float32]:
        """See `VecSim.state`."""
        found = self._fields.get(field)
        if found is None:
            found = self._fields[field] = self._sim.state(field)
            found.flags.writeable = False
        return found

    @property
    def action_mask(self) -> npt.NDArray[np.bool_]:
        """See `VecSim.action_mask`."""
        if self._action_mask is None:
            self._action_mask = self._sim.action_mask
            self._action_mask.flags.writeable = False
        return self._action_mask

    @property
    def episode_length(self) -> npt.NDArray[np.int64]:
        """See `VecSim.episode_length`."""
        if self._length is None:
            self._length = self._sim.episode_length
            self._length.flags.writeable = False
        return self._length


class TermEnv(State):
    """All envs, as terms in Python see them: the fields of `polypod.State`, and more.

    State arrays are read-only: write through `sim`.
    """

    sim: _core.VecSim
    """The simulator, with its methods that change states and physics."""
    commands: Mapping[str, npt.NDArray[np.float32]]
    """Present values of one's own commands by name, float32 [num_envs, size]. They may be
    changed."""
    memory: Mapping[str, npt.NDArray[Any]]
    """Arrays of `polypod.terms.memory` by name. They may be changed."""
    random: EnvRandom
    """A random stream for each env."""

    def __init__(
        self,
        sim: _core.VecSim,
        rewards: Rewards,
        commands: Mapping[str, npt.NDArray[np.float32]],
        memory: Mapping[str, npt.NDArray[Any]],
        random: EnvRandom,
    ) -> None:
        """Shows the envs of `sim`."""
        gathered: Any = _Gathered(sim)
        super().__init__(lambda: gathered)
        self._gathered: _Gathered = gathered
        self.sim = sim
        self._rewards = rewards
        self.commands = MappingProxyType(dict(commands))
        self.memory = MappingProxyType(dict(memory))
        self.random = random
        self.num_envs = sim.num_envs
        """Number of envs."""
        self.step_dt = sim.step_dt
        """Seconds of a control step."""
        self.max_episode_length = sim.max_episode_length
        """Control steps of a full episode."""
        self.robots = sim.robots
        """Names of the robots, in the order of their blocks of envs."""
        self._ids = {robot: np.arange(*sim.env_ids(robot), dtype=np.int64) for robot in self.robots}

    def env_ids(self, robot: str) -> npt.NDArray[np.int64]:
        """Rows of the envs that hold `robot`; empty where there is no such robot."""
        return self._ids.get(robot, np.empty(0, dtype=np.int64))

    def episode_reward(self, term: str) -> npt.NDArray[np.float64]:
        """Sum of a weighted reward term in the episode so far, [num_envs].

        Raises UnknownNameError where no robot has the term.
        """
        return self._rewards.episode_reward(term)

    def set_weight(self, term: str, weight: float) -> None:
        """Sets the weight of a reward term, the task's or one's own, of all robots that have it.

        Raises UnknownNameError where no robot has the term.
        """
        self._rewards.set_weight(term, weight)

    def refresh(self) -> None:
        """Gathers the state again, after it was changed through `sim`."""
        self._gathered.clear()
