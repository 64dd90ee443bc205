"""Scaling of rewards, so that no robot drowns the others in a shared learner."""

from typing import Any

import torch

from polypod.training.workers import Workers

EPSILON = 1e-8


class RewardScale:
    """Divides each robot's rewards by the running deviation of its discounted return.

    The reward sets of different robots differ in scale by more than ten, while one critic fits all
    returns and one update averages over all advantages. Scaling changes no robot's own preferences:
    its rewards keep their proportions.
    """

    def __init__(
        self,
        blocks: list[tuple[int, int]],
        gamma: float,
        device: str,
        workers: Workers | None = None,
        together: bool = False,
    ) -> None:
        """Prepares the scales; they are 1 before the first reward.

        Args:
            blocks: the env range [start, stop) of each robot.
            gamma: the discount of the learner.
            device: where rewards are.
            workers: those that have the other envs; None: there are none.
            together: sum for all robots at once, which takes fewer kernels of a GPU and rounds
                differently.
        """
        self._workers = workers or Workers.alone()
        self.blocks = blocks
        self.gamma = gamma
        num_envs = max(stop for _, stop in blocks)
        self.returns = torch.zeros(num_envs, device=device)
        self.count = torch.full((len(blocks),), EPSILON, dtype=torch.float64, device=device)
        self.mean = torch.zeros(len(blocks), dtype=torch.float64, device=device)
        self.variance = torch.ones(len(blocks), dtype=torch.float64, device=device)
        sizes = torch.tensor([stop - start for start, stop in blocks], device=device)
        robots = torch.arange(len(blocks), device=device)
        self.robot_of_env = torch.repeat_interleave(robots, sizes)
        self._envs_of_robot = (robots.unsqueeze(1) == self.robot_of_env).double() if together else None

    def __call__(self, rewards: torch.Tensor, dones: torch.Tensor) -> torch.Tensor:
        """The scaled rewards of one step, float32 [num_envs]; the statistics take them in first."""
        self.returns.mul_(self.gamma).add_(rewards)
        if self._workers.count > 1:
            self._update_with_others()
        elif self._envs_of_robot is not None:
            self._update_together(self._envs_of_robot)
        else:
            for robot, (start, stop) in enumerate(self.blocks):
                self._update(robot, self.returns[start:stop].double())
        self.returns.mul_(dones == 0)
        scale = torch.rsqrt(self.variance + EPSILON).float()
        return rewards * scale[self.robot_of_env]

    def _update_with_others(self) -> None:
        own = [self.returns[start:stop].double() for start, stop in self.blocks]
        # about the running mean, which all have, sums of squares lose no digits
        offsets = [sample - mean for sample, mean in zip(own, self.mean, strict=True)]
        rows = [torch.stack([of.new_tensor(of.numel()), of.sum(), of.square().sum()]) for of in offsets]
        for robot, (n, total, squares) in enumerate(self._workers.sum(torch.stack(rows))):
            offset = total / n
            self._merge(robot, n, self.mean[robot] + offset, squares / n - offset**2)

    def _update_together(self, envs_of_robot: torch.Tensor) -> None:
        # about the running mean, as with other workers
        offsets = self.returns.double() - self.mean[self.robot_of_env]
        sums = torch.stack([torch.ones_like(offsets), offsets, offsets.square()], dim=1)
        n, total, squares = (envs_of_robot @ sums).unbind(dim=1)
        offset = total / n
        self._merge(slice(None), n, self.mean + offset, squares / n - offset**2)

    def _update(self, robot: int, sample: torch.Tensor) -> None:
        self._merge(robot, sample.numel(), sample.mean(), sample.var(correction=0))

    def _merge(self, robot: int | slice, n: "int | torch.Tensor", mean: torch.Tensor, variance: torch.Tensor) -> None:
        # the parallel form of Welford's update (Chan, Golub and LeVeque)
        delta = mean - self.mean[robot]
        total = self.count[robot] + n
        spread = self.variance[robot] * self.count[robot] + variance * n
        self.variance[robot] = (spread + delta**2 * self.count[robot] * n / total) / total
        self.mean[robot] += delta * n / total
        self.count[robot] = total

    def state(self) -> dict[str, Any]:
        """State for a checkpoint."""
        return {"returns": self.returns, "count": self.count, "mean": self.mean, "variance": self.variance}

    def restore(self, state: dict[str, Any]) -> None:
        """Takes over a `state`."""
        for name, value in self.state().items():
            value.copy_(state[name])
