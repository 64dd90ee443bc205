"""A vector env is what Gymnasium says it is."""

import os
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import polypod


def test_spaces_and_dtypes(make, actions):
    env = make(num_envs=16)
    assert env.single_observation_space.shape == (48,)
    assert env.single_action_space.shape == (12,)
    assert env.observation_space.shape == (16, 48)
    assert env.action_space.shape == (16, 12)
    observations, infos = env.reset(seed=0)
    assert env.observation_space.contains(observations)
    assert infos == {}
    observations, rewards, terminated, truncated, _ = env.step(actions(env, 0))
    assert env.observation_space.contains(observations)
    assert (rewards.shape, rewards.dtype) == ((16,), np.float32)
    assert (terminated.shape, terminated.dtype) == ((16,), np.bool_)
    assert (truncated.shape, truncated.dtype) == ((16,), np.bool_)
    assert np.isfinite(rewards).all()


def test_sampled_actions_are_accepted(make):
    env = make()
    env.reset(seed=0)
    env.action_space.seed(0)
    env.step(env.action_space.sample())


@pytest.mark.parametrize("entry", polypod.tasks(), ids=lambda entry: entry["name"])
def test_every_task_is_registered(entry):
    assert f"polypod/{entry['name']}" in gymnasium.registry


def test_make_vec(actions):
    env = gymnasium.make_vec("polypod/Velocity-Flat-HeteroQuadruped-v0", num_envs=8, seed=3, autoreset="next_step")
    try:
        assert isinstance(env, polypod.VectorEnv)
        assert env.spec.id == "polypod/Velocity-Flat-HeteroQuadruped-v0"
        assert env.num_envs == 8
        assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
        env.reset(seed=0)
        env.step(actions(env, 0))
        again = gymnasium.make_vec(env.spec)
        assert again.num_envs == 8
        again.close()
    finally:
        env.close()


@pytest.mark.parametrize(
    ("task", "robots", "count"),
    [("velocity_flat", None, 8), ("Velocity-Flat-Spot-v0", None, 1), ("velocity_flat", ["spot", "anymal_d"], 2)],
)
def test_there_is_one_env_per_robot_by_default(task, robots, count):
    env = polypod.make(task, robots=robots, seed=0)
    assert env.num_envs == len(env.robots) == count
    env.close()


def test_make_vec_needs_no_number_of_envs():
    """Gymnasium passes 1 when its caller names none: an env of each robot, with a warning."""
    with pytest.warns(UserWarning, match=r"gives 8 envs, one for each robot.*pass num_envs=8 or more, or robots="):
        env = gymnasium.make_vec("polypod/Velocity-Flat-HeteroQuadruped-v0", seed=0)
    assert env.num_envs == 8
    with pytest.warns(UserWarning, match="gives 8 envs"):
        assert gymnasium.make_vec(env.spec).num_envs == 8
    env.close()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("task", "options"), [("Velocity-Flat-HeteroQuadruped-v0", {"robots": ["spot"]}), ("Velocity-Flat-Spot-v0", {})]
)
def test_one_env_is_one_env_where_there_is_one_robot(task, options):
    env = gymnasium.make_vec(f"polypod/{task}", num_envs=1, seed=0, **options)
    assert env.num_envs == 1
    assert env.reset()[0].shape[0] == 1
    env.close()
    with pytest.raises(polypod.ConfigError, match="num_envs"):
        gymnasium.make_vec("polypod/Velocity-Flat-HeteroQuadruped-v0", num_envs=2)


def test_an_unknown_option_is_named():
    with pytest.raises(TypeError, match="unknown option 'robot'; did you mean 'robots'"):
        polypod.make("velocity_flat", robot=["spot"])


@pytest.mark.parametrize(
    ("kind", "stem", "use"),
    [("tasks", "broken", "'broken'"), ("robots", "big_dog", "'velocity_flat', robots=['big_dog']")],
)
def test_a_broken_config_does_not_break_the_import(kind, stem, use, tmp_path):
    """A broken file is a warning with its name, others work, and using it is the error."""
    file = tmp_path / "configs" / kind / f"{stem}.toml"
    file.parent.mkdir(parents=True)
    file.write_text("name = [")
    code = (
        "import gymnasium, polypod\n"
        "print('polypod/Velocity-Flat-HeteroQuadruped-v0' in gymnasium.registry)\n"
        "polypod.make('Velocity-Flat-HeteroQuadruped-v0')\n"
        f"polypod.make({use})\n"
    )
    environment = {**os.environ, "POLYPOD_PATH": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout == "True\n"
    warning, _, error = done.stderr.partition("Traceback")
    assert "RuntimeWarning" in warning
    assert str(file) in warning
    assert "line 4" in error
    assert "ConfigError" in error
    assert str(file) in error


@pytest.mark.parametrize("name", ["velocity_flat", "polypod/Velocity-Flat-HeteroQuadruped-v0"])
def test_a_task_has_one_env_by_all_its_names(name):
    env = polypod.make(name, num_envs=8, seed=0)
    assert env.sim.task_name == "Velocity-Flat-HeteroQuadruped-v0"
    env.close()


def test_autoreset_mode_is_in_the_metadata(make):
    assert make().metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert make(autoreset="disabled").metadata["autoreset_mode"] is AutoresetMode.DISABLED
    assert make(autoreset=AutoresetMode.NEXT_STEP).metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP


def test_a_closed_env_says_so(make, actions):
    env = make()
    env.reset(seed=0)
    drawn = actions(env, 0)
    env.close()
    env.close()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError, match=r"polypod\.make"):
        env.step(drawn)
