"""Left and right exchanged: what a quadruped's observations and actions become in a mirror.

Mittal et al., "Symmetry Considerations for Learning Task Symmetric Robot Policies", ICRA 2024: PPO learns faster when
every sample is also seen mirrored.
"""

import torch
from tensordict import TensorDict

from polypod import _core
from polypod.rsl_rl import VecEnv
from polypod.training.config import OBSERVATION_GROUP


class Mirror:
    """Mirrors observations and actions; `augment` is what rsl_rl's symmetry extension calls."""

    def __init__(self, env: VecEnv, device: str) -> None:
        """For the robots and the observation of `env`.

        Raises:
            ConfigError: when the robots of the run have different mirrors.
        """
        sim = env.unwrapped.sim
        first, *others = sim.robots
        actions, observations = sim.action_mirror(first), sim.observation_mirror(first)
        for name in others:
            if sim.action_mirror(name) != actions or sim.observation_mirror(name) != observations:
                raise _core.ConfigError(
                    f"joints of {first} and {name} change sign differently in a mirror: set symmetry = false in [run]"
                )
        self._actions, self._observations = _tensors(actions, device), _tensors(observations, device)

    def augment(
        self, env: VecEnv, obs: TensorDict | None, actions: torch.Tensor | None
    ) -> tuple[TensorDict | None, torch.Tensor | None]:
        """Each sample, then each sample's mirror image.

        Args:
            env: the env, which is not looked at.
            obs: group `policy`, [n, num_obs].
            actions: [n, num_actions].

        Returns:
            Both with 2 n rows.
        """
        if obs is not None:
            policy = obs[OBSERVATION_GROUP]
            both = torch.cat([policy, _mirrored(policy, self._observations)])
            obs = TensorDict({OBSERVATION_GROUP: both}, batch_size=[both.shape[0]], device=obs.device)
        if actions is not None:
            actions = torch.cat([actions, _mirrored(actions, self._actions)])
        return obs, actions


def _tensors(mirror: list[tuple[int, float]], device: str) -> tuple[torch.Tensor, torch.Tensor]:
    indices = torch.tensor([index for index, _ in mirror], device=device)
    return indices, torch.tensor([sign for _, sign in mirror], device=device)


def _mirrored(rows: torch.Tensor, mirror: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    indices, signs = mirror
    return rows.index_select(1, indices) * signs
