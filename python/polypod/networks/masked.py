"""rsl_rl's perceptron for batches of different bodies: missing actions count for nothing.

The mask of an env's actions is data of its observations, the group `ACTION_MASK`, and so of the
rollout. Weights and checkpoints are those of the plain perceptron.
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

    Numbers that a robot lacks are 0 in observations, and 0 once they are normalised.
    """

    def __init__(self, *args: Any, shares: Sequence[float], **kwargs: Any) -> None:
        """As `MLPModel`.

        Args:
            args: of `MLPModel`.
            shares: [num_obs], the share of envs whose robot has each number
                (`VecSim.observation_shares`).
            kwargs: of `MLPModel`.
        """
        super().__init__(*args, **kwargs)
        if self.obs_normalization:
            self.obs_normalizer = MaskedNormalization(torch.tensor(shares))

    def forward(
        self,
        obs: TensorDict,
        masks: torch.Tensor | None = None,
        hidden_state: HiddenState = None,
        stochastic_output: bool = False,
    ) -> torch.Tensor:
        """Actions as those of `MLPModel`; actions that a robot lacks are 0."""
        if isinstance(self.distribution, MaskedGaussian):
            self.distribution.mask = obs[ACTION_MASK]
        output: torch.Tensor = super().forward(obs, masks, hidden_state, stochastic_output)
        return output


class MaskedNormalization(EmpiricalNormalization):
    """Normalises by running mean and deviation.

    Missing numbers stay 0: numbers that some robots lack are divided by the root of their mean
    square over those that have them, and nothing is subtracted.
    """

    is_padded: torch.Tensor
    scale: torch.Tensor

    def __init__(self, shares: torch.Tensor) -> None:
        """Normalises observations whose numbers, [num_obs], exist in these shares of the envs.

        Statistics of a number that no env has stay as they are.
        """
        super().__init__(shares.numel())
        self._absent = None if bool((shares > 0.0).all()) else torch.nonzero(shares == 0.0).squeeze(1)
        self.register_buffer("is_padded", (shares < 1.0).unsqueeze(0), persistent=False)
        # missing numbers are 0: they lower the mean of the squares of all
        scale = torch.where(shares > 0.0, shares.float().rsqrt(), 0.0)
        self.register_buffer("scale", scale.unsqueeze(0), persistent=False)

    @torch.jit.unused
    def update(self, x: torch.Tensor) -> None:
        """Takes in observations [n, num_obs], 0 where a number is missing."""
        if not self.training:
            return
        absent = None if self._absent is None else self._absent.to(x.device)
        kept = [] if absent is None else [of[:, absent].clone() for of in (self._mean, self._var)]
        super().update(x * self.scale)
        # variance about the mean to mean square
        self._var += torch.where(self.is_padded, self._mean.square(), 0.0)
        self._mean.masked_fill_(self.is_padded, 0.0)
        if absent is not None:
            self._mean[:, absent], self._var[:, absent] = kept
        self._std = torch.sqrt(self._var)


class MaskedGaussian(GaussianDistribution):
    """A Gaussian over the actions that a robot has.

    Density, entropy and divergence are sums over these alone.

    Missing numbers have mean 0 and are 0.
    """

    mask: torch.Tensor
    """Mask of the outputs for the observations at hand, [n, output_dim]; set before `update`."""

    def update(self, mlp_output: torch.Tensor) -> None:
        """Takes the means, [n, output_dim]."""
        super().update(mlp_output * self.mask)

    def sample(self) -> torch.Tensor:
        """Actions, [n, output_dim]."""
        return super().sample() * self.mask

    def deterministic_output(self, mlp_output: torch.Tensor) -> torch.Tensor:
        """Means of the distribution, 0 for missing joints."""
        return mlp_output * self.mask

    @property
    def entropy(self) -> torch.Tensor:
        """Entropy over the present actions, [n]."""
        return (self._normal.entropy() * self.mask).sum(dim=-1)  # type: ignore[no-untyped-call]

    @property
    def params(self) -> tuple[torch.Tensor, ...]:
        """Mean, deviation and mask, each [n, output_dim]: what the rollout stores."""
        return (self.mean, self.std, self.mask)

    def log_prob(self, outputs: torch.Tensor) -> torch.Tensor:
        """Logarithm of the probability of actions [n, output_dim], [n]."""
        return (self._normal.log_prob(outputs) * self.mask).sum(dim=-1)  # type: ignore[no-untyped-call]

    def kl_divergence(self, old_params: tuple[torch.Tensor, ...], new_params: tuple[torch.Tensor, ...]) -> torch.Tensor:
        """Divergence over the present actions, [n]."""
        (old_mean, old_std, mask), (new_mean, new_std, _) = old_params, new_params
        divergence = kl_divergence(Normal(old_mean, old_std), Normal(new_mean, new_std))
        return (divergence * mask).sum(dim=-1)

    @property
    def _normal(self) -> Normal:
        if self._distribution is None:
            raise RuntimeError("the distribution has no means yet; call update first")
        return self._distribution
