"""A network of joints: it learns what a joint is, not which column of the observation it has.

After URMA, Bohlinger et al., "One Policy to Run Them All: an End-to-end Learning Approach to
Multi-Embodiment Locomotion", CoRL 2024: every joint is described, one encoder reads all joints,
attention over the joints gathers the body's state, and one decoder turns it into each joint's
action by the joint's description. As there, the deviation of an action depends on the joint's
description. As in the author's later networks, a joint's action is an inner product of the body's
state and the joint's key. Here each head shares its attention among a robot's joints.

Joints must be told apart before anything can be learned about them. The joints of one robot differ
in their descriptions, so every description is compared with those of the other joints, and sines of
the comparison are the joint's code. Codes of different joints are nearly orthogonal for any robot,
so that each joint starts with a separate reading and key, and codes of corresponding joints of
different robots are nearly the same.
"""

import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization
from rsl_rl.modules.distribution import Distribution, HeteroscedasticGaussianDistribution
from rsl_rl.utils import resolve_nn_activation
from tensordict import TensorDict
from torch.distributions import Normal

from polypod import _core
from polypod.descriptions import LOG_FLOOR
from polypod.networks.joints import JointColumns, as_range, joint_columns
from polypod.networks.masked import MaskedGaussian
from polypod.observation import Layout

RELATIVE_FLOOR = 0.1
"""Deviation within a robot, in deviations over all joints, below which joints count as equal."""
STD_RANGE = (0.01, 2.0)
"""Bounds of the standard deviation of actions; URMA has 2 at most."""
_FIRST_FOCUS = 5.0
"""Deviation of the first attention over a robot's joints: each head begins by looking at one joint
or two."""
_FIRST_FREQUENCY = 1.0
"""Deviation of the first weights of a code: joints that differ by one deviation in n numbers have
codes with a correlation of exp(-n / 2)."""
KEY_SCALE = 2.0
"""Scale of an action's inner product over the numbers of a code. A step of the optimiser moves
every number of the body's state in the same sense, so the sum over them must be a mean: else a step
changes the policy by far more than a perceptron's, the divergence that PPO aims at holds the
learning rate down, and all else learns slowly."""
REFLEX_SCALE = 0.1
"""Scale of the reflex, whose weights all joints of all robots share: a step moves all actions in
the same sense."""
OUTSIDE = -1e4
"""Attention to joints that a robot lacks, before the softmax."""


class JointCounts(NamedTuple):
    """Joints of the robots of a rollout.

    A batch that holds every env equally often has as many for each of them.
    """

    envs: int
    joints: int
    """Number of joints of all envs."""
    most: int
    """Largest number of joints of one env."""


class _Joints(NamedTuple):
    """The joints of a batch, one row each: the real ones, or all places where that is as cheap."""

    states: torch.Tensor
    """Scaled states of the joints, [rows, numbers]."""
    descriptions: torch.Tensor
    """Descriptions of the joints, [rows, features]."""
    relative: torch.Tensor
    """Part of the descriptions that compares joints of one robot, [rows, numbers]."""
    present: torch.Tensor
    """Whether a sample's places hold a joint, [batch, places]."""
    legs: torch.Tensor | None
    """Whether they hold a joint of a leg, [batch, places]; None without heads of legs."""
    place_of_row: torch.Tensor | None
    """Place of each row in batch x places, [rows]; None: rows are all places."""
    sample_of_row: torch.Tensor | None
    """Sample of each row, [rows]; None: every sample has all slots."""
    slot_of_row: torch.Tensor | None
    """Place of each row in batch x slots, [rows]; None: places are slots."""

    def at_places(self, rows: torch.Tensor) -> torch.Tensor:
        """Spreads rows [rows, n] over places [batch, places, n]; places without a row are zero."""
        if self.place_of_row is not None:
            places = rows.new_zeros(self.present.numel(), rows.shape[1])
            rows = places.index_copy(0, self.place_of_row, rows)
        return rows.reshape(*self.present.shape, rows.shape[1])

    def of_rows(self, samples: torch.Tensor) -> torch.Tensor:
        """Repeats numbers of samples [batch, n] for their rows, [rows, n]."""
        if self.sample_of_row is None:
            places = self.present.shape[1]
            return samples.unsqueeze(1).expand(-1, places, -1).flatten(0, 1)
        return samples.index_select(0, self.sample_of_row)

    def at_slots(self, rows: torch.Tensor, slots: int) -> torch.Tensor:
        """Spreads outputs [rows] over slots [batch, slots], zero where there is no joint."""
        batch = self.present.shape[0]
        if self.slot_of_row is None:
            return rows.reshape(self.present.shape) * self.present
        return rows.new_zeros(batch * slots).index_copy(0, self.slot_of_row, rows).reshape(batch, slots)


