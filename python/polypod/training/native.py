"""Training with the native learner, in f32.

Policy, simulator and update take turns on the simulator's threads.

rsl_rl's networks and optimiser stay as the form in which a run is begun, saved and loaded. So a run
may begin with one learner and go on with the other.
"""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from polypod import _core
from polypod.networks import UrmaModel
from polypod.python_terms import TermSim
from polypod.training.runner import Runner

NETWORKS = ("actor", "critic")


class NativeRunner(Runner):
    """A `Runner` whose iterations are computed by `polypod._core.Learner`."""

    draws = False
    # samples and mirror images are the native learner's: rsl_rl stores none
    storage = {"symmetry": False, "num_steps_per_env": 1}  # noqa: RUF012

    def _prepare(self) -> None:
        sim, workers = self.env.unwrapped.sim, self.workers
        self.cfg = self.logger.cfg = self.config.rsl_rl_cfg(sim)
        peers = workers if workers.count > 1 else None
        options = json.dumps(self.config.native_options(sim))
        self._learner = _core.Learner(sim, options, peers, workers.index, workers.count)
        self._take_from_rsl_rl()

    def _collect(self, observations: TensorDict) -> TensorDict:
        sim = self.env.unwrapped.sim
        if isinstance(sim, TermSim):
            self.logger.ended = self._collect_with_terms(sim)
        else:
            self.logger.ended = self._learner.collect(
                sim, self.current_learning_iteration, self.config.run.clip_actions
            )
        return observations

    def _collect_with_terms(self, sim: TermSim) -> list[tuple[int, int, float, float]]:
        """`Learner.collect` with Python between the steps."""
        self._learner.begin(self.current_learning_iteration)
        limit = self.config.run.clip_actions
        for _ in range(self.config.run.num_steps_per_env):
            actions = self._learner.act(sim)
            sim.step(actions if limit is None else np.clip(actions, -np.float32(limit), np.float32(limit)))
            self._learner.record(sim.reward, sim.terminated, sim.truncated)
        return self._learner.finish(sim)

    def _update(self, observations: TensorDict) -> dict[str, float]:
        self._learner.set_goals(self.alg.entropy_coef, self.alg.desired_kl if self.alg.schedule == "adaptive" else None)
        loss = self._learner.update(self.env.unwrapped.sim, self.alg.learning_rate)
        self.alg.learning_rate = loss.pop("learning_rate")
        return loss

    def _actor_state(self) -> Any:
        return self._learner.network("actor")

    def _restore_actor(self, state: Any) -> None:
        self._learner.set_network("actor", *state)

    def _action_std(self) -> torch.Tensor:
        return torch.from_numpy(self._learner.action_std())

    def start_from(self, path: Path) -> None:
        """Takes over a checkpoint's networks and nothing else."""
        super().start_from(path)
        self._take_from_rsl_rl()

    def _take_from_rsl_rl(self) -> None:
        """Hands rsl_rl's networks, optimiser and statistics to the native learner."""
        for name in NETWORKS:
            parameters = self._parameters(name)
            states = [self.alg.optimizer.state.get(parameter, {}) for parameter in parameters]
            zeros = [torch.zeros_like(parameter) for parameter in parameters]
            first, second = (
                [array_of(state.get(key, zero)) for state, zero in zip(states, zeros, strict=True)]
                for key in ("exp_avg", "exp_avg_sq")
            )
            steps = int(states[0].get("step", 0))
            self._learner.set_network(name, [array_of(parameter) for parameter in parameters], first, second, steps)
            self._give_normalizers(name)
        if self.reward_scale is not None:
            state = self.reward_scale.state()
            self._learner.set_reward_scale(*(array_of(state[key]) for key in ("returns", "count", "mean", "variance")))
        self._learner.set_episodes(array_of(self.logger.cur_reward_sum), array_of(self.logger.cur_episode_length))

    def _give_normalizers(self, name: str) -> None:
        for index, normalizer in enumerate(self._normalizers(name)):
            mean, variance = normalizer.get_buffer("_mean"), normalizer.get_buffer("_var")
            count = int(normalizer.get_buffer("count"))
            self._learner.set_normalizer(name, array_of(mean), array_of(variance), count, index)

    @torch.no_grad()
    def _give_to_rsl_rl(self) -> None:
        """The reverse of `_take_from_rsl_rl`."""
        self._take_networks()
        for group in self.alg.optimizer.param_groups:
            group["lr"] = self.alg.learning_rate
        if self.reward_scale is not None and (scale := self._learner.reward_scale()):
            returns, of_robots = scale
            names = ("returns", "count", "mean", "variance")
            self.reward_scale.restore(
                {name: torch.from_numpy(array) for name, array in zip(names, [returns, *of_robots], strict=True)}
            )
        rewards, lengths = self._learner.episodes()
        self.logger.cur_reward_sum = torch.from_numpy(rewards)
        self.logger.cur_episode_length = torch.from_numpy(lengths)

    def _take_networks(self) -> None:
        for name in NETWORKS:
            parameters = self._parameters(name)
            weights, first, second, steps = self._learner.network(name)
            for parameter, *arrays in zip(parameters, weights, first, second, strict=True):
                values = [torch.from_numpy(array).view_as(parameter) for array in arrays]
                parameter.copy_(values[0])
                self.alg.optimizer.state[parameter] = {
                    "step": torch.tensor(float(steps)),
                    "exp_avg": values[1],
                    "exp_avg_sq": values[2],
                }
            for index, normalizer in enumerate(self._normalizers(name)):
                if (of := self._learner.normalizer(name, index)) is None:
                    continue
                mean, variance, count = of
                for buffer, array in (("_mean", mean), ("_var", variance), ("_std", np.sqrt(variance))):
                    normalizer.get_buffer(buffer).view(-1).copy_(torch.from_numpy(array))
                normalizer.get_buffer("count").fill_(count)

    def _parameters(self, name: str) -> list[torch.nn.Parameter]:
        return list(getattr(self.alg, name).parameters())

    def _normalizers(self, name: str) -> list[torch.nn.Module]:
        """The statistics of a network, in the native learner's order."""
        model = getattr(self.alg, name)
        is_of_joints = isinstance(model, UrmaModel)
        of_model: Iterable[torch.nn.Module] = model.mlp.moments.values() if is_of_joints else [model.obs_normalizer]
        return [normalizer for normalizer in of_model if not isinstance(normalizer, torch.nn.Identity)]


class CardRunner(NativeRunner):
    """A `NativeRunner` whose updates an NVIDIA card computes, with the bits of the CPU."""

    card: str | None = None
    """Name of the card; None: the CPU computes the updates."""

    def _prepare(self) -> None:
        super()._prepare()
        self._ask_for_card()

    def _ask_for_card(self) -> None:
        try:
            self.card = self._learner.use_card()
        except _core.ConfigError as error:
            self.reporter.message(f"polypod: the CPU computes the updates, with the same policy: {error}")

    def _update(self, observations: TensorDict) -> dict[str, float]:
        loss = super()._update(observations)
        if (failure := self._learner.take_card_failure()) is not None:
            self.reporter.message(
                f"polypod: warning: {self.card}: {failure}; the CPU computes this update and those after it, with the "
                "same policy"
            )
            self.card = None
        return loss


def array_of(tensor: torch.Tensor) -> np.ndarray:
    """A copy with one dimension."""
    flat: np.ndarray = tensor.detach().cpu().numpy().ravel().copy()
    return flat
