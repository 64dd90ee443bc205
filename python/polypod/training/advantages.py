"""Advantages of different robots brought to one scale, so that each robot has its say in a shared update."""

import torch

EPSILON = 1e-8


def normalize_per_robot(advantages: torch.Tensor, blocks: list[tuple[int, int]]) -> None:
    """Gives each robot's advantages mean 0 and deviation 1, in place.

    Over all robots together, those whose returns spread least, because they stand or fall alike, count least: their
    share of the gradient vanishes just while they have to find out how to walk.

    Args:
        advantages: float [steps, num_envs, 1].
        blocks: the env range [start, stop) of each robot.
    """
    for start, stop in blocks:
        own = advantages[:, start:stop]
        own.sub_(own.mean()).div_(own.std(correction=0) + EPSILON)
