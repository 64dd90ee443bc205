"""Bad input raises the right exception, and its message names the remedy."""

import numpy as np
import pytest

import polypod
from common import TASK


@pytest.mark.parametrize(
    ("arguments", "exception", "message"),
    [
        ({"task_id": "Velocity-Flat-HeteroQuadrupet-v0"}, polypod.UnknownNameError, "Velocity-Flat-HeteroQuadruped-v0"),
        ({"robots": ["spott"]}, polypod.UnknownNameError, "spot"),
        ({"robots": []}, polypod.ConfigError, "robots"),
        ({"robots": "spot"}, polypod.ConfigError, r"\['spot'\]"),
        ({"num_envs": 3}, polypod.ConfigError, "num_envs"),
        ({"num_envs": 0}, polypod.ConfigError, "num_envs"),
        ({"num_envs": -1}, polypod.ConfigError, "num_envs=-1"),
        ({"num_envs": 8.0}, TypeError, "num_envs must be one int"),
        ({"seed": -1}, polypod.ConfigError, "seed=-1"),
        ({"seed": [1, 2]}, TypeError, "seed must be one int"),
        ({"autoreset": "sometimes"}, polypod.ConfigError, "same_step, next_step, disabled"),
        ({"overrides": ["sim.episode_lenght_s=1.0"]}, polypod.ConfigError, "did you mean `episode_length_s`"),
    ],
    ids=lambda value: next(iter(value.items())).__repr__() if isinstance(value, dict) else "",
)
def test_make(arguments, exception, message):
    with pytest.raises(exception, match=message):
        polypod.make(**{"task_id": TASK, "num_envs": 8, "seed": 0, **arguments})


def test_errors_are_value_errors():
    assert issubclass(polypod.ConfigError, ValueError)
    assert issubclass(polypod.RobotError, ValueError)
    assert issubclass(polypod.UnknownNameError, polypod.ConfigError)
    assert issubclass(polypod.ConfigError, polypod.PolypodError)


@pytest.mark.parametrize("shape", [(16,), (16, 11), (15, 12), (12, 16), (0, 12), (16, 12, 1)])
def test_actions_of_another_shape(make, shape):
    with pytest.raises(ValueError, match=r"\(16, 12\)"):
        make().step(np.zeros(shape, dtype=np.float32))


@pytest.mark.parametrize("dtype", [np.bool_, np.complex64, np.str_, object])
def test_actions_that_are_no_numbers(make, dtype):
    with pytest.raises(TypeError, match="no numbers"):
        make().step(np.zeros((16, 12), dtype=dtype))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_actions_that_are_not_finite(make, actions, bad):
    env, twin = make(), make()
    drawn = actions(env, 0)
    spoilt = drawn.copy()
    spoilt[5, 3] = bad
    with pytest.raises(ValueError, match="env 5"):
        env.step(spoilt)
    np.testing.assert_array_equal(env.step(drawn)[0], twin.step(drawn)[0])


def test_actions_in_another_memory_order_are_accepted(make, actions):
    env, twin = make(), make()
    drawn = actions(env, 0)
    np.testing.assert_array_equal(env.step(np.asfortranarray(drawn))[0], twin.step(drawn)[0])


@pytest.mark.parametrize(
    ("mask", "exception", "message"),
    [
        ([True] * 16, TypeError, "NumPy array of bools"),
        (np.ones(16), TypeError, "NumPy array of bools"),
        (np.ones(15, dtype=np.bool_), polypod.ConfigError, r"\(16,\)"),
        (np.zeros(16, dtype=np.bool_), polypod.ConfigError, "selects no env"),
    ],
)
def test_reset_masks(make, mask, exception, message):
    with pytest.raises(exception, match=message):
        make(autoreset="disabled").reset(options={"reset_mask": mask})


def test_unknown_reset_options(make):
    with pytest.raises(polypod.ConfigError, match="reset_mask"):
        make().reset(options={"mask": np.ones(16, dtype=np.bool_)})


def test_robots_that_this_env_has_not(make):
    env = make(robots=["spot"])
    with pytest.raises(polypod.UnknownNameError, match="spot"):
        env.env_ids("unitree_a1")
    with pytest.raises(polypod.UnknownNameError, match="spot"):
        env.joint_map("unitree_a1")


def test_snapshots_that_are_none(make):
    with pytest.raises(polypod.ConfigError, match="snapshot"):
        make().sim.restore(b"not one")
