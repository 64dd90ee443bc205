"""States that break are dumped where the caller or the training says."""

import numpy as np
import pytest

# the least that a task takes, rad/s; random actions turn joints faster: every state counts as
# broken
BROKEN = ["terminations.illegal_state.max_joint_vel=1"]


def names(directory):
    return sorted(path.name for path in directory.glob("*"))


def test_make(make, actions, tmp_path):
    directory = tmp_path / "dumps"
    env = make(robots=["spot", "anymal_d"], overrides=BROKEN, dump_dir=directory)
    twin = make(robots=["spot", "anymal_d"], overrides=BROKEN)
    assert not directory.exists()
    for step in range(3):
        drawn = actions(env, step)
        observation, reward, terminated, *_ = env.step(drawn)
        expected = twin.step(drawn)
        np.testing.assert_array_equal(observation, expected[0])
        np.testing.assert_array_equal(reward, expected[1])
        assert terminated.all()
    assert names(directory) == ["broken_anymal_d_env8_step0.polypod", "broken_spot_env0_step0.polypod"]
    assert env.sim.log()["Episode_Termination/spot/illegal_state"] == 24.0


def test_set_dump_dir(make, actions, tmp_path):
    env = make(robots=["spot"], overrides=BROKEN)
    env.step(actions(env, 0))
    env.sim.set_dump_dir(tmp_path)
    env.step(actions(env, 1))
    assert names(tmp_path) == ["broken_spot_env0_step1.polypod"]
    env.sim.set_dump_dir(None)
    with pytest.raises(TypeError):
        env.sim.set_dump_dir(3)


def test_train(cli, tmp_path):
    options = "--num-envs 16 --robots spot --max-iterations 1 --train-config quick --run-name broken --threads 1"
    done = cli("train", *options.split(), "--set", BROKEN[0], "--set", "sim.episode_length_s=0.5")
    assert done.returncode == 0, done.stderr
    (run,) = tmp_path.glob("logs/rsl_rl/*/*_broken")
    assert "broken_spot_env0_step0.polypod" in names(run)
