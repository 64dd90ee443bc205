"""Rollouts of a policy on a GPU: each control step is one launch of a CUDA graph.

Where the simulator makes whole control steps on the learner's card, all of a step stays there, and
the host queues the steps of an iteration ahead. Else observations go to the device and actions come
back through pinned memory, and everything else of a step stays where it is until the iteration
ends: rewards and ends of episodes on the host, samples on the device.
"""

from collections.abc import Callable

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.utils import check_nan
from tensordict import TensorDict

from polypod import _core
from polypod.networks.urma import JointCounts, UrmaModel, counted
from polypod.rsl_rl import VecEnv
from polypod.runs.schema import TrainConfig
from polypod.training import deviations
from polypod.training.advantages import EPSILON, normalize_per_robot
from polypod.training.exchange import CardExchange, Exchange
from polypod.training.gpu_update import Samples, ask_policy
from polypod.training.graphs import Graphs
from polypod.training.logger import TrainingLogger
from polypod.training.reward_scale import RewardScale
from polypod.training.workers import Workers


class Rollout(Samples):
    """The samples of a policy that acts on the learner's device.

    Every mini-batch holds each env equally often where the steps of an iteration allow it, else
    samples are drawn as rsl_rl does.
    """

    def __init__(
        self, alg: PPO, env: VecEnv, config: TrainConfig, reward_scale: RewardScale | None, workers: Workers
    ) -> None:
        """Prepares rollouts of the networks of `alg` in the envs of `env`.

        Args:
            alg: whose networks act and estimate; its storage is not looked at.
            env: this worker's envs.
            config: the training.
            reward_scale: of each robot's rewards; None: rewards stay as they are.
            workers: those that have the other envs.
        """
        device, steps = env.device, config.run.num_steps_per_env
        batches = config.algorithm.num_mini_batches
        self._exchange = Exchange(env, steps) if env.card is None else CardExchange(env, steps)
        super().__init__(self._exchange.widths, env.num_actions, steps * env.num_envs, device)
        self._actor, self._critic, self._env, self._algorithm = alg.actor, alg.critic, env, config.algorithm
        self._is_per_robot = config.run.normalize_advantage_per_robot
        self._reward_scale, self._workers = reward_scale, workers
        sim = env.unwrapped.sim
        self._blocks = [sim.env_ids(robot) for robot in sim.robots]
        if deviations.of(alg.actor.distribution) is None:
            self.numbers["deviations"] = torch.zeros_like(self.numbers["means"])
        self._shape = (steps, env.num_envs)
        size = steps * env.num_envs // batches
        self.batch_sizes = [size] * batches
        self.order = self.order[: size * batches]
        if steps % batches == 0:
            self.counts = _joint_counts(env, [alg.actor, alg.critic], env.get_observations())
        in_turn = torch.arange(steps, device=device).unsqueeze(1) + torch.arange(env.num_envs, device=device)
        self.places = in_turn.flatten()
        self._step = torch.zeros(1, dtype=torch.int64, device=device)
        self._received = {name: torch.zeros(self._shape, device=device) for name in self._exchange.told}
        self._graphs = Graphs(device, self._changed, workers.count == 1)

    @torch.no_grad()
    def collect(self, logger: TrainingLogger) -> None:
        """Takes the steps of an iteration, and estimates returns and advantages."""
        exchange, told = self._exchange, self._exchange.told
        self._step.zero_()
        for step in range(self._shape[0]):
            exchange.observe()
            self._graphs.run("act", self._act)
            exchange.fetch_actions()
            if not isinstance(exchange, CardExchange):
                self._log(logger, told, step - 1)  # while the device computes
                self._synchronize()
            exchange.step(step)
        exchange.observe()
        for name, received in self._received.items():
            received.copy_(told[name], non_blocking=True)
        if isinstance(exchange, CardExchange):
            exchange.fetch_told()
        else:
            self._log(logger, told, self._shape[0] - 1)
        check_nan(TensorDict(self.observations), told["rewards"], told["dones"])
        check_nan(exchange.observed, told["rewards"], told["dones"])
        self._run_alone("estimate", self._estimate)
        self._draw_order()

    def log(self, logger: TrainingLogger) -> None:
        """Tells `logger` of the steps, where `collect` has not: the device learns meanwhile."""
        if isinstance(self._exchange, CardExchange):
            for step in range(self._shape[0]):
                self._log(logger, self._exchange.on_host, step)

    def deviations_of_actions(self) -> torch.Tensor:
        """Deviations of the last step's actions that are a network's output, [n].

        Joints that robots have, alone.
        """
        last = self.numbers["deviations"].view(*self._shape, -1)[-1]
        return last[torch.from_numpy(self._env.unwrapped.sim.action_mask).to(last.device)]

    def _act(self) -> None:
        """Draws the actions of a step and keeps its samples."""
        observed, actor = self._exchange.observed, self._actor
        with counted([actor, self._critic], self.counts):
            ask_policy(actor, observed)
            values = self._critic(observed)
        mean, std, *mask = actor.output_distribution_params
        # torch.normal waits for the device, to look at the deviations
        actions = mean + std * torch.randn_like(mean)
        if mask:
            actions = actions * mask[0]
        log_probs = actor.get_output_log_prob(actions).unsqueeze(1)
        self._exchange.drawn.copy_(actions)
        samples = {"actions": actions, "means": mean, "values": values, "log_probs": log_probs, "deviations": std}
        for name, value in samples.items():
            if name in self.numbers:
                self._keep(self.numbers[name], value)
        for name, value in self._exchange.inputs.items():
            self._keep(self.observations[name], value)
        self._step.add_(1).remainder_(self._shape[0])

    def _keep(self, samples: torch.Tensor, of_step: torch.Tensor) -> None:
        samples.view(*self._shape, -1).index_copy_(0, self._step, of_step.unsqueeze(0))

    def _estimate(self) -> None:
        """Returns and advantages, as rsl_rl computes them."""
        with counted([self._critic], self.counts):
            following = self._critic(self._exchange.observed).squeeze(1)
        values, returns = (self.numbers[name].view(self._shape) for name in ("values", "returns"))
        algorithm, (steps, _) = self._algorithm, self._shape
        rewards, dones, time_outs = (self._received[name] for name in ("rewards", "dones", "time_outs"))
        if self._reward_scale is not None:
            rewards = torch.stack([self._reward_scale(rewards[step], dones[step]) for step in range(steps)])
        rewards = rewards + algorithm.gamma * values * time_outs
        goes_on = 1.0 - dones
        advantage = torch.zeros_like(following)
        for step in reversed(range(steps)):
            delta = rewards[step] + goes_on[step] * algorithm.gamma * following - values[step]
            advantage = delta + goes_on[step] * algorithm.gamma * algorithm.lam * advantage
            returns[step] = advantage + values[step]
            following = values[step]
        advantages = (returns - values).unsqueeze(2)
        if self._is_per_robot:
            normalize_per_robot(advantages, self._blocks, self._workers)
        elif not algorithm.normalize_advantage_per_mini_batch:
            advantages = self._normalized(advantages)
        self.numbers["advantages"].copy_(advantages.view(-1, 1))

    def _normalized(self, advantages: torch.Tensor) -> torch.Tensor:
        if self._workers.count == 1:
            return (advantages - advantages.mean()) / (advantages.std() + EPSILON)
        exact = advantages.double()
        count = exact.numel() * self._workers.count  # shares of rsl_rl's workers are equal
        mean = self._workers.sum(exact.sum()) / count
        squares = self._workers.sum((exact - mean).square().sum()) / (count - 1)
        return ((exact - mean) / (squares.sqrt() + EPSILON)).float()

    def _draw_order(self) -> None:
        steps, envs = self._shape
        if steps % len(self.batch_sizes):
            self.order.copy_(torch.randperm(len(self.order), device=self.order.device))
            return
        drawn = torch.rand(self._shape, device=self.order.device).argsort(dim=0)
        self.order.copy_((drawn * envs + torch.arange(envs, device=self.order.device)).flatten())

    def _run_alone(self, key: str, step: Callable[[], None]) -> None:
        """Computes a step in which several workers talk: as a graph where there is one worker."""
        if self._workers.count == 1:
            self._graphs.run(key, step)
        else:
            step()

    def _changed(self) -> list[torch.Tensor]:
        scale = self._reward_scale
        return [self._step, *([] if scale is None else scale.state().values())]

    def _log(self, logger: TrainingLogger, told: dict[str, torch.Tensor], step: int) -> None:
        if step >= 0:
            logger.process_env_step(told["rewards"][step], told["dones"][step], {})

    def _synchronize(self) -> None:
        drawn = self._exchange.drawn
        if drawn.is_cuda:
            torch.cuda.current_stream(drawn.device).synchronize()


def _joint_counts(env: VecEnv, models: list[torch.nn.Module], observed: TensorDict) -> JointCounts:
    """Joints of the envs' robots.

    Raises:
        ConfigError: where a network of joints reads other joints off the observation.
    """
    mask = torch.from_numpy(env.unwrapped.sim.action_mask)
    for model in models:
        if isinstance(model, UrmaModel):
            read = model.mlp.mask(torch.cat([observed[group] for group in model.obs_groups], dim=-1)).cpu()
            if not torch.equal(read, mask):
                env_id = int((read != mask).any(dim=1).nonzero()[0])
                raise _core.ConfigError(
                    f"the descriptions that env {env_id} observes are not of the joints of its robot; leave noise and "
                    "scale out of the observation term that describes joints"
                )
    counts = mask.sum(dim=1)
    return JointCounts(len(mask), int(counts.sum()), int(counts.max()))
