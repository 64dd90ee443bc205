"""The rough tasks of all classes have the quadrupeds' ground, scan and curriculum.

Their bodies fit them.
"""

import numpy as np
import pytest
import tomllib

import polypod

SMALL = [
    "scene.terrain.num_rows=2",
    "scene.terrain.num_cols=4",
    "scene.terrain.max_init_terrain_level=1",
]
TOO_SMALL = {"solo12", "box_quadruped", "bolt", "phantomx"}


@pytest.mark.parametrize(("task", "count"), [("velocity_rough_legged", 20), ("velocity_rough_humanoid", 5)])
@pytest.mark.parametrize("variant", ["", "_play"])
def test_every_robot_stands_on_rough_ground_and_sees_it(task, count, variant):
    env = polypod.make(task + variant, count, seed=0, threads=1, overrides=SMALL)
    env.reset()
    for _ in range(5):
        observations, rewards = env.step(np.zeros((count, env.sim.num_actions), dtype=np.float32))[:2]
    assert np.isfinite(observations).all()
    assert np.isfinite(rewards).all()
    assert dict(env.observation_layout)["height_scan"] == 187
    assert len(env.robots) == count
    assert not TOO_SMALL & set(env.robots)
    config = tomllib.loads(env.sim.resolved_config())["task"]
    is_play = variant == "_play"
    assert config["curriculum"]["terrain_levels"].get("enabled", True) != is_play
    assert config["observations"]["enable_noise"] != is_play
    # terminations of upright bodies are also theirs on rough ground
    assert {"illegal_contact", "bad_orientation", "root_height_below_minimum"} <= set(config["terminations"])
    assert config["rewards"]["g1"]["lin_vel_z_l2"]["weight"] == 0.0
