"""One robot as a `gymnasium.Env`, for learners, wrappers and checkers that know no batch."""

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.state import State
from polypod.vector_env import EnvOptions, FloatArray, VectorEnv

if TYPE_CHECKING:
    from typing_extensions import Unpack


class Env(gymnasium.Env[FloatArray, FloatArray]):
    """A batch of one env.

    >>> import gymnasium, polypod
    >>> env = gymnasium.make("polypod/Velocity-Flat-Spot-v0")

    An observation is float32 [num_obs], an action [num_actions], see `polypod.VectorEnv`. Episodes
    are not reset by themselves. Batches are what polypod is fast at: prefer `polypod.make` where
    the learner takes one.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012  (declared so by Gymnasium)

    def __init__(self, task_id: str, **options: "Unpack[EnvOptions]") -> None:
        """Builds the env.

        `EnvOptions` documents the arguments. The robot is the only one, or the first of the task.

        Raises:
            ConfigError: as `polypod.make`; for more than one robot, and for an autoreset mode.
        """
        if options.setdefault("autoreset", "disabled") != "disabled":
            raise _core.ConfigError("a single env is reset by its caller; leave autoreset out, or use polypod.make")
        robots = options.get("robots")
        if robots is not None and len(robots) > 1:
            raise _core.ConfigError(f"a single env holds one robot, not {len(robots)}; use polypod.make for many")
        if robots is None:
            options["robots"] = _first_robot(task_id, options)
        # a second thread has nothing to do for one robot
        options.setdefault("threads", 1)
        self.batch = VectorEnv(task_id, 1, **options)
        self.render_mode = self.batch.render_mode
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space

    @property
    def sim(self) -> _core.VecSim:
        """The simulator underneath."""
        return self.batch.sim

    @property
    def state(self) -> State:
        """The robot's state, see `polypod.State`: arrays of one row."""
        return self.batch.state

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begins a new episode.

        Args:
            seed: restarts every random stream; None: they go on.
            options: none are known.

        Raises:
            ConfigError: for an option.
        """
        super().reset(seed=seed)
        if options:
            raise _core.ConfigError(f"unknown reset option {next(iter(options))!r}; a single env has none")
        observations, infos = self.batch.reset(seed=seed)
        return observations[0].copy(), _of_one(infos)

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Advances by one control step, see `VectorEnv.step`.

        Args:
            action: [num_actions], of any float type.
        """
        observations, rewards, terminated, truncated, infos = self.batch.step(np.asarray(action)[np.newaxis])
        return observations[0].copy(), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), _of_one(infos)

    def render(self) -> npt.NDArray[np.uint8] | None:
        """A picture, uint8 [360, 640, 3], for `render_mode="rgb_array"`; None without it."""
        pictures = self.batch.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Lets go of the simulator."""
        self.batch.close()


def _of_one(infos: dict[str, Any]) -> dict[str, Any]:
    """The infos of a batch's only env."""
    return {key: value[0] if isinstance(value, np.ndarray) else value for key, value in infos.items()}


def _first_robot(task_id: str, options: "EnvOptions") -> list[str]:
    """The first robot of a task."""
    env = VectorEnv(task_id, **options)
    robots = env.robots
    env.close()
    return robots[:1]
