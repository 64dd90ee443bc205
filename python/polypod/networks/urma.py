"""A network for any number of joints: it learns what a joint is, not which column of the observation it has.

After URMA, Bohlinger et al., "One Policy to Run Them All: an End-to-end Learning Approach to Multi-Embodiment
Locomotion", CoRL 2024: every joint is described, one encoder reads all joints, attention over the joints gathers the
body's state, and one decoder turns it into each joint's action by the joint's description. Here the attention has
several heads, and the decoder is bilinear: the description gives the weights that read the action off the body's state.
"""

from collections.abc import Sequence
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.utils import resolve_nn_activation
from tensordict import TensorDict
from torch.distributions import Normal

from polypod import _core
from polypod.networks.joints import NUM_PLACES, ROLES, JointTable, joint_table, leg_and_role
from polypod.observation import Layout

_FIRST_FOCUS = 2.0
"""Deviation of the first weights on a place: a head's largest share of twelve joints is then 0.7 on average."""


class JointNetwork(torch.nn.Module):
    """From observations [batch, num_obs] to one number per joint, or to numbers about the whole body.

    No parameter's shape depends on the number of joints, so weights go from one body to another.
    """

    select_states: torch.Tensor
    state_constants: torch.Tensor
    select_descriptions: torch.Tensor
    description_constants: torch.Tensor
    place: torch.Tensor
    general: torch.Tensor

    def __init__(
        self,
        table: JointTable,
        num_outputs: int | None,
        joint_dim: int,
        num_heads: int,
        hidden_dims: Sequence[int],
        activation: str,
    ) -> None:
        """Draws the weights.

        Args:
            table: where the observation holds what.
            num_outputs: numbers about the whole body; None: one per joint.
            joint_dim: what is known of one joint, and of its description.
            num_heads: of the attention; each gathers `joint_dim` numbers.
            hidden_dims: sizes of the layers between the gathered state and the outputs.
            activation: in rsl_rl's words.
        """
        super().__init__()
        self.num_joints = table.num_joints
        # the rows of the joints are linear in the observation, and so is a layer on them: one product does both
        for name, first in (("state", 0), ("description", table.num_states)):
            self.register_buffer(f"select_{name}s", torch.from_numpy(table.selection(first)), persistent=False)
            constants = torch.from_numpy(table.constant[:, first:].copy())
            self.register_buffer(f"{name}_constants", constants, persistent=False)
        self.register_buffer("place", torch.from_numpy(table.place), persistent=False)
        self.register_buffer("general", torch.from_numpy(table.general), persistent=False)
        features = table.column.shape[1]
        self.activation: torch.nn.Module = resolve_nn_activation(activation)
        self.state = torch.nn.Linear(features, joint_dim)
        self.description = torch.nn.Linear(features - table.num_states, joint_dim)
        self.attention = torch.nn.Linear(joint_dim, num_heads)
        self.place_attention = torch.nn.Linear(NUM_PLACES, num_heads, bias=False)
        # the heads begin by looking at different joints: from equal weights they would have to find out first
        torch.nn.init.normal_(self.place_attention.weight, std=_FIRST_FOCUS)
        layers: list[torch.nn.Module] = []
        width = num_heads * joint_dim + len(table.general)
        for size in hidden_dims:
            layers += [torch.nn.Linear(width, size), resolve_nn_activation(activation)]
            width = size
        self.body = torch.nn.Sequential(*layers)
        self.per_joint = num_outputs is None
        if num_outputs is None:
            self.decoder = torch.nn.Linear(width, joint_dim, bias=False)
            self.place_decoder = torch.nn.Linear(width, NUM_PLACES, bias=False)
            self.reflex = torch.nn.Linear(joint_dim, 1)
        else:
            self.decoder = torch.nn.Linear(width, num_outputs)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """[batch, num_obs] to [batch, joints] or [batch, num_outputs]."""
        descriptions = self._of_each_joint(observations, *self.description_layer())
        states = self._of_each_joint(observations, *self.state_layer())
        weights = torch.softmax(self.attention(descriptions) + self.place_attention(self.place), dim=1)
        gathered = torch.matmul(weights.transpose(1, 2), states).flatten(1)
        body = self.body(torch.cat([gathered, observations.index_select(1, self.general)], dim=1))
        if not self.per_joint:
            return self.decoder(body)
        read = torch.matmul(descriptions, self.decoder(body).unsqueeze(-1)) + self.reflex(states)
        return read.squeeze(-1) + torch.matmul(self.place_decoder(body), self.place.t())

    def state_layer(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Matrix [num_obs, joints * joint_dim] and offset of the layer that encodes the joints' states."""
        return _on_every_joint(self.select_states, self.state_constants, self.state)

    def description_layer(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The same for the joints' descriptions."""
        return _on_every_joint(self.select_descriptions, self.description_constants, self.description)

    def _of_each_joint(self, observations: torch.Tensor, matrix: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
        encoded = torch.addmm(offset, observations, matrix)
        return self.activation(encoded).unflatten(1, (self.num_joints, -1))


def _on_every_joint(
    select: torch.Tensor, constants: torch.Tensor, layer: torch.nn.Linear
) -> tuple[torch.Tensor, torch.Tensor]:
    matrix = torch.einsum("jfn,hf->njh", select, layer.weight).flatten(1)
    return matrix, (torch.matmul(constants, layer.weight.t()) + layer.bias).flatten()


class UrmaModel(MLPModel):
    """rsl_rl's model with a `JointNetwork` in the place of its perceptron, as actor or as critic."""

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        hidden_dims: Sequence[int] = (128, 128),
        activation: str = "elu",
        obs_normalization: bool = False,
        distribution_cfg: dict[str, Any] | None = None,
        *,
        joint_dim: int,
        num_heads: int,
        observation_layout: Layout,
        joint_names: Sequence[str],
    ) -> None:
        """Draws the weights, as rsl_rl asks for it.

        Args:
            obs: as of `MLPModel`.
            obs_groups: likewise.
            obs_set: "critic" for a network whose outputs are about the whole body.
            output_dim: number of outputs.
            hidden_dims: see `JointNetwork`.
            activation: likewise.
            obs_normalization: normalise observations, see `KindNormalization`.
            distribution_cfg: as of `MLPModel`; `RoleGaussian` fits any number of joints.
            joint_dim: see `JointNetwork`.
            num_heads: likewise.
            observation_layout: terms of the observation, see `polypod.observation.layout_of`.
            joint_names: canonical joints; for each one number comes out, but of a critic.

        Raises:
            ConfigError: for an observation without what the network reads.
        """
        super().__init__(obs, obs_groups, obs_set, output_dim, [1], activation, False, distribution_cfg)
        table = joint_table(observation_layout, joint_names, obs_normalization)
        if table.num_obs != self.obs_dim:
            raise _core.ConfigError(
                f"observation_layout counts {table.num_obs} numbers, but an observation has {self.obs_dim}"
            )
        if obs_normalization:
            self.obs_normalization = True
            self.obs_normalizer = KindNormalization(table)
        outputs = output_dim if obs_set == "critic" else None
        if outputs is None and output_dim != table.num_joints:
            raise _core.ConfigError(f"{table.num_joints} joint_names, but an action has {output_dim} numbers")
        self.mlp = JointNetwork(table, outputs, joint_dim, num_heads, hidden_dims, activation)


class KindNormalization(EmpiricalNormalization):
    """Normalises by running mean and deviation, which all columns of one kind share: see `JointTable.kind`.

    So its numbers, too, go from one body to another.
    """

    kind: torch.Tensor
    columns: torch.Tensor

    def __init__(self, table: JointTable) -> None:
        """Begins with mean 0 and deviation 1."""
        super().__init__(table.num_kinds)
        self.register_buffer("kind", torch.from_numpy(table.kind), persistent=False)
        columns = torch.bincount(self.kind, minlength=table.num_kinds)
        self.register_buffer("columns", columns.to(torch.float32), persistent=False)

    @property
    def mean(self) -> torch.Tensor:
        """[num_obs], the running mean of each column's kind."""
        return self._mean[0].index_select(0, self.kind)

    @property
    def std(self) -> torch.Tensor:
        """[num_obs], the running deviation."""
        return self._std[0].index_select(0, self.kind)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[batch, num_obs], normalised."""
        return (x - self.mean) / (self.std + self.eps)

    @torch.jit.unused
    def update(self, x: torch.Tensor) -> None:
        """Takes in observations [batch, num_obs], as rsl_rl does, but over kinds in place of columns."""
        if not self.training:
            return
        own_mean = x.mean(dim=0)
        own_var = x.var(dim=0, unbiased=False)
        mean = self._over_kinds(own_mean)
        var = self._over_kinds(own_var + (own_mean - mean.index_select(0, self.kind)).square())
        # a kind that this body lacks keeps what it has
        present = self.columns > 0
        self.count += x.shape[0]
        rate = x.shape[0] / self.count
        change = torch.where(present, mean - self._mean[0], 0.0)
        self._mean += rate * change
        new = var - self._var[0] + change * (mean - self._mean[0])
        self._var += rate * torch.where(present, new, 0.0)
        self._std = torch.sqrt(self._var)

    def _over_kinds(self, values: torch.Tensor) -> torch.Tensor:
        """[num_obs] to the mean of each kind, [num_kinds]."""
        sums = torch.zeros_like(self.columns).index_add(0, self.kind, values)
        return sums / self.columns.clamp(min=1.0)


class RoleGaussian(GaussianDistribution):
    """Gaussian whose learned deviation is one number per role of joint, and so fits any number of joints."""

    role: torch.Tensor

    def __init__(self, output_dim: int, joint_names: Sequence[str], init_std: float = 1.0) -> None:
        """One joint per output."""
        super().__init__(len(ROLES), init_std)
        self.output_dim = output_dim
        role = torch.tensor([ROLES.index(leg_and_role(name)[2]) for name in joint_names])
        self.register_buffer("role", role, persistent=False)

    def update(self, mlp_output: torch.Tensor) -> None:
        """Takes the means, [batch, output_dim]."""
        deviation = self.std_param.clamp(self.std_range[0], self.std_range[1])
        self._distribution = Normal(mlp_output, deviation.index_select(0, self.role).expand_as(mlp_output))
