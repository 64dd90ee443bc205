"""Snapshot, restore, step equals never having stopped, byte for byte."""

import numpy as np

from common import SHORT, size


def test_restore_goes_on_as_if_nothing_happened(make, actions):
    env, other = make(overrides=SHORT), make(overrides=SHORT, seed=99)
    env.reset(seed=3)
    for step in range(15):
        env.step(actions(env, step))
    state = env.sim.snapshot()
    other.sim.restore(state)
    np.testing.assert_array_equal(env.sim.observation, other.sim.observation)
    for step in range(15, size(60, 600)):
        drawn = actions(env, step)
        for expected, found in zip(env.step(drawn)[:4], other.step(drawn)[:4], strict=True):
            assert expected.tobytes() == found.tobytes()
    assert env.sim.snapshot() == other.sim.snapshot()
