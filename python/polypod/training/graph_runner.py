"""Training with rsl_rl's networks and PPO on a GPU, as CUDA graphs.

Any network without a recurrent state will do.
"""

import torch
from tensordict import TensorDict

from polypod.training import deviations
from polypod.training.adam import give_moments, take_moments
from polypod.training.gpu_update import Update
from polypod.training.reward_scale import RewardScale
from polypod.training.rollout import Rollout
from polypod.training.runner import Runner
from polypod.training.symmetry import Mirror


class GraphRunner(Runner):
    """A `Runner` with the results of rsl_rl's PPO: one launch per control step and mini-batch.

    On a CPU it computes the same without graphs.
    """

    # samples and mirror images are the rollout's and the update's: rsl_rl stores none
    storage = {"symmetry": False, "num_steps_per_env": 1}  # noqa: RUF012

    def _prepare(self) -> None:
        env, config, device = self.env, self.config, torch.device(self.device)
        self.cfg = self.logger.cfg = config.rsl_rl_cfg(env.unwrapped.sim)
        if device.type == "cuda":
            # torch's idle threads would spin where the simulator's want to work
            torch.set_num_threads(1)
            if config.algorithm.mixed_precision == "on":
                torch.set_float32_matmul_precision("high")
        self.logger.keep_on_host()
        if self.reward_scale is not None:
            gamma = config.algorithm.gamma
            self.reward_scale = RewardScale(self.blocks, gamma, self.device, self.workers, together=True)
        mirror = (Mirror(env, self.device), config.run.symmetry) if config.run.symmetry else None
        self._rollout = Rollout(self.alg, env, config, self.reward_scale, self.workers)
        self._update_of = Update(self.alg, env, self._rollout, config.algorithm, mirror, self.workers)

    def _collect(self, observations: TensorDict) -> TensorDict:
        self._rollout.collect(self.logger)
        return observations

    def _update(self, observations: TensorDict) -> dict[str, float]:
        loss = self._update_of.run(
            self.alg.learning_rate,
            self.alg.entropy_coef,
            self.alg.desired_kl,
            meanwhile=lambda: self._rollout.log(self.logger),
        )
        self.alg.learning_rate = loss.pop("learning_rate")
        return loss

    def _optimizer(self) -> torch.optim.Optimizer:
        return self._update_of.optimizer

    def _action_std(self) -> torch.Tensor:
        is_learnt = deviations.of(self._distribution) is not None
        return super()._action_std() if is_learnt else self._rollout.deviations_of_actions()

    def _give_to_rsl_rl(self) -> None:
        give_moments(self._update_of.optimizer, self.alg.optimizer)
        for group in self.alg.optimizer.param_groups:
            group["lr"] = self.alg.learning_rate

    def _take_from_rsl_rl(self) -> None:
        take_moments(self._update_of.optimizer, self.alg.optimizer)
