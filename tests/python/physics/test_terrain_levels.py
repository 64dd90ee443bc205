"""Resets of a caller's own move no env to another level of terrain."""

import numpy as np

import polypod
import polypod.rsl_rl
from polypod.terms import CustomTerms


def make(**options: object) -> polypod.VectorEnv:
    return polypod.make("velocity_rough", 64, robots=["unitree_go2"], seed=1, **options)  # type: ignore[arg-type]


def zeros(env: polypod.VectorEnv | CustomTerms) -> np.ndarray:
    return np.zeros(env.action_space.shape, dtype=np.float32)


def levels(env: polypod.VectorEnv | CustomTerms) -> np.ndarray:
    return env.sim.terrain_tiles()[0].copy()


def test_resets_in_mid_episode() -> None:
    env = make()
    env.reset()
    before = levels(env)
    mask = np.arange(64) % 3 == 0
    for options in (None, {"reset_mask": mask}):
        for _ in range(6):
            env.step(zeros(env))
            env.reset(options=options)
    assert before.mean() > 1.0
    assert np.array_equal(levels(env), before)


def test_resets_of_rsl_rl() -> None:
    import torch

    env = make()
    wrapped = polypod.rsl_rl.VecEnv(env)
    wrapped.reset()
    before = levels(env)
    for _ in range(3):
        wrapped.step(torch.zeros(64, wrapped.num_actions))
        wrapped.reset()
    # the first episodes of a training end early
    wrapped.episode_length_buf = torch.full((64,), int(wrapped.max_episode_length) - 1)
    wrapped.step(torch.zeros(64, wrapped.num_actions))
    assert np.array_equal(levels(env), before)


def test_terminations_after_one_step() -> None:
    env = CustomTerms(make(autoreset="disabled"), terminations={"at_once": lambda state: np.ones(64, dtype=np.bool_)})
    env.reset()
    before = levels(env)
    for _ in range(3):
        assert env.step(zeros(env))[2].all()
    assert np.array_equal(levels(env), before)
