"""`send` and `recv` are `step` in two halves, with room for other work in between."""

import threading

import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError

import polypod
from common import ROBOTS, size

STEPS = size(30, 300)


def envs(count: int):
    return [polypod.make("velocity_flat", num_envs=16, robots=ROBOTS, seed=3) for _ in range(count)]


def test_two_halves_give_what_a_step_gives() -> None:
    whole, halves = envs(2)
    whole.reset(seed=3)
    halves.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(STEPS):
        actions = rng.standard_normal((16, 12)).astype(np.float32)
        expected = whole.step(actions)
        halves.send(actions)
        actions[:] = np.nan  # the sent array is a copy
        found = halves.recv()
        for a, b in zip(expected[:4], found[:4], strict=True):
            assert np.array_equal(a, b)
        assert expected[4].keys() == found[4].keys()


def test_the_caller_goes_on_while_the_step_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    (env,) = envs(1)
    env.reset(seed=3)
    made_by = []
    real = env.sim

    class Watched:
        def __getattr__(self, name):
            return getattr(real, name)

        def step(self, actions):
            made_by.append(threading.current_thread())
            assert gate.wait(10.0)
            real.step(actions)

    gate = threading.Event()
    monkeypatch.setattr(env, "_sim", Watched())
    env.send(np.zeros((16, 12), np.float32))
    gate.set()  # a step that was made by `send` itself would have waited for this in vain
    env.recv()
    assert made_by[0] is not threading.current_thread()


def test_calls_in_the_wrong_order_are_refused() -> None:
    (env,) = envs(1)
    env.reset(seed=3)
    zeros = np.zeros((16, 12), np.float32)
    with pytest.raises(NoAsyncCallError, match="send"):
        env.recv()
    env.send(zeros)
    for call in (lambda: env.send(zeros), lambda: env.step(zeros), env.reset):
        with pytest.raises(AlreadyPendingCallError, match="recv"):
            call()
    env.recv()
    env.step(zeros)


def test_errors_of_the_step_reach_the_receiver() -> None:
    (env,) = envs(1)
    env.reset(seed=3)
    env.send(np.full((16, 12), np.nan, np.float32))
    with pytest.raises(ValueError, match="finite"):
        env.recv()
    env.send(np.zeros((16, 11), np.float32))
    with pytest.raises(ValueError, match="12"):
        env.recv()
    env.step(np.zeros((16, 12), np.float32))


def test_closing_waits_for_the_step() -> None:
    (env,) = envs(1)
    env.reset(seed=3)
    env.send(np.zeros((16, 12), np.float32))
    env.close()
    with pytest.raises(ClosedEnvironmentError):
        env.step(np.zeros((16, 12), np.float32))
