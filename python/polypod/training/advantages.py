"""Scaling of advantages, so that each robot counts in a shared update."""

import torch

from polypod.training.workers import Workers

EPSILON = 1e-8


def normalize_per_robot(
    advantages: torch.Tensor, blocks: list[tuple[int, int]], workers: Workers | None = None
) -> None:
    """Gives each robot's advantages mean 0 and deviation 1, in place.

    Over all robots together, the robots whose returns spread least, because all of them stand or
    all fall, count least: their share of the gradient vanishes just while they have to find out how
    to walk.

    Args:
        advantages: float [steps, num_envs, 1].
        blocks: the env range [start, stop) of each robot.
        workers: those that have the other envs; None: there are none.
    """
    if workers is not None and workers.count > 1:
        _normalize_with_others(advantages, blocks, workers)
        return
    for start, stop in blocks:
        own = advantages[:, start:stop]
        own.sub_(own.mean()).div_(own.std(correction=0) + EPSILON)


def _normalize_with_others(advantages: torch.Tensor, blocks: list[tuple[int, int]], workers: Workers) -> None:
    own = [advantages[:, start:stop] for start, stop in blocks]
    sums = [[block.numel(), block.double().sum().item()] for block in own]
    counts, totals = workers.sum(torch.tensor(sums, dtype=torch.float64, device=advantages.device)).T
    means = totals / counts
    squares = [(block.double() - mean).square().sum() for block, mean in zip(own, means, strict=True)]
    deviations = (workers.sum(torch.stack(squares)) / counts).sqrt()
    for block, mean, deviation in zip(own, means.float(), deviations.float(), strict=True):
        block.sub_(mean).div_(deviation + EPSILON)
