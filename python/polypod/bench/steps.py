"""Whole control steps of the Python vector env: actions, observations, rewards and resets."""

from collections.abc import Sequence

import numpy as np

import polypod
from polypod.bench.sampling import Sample

SETTLE = 60
"""Control steps before anything is timed: robots have left their first pose, and some have
fallen."""


def control_steps(
    task: str,
    num_envs: int,
    threads: int,
    seed: int,
    *,
    robots: Sequence[str] | None = None,
    scale: float = 0.3,
    overrides: Sequence[str] = (),
) -> Sample:
    """One control step of every env with random actions.

    Args:
        task: name or alias.
        num_envs: number of envs.
        threads: number of threads.
        seed: of the simulation and the actions.
        robots: None: the task's.
        scale: standard deviation of the actions; at 0.3 most robots stay up, at 1 most fall again
            and again.
        overrides: `key=value` changes to the task.
    """
    env = polypod.make(
        task,
        num_envs=num_envs,
        robots=None if robots is None else list(robots),
        seed=seed,
        threads=threads,
        copy=False,
        overrides=list(overrides),
    )
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    actions = [(scale * rng.standard_normal(env.action_space.shape)).astype(np.float32) for _ in range(8)]
    count = 0

    def sample() -> int:
        nonlocal count
        env.step(actions[count % len(actions)])
        count += 1
        return num_envs

    for _ in range(SETTLE):
        sample()
    return sample
