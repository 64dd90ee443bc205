"""Left and right exchanged: what a quadruped's observations and actions become in a mirror.

Mittal et al., "Symmetry Considerations for Learning Task Symmetric Robot Policies", ICRA 2024: PPO learns faster when
every sample is also seen mirrored.
"""

import torch
from tensordict import TensorDict

from polypod import _core
from polypod.rsl_rl import VecEnv


class Mirror:
    """Mirrors observations and actions; `augment` is what rsl_rl's symmetry extension calls."""

    def __init__(self, env: VecEnv, device: str) -> None:
        """For the robots and the observation of `env`.

        Raises:
            ConfigError: when the robots of the run have different mirrors.
        """
        sim = env.unwrapped.sim
        first, *others = sim.robots
        actions = sim.action_mirror(first)
        observations = {group: sim.observation_mirror(first, group) for group in sim.observation_groups}
        for name in others:
            if sim.action_mirror(name) != actions or any(
                sim.observation_mirror(name, group) != mirror for group, mirror in observations.items()
            ):
                raise _core.ConfigError(
                    f"joints of {first} and {name} change sign differently in a mirror: set symmetry = false in [run]"
                )
        self._actions = _tensors(actions, device)
        self._observations = {group: _tensors(mirror, device) for group, mirror in observations.items()}

    def augment(
        self, env: VecEnv, obs: TensorDict | None, actions: torch.Tensor | None
    ) -> tuple[TensorDict | None, torch.Tensor | None]:
        """Each sample, then each sample's mirror image.

        Args:
            env: the env, which is not looked at.
            obs: groups of observations, [n, size] each.
            actions: [n, num_actions].

        Returns:
            Both with 2 n rows.
        """
        if obs is not None:
            groups = {
                group: torch.cat([obs[group], _mirrored(obs[group], mirror)])
                for group, mirror in self._observations.items()
            }
            obs = TensorDict(groups, batch_size=[2 * obs.batch_size[0]], device=obs.device)
        if actions is not None:
            actions = torch.cat([actions, _mirrored(actions, self._actions)])
        return obs, actions


def _tensors(mirror: list[tuple[int, float]], device: str) -> tuple[torch.Tensor, torch.Tensor]:
    indices = torch.tensor([index for index, _ in mirror], device=device)
    return indices, torch.tensor([sign for _, sign in mirror], device=device)


def _mirrored(rows: torch.Tensor, mirror: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    indices, signs = mirror
    return rows.index_select(1, indices) * signs
