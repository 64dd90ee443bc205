"""The same seed gives the same bits, another seed gives others."""

import numpy as np

from common import SHORT, size

STEPS = size(30, 300)


def rollout(env, actions, seed, steps=STEPS):
    observations, _ = env.reset(seed=seed)
    trace = [observations.copy()]
    for step in range(steps):
        observations, rewards, terminated, truncated, _ = env.step(actions(env, step))
        trace.append(np.column_stack([observations, rewards, terminated, truncated]))
    return np.concatenate([array.ravel() for array in trace])


def test_same_seed_same_bits(make, actions):
    first = rollout(make(seed=1, overrides=SHORT), actions, seed=7)
    other_env = make(seed=2, overrides=SHORT)
    assert first.tobytes() == rollout(other_env, actions, seed=7).tobytes()
    assert first.tobytes() == rollout(other_env, actions, seed=7).tobytes()


def test_the_seed_of_make_is_the_seed_of_reset(make):
    made, reset = make(seed=5), make(seed=6)
    observations, _ = reset.reset(seed=5)
    assert made.sim.observation.tobytes() == observations.tobytes()


def test_other_seed_other_bits(make, actions):
    env = make()
    assert not np.array_equal(rollout(env, actions, seed=7), rollout(env, actions, seed=8))


def test_without_a_seed_the_streams_go_on(make):
    env = make()
    first = env.reset(seed=7)[0].copy()
    assert not np.array_equal(first, env.reset()[0])


def test_thread_count_does_not_matter(make, actions):
    one, two = (make(robots=None, num_envs=40, threads=threads) for threads in (1, 2))
    assert rollout(one, actions, seed=7).tobytes() == rollout(two, actions, seed=7).tobytes()


def test_an_env_does_not_depend_on_its_neighbours(make, actions):
    few, many = make(num_envs=8, robots=["unitree_a1"]), make(num_envs=24, robots=["unitree_a1"])
    few.reset(seed=7)
    many.reset(seed=7)
    for step in range(20):
        drawn = actions(many, step)
        of_many = many.step(drawn)[0][:8]
        of_few = few.step(drawn[:8])[0]
        assert of_few.tobytes() == of_many.tobytes()