class JointNetwork(torch.nn.Module):
    """Maps observations [batch, num_obs] to actions of joints, or to numbers about the whole body.

    No parameter's shape depends on the number of joints, so weights go from one body to another.
    The output of an actor is [batch, 3, slots]: mean, deviation, and 1 where there is a joint; mean
    and mask are exactly zero elsewhere.
    """

    state_columns: torch.Tensor
    description_columns: torch.Tensor
    general_columns: torch.Tensor
    state_scale: torch.Tensor
    leg_slots: torch.Tensor

    def __init__(
        self,
        columns: JointColumns,
        num_outputs: int | None,
        joint_dim: int,
        num_heads: int,
        hidden_dims: Sequence[int],
        activation: str,
        normalize: bool = False,
        init_std: float = 1.0,
        leg_heads: int | None = None,
    ) -> None:
        """Draws the weights.

        Args:
            columns: where the observation holds what. `columns.legs` is read with `leg_heads`.
            num_outputs: numbers about the whole body; None: actions of the joints.
            joint_dim: width of a joint's encodings, at least 4.
            num_heads: of the attention; each gathers `joint_dim` / 4 numbers.
            hidden_dims: sizes of the layers between the gathered state and the decoder.
            activation: in rsl_rl's words.
            normalize: by running mean and deviation, which all joints share; else states by their
                magnitudes alone.
            init_std: first deviation of the actions.
            leg_heads: heads that look at joints of legs alone; the others look at all other joints,
                and gather zeros where there are none. Joints are compared with those of the legs.
                So the reading of a leg does not depend on which arms a body has. None: all heads
                look at all joints, and joints are compared with all of them.
        """
        super().__init__()
        self.leg_heads = leg_heads
        self.register_buffer("leg_slots", torch.from_numpy(columns.legs.copy()), persistent=False)
        self.num_joints = columns.num_joints
        self.num_states, self.num_descriptions = len(columns.states), len(columns.descriptions)
        for name in ("state", "description", "general"):
            of_kind = torch.from_numpy(getattr(columns, f"{name}s" if name != "general" else name).reshape(-1).copy())
            self.register_buffer(f"{name}_columns", of_kind, persistent=False)
        self._blocks = {
            name: as_range(getattr(self, f"{name}_columns").tolist()) for name in ("state", "description", "general")
        }
        self.register_buffer("state_scale", torch.from_numpy(1.0 / columns.magnitudes), persistent=False)
        self.normalize = normalize
        sizes = {"states": self.num_states, "numbers": self.num_descriptions, "logarithms": self.num_descriptions}
        sizes["general"] = len(columns.general)
        self.moments = torch.nn.ModuleDict(
            {name: EmpiricalNormalization(size) if normalize else torch.nn.Identity() for name, size in sizes.items()}
        )
        described = 3 * self.num_descriptions
        self.activation: torch.nn.Module = resolve_nn_activation(activation)
        self.describe = torch.nn.Sequential(
            torch.nn.Linear(described, joint_dim),
            resolve_nn_activation(activation),
            torch.nn.Linear(joint_dim, joint_dim),
            resolve_nn_activation(activation),
        )
        self.state = torch.nn.Linear(self.num_states, joint_dim)
        self.state_by_description = torch.nn.Linear(joint_dim, joint_dim, bias=False)
        self.value = torch.nn.Linear(joint_dim, max(joint_dim // 4, 1))
        self.code = torch.nn.Linear(self.num_descriptions, joint_dim)
        torch.nn.init.normal_(self.code.weight, std=_FIRST_FREQUENCY)
        torch.nn.init.uniform_(self.code.bias, 0.0, 2.0 * math.pi)
        self.attention = torch.nn.Linear(joint_dim, num_heads)
        # heads begin by looking at different joints: from equal weights they would have to find out
        # first
        self.focus = torch.nn.Linear(joint_dim, num_heads, bias=False)
        torch.nn.init.normal_(self.focus.weight, std=_FIRST_FOCUS / joint_dim**0.5)
        layers: list[torch.nn.Module] = []
        width = num_heads * self.value.out_features + len(columns.general)
        for size in hidden_dims:
            layers += [torch.nn.Linear(width, size), resolve_nn_activation(activation)]
            width = size
        self.body = torch.nn.Sequential(*layers)
        self.counts: JointCounts | None = None
        self.per_joint = num_outputs is None
        if num_outputs is None:
            self.request = torch.nn.Linear(width, 2 * joint_dim)
            self.reflex = torch.nn.Sequential(
                torch.nn.Linear(joint_dim, joint_dim), resolve_nn_activation(activation), torch.nn.Linear(joint_dim, 1)
            )
            self.deviation = torch.nn.Linear(described, 1)
            torch.nn.init.zeros_(self.deviation.weight)
            torch.nn.init.constant_(self.deviation.bias, math.log(init_std))
        else:
            self.decoder = torch.nn.Linear(width, num_outputs)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Maps observations [batch, num_obs] to [batch, 3, slots] or [batch, num_outputs]."""
        joints = self._joints(observations)
        description = self.describe(joints.descriptions)
        state = self.activation(self.state(joints.states) + self.state_by_description(description))
        # with deviation 1
        code = math.sqrt(2.0) * torch.sin(_at_least_single(self.code(joints.relative)))
        attention = joints.at_places(self.attention(description) + self.focus(code))
        shares = self._shares(attention, joints)
        values = joints.at_places(self.value(state))
        gathered = torch.matmul(shares.transpose(1, 2).to(values.dtype), values).flatten(1)
        body = self.body(torch.cat([gathered, self._general(observations)], dim=1))
        if not self.per_joint:
            return self.decoder(body)
        keys = torch.cat([code.to(description.dtype), description], dim=1) * (KEY_SCALE / code.shape[1])
        read = (joints.of_rows(self.request(body)) * keys).sum(dim=1) + REFLEX_SCALE * self.reflex(state).squeeze(-1)
        means = joints.at_slots(_at_least_single(read), self.num_joints)
        deviations = joints.at_slots(self.deviations(joints.descriptions), self.num_joints)
        mask = self.mask(observations).to(means.dtype)
        return torch.stack([means, deviations + (1.0 - mask), mask], dim=1)

    def _shares(self, attention: torch.Tensor, joints: _Joints) -> torch.Tensor:
        """Shares of the joints in what each head gathers, [batch, places, heads]."""
        present = joints.present.unsqueeze(-1)
        if joints.legs is None:
            return attention.masked_fill(~present, OUTSIDE).softmax(dim=1)
        assert self.leg_heads is not None
        legs, others = joints.legs.unsqueeze(-1), present & ~joints.legs.unsqueeze(-1)
        heads = (self.leg_heads, attention.shape[-1] - self.leg_heads)
        seen = torch.cat([legs.expand(-1, -1, heads[0]), others.expand(-1, -1, heads[1])], dim=2)
        return attention.masked_fill(~seen, OUTSIDE).softmax(dim=1) * seen

    def deviations(self, descriptions: torch.Tensor) -> torch.Tensor:
        """Deviations [rows] of joints with these descriptions [rows, features]."""
        # the weights are summed over the features: a step of the optimiser shall move the logarithm
        # by about its size
        weight = self.deviation.weight / self.deviation.in_features
        with torch.amp.autocast(descriptions.device.type, enabled=False):
            logarithms = torch.nn.functional.linear(descriptions, weight, self.deviation.bias).squeeze(-1)
            return logarithms.exp().clamp(*STD_RANGE)

    def update(self, observations: torch.Tensor) -> None:
        """Takes observations [batch, num_obs] into the running means and deviations.

        Statistics of joints count real joints alone.
        """
        if not self.normalize:
            return
        rows = self._features(observations).flatten(0, 1)
        rows = rows.index_select(0, self.mask(observations).flatten().nonzero().squeeze(1))
        states, numbers = rows[:, : self.num_states], rows[:, self.num_states :]
        self._moments("states").update(states * self.state_scale)
        self._moments("numbers").update(numbers)
        self._moments("logarithms").update(_logarithms(numbers))
        self._moments("general").update(self._block(observations, "general"))

    def _moments(self, name: str) -> EmpiricalNormalization:
        moments = self.moments[name]
        assert isinstance(moments, EmpiricalNormalization)
        return moments

    def _general(self, observations: torch.Tensor) -> torch.Tensor:
        general: torch.Tensor = self.moments["general"](self._block(observations, "general"))
        return general

    def _block(self, observations: torch.Tensor, name: str) -> torch.Tensor:
        block = self._blocks[name]
        if block is not None:
            return observations[:, block.start : block.stop]
        return observations.index_select(1, getattr(self, f"{name}_columns"))

    def mask(self, observations: torch.Tensor) -> torch.Tensor:
        """Whether a slot has a joint, [batch, slots]: its description holds more than zeros."""
        numbers = self._block(observations, "description").reshape(-1, self.num_descriptions, self.num_joints)
        return (numbers != 0.0).any(dim=1)

    def _features(self, observations: torch.Tensor) -> torch.Tensor:
        """States and descriptions as they are observed, [batch, slots, numbers]."""
        features = torch.cat([self._block(observations, "state"), self._block(observations, "description")], dim=1)
        return features.reshape(-1, self.num_states + self.num_descriptions, self.num_joints).transpose(1, 2)

    def _sizes(self, counts: torch.Tensor) -> tuple[int, int]:
        """Rows of a batch and places of a sample, for samples with `counts` joints each."""
        batch, slots = counts.shape[0], self.num_joints
        # a graph has all slots: what it leaves out must not depend on the example that it is traced
        # with
        if torch.jit.is_tracing():  # type: ignore[attr-defined, no-untyped-call]
            return batch * slots, slots
        if self.counts is not None:
            return batch // self.counts.envs * self.counts.joints, self.counts.most
        num_rows, most = torch.stack([counts.sum(), counts.max()]).tolist()
        return int(num_rows), int(most)

    def _joints(self, observations: torch.Tensor) -> _Joints:
        mask, features = self.mask(observations), self._features(observations)
        batch, slots = observations.shape[0], self.num_joints
        counts = mask.sum(dim=1)
        place_of_row = sample_of_row = slot_of_row = None
        present = mask
        legs = mask & self.leg_slots if self.leg_heads is not None else None
        num_rows, most = self._sizes(counts)
        if num_rows < batch * slots:
            ranks = mask.cumsum(dim=1) - 1
            slot_of_row = _where_true(mask.flatten(), num_rows)
            sample_of_row = torch.div(slot_of_row, slots, rounding_mode="floor")
            place_of_row = sample_of_row * most + ranks.flatten().index_select(0, slot_of_row)
            rows = features.flatten(0, 1).index_select(0, slot_of_row)
            features = rows.new_zeros(batch * most, rows.shape[1]).index_copy(0, place_of_row, rows)
            features = features.reshape(batch, most, rows.shape[1])
            present = torch.arange(most, device=mask.device) < counts.unsqueeze(1)
            if legs is not None:
                legs_of_rows = legs.flatten().index_select(0, slot_of_row)
                legs = present.new_zeros(batch * most).index_copy(0, place_of_row, legs_of_rows).reshape(batch, most)
        states, numbers = features[..., : self.num_states], features[..., self.num_states :]
        states = self.moments["states"](states * self.state_scale)
        there = present.unsqueeze(-1).to(states.dtype)
        absolute = self.moments["numbers"](numbers) * there
        # joints that the others are compared with
        compared = None if legs is None else legs.unsqueeze(-1).to(states.dtype)
        if legs is not None:
            counts = legs.sum(dim=1)
        counted = counts.clamp(min=1).view(-1, 1, 1).to(states.dtype)

        def mean(of_joints: torch.Tensor) -> torch.Tensor:
            """Means over the places, [batch, places, numbers] to [batch, 1, numbers]."""
            return (of_joints if compared is None else of_joints * compared).sum(dim=1, keepdim=True) / counted

        differences = (absolute - mean(absolute)) * there
        deviations = mean(differences.square()).sqrt()
        relative = differences / (deviations + RELATIVE_FLOOR)
        logarithms = self.moments["logarithms"](_logarithms(numbers)) * there
        descriptions = torch.cat([absolute, logarithms, relative], dim=2).flatten(0, 1)
        states, relative = states.flatten(0, 1), relative.flatten(0, 1)
        if place_of_row is not None:
            states, descriptions, relative = (x.index_select(0, place_of_row) for x in (states, descriptions, relative))
        return _Joints(states, descriptions, relative, present, legs, place_of_row, sample_of_row, slot_of_row)


def _where_true(mask: torch.Tensor, count: int) -> torch.Tensor:
    """Places of the `count` ones of a mask [n] in order, int64 [count]; nothing waits for a GPU."""
    numbers = torch.arange(mask.shape[0], device=mask.device)
    ranks = torch.where(mask, mask.cumsum(dim=0) - 1, count)
    return numbers.new_zeros(count + 1).scatter(0, ranks, numbers)[:count]


def _at_least_single(numbers: torch.Tensor) -> torch.Tensor:
    """The numbers in single precision, or in double where they have it."""
    return numbers if numbers.dtype == torch.float64 else numbers.float()


def _logarithms(numbers: torch.Tensor) -> torch.Tensor:
    """Logarithms of magnitudes: efforts, gains and inertias of robots differ by factors."""
    return (numbers.abs() + LOG_FLOOR).log()


@contextlib.contextmanager
def counted(models: Iterable[torch.nn.Module], counts: JointCounts | None) -> Iterator[None]:
    """Tells networks of joints their batches' numbers of joints, which saves waits for a GPU.

    Args:
        models: networks, of which those of joints are told.
        counts: of a rollout of which each batch holds every env equally often; None: batches are
            counted.
    """
    networks = [model.mlp for model in models if isinstance(model, UrmaModel)]
    for network in networks:
        network.counts = counts
    try:
        yield
    finally:
        for network in networks:
            network.counts = None


class UrmaModel(MLPModel):
    """rsl_rl's model with a `JointNetwork` in the place of its perceptron, as actor or as critic.

    The slots of a robot are read off its description, so that batches of different bodies need no
    mask.
    """

    mlp: JointNetwork

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        hidden_dims: Sequence[int] = (256, 128),
        activation: str = "elu",
        obs_normalization: bool = False,
        distribution_cfg: dict[str, Any] | None = None,
        *,
        joint_dim: int,
        num_heads: int,
        observation_layout: Layout,
        joint_names: Sequence[str],
        leg_heads: int | None = None,
    ) -> None:
        """Draws the weights, as rsl_rl asks for it.

        Args:
            obs: as of `MLPModel`.
            obs_groups: see `MLPModel`.
            obs_set: "critic" for a network whose outputs are about the whole body.
            output_dim: number of outputs.
            hidden_dims: see `JointNetwork`.
            activation: see `JointNetwork`.
            obs_normalization: normalise observations, see `JointNetwork`.
            distribution_cfg: a `JointGaussian`, for an actor.
            joint_dim: see `JointNetwork`.
            num_heads: see `JointNetwork`.
            observation_layout: terms of the observation, see `polypod.observation.layout_of`.
            joint_names: slots of the action.
            leg_heads: see `JointNetwork`.

        Raises:
            ConfigError: for an observation without what the network reads.
        """
        super().__init__(obs, obs_groups, obs_set, output_dim, [1], activation, False, distribution_cfg)
        columns = joint_columns(observation_layout, joint_names)
        if columns.num_obs != self.obs_dim:
            raise _core.ConfigError(
                f"observation_layout counts {columns.num_obs} numbers, but an observation has {self.obs_dim}"
            )
        outputs = output_dim if obs_set == "critic" else None
        if outputs is None and output_dim != columns.num_joints:
            raise _core.ConfigError(f"{columns.num_joints} joint_names, but an action has {output_dim} numbers")
        if outputs is None and not isinstance(self.distribution, JointGaussian):
            raise _core.ConfigError("a network of joints draws its actions from a polypod.networks:JointGaussian")
        init_std = self.distribution.init_std if isinstance(self.distribution, JointGaussian) else 1.0
        self.mlp = JointNetwork(
            columns, outputs, joint_dim, num_heads, hidden_dims, activation, obs_normalization, init_std, leg_heads
        )

    def update_normalization(self, obs: TensorDict) -> None:
        """Takes observations into the running means and deviations."""
        if self.training:
            self.mlp.update(torch.cat([obs[group] for group in self.obs_groups], dim=-1))


class JointGaussian(MaskedGaussian):
    """A Gaussian whose means, deviations and mask are the output of a `JointNetwork`."""

    def __init__(self, output_dim: int, init_std: float = 1.0) -> None:
        """Makes the distribution of actions of `output_dim` slots."""
        Distribution.__init__(self, output_dim)
        self.init_std = init_std
        self._distribution: Normal | None = None
        Normal.set_default_validate_args(False)

    def update(self, mlp_output: torch.Tensor) -> None:
        """Takes means, deviations and mask, [n, 3, output_dim]."""
        mean, deviation, self.mask = mlp_output.unbind(dim=-2)
        self._distribution = Normal(mean, deviation)

    def deterministic_output(self, mlp_output: torch.Tensor) -> torch.Tensor:
        """The means, [n, output_dim]."""
        return mlp_output.select(-2, 0).contiguous()

    def as_deterministic_output_module(self) -> torch.nn.Module:
        """Module that takes the means out of the network's output."""
        return HeteroscedasticGaussianDistribution(self.output_dim).as_deterministic_output_module()
