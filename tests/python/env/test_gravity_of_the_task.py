"""Everything that reads gravity reads the task's."""

import numpy as np
import pytest

import polypod
from polypod import _core
from polypod.render.scene import Scene
from polypod.sim2sim import twin

QUIET = {"observations.enable_noise": False, "events.push_robot.enabled": False, "events.reset_base.yaw": [0, 0]}


def make(gravity: tuple[float, float, float]) -> polypod.VectorEnv:
    overrides = {**QUIET, "sim.gravity": list(gravity)}
    return polypod.make("velocity_flat", 2, robots=["unitree_go2"], seed=1, overrides=overrides)


@pytest.mark.parametrize(
    ("gravity", "sensed"),
    [
        ((1.7035, 0.0, -9.661), (0.1736, 0.0, -0.9848)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.0, 0.0, 9.81), (0.0, 0.0, 1.0)),
        ((0.0, 0.0, -1.62), (0.0, 0.0, -1.0)),
    ],
)
def test_sensor_and_state(gravity: tuple[float, float, float], sensed: tuple[float, float, float]) -> None:
    env = make(gravity)
    observation, _ = env.reset()
    np.testing.assert_allclose(observation[0, 6:9], sensed, atol=1e-4)
    np.testing.assert_allclose(env.state.projected_gravity[0], sensed, atol=1e-4)
    assert env.sim.gravity == gravity


def test_arrows_are_measured_in_weights() -> None:
    moon, earth, nowhere = (
        Scene(make((0.0, 0.0, -size)).sim)._weights["unitree_go2"] for size in (1.62, _core.EARTH_GRAVITY, 0.0)
    )
    assert moon / earth == pytest.approx(1.62 / 9.81)
    assert nowhere == earth > 0.0


def test_the_twin_falls_as_the_task_says() -> None:
    gravity = (3.0, 2.0, -6.0)
    made = twin.Twin.__new__(twin.Twin)
    made._down = np.array(gravity) / 7.0
    made.qpos = np.array([[0.0, 0.0, 0.0, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]])
    # turned by 90 degrees to the left
    np.testing.assert_allclose(made.projected_gravity(), [[2.0 / 7.0, -3.0 / 7.0, -6.0 / 7.0]], atol=1e-12)


def test_earth_is_said_once() -> None:
    task = polypod.make("velocity_flat", 1, robots=["unitree_go2"])
    assert task.sim.gravity == (0.0, 0.0, -_core.EARTH_GRAVITY)
