"""Gymnasium's single envs, checkers, wrappers, pictures, specs, attributes and actions."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import vector as wrappers

import polypod
from polypod.vector_env import override_texts

SPOT = "polypod/Velocity-Flat-Spot-v0"
HETERO = "polypod/Velocity-Flat-HeteroQuadruped-v0"


def test_a_single_env_passes_the_checker():
    env = gymnasium.make(SPOT)
    check_env(env.unwrapped)
    env.close()


def test_a_single_env_is_the_batch_of_one():
    env = gymnasium.make(SPOT, overrides={"sim": {"episode_length_s": 0.4}})
    twin = polypod.make(SPOT, 1, autoreset="disabled", overrides=["sim.episode_length_s=0.4"])
    observation, _ = env.reset(seed=3)
    np.testing.assert_array_equal(observation, twin.reset(seed=3)[0][0])
    random = np.random.default_rng(0)
    for step in range(20):
        action = random.uniform(-1.0, 1.0, 12)
        observation, reward, terminated, truncated, _ = env.step(action)
        observations, rewards, ends, times, _ = twin.step(action[np.newaxis])
        np.testing.assert_array_equal(observation, observations[0])
        assert (reward, terminated, truncated) == (rewards[0], ends[0], times[0])
        assert truncated == (step == 19)
    assert isinstance(reward, float)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(action)
    env.close()


def test_a_single_env_of_many_robots_has_the_first_or_the_one_that_is_named():
    for robots, expected in ((None, "anymal_d"), (["spot"], "spot")):
        env = gymnasium.make(HETERO, robots=robots)
        assert env.unwrapped.sim.robots == [expected]
        env.close()
    with pytest.raises(polypod.ConfigError, match=r"holds one robot, not 2; use polypod\.make"):
        gymnasium.make(HETERO, robots=["spot", "unitree_a1"])
    with pytest.raises(polypod.ConfigError, match="autoreset"):
        gymnasium.make(HETERO, autoreset="same_step")


def test_single_envs_can_be_vectorised_by_gymnasium():
    env = gymnasium.make_vec(SPOT, num_envs=2, vectorization_mode="sync")
    assert env.reset(seed=0)[0].shape == (2, 48)
    env.step(env.action_space.sample())
    env.close()


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.int64, np.uint8, list, tuple, "torch"])
def test_actions_of_any_type_of_number(make, dtype):
    env, twin = make(), make()
    env.reset(seed=0)
    twin.reset(seed=0)
    whole = np.ones(env.action_space.shape, dtype=np.float32)
    if dtype == "torch":
        given = pytest.importorskip("torch").ones(whole.shape, dtype=pytest.importorskip("torch").float64)
    elif dtype in (list, tuple):
        given = dtype(map(dtype, whole.tolist()))
    else:
        given = whole.astype(dtype)
    np.testing.assert_array_equal(env.step(given)[0], twin.step(whole)[0])
    env.send(given)
    np.testing.assert_array_equal(env.recv()[0], twin.step(whole)[0])


def test_actions_in_another_memory_order(make, actions):
    env, twin = make(), make()
    env.reset(seed=0)
    twin.reset(seed=0)
    drawn = actions(env, 0)
    np.testing.assert_array_equal(env.step(np.asfortranarray(drawn))[0], twin.step(drawn)[0])


@pytest.mark.parametrize(
    ("bad", "error", "said"),
    [
        ("walk", TypeError, "no numbers"),
        (None, TypeError, "no numbers"),
        (1e300, ValueError, "infinit|inf"),
        (1j, TypeError, "no numbers"),
    ],
)
def test_what_is_no_action_is_refused(make, bad, error, said):
    env = make()
    env.reset(seed=0)
    with pytest.raises(error, match=said):
        env.step(np.full(env.action_space.shape, bad))


def test_the_action_space_is_finite_and_holds_what_joints_reach():
    env = polypod.make("velocity_flat", robots=["spot"], num_envs=1, seed=0)
    space = env.single_action_space
    assert np.isfinite(space.low).all()
    assert np.isfinite(space.high).all()
    assert (space.low < 0).all()
    assert (space.high > 0).all()
    # Spot's left front hip: default 0.1 rad, limits +-0.785398 rad, 0.2 rad per unit of action
    slot = env.canonical_joint_names.index("LF_HAA")
    np.testing.assert_allclose(space.low[slot], (-0.785398 - 0.1) / 0.2, rtol=1e-5)
    np.testing.assert_allclose(space.high[slot], (0.785398 - 0.1) / 0.2, rtol=1e-5)
    env.close()


def test_the_action_space_of_many_robots_holds_that_of_each():
    robots = ["spot", "unitree_a1", "anymal_d"]
    together = polypod.make("velocity_flat", robots=robots, num_envs=3, seed=0).single_action_space
    alone = [polypod.make("velocity_flat", robots=[robot], num_envs=1, seed=0).single_action_space for robot in robots]
    np.testing.assert_array_equal(together.low, np.min([space.low for space in alone], axis=0))
    np.testing.assert_array_equal(together.high, np.max([space.high for space in alone], axis=0))


def test_gymnasiums_vector_wrappers(make, actions):
    env = make(autoreset="next_step", overrides={"sim.episode_length_s": 0.4})
    wrapped = wrappers.NormalizeObservation(wrappers.RecordEpisodeStatistics(env))
    wrapped = wrappers.NormalizeReward(wrappers.ClipAction(wrapped))
    wrapped.reset(seed=0)
    lengths = []
    for step in range(45):
        observations, _, _, _, infos = wrapped.step(actions(env, step))
        lengths += infos["episode"]["l"][infos["_episode"]].tolist() if "episode" in infos else []
    assert observations.shape == env.observation_space.shape
    assert len(lengths) >= env.num_envs
    assert max(lengths) == 20


def test_gymnasiums_wrappers_of_single_envs():
    env = gymnasium.make(SPOT)
    env = gymnasium.wrappers.RescaleAction(env, -1.0, 1.0)
    env = gymnasium.wrappers.NormalizeObservation(gymnasium.wrappers.TimeLimit(env, 3))
    env.reset(seed=0)
    assert not env.step(env.action_space.sample())[3]
    env.step(env.action_space.sample())
    assert env.step(env.action_space.sample())[3]
    env.close()


def test_pictures(make):
    pytest.importorskip("PIL")
    env = make(num_envs=4, render_mode="rgb_array")
    assert env.render_mode == "rgb_array"
    assert env.metadata["render_fps"] == 50
    env.reset(seed=0)
    first = env.render()
    assert [picture.shape for picture in first] == [(360, 640, 3)] * 4
    assert first[0].dtype == np.uint8
    assert len({picture.tobytes() for picture in first}) == 4, "each env is drawn"
    for _ in range(5):
        env.step(np.full((4, 12), 0.5))
    assert not np.array_equal(env.render()[0], first[0]), "it moves"
    assert make(num_envs=4).render() is None
    with pytest.raises(polypod.ConfigError, match="render_mode='human' is not one of rgb_array"):
        make(render_mode="human")


def test_a_single_env_is_recorded(tmp_path, monkeypatch):
    pytest.importorskip("PIL")
    env = gymnasium.make(SPOT, render_mode="rgb_array")
    env = gymnasium.wrappers.AddRenderObservation(env)
    observation, _ = env.reset(seed=0)
    assert observation.shape == (360, 640, 3)
    env.close()
    pytest.importorskip("moviepy", reason="Gymnasium's RecordVideo needs moviepy")
    env = gymnasium.wrappers.RecordVideo(gymnasium.make(SPOT, render_mode="rgb_array"), str(tmp_path), video_length=3)
    env.reset(seed=0)
    for _ in range(4):
        env.step(env.action_space.sample())
    env.close()
    assert list(tmp_path.glob("*.mp4"))


def test_the_spec_builds_the_same_env():
    env = polypod.make("velocity_flat", 8, seed=7, overrides={"sim.episode_length_s": 5.0})
    assert env.spec.id == HETERO
    again = gymnasium.make_vec(env.spec)
    assert again.num_envs == 8
    np.testing.assert_array_equal(again.sim.observation, env.sim.observation)
    assert again.max_episode_length == env.max_episode_length == 250
    env.close()
    again.close()


def test_attributes_of_all_envs(make):
    env = make(num_envs=4)
    assert env.get_attr("step_dt") == (0.02,) * 4
    assert env.call("env_ids", "spot")[0].tolist() == [3]
    env.set_attr("note", "mine")
    env.set_attr("note", ["mine"] * 4)
    assert env.get_attr("note") == ("mine",) * 4
    with pytest.raises(polypod.ConfigError, match="share one simulator"):
        env.set_attr("note", [1, 2, 3, 4])
    with pytest.raises(AttributeError):
        env.get_attr("nothing")


def test_overrides_are_a_dict_or_texts():
    given = {
        "sim": {"episode_length_s": 5.0, "dt": np.float64(0.004)},
        "commands.base_velocity.lin_vel_x": (0.0, 1),
        "physics.engine": "articulated",
        "commands.base_velocity.heading_command": False,
        "rewards.unitree.dof_acc_l2": None,
        "observations.policy": [{"term": "base_lin_vel", "noise": 0.5}],
    }
    assert override_texts(given) == [
        "sim.episode_length_s=5.0",
        "sim.dt=0.004",
        "commands.base_velocity.lin_vel_x=[0.0, 1]",
        'physics.engine="articulated"',
        "commands.base_velocity.heading_command=false",
        "rewards.unitree.dof_acc_l2=null",
        'observations.policy=[{ "term" = "base_lin_vel", "noise" = 0.5 }]',
    ]
    env, twin = (polypod.make("velocity_flat", 8, seed=0, overrides=x) for x in (given, override_texts(given)))
    assert env.sim.config_hash() == twin.sim.config_hash()
    for wrong, said in (
        ("sim.dt=1", "one string"),
        ({"sim.dt": object()}, "a object"),
        ({"sim.dtt": 1}, "did you mean"),
    ):
        with pytest.raises(polypod.ConfigError, match=said):
            polypod.make("velocity_flat", 8, overrides=wrong)
