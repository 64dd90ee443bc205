"""Left and right exchanged: what a legged body's observations and actions become in a mirror.

Mittal et al., "Symmetry Considerations for Learning Task Symmetric Robot Policies", ICRA 2024: PPO
learns faster when every sample is also seen mirrored.
"""

from typing import Any

import torch
from rsl_rl.extensions import Symmetry
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from polypod import _core
from polypod.networks.masked import ACTION_MASK
from polypod.rsl_rl import VecEnv


class Mirror:
    """Mirrors observations and actions; `augment` is what rsl_rl's symmetry extension calls."""

    def __init__(self, env: VecEnv, device: str) -> None:
        """Reads the mirrors of the robots and of the observation of `env`.

        Raises:
            ConfigError: when the robots of the run have different mirrors.
        """
        sim = env.unwrapped.sim
        mask, blocks = sim.action_mask, {name: sim.env_ids(name) for name in sim.robots}
        # a worker's share may have no env of a robot
        robots = [name for name, (start, stop) in blocks.items() if start < stop]
        actions = {name: (sim.action_mirror(name), mask[blocks[name][0]].tolist()) for name in robots}
        self._actions = _tensors(_common(actions), device)
        self._observations = {}
        for group in sim.observation_groups:
            mirrors = {
                name: (sim.observation_mirror(name, group), sim.observation_mask(name, group)) for name in robots
            }
            self._observations[group] = _tensors(_common(mirrors), device)

    def augment(
        self, env: VecEnv, obs: TensorDict | None, actions: torch.Tensor | None
    ) -> tuple[TensorDict | None, torch.Tensor | None]:
        """Each sample, then each sample's mirror image.

        Args:
            env: the env, which is not looked at.
            obs: groups of observations, [n, size] each, and in batches of different bodies
                `action_mask`.
            actions: [n, num_actions].

        Returns:
            Both with 2 n rows.
        """
        if obs is not None:
            groups = {
                group: torch.cat([obs[group], _mirrored(obs[group], mirror)])
                for group, mirror in self._observations.items()
            }
            if ACTION_MASK in obs.keys():  # noqa: SIM118  a TensorDict is no dict
                # a joint's image is a joint
                mask = obs[ACTION_MASK]
                groups[ACTION_MASK] = torch.cat([mask, mask.index_select(1, self._actions[0])])
            obs = TensorDict(groups, batch_size=[2 * obs.batch_size[0]], device=obs.device)
        if actions is not None:
            actions = torch.cat([actions, _mirrored(actions, self._actions)])
        return obs, actions


class MirrorLoss(Symmetry):
    """rsl_rl's samples with their images, and the mirror loss of `[algorithm] mirror_loss_coef`."""

    def compute_loss(self, actor: MLPModel, batch: Any, original_batch_size: int) -> torch.Tensor:
        """The mean loss of the images, which are the rows from `original_batch_size` on."""
        _, means = self.data_augmentation_func(env=self.env, obs=None, actions=batch.old_distribution_params[0])
        return mirror_losses(actor, means)[original_batch_size:].mean()


def mirror_losses(actor: MLPModel, targets: torch.Tensor) -> torch.Tensor:
    """Squared differences between the actor's means and `targets`, averaged over a robot's actions.

    Args:
        actor: whose distribution is that of the rows.
        targets: [n, num_actions], 0 for actions that a robot lacks.

    Returns:
        The losses of the rows, [n].
    """
    mean, _, *mask = actor.output_distribution_params
    squares = (mean.float() - targets).square()
    return squares.sum(dim=1) / mask[0].sum(dim=1) if mask else squares.mean(dim=1)


def _common(mirrors: dict[str, tuple[list[tuple[int, float]], list[bool]]]) -> list[tuple[int, float]]:
    """The mirror of all robots, of each number that of the robots that have it.

    Raises:
        ConfigError: when robots that have the same number mirror it differently.
    """
    first: dict[int, str] = {}
    common = [(index, 1.0) for index in range(len(next(iter(mirrors.values()))[0]))]
    for name, (mirror, present) in mirrors.items():
        for index, image in enumerate(mirror):
            if not present[index]:
                continue
            other = first.setdefault(index, name)
            if other != name and common[index] != image:
                raise _core.ConfigError(
                    f"joints of {other} and {name} change sign differently in a mirror: set symmetry = false in [run]"
                )
            common[index] = image
    return common


def _tensors(mirror: list[tuple[int, float]], device: str) -> tuple[torch.Tensor, torch.Tensor]:
    indices = torch.tensor([index for index, _ in mirror], device=device)
    return indices, torch.tensor([sign for _, sign in mirror], device=device)


def _mirrored(rows: torch.Tensor, mirror: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    indices, signs = mirror
    return rows.index_select(1, indices) * signs
