"""Training with the native learner's rollouts on the CPU, and its update on a GPU."""

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from polypod import _core
from polypod.training.adam import give_moments, take_moments
from polypod.training.gpu_update import Samples, Update
from polypod.training.native import NETWORKS, NativeRunner, array_of
from polypod.training.runner import Runner
from polypod.training.symmetry import Mirror


class NativeSamples(Samples):
    """The samples of the native learner, whose threads write them into pinned memory."""

    def __init__(self, sim: _core.VecSim, num_steps: int, device: torch.device) -> None:
        """Makes room for `num_steps` steps of the envs of `sim`."""
        groups, count = sim.observation_groups, sim.num_envs * num_steps
        super().__init__({}, sim.num_actions, count, device)
        rows = torch.zeros((count, max(stop for _, stop in groups.values())), device=device)
        self.observations = {name: rows[:, start:stop] for name, (start, stop) in groups.items()}
        self._device = {"observations": rows, **self.numbers}
        is_cuda = device.type == "cuda"
        self._host = {name: torch.zeros(tensor.shape, pin_memory=is_cuda) for name, tensor in self._device.items()}
        self._arrays: dict[str, np.ndarray] = {name: tensor.numpy().ravel() for name, tensor in self._host.items()}

    def take(self, learner: _core.Learner, sim: _core.VecSim) -> None:
        """Takes over the samples that `learner` has collected."""
        arrays = learner.rollout(sim, self._arrays)
        for name, host in self._host.items():
            self._device[name].copy_(host, non_blocking=True)
        self.order.copy_(torch.from_numpy(arrays["order"].astype(np.int64)))
        self.places.copy_(torch.from_numpy(arrays["places"].astype(np.int64)))
        self.batch_sizes = arrays["batch_sizes"].tolist()


class GpuRunner(NativeRunner):
    """A `NativeRunner` that learns on a GPU what its threads have collected.

    It computes what rsl_rl computes with the same samples, but not the bits of the update on the
    CPU. Each of several workers has a GPU for its own samples, or shares one.
    """

    def _prepare(self) -> None:
        env, run = self.env, self.config.run
        mirror = (Mirror(env, self.device), run.symmetry) if run.symmetry else None
        self._samples = NativeSamples(env.unwrapped.sim, run.num_steps_per_env, torch.device(self.device))
        self._no_moments = {
            name: [array_of(torch.zeros_like(parameter)) for parameter in self._parameters(name)] for name in NETWORKS
        }
        self._update_of = Update(self.alg, env, self._samples, self.config.algorithm, mirror, self.workers)
        super()._prepare()

    def _update(self, observations: TensorDict) -> dict[str, float]:
        self._samples.take(self._learner, self.env.unwrapped.sim)
        loss = self._update_of.run(self.alg.learning_rate, self.alg.entropy_coef, self.alg.desired_kl)
        self.alg.learning_rate = loss.pop("learning_rate")
        self._give_policy()
        return loss

    def _actor_state(self) -> Any:
        return Runner._actor_state(self)

    def _restore_actor(self, state: Any) -> None:
        Runner._restore_actor(self, state)
        self._give_policy()

    def _optimizer(self) -> torch.optim.Optimizer:
        return self._update_of.optimizer

    def _give(self) -> None:
        """Hands networks and statistics to the native learner, and Adam's moments to the update."""
        super()._give()
        take_moments(self._update_of.optimizer, self.alg.optimizer)

    def _give_policy(self) -> None:
        """Hands the acting and the estimating network and statistics to the native learner."""
        for name in NETWORKS:
            parameters = self._parameters(name)
            flat = torch.nn.utils.parameters_to_vector(parameters).detach().cpu()
            sizes = [parameter.numel() for parameter in parameters]
            weights = [part.numpy() for part in torch.split(flat, sizes)]
            self._learner.set_network(name, weights, self._no_moments[name], self._no_moments[name], 0)
            self._give_normalizers(name)

    def _take_networks(self) -> None:
        """Networks and statistics of observations are rsl_rl's; Adam's moments the update's."""
        give_moments(self._update_of.optimizer, self.alg.optimizer)
