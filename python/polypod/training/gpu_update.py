"""rsl_rl's PPO update on a GPU: each mini-batch is one launch of a CUDA graph.

A mini-batch of small networks is a few hundred kernels of a few microseconds each. Launched one by
one they take several times as long as they compute.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import nn

from polypod import _core
from polypod.networks.masked import ACTION_MASK, MaskedGaussian
from polypod.networks.urma import JointCounts, counted
from polypod.rsl_rl import VecEnv
from polypod.runs.schema import ALTERNATE, AlgorithmConfig
from polypod.training import deviations
from polypod.training.adam import graph_adam, tensors_of
from polypod.training.graphs import Graphs
from polypod.training.symmetry import Mirror, mirror_losses
from polypod.training.workers import Workers

RATE_STEP = 1.5
"""The learning rate is multiplied or divided by this where the divergence is far from the one that
is wanted."""
LOWEST_RATE, HIGHEST_RATE = 1e-5, 1e-2
"""Learning rates that rsl_rl's adaptive schedule keeps to."""


class Samples:
    """The samples of an iteration on the learner's device, by steps and envs."""

    counts: JointCounts | None = None
    """Joints of the robots, where each mini-batch holds every env equally often."""

    def __init__(self, groups: Mapping[str, int], num_actions: int, count: int, device: torch.device) -> None:
        """Makes room for `count` samples.

        Args:
            groups: widths of the observation groups.
            num_actions: of the policy.
            count: number of samples.
            device: of the learner.
        """
        self.observations = {name: torch.zeros((count, width), device=device) for name, width in groups.items()}
        """Observations by group, [samples, n]."""
        widths = {"actions": num_actions, "means": num_actions}
        single = {"log_probs": 1, "values": 1, "returns": 1, "advantages": 1}
        self.numbers = {name: torch.zeros((count, n), device=device) for name, n in {**widths, **single}.items()}
        """Numbers of the samples, [samples, n]; also `deviations`, [samples, num_actions], where
        they are a network's output."""
        self.order = torch.zeros(count, dtype=torch.int64, device=device)
        """Order in which the mini-batches take the samples, [samples]."""
        self.places = torch.zeros(count, dtype=torch.int64, device=device)
        """Places of the samples, [samples]; those with an even number begin as they are where
        images take turns, the others as images."""
        self.batch_sizes: list[int] = []

    def __getitem__(self, name: str) -> torch.Tensor:
        """Values of a quantity, [samples, numbers]."""
        return self.numbers[name]


def ask_policy(actor: MLPModel, observations: TensorDict) -> None:
    """Updates the actions' distribution like the actor's forward, without sampling actions."""
    distribution = actor.distribution
    if isinstance(distribution, MaskedGaussian) and ACTION_MASK in observations.keys():  # noqa: SIM118
        distribution.mask = observations[ACTION_MASK]
    distribution.update(actor.mlp(actor.get_latent(observations)))


