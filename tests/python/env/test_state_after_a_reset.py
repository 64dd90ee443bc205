"""After a reset `env.state` is the new episode's, in all that follows from poses and velocities."""

import json

import numpy as np
import numpy.typing as npt
import pytest

import polypod
from polypod.terms import CustomTerms

QUIET = {
    "observations.enable_noise": False,
    "events.push_robot.enabled": False,
    "events.reset_base.x": [0, 0],
    "events.reset_base.y": [0, 0],
    "events.reset_base.yaw": [0, 0],
}
MOVING = {
    "reset.base_velocity.range": [-1.0, 1.0],
    "reset.joint_velocity.range": [-2.0, 2.0],
    "reset.joint_position": {"mode": "scale", "range": [0.5, 1.5]},
}

Array = npt.NDArray[np.float64]


def feet_by_hand(env: polypod.VectorEnv, robot: str) -> tuple[Array, Array]:
    """[envs, feet, 3] each, positions and velocities of the feet by those of the links."""
    twin = polypod.Simulation(robot, env.num_envs, ground=None)
    twin.set_state(qpos=env.sim.qpos(robot), qvel=env.sim.qvel(robot))
    position, quaternion = twin.link_pose()
    linear, angular = twin.link_velocity()
    shapes = json.loads(env.sim.robot_shapes())[robot]
    feet = [body for body in shapes["bodies"] if body["group"] == "foot"]
    places, speeds = [], []
    for foot in feet:
        link = twin.link_names.index(shapes["links"][foot["link"]] if isinstance(foot["link"], int) else foot["link"])
        (sphere,) = [shape for shape in foot["shapes"] if shape["shape"] == "sphere"]
        point = np.array(sphere["position"])
        w, x, y, z = np.moveaxis(quaternion[:, link], -1, 0)
        axis = np.stack([x, y, z], axis=-1)
        turned = point + 2.0 * np.cross(axis, np.cross(axis, point) + w[:, None] * point)
        places.append(position[:, link] + turned)
        speeds.append(linear[:, link] + np.cross(angular[:, link], turned))
    return np.stack(places, axis=1), np.stack(speeds, axis=1)


def check(env: polypod.VectorEnv, robot: str, rows: npt.ArrayLike = slice(None)) -> None:
    places, speeds = feet_by_hand(env, robot)
    seen = env.state.feet_pos.reshape(env.num_envs, -1, 3), env.state.feet_vel.reshape(env.num_envs, -1, 3)
    # the order of the feet is not that of the bodies
    for mine, theirs in ((seen[0], places), (seen[1], speeds)):
        gaps = np.linalg.norm(mine[:, :, None] - theirs[:, None], axis=-1).min(axis=2)
        assert gaps[rows].max() < 2e-5


def test_feet_of_a_robot_that_was_just_reset() -> None:
    env = polypod.make("velocity_flat", 2, robots=["unitree_go2"], seed=1, autoreset="disabled", overrides=QUIET)
    env.reset()
    feet = env.state.feet_pos.reshape(2, 4, 3)
    np.testing.assert_allclose(feet[:, 0, :2], [[0.18, 0.17]] * 2, atol=0.01)
    # the lowest underside 2 cm above the ground
    np.testing.assert_allclose(feet[:, :, 2].min(axis=1), 0.042, atol=0.002)
    np.testing.assert_allclose(env.state.feet_height, feet[:, :, 2], atol=1e-6)
    assert not env.state.feet_vel.any()
    check(env, "unitree_go2")


@pytest.mark.parametrize("robot", ["unitree_go2", "anymal_c"])
@pytest.mark.parametrize("autoreset", ["same_step", "next_step", "disabled"])
def test_feet_of_robots_that_begin_in_motion(robot: str, autoreset: str) -> None:
    env = polypod.make(
        "velocity_flat",
        8,
        robots=[robot],
        seed=1,
        autoreset=autoreset,
        overrides={
            **QUIET,
            "sim.episode_length_s": 0.06,
            **{f"robot_overrides.{robot}.{key}": value for key, value in MOVING.items()},
        },
    )
    env.reset()
    check(env, robot)
    assert np.abs(env.state.feet_vel).max() > 0.5
    actions = np.zeros(env.action_space.shape, dtype=np.float32)
    # an episode is three steps long
    for _ in range(2 if autoreset == "disabled" else 4):
        env.step(actions)
        check(env, robot)
    if autoreset == "disabled":
        mask = np.arange(8) % 2 == 0
        before = env.state.feet_pos[~mask]
        env.reset(options={"reset_mask": mask})
        check(env, robot)
        assert np.array_equal(env.state.feet_pos[~mask], before)


def test_terms_of_ones_own_see_the_new_state() -> None:
    env = polypod.make(
        "velocity_flat",
        4,
        robots=["unitree_go2"],
        seed=1,
        autoreset="disabled",
        overrides={**QUIET, "sim.episode_length_s": 0.1},
    )
    terms = CustomTerms(env, observations={"heights": lambda state: state.feet_height})
    observations, _ = terms.reset()
    for _ in range(12):
        assert observations[:, -4:].min() > 0.01
        observations = terms.step(np.zeros(terms.action_space.shape, dtype=np.float32))[0]


def test_a_snapshot_holds_the_feet() -> None:
    env = polypod.make("velocity_rough", 8, robots=["spot"], seed=2)
    env.reset()
    before, snapshot = env.state.feet_pos, env.sim.snapshot()
    env.step(np.ones(env.action_space.shape, dtype=np.float32))
    assert not np.array_equal(env.state.feet_pos, before)
    env.sim.restore(snapshot)
    assert np.array_equal(env.state.feet_pos, before)
