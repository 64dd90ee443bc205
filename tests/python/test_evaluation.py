"""An evaluation counts every env once, and its figures are those of the simulation."""

import numpy as np
import pytest

import polypod
from common import SHORT, TASK
from polypod import evaluation


def still(observations):
    return np.zeros((len(observations), 12), dtype=np.float32)


def test_the_play_variant_is_used():
    assert evaluation.play_task(TASK) == "Velocity-Flat-HeteroQuadruped-Play-v0"
    assert evaluation.play_task("velocity_flat") == "Velocity-Flat-HeteroQuadruped-Play-v0"
    assert evaluation.play_task("Velocity-Flat-HeteroQuadruped-Play-v0") == "Velocity-Flat-HeteroQuadruped-Play-v0"


def test_every_env_counts_once():
    found = evaluation.evaluate(still, TASK, num_envs=20, overrides=SHORT, episodes=2)
    assert sum(result.episodes for result in found.robots.values()) == 40
    assert found.duration_s == pytest.approx(0.4)
    for result in found.robots.values():
        assert 0.0 <= result.fall_rate <= 1.0
        assert 0.0 < result.episode_length_s <= 0.4 + 1e-9


def test_figures_are_those_of_the_simulation():
    """Recomputed from a copy of the same episodes, env by env."""
    robots = ["spot", "unitree_a1"]
    found = evaluation.evaluate(still, TASK, robots=robots, num_envs=8, overrides=SHORT, seed=4)
    env = polypod.make(found.task, num_envs=8, robots=robots, seed=4, overrides=SHORT, autoreset="disabled")
    env.reset(seed=4)
    columns = {"base_lin_vel": 0, "base_ang_vel": 3, "velocity_commands": 9}
    start = 0
    for term, size in env.observation_layout:
        columns[term], start = start, start + size
    velocity, turn, command = (columns[name] for name in ("base_lin_vel", "base_ang_vel", "velocity_commands"))
    errors, rewards = [[] for _ in range(8)], [0.0] * 8
    running, fallen = set(range(8)), set()
    while running:
        observations, reward, terminated, truncated, _ = env.step(still(env.sim.observation))
        for row in sorted(running):
            wanted = observations[row, command : command + 3]
            planar = np.hypot(*(wanted[:2] - observations[row, velocity : velocity + 2]))
            errors[row].append((planar, abs(wanted[2] - observations[row, turn + 2])))
            rewards[row] += reward[row]
            if terminated[row]:
                fallen.add(row)
        running -= set(np.flatnonzero(terminated | truncated).tolist())
        done = terminated | truncated
        if done.any():
            env.reset(options={"reset_mask": done})
    for robot in robots:
        rows = env.env_ids(robot)
        planar, yaw = np.mean([np.mean(errors[row], axis=0) for row in rows], axis=0)
        seconds = sum(len(errors[row]) for row in rows) * env.step_dt
        assert found.robots[robot].error_vel_xy == pytest.approx(planar, rel=1e-5)
        assert found.robots[robot].error_vel_yaw == pytest.approx(yaw, rel=1e-5)
        assert found.robots[robot].reward_per_s == pytest.approx(sum(rewards[row] for row in rows) / seconds, rel=1e-4)
        assert found.robots[robot].fall_rate == len(fallen & set(rows.tolist())) / len(rows)
    env.close()


@pytest.mark.parametrize("name", ["num_envs", "episodes", "steps"])
def test_counts_are_positive(name):
    with pytest.raises(polypod.ConfigError, match=name):
        evaluation.evaluate(still, TASK, **{name: 0})


def test_rough_ground_is_told_by_type_and_level():
    """Robots that hold their pose stay up on every platform and follow nothing."""
    found = evaluation.evaluate(still, "velocity_rough", robots=["unitree_a1"], num_envs=40, steps=100, seed=1)
    (result,) = found.robots.values()
    assert set(result.terrain) == {
        *("pyramid_stairs", "pyramid_stairs_inv", "boxes", "random_rough", "hf_pyramid_slope", "hf_pyramid_slope_inv")
    }
    tiles = [tile for tiles in result.terrain.values() for tile in tiles]
    assert sum(tile.episodes for tile in tiles) == 40
    assert all(0 <= tile.level < 5 and tile.fall_rate == 0.0 for tile in tiles)
    assert [tile.level for tile in result.terrain["boxes"]] == sorted(tile.level for tile in result.terrain["boxes"])
    # only those that were told to go slower than 0.2 m/s or to stand have done as they were told
    assert result.success() < 0.3
    assert result.success("boxes") == pytest.approx(
        np.average([t.success for t in result.terrain["boxes"]], weights=[t.episodes for t in result.terrain["boxes"]])
    )
    assert np.isnan(result.success("boxes", level=7))


def test_a_plane_has_no_tiles():
    (result,) = evaluation.evaluate(still, TASK, robots=["spot"], num_envs=2, overrides=SHORT).robots.values()
    assert result.terrain == {}