class Update:
    """Steps of Adam on rsl_rl's loss, on any device; a CUDA device replays graphs of them.

    Several workers, each with the samples of its envs, take the steps that one would take with all
    samples. They sum gradients and figures of each mini-batch, between a graph of the gradients and
    one of the step.
    """

    def __init__(
        self,
        alg: PPO,
        env: VecEnv,
        samples: Samples,
        algorithm: AlgorithmConfig,
        symmetry: tuple[Mirror, bool | str] | None,
        workers: Workers,
    ) -> None:
        """Prepares the update of the networks of `alg`.

        Args:
            alg: whose networks learn; its optimiser and storage are not looked at.
            env: whose envs the samples are of.
            samples: what they learn from.
            algorithm: how.
            symmetry: the mirror and `[run] symmetry`; None: samples have no images.
            workers: those that learn together.
        """
        self._alg, self._env, self._samples, self._algorithm = alg, env, samples, algorithm
        self._workers = workers
        sim = env.unwrapped.sim
        device = self._device = torch.device(alg.device)
        self._mirror = None if symmetry is None else symmetry[0]
        self._is_in_turn = symmetry is not None and symmetry[1] == ALTERNATE
        mask = torch.from_numpy(sim.action_mask.astype(np.float32)).to(device)
        self._mask = mask if sim.is_padded else None
        self._networks = (alg.actor, alg.critic)
        self._rate = torch.tensor(algorithm.learning_rate, device=device)
        self._entropy_coef, self._desired_kl = (torch.zeros((), device=device) for _ in range(2))
        self._epoch = torch.zeros((), dtype=torch.int64, device=device)
        self._losses = torch.zeros(3, device=device)
        self._old_std = torch.zeros(sim.num_actions, device=device)
        """Deviations that the samples were drawn with, where they are parameters."""
        self._index = torch.zeros(len(samples.order), dtype=torch.int64, device=device)
        parameters = [parameter for network in self._networks for parameter in network.parameters()]
        self.optimizer = graph_adam(parameters, self._rate)
        self._sizes: list[tuple[int, ...]] = []
        """Sizes of each mini-batch: the samples of each worker."""
        self._parameters = parameters
        self._widths = [*(parameter.numel() for parameter in parameters), 3, 2]
        self._sums = torch.zeros(sum(self._widths), device=device)
        """Gradients of the parameters, losses, divergence: what several workers sum."""
        self._advantage_moments = torch.zeros(2, dtype=torch.float64, device=device)
        """Mean and deviation over a mini-batch of several workers."""
        self._graphs = Graphs(device, self._changed, workers.count == 1)

    def run(
        self,
        learning_rate: float,
        entropy_coef: float,
        desired_kl: float | None,
        meanwhile: Callable[[], None] | None = None,
    ) -> dict[str, float]:
        """Learns from the samples, and takes their observations into the networks' statistics.

        Args:
            learning_rate: to begin with.
            entropy_coef: weight of the entropy.
            desired_kl: divergence that an adaptive learning rate follows; None: it stays.
            meanwhile: is called when all steps are queued, before the device is waited for.

        Returns:
            The mean losses `value`, `surrogate` and `entropy`, and the `learning_rate` to go on
            with.

        Raises:
            ConfigError: where a loss is not finite.
        """
        samples, workers = self._samples, self._workers
        if not self._sizes:
            self._sizes = list(zip(*workers.gather_messages(samples.batch_sizes), strict=True))
        self._rate.fill_(learning_rate)
        self._entropy_coef.fill_(entropy_coef)
        # a graph compares with the number as it is then, and nothing is more or less than no number
        self._desired_kl.fill_(math.nan if desired_kl is None else desired_kl)
        self._losses.zero_()
        with torch.no_grad():
            if (learnt := deviations.of(self._alg.actor.distribution)) is not None:
                self._old_std.copy_(learnt)
        for epoch in range(self._algorithm.num_learning_epochs):
            self._epoch.fill_(epoch)
            for order, sizes in zip(torch.split(samples.order, samples.batch_sizes), self._sizes, strict=True):
                self._index[: len(order)].copy_(order)
                self._learn_mini_batch(sizes)
        with torch.no_grad():
            observations = self._observations(torch.arange(len(samples["actions"]), device=self._device))
            for network in self._networks:
                update_normalization(network, observations)
        if meanwhile is not None:
            meanwhile()
        value, surrogate, entropy, rate = torch.cat([self._losses, self._rate.view(1)]).tolist()
        if not np.isfinite([value, surrogate, entropy]).all():
            raise _core.ConfigError(
                f"update: value loss {value}, surrogate loss {surrogate}; resume from the checkpoint before it with a "
                "smaller learning rate"
            )
        updates = self._algorithm.num_learning_epochs * len(samples.batch_sizes)
        losses = {"value": value / updates, "surrogate": surrogate / updates, "entropy": entropy / updates}
        return {**losses, "learning_rate": rate}

    def _learn_mini_batch(self, sizes: tuple[int, ...]) -> None:
        """Learns from a mini-batch: the first samples of `_index`, `sizes` of this worker."""
        if self._workers.count == 1:
            self._run("step", sizes, lambda: self._apply(*self._backward(sizes)))
            return
        if self._algorithm.normalize_advantage_per_mini_batch:
            self._measure_advantages(sizes)
        self._run("gradients", sizes, lambda: self._write_sums(sizes))
        self._workers.sum(self._sums)
        self._run("step", (), self._apply_sums)

    def _run(self, name: str, sizes: tuple[int, ...], step: Callable[[], None]) -> None:
        """Computes a step, of which there is a graph for each name and sizes."""
        self._graphs.run((name, *sizes), step)

    def _changed(self) -> list[torch.Tensor]:
        """Tensors that a step changes and the next step reads."""
        return [self._rate, self._losses, self._sums, *tensors_of(self.optimizer)]

    def _observations(self, index: torch.Tensor) -> TensorDict:
        groups = {name: tensor[index] for name, tensor in self._samples.observations.items()}
        if self._mask is not None:
            groups[ACTION_MASK] = self._mask[index % len(self._mask)]
        return TensorDict(groups, batch_size=[len(index)], device=self._device)

    def _with_images(
        self, index: torch.Tensor, observations: TensorDict, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor | None]:
        """Returns the batch with mirror images, and its original rows; None: the first rows."""
        if self._mirror is None:
            return observations, actions, None
        both, both_actions = self._mirror.augment(self._env, observations, actions)
        assert both is not None
        assert both_actions is not None
        if not self._is_in_turn:
            return both, both_actions, None
        n, is_image = len(index), ((self._samples.places[index] + self._epoch) % 2 == 1).unsqueeze(1)
        groups = {name: torch.where(is_image, both[name][n:], both[name][:n]) for name in observations.keys()}  # noqa: SIM118
        chosen = TensorDict(groups, batch_size=[n], device=self._device)
        return chosen, torch.where(is_image, both_actions[n:], both_actions[:n]), ~is_image.squeeze(1)

    def _backward(self, sizes: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradients of a mini-batch.

        Returns its losses [3] and divergence [2]: what this worker has of them.
        """
        samples, algorithm = self._samples, self._algorithm
        actor, critic = self._networks
        n, clip = sizes[self._workers.index], algorithm.clip_param
        index, share = self._index[:n], n / sum(sizes)
        observations, actions, is_sample = self._with_images(
            index, self._observations(index), samples["actions"][index]
        )
        copies = len(actions) // n
        old_log_prob, old_values, returns, advantages = (
            samples[name][index].squeeze(1).repeat(copies) for name in ("log_probs", "values", "returns", "advantages")
        )
        if algorithm.normalize_advantage_per_mini_batch:
            advantages = self._normalized(advantages, n)
        with torch.autocast(
            self._device.type,
            dtype=torch.bfloat16,
            enabled=algorithm.mixed_precision == "on",
            cache_enabled=False,  # a graph reads the weights at each replay
        ):
            with counted(self._networks, samples.counts):
                ask_policy(actor, observations)
                values = critic(observations).squeeze(1)
            log_prob = actor.get_output_log_prob(actions)
            entropy = actor.output_entropy[:n].mean()
            with torch.no_grad():
                divergence = self._divergence(index, is_sample)
            ratio = torch.exp(log_prob - old_log_prob)
            surrogate = torch.max(-advantages * ratio, -advantages * ratio.clamp(1.0 - clip, 1.0 + clip)).mean()
            value_losses = (values - returns).square()
            if algorithm.use_clipped_value_loss:
                clipped = old_values + (values - old_values).clamp(-clip, clip)
                value_losses = torch.max(value_losses, (clipped - returns).square())
            value = value_losses.mean()
            loss = surrogate + algorithm.value_loss_coef * value - self._entropy_coef * entropy
            if algorithm.mirror_loss_coef:
                loss = loss + algorithm.mirror_loss_coef * self._mirror_loss(index, is_sample)
        self.optimizer.zero_grad(set_to_none=True)
        (loss * share).backward()
        losses = torch.stack([value.detach(), surrogate.detach(), entropy.detach()]).float() * share
        return losses, divergence.float()

    def _mirror_loss(self, index: torch.Tensor, is_sample: torch.Tensor | None) -> torch.Tensor:
        """Mirror loss of the mini-batch's images; half of the rows are images, up to chance."""
        assert self._mirror is not None
        _, means = self._mirror.augment(self._env, None, self._samples["means"][index])
        assert means is not None
        if is_sample is None:
            return mirror_losses(self._alg.actor, means)[len(index) :].mean()
        losses = mirror_losses(self._alg.actor, means[len(index) :])
        return 2.0 * torch.where(is_sample, 0.0, losses).mean()

    def _apply(self, losses: torch.Tensor, divergence: torch.Tensor) -> None:
        """A step of Adam with the gradients that there are."""
        self._adapt_rate(divergence)
        for network in self._networks:
            nn.utils.clip_grad_norm_(network.parameters(), self._algorithm.max_grad_norm)
        self.optimizer.step()
        deviations.limit(self._alg.actor.distribution)
        self._losses += losses

    def _write_sums(self, sizes: tuple[int, ...]) -> None:
        """Writes this worker's part of `_sums`."""
        figures = self._backward(sizes)
        gradients = [parameter.grad for parameter in self._parameters if parameter.grad is not None]
        torch.cat([tensor.flatten() for tensor in (*gradients, *figures)], out=self._sums)

    def _apply_sums(self) -> None:
        """The step with what all workers have."""
        *gradients, losses, divergence = torch.split(self._sums, self._widths)
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient.view_as(parameter)
        self._apply(losses, divergence)

    def _measure_advantages(self, sizes: tuple[int, ...]) -> None:
        """Moments of the mini-batch of all workers."""
        n, total = sizes[self._workers.index], sum(sizes)
        of_samples = self._samples["advantages"][self._index[:n]].double()
        mean = self._workers.sum(of_samples.sum()) / total
        squares = self._workers.sum((of_samples - mean).square().sum()) / (total - 1)
        self._advantage_moments.copy_(torch.stack([mean, squares.sqrt()]))

    def _normalized(self, advantages: torch.Tensor, n: int) -> torch.Tensor:
        """Advantages of mean 0 and deviation 1 over the mini-batch.

        Its first `n` rows are this worker's samples.
        """
        if self._workers.count == 1:
            of_samples = advantages[:n]
            return (advantages - of_samples.mean()) / (of_samples.std() + 1e-8)
        mean, deviation = self._advantage_moments
        return ((advantages - mean) / (deviation + 1e-8)).float()

    def _divergence(self, index: torch.Tensor, is_sample: torch.Tensor | None) -> torch.Tensor:
        """Sum of the divergence from the old policy over true samples; their number."""
        n, numbers = len(index), self._samples.numbers
        means = numbers["means"][index]
        std = numbers["deviations"][index] if "deviations" in numbers else self._old_std.expand_as(means)
        new = tuple(of[:n].float() for of in self._alg.actor.output_distribution_params)
        old = (means, std, *new[2:])
        divergence = self._alg.actor.get_kl_divergence(old, new)
        weights = torch.ones_like(divergence) if is_sample is None else is_sample.to(divergence.dtype)
        return torch.stack([(divergence * weights).sum(), weights.sum()])

    def _adapt_rate(self, divergence: torch.Tensor) -> None:
        """Follows the divergence of the mini-batch, as `_divergence` gives it."""
        if self._algorithm.schedule != "adaptive":
            return
        mean = divergence[0] / divergence[1].clamp(min=1.0)
        rate, wanted = self._rate, self._desired_kl
        slower, faster = (rate / RATE_STEP).clamp(min=LOWEST_RATE), (rate * RATE_STEP).clamp(max=HIGHEST_RATE)
        is_small = (mean < wanted / 2.0) & (mean > 0.0)
        rate.copy_(torch.where(mean > wanted * 2.0, slower, torch.where(is_small, faster, rate)))


@torch.no_grad()
def update_normalization(network: MLPModel, observations: TensorDict) -> None:
    """Takes observations into the network's statistics, which stay where graphs read them."""
    buffers = dict(network.named_buffers())
    network.update_normalization(observations)
    for name, old in buffers.items():
        owner, _, leaf = name.rpartition(".")
        new = network.get_buffer(name)
        if new is not old:
            old.copy_(new)
            setattr(network.get_submodule(owner), leaf, old)
