"""rsl_rl's perceptron for batches of different bodies: actions that a robot lacks count for nothing.

The mask of an env's actions is data of its observations, the group `ACTION_MASK`, and so of the rollout. Weights and
checkpoints are those of the plain perceptron.
"""

from collections.abc import Sequence
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization, HiddenState
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch.distributions import Normal, kl_divergence

ACTION_MASK = "action_mask"
"""Observation group: float32 [num_envs, num_actions], 1 where the robot has a joint, else 0."""


class MaskedMLPModel(MLPModel):
    """A perceptron whose distribution and statistics leave out what a robot lacks.

    Numbers of joints that a robot lacks are 0 in observations; they stay out of the running mean and deviation.
    """

    joint_of_number: torch.Tensor

    def __init__(self, *args: Any, joint_of_number: Sequence[int], **kwargs: Any) -> None:
        """As `MLPModel`.

        Args:
            args: of `MLPModel`.
            joint_of_number: for each number of an observation, the action's column whose joint it belongs to, or -1.
            kwargs: of `MLPModel`.
        """
        super().__init__(*args, **kwargs)
        self.register_buffer("joint_of_number", torch.tensor(joint_of_number), persistent=False)
        if self.obs_normalization:
            self.obs_normalizer = MaskedNormalization(self.obs_dim)

    def forward(
        self,
        obs: TensorDict,
        masks: torch.Tensor | None = None,
        hidden_state: HiddenState = None,
        stochastic_output: bool = False,
    ) -> torch.Tensor:
        """As of `MLPModel`; actions that a robot lacks are 0."""
        if isinstance(self.distribution, MaskedGaussian):
            self.distribution.mask = obs[ACTION_MASK]
        output: torch.Tensor = super().forward(obs, masks, hidden_state, stochastic_output)
        return output

    def update_normalization(self, obs: TensorDict) -> None:
        """Takes in observations [n, num_obs], each number of the robots that have it."""
        if self.obs_normalization:
            present = torch.cat([obs[ACTION_MASK], torch.ones_like(obs[ACTION_MASK][:, :1])], dim=1)
            numbers = torch.cat([obs[group] for group in self.obs_groups], dim=-1)
            self.obs_normalizer.update(numbers, present.index_select(1, self.joint_of_number % present.shape[1]))


class MaskedNormalization(EmpiricalNormalization):
    """Normalises by running mean and deviation of what is there. The share of each number is the same at all times."""

    @torch.jit.unused
    def update(self, x: torch.Tensor, present: torch.Tensor | None = None) -> None:
        """Takes in observations [n, num_obs]; `present` is 1 where a number is there, else 0."""
        if present is None:
            super().update(x)
            return
        if not self.training:
            return
        counts = present.sum(dim=0, keepdim=True)
        mean_x = _over_present((x * present).sum(dim=0, keepdim=True), counts)
        squares = ((x - mean_x).square() * present).sum(dim=0, keepdim=True)
        samples = torch.tensor(x.shape[0], dtype=self.count.dtype, device=self.count.device)
        if torch.distributed.is_initialized():
            local_counts, local_mean = counts, mean_x
            counts = counts.clone()
            torch.distributed.all_reduce(counts)
            torch.distributed.all_reduce(samples)
            sums = local_mean * local_counts
            torch.distributed.all_reduce(sums)
            mean_x = _over_present(sums, counts)
            squares = squares + local_counts * (local_mean - mean_x).square()
            torch.distributed.all_reduce(squares)
        var_x = _over_present(squares, counts)
        self.count += samples
        # what no robot has keeps what it has
        rate = torch.where(counts > 0, samples / self.count, 0.0)
        delta_mean = mean_x - self._mean
        self._mean += rate * delta_mean
        self._var += rate * (var_x - self._var + delta_mean * (mean_x - self._mean))
        self._std = torch.sqrt(self._var)


def _over_present(sums: torch.Tensor, counts: torch.Tensor) -> torch.Tensor:
    return sums / counts.clamp(min=1.0)


class MaskedGaussian(GaussianDistribution):
    """A Gaussian over the actions that a robot has: density, entropy and divergence are sums over these alone.

    Those that it lacks have mean 0 and are 0.
    """

    mask: torch.Tensor
    """[n, output_dim], of the observations at hand; set before `update`."""

    def update(self, mlp_output: torch.Tensor) -> None:
        """Takes the means, [n, output_dim]."""
        super().update(mlp_output * self.mask)

    def sample(self) -> torch.Tensor:
        """Actions, [n, output_dim]."""
        return super().sample() * self.mask

    def deterministic_output(self, mlp_output: torch.Tensor) -> torch.Tensor:
        """The means."""
        return mlp_output * self.mask

    @property
    def entropy(self) -> torch.Tensor:
        """[n]."""
        return (self._normal.entropy() * self.mask).sum(dim=-1)  # type: ignore[no-untyped-call]

    @property
    def params(self) -> tuple[torch.Tensor, ...]:
        """Mean, deviation and mask, each [n, output_dim]: what the rollout stores."""
        return (self.mean, self.std, self.mask)

    def log_prob(self, outputs: torch.Tensor) -> torch.Tensor:
        """[n], of actions [n, output_dim]."""
        return (self._normal.log_prob(outputs) * self.mask).sum(dim=-1)  # type: ignore[no-untyped-call]

    def kl_divergence(self, old_params: tuple[torch.Tensor, ...], new_params: tuple[torch.Tensor, ...]) -> torch.Tensor:
        """[n]."""
        (old_mean, old_std, mask), (new_mean, new_std, _) = old_params, new_params
        divergence = kl_divergence(Normal(old_mean, old_std), Normal(new_mean, new_std))
        return (divergence * mask).sum(dim=-1)

    @property
    def _normal(self) -> Normal:
        if self._distribution is None:
            raise RuntimeError("the distribution has no means yet; call update first")
        return self._distribution
