"""Terms in Python see the true state, add up and end episodes.

Autoreset and final observations stay right.
"""

import re

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import polypod
import polypod.single_env
from common import SHORT, size
from polypod.terms import CustomTerms, Reward

STEPS = size(40, 400)
WIDTHS = {
    "base_pos": 3,
    "base_quat": 4,
    "base_lin_vel": 3,
    "base_ang_vel": 3,
    "projected_gravity": 3,
    "joint_pos": 12,
    "joint_vel": 12,
    "joint_acc": 12,
    "joint_effort": 12,
    "default_joint_pos": 12,
    "contact_forces": 12,
    "feet_pos": 12,
    "feet_height": 4,
    "feet_vel": 12,
    "feet_air_time": 4,
    "feet_contact_time": 4,
    "command": 3,
    "last_action": 12,
    "previous_action": 12,
}
QUIET = ("observations.enable_noise=false",)


def fields():
    return {name for name, value in vars(polypod.State).items() if isinstance(value, property)}


def test_the_state_is_dense_and_a_copy(make, actions):
    env = make(autoreset="disabled")
    env.reset(seed=3)
    assert fields() == {*WIDTHS, "base_height", "valid", "episode_length", "action_mask"}
    env.step(actions(env, 0))
    before = {}
    for name, width in WIDTHS.items():
        values = getattr(env.state, name)
        assert values.shape == (env.num_envs, width), name
        assert values.dtype == np.float32, name
        assert values.flags.c_contiguous, name
        assert np.isfinite(values).all(), name
        before[name] = (values, values.copy())
    # above the plane, on which the envs' origins lie
    np.testing.assert_array_equal(env.state.base_height, env.state.base_pos[:, 2])
    assert env.state.valid.all()
    assert env.state.action_mask.all()
    assert env.state.valid.dtype == np.bool_
    np.testing.assert_array_equal(env.state.episode_length, 1)
    env.step(actions(env, 1))
    for name, (values, kept) in before.items():
        np.testing.assert_array_equal(values, kept, err_msg=name)
        if name not in {"default_joint_pos", "feet_contact_time", "contact_forces", "command"}:
            assert not np.array_equal(getattr(env.state, name), kept), name


def test_the_state_is_what_the_observation_shows(make, actions):
    env = make(autoreset="disabled", overrides=QUIET)
    observations, _ = env.reset(seed=3)
    for step in range(5):
        state = env.state
        seen = [
            state.base_lin_vel,
            state.base_ang_vel,
            state.projected_gravity,
            state.command,
            state.joint_pos - state.default_joint_pos,
            state.joint_vel,
            state.last_action,
        ]
        np.testing.assert_array_equal(np.concatenate(seen, axis=1), observations)
        drawn = actions(env, step, scale=0.3)
        previous = state.last_action
        observations = env.step(drawn)[0]
        np.testing.assert_array_equal(env.state.last_action, drawn)
        np.testing.assert_array_equal(env.state.previous_action, previous)


def test_the_state_is_consistent(make):
    """Standing robots: feet below the base and on the ground, quaternions are unit.

    Their contact forces carry the weight.
    """
    env = make(robots=None, autoreset="disabled", overrides=(*QUIET, "events.push_robot.enabled=false"))
    env.reset(seed=3)
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    for _ in range(20):
        env.step(still)
    state = env.state
    np.testing.assert_allclose(np.linalg.norm(state.base_quat, axis=1), 1.0, atol=1e-5)
    feet = state.feet_pos.reshape(-1, 4, 3)
    assert (feet[:, :, 2] < state.base_pos[:, 2:]).all()
    # left feet are left of right ones, front feet before hind ones, in the base's heading
    w, z = state.base_quat[:, 0], state.base_quat[:, 3]
    yaw = 2 * np.arctan2(z, w)
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)[:, np.newaxis]
    along = ((feet - state.base_pos[:, np.newaxis])[:, :, :2] * ahead).sum(axis=2)
    assert (along[:, [0, 2]] > along[:, [1, 3]]).all()
    forces = state.contact_forces.reshape(-1, 4, 3)
    touching = state.feet_contact_time > 0
    assert (forces[touching][:, 2] > 0).all()
    assert (np.abs(forces[~touching]) <= 1.0).all()
    assert ((state.feet_air_time > 0) ^ touching).all()


def test_an_unknown_field_is_refused(make):
    with pytest.raises(ValueError, match="base_pos"):
        make().sim.state("base_position")


def height(state):
    return state.base_pos[:, 2]


def test_without_terms_it_is_the_same_step_env(make, actions):
    """The wrapper over a non-resetting env equals the resetting env in every bit."""
    env = make(overrides=SHORT)
    wrapped = CustomTerms(make(overrides=SHORT, autoreset="disabled"))
    assert wrapped.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    first, again = env.reset(seed=3)[0], wrapped.reset(seed=3)[0]
    np.testing.assert_array_equal(first, again)
    ended = 0
    for step in range(STEPS):
        drawn = actions(env, step)
        expected, got = env.step(drawn), wrapped.step(drawn)
        for one, other in zip(expected[:4], got[:4], strict=True):
            np.testing.assert_array_equal(one, other)
        assert expected[4].keys() == got[4].keys()
        for row in np.flatnonzero(expected[4].get("_final_obs", [])):
            np.testing.assert_array_equal(expected[4]["final_obs"][row], got[4]["final_obs"][row])
            ended += 1
    assert ended > env.num_envs
    assert wrapped.log() == env.sim.log()


def test_rewards_are_added_where_they_are_meant(make, actions):
    terms = {
        "height": Reward(lambda state: height(state) ** 2, weight=-10.0),
        "spot_only": Reward(lambda state: np.ones(len(state.base_pos)), weight=2.0, robots=["spot"]),
    }
    plain = make(autoreset="disabled")
    wrapped = CustomTerms(make(autoreset="disabled"), rewards=terms)
    plain.reset(seed=3)
    wrapped.reset(seed=3)
    is_spot = np.isin(np.arange(plain.num_envs), plain.env_ids("spot"))
    for step in range(3):
        drawn = actions(plain, step, scale=0.1)
        _, rewards, terminated, truncated, _ = plain.step(drawn)
        assert not (terminated | truncated).any()
        expected = rewards + (-10.0 * height(plain.state).astype(np.float64) ** 2 + 2.0 * is_spot) * plain.step_dt
        np.testing.assert_allclose(wrapped.step(drawn)[1], expected, rtol=1e-6)


def test_own_terminations_end_and_reset(make, actions):
    """Each env falls below a separate limit at some step.

    It ends there, shows its last state, and restarts.
    """
    env = make(autoreset="disabled", overrides=QUIET)
    limit = 10
    wrapped = CustomTerms(
        env,
        terminations={"long": lambda state: state.episode_length >= limit},
        observations={"height": height, "feet": lambda state: state.feet_pos},
        rewards={"alive": Reward(lambda state: np.ones(len(state.base_pos)), weight=1.0)},
    )
    assert wrapped.observation_layout[-2:] == [("height", 1), ("feet", 12)]
    observations, _ = wrapped.reset(seed=3)
    assert observations.shape == wrapped.observation_space.shape == (env.num_envs, 48 + 13)
    twin = make(autoreset="disabled", overrides=QUIET)
    twin.reset(seed=3)
    for step in range(limit):
        drawn = actions(env, step, scale=0.05)
        observations, _, terminated, truncated, infos = wrapped.step(drawn)
        seen = twin.step(drawn)[0]
        done = terminated | truncated
        if step < limit - 1 and not done.any():
            np.testing.assert_array_equal(observations[:, :48], seen)
            np.testing.assert_array_equal(observations[:, 48], height(env.state))
        elif step < limit - 1:
            pytest.fail("an episode ended by itself; choose calmer actions")
    assert terminated.all()
    assert not truncated.any()
    for row in range(env.num_envs):
        np.testing.assert_array_equal(infos["final_obs"][row][:48], seen[row])
        assert infos["final_obs"][row][48] == twin.state.base_pos[row, 2]
    # the observation is that of the new episode, and so is the state
    np.testing.assert_array_equal(env.sim.episode_length, 0)
    np.testing.assert_array_equal(observations[:, :48], env.sim.observation)
    np.testing.assert_array_equal(observations[:, 48], height(env.state))
    log = wrapped.log()
    for robot in env.robots:
        assert log[f"Metrics/{robot}/fall_rate"] == 1.0
        assert log[f"Episode_Reward/{robot}/alive"] == pytest.approx(limit * env.step_dt / 20.0)
        assert log[f"Episode_Termination/{robot}/long"] == len(env.env_ids(robot))
    again = wrapped.log()
    assert "Episode_Reward/spot/alive" not in again
    assert "Episode_Termination/spot/long" not in again


def test_own_terminations_are_counted_by_robot_and_term(make, actions):
    """Each episode that a term has ended, of the robots that had ends.

    Two terms may end the same episode.
    """
    env = make(autoreset="disabled", overrides=QUIET)
    ids = {robot: env.env_ids(robot) for robot in env.robots}
    first, second = env.robots[:2]

    def ends(rows):
        mask = np.zeros(env.num_envs, dtype=np.bool_)
        mask[rows] = True
        return lambda state: mask & (state.episode_length >= 2)

    terms = {"one": ends(ids[first][:1]), "both": ends([*ids[first][:2], ids[second][0]]), "never": ends([])}
    wrapped = CustomTerms(env, terminations=terms)
    wrapped.reset(seed=3)
    for step in range(2):
        wrapped.step(actions(env, step, scale=0.05))
    log = wrapped.log()
    counts = {key: value for key, value in log.items() if key.split("/")[-1] in terms}
    assert counts == {
        f"Episode_Termination/{first}/one": 1.0,
        f"Episode_Termination/{first}/both": 2.0,
        f"Episode_Termination/{first}/never": 0.0,
        f"Episode_Termination/{second}/one": 0.0,
        f"Episode_Termination/{second}/both": 1.0,
        f"Episode_Termination/{second}/never": 0.0,
    }


def test_an_env_that_ends_leaves_the_others_alone(make, actions):
    only = {"third": lambda state: (state.episode_length >= 3) & (np.arange(len(state.episode_length)) == 2)}
    wrapped = CustomTerms(make(autoreset="disabled"), terminations=only)
    plain = make(autoreset="disabled")
    wrapped.reset(seed=3)
    plain.reset(seed=3)
    for step in range(5):
        drawn = actions(plain, step, scale=0.05)
        got, expected = wrapped.step(drawn), plain.step(drawn)
        others = np.arange(plain.num_envs) != 2
        np.testing.assert_array_equal(got[0][others], expected[0][others])
        np.testing.assert_array_equal(got[2], (np.arange(plain.num_envs) == 2) & (step == 2))


def test_mistakes_are_told(make):
    with pytest.raises(polypod.ConfigError, match="autoreset='disabled'"):
        CustomTerms(make())
    env = make(autoreset="disabled")
    with pytest.raises(polypod.UnknownNameError, match="spott"):
        CustomTerms(env, rewards={"x": Reward(height, 1.0, robots=["spott"])})
    with pytest.raises(polypod.ConfigError, match="one row per env"):
        CustomTerms(env, observations={"x": lambda state: np.zeros((3, 2))})
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    wrapped = CustomTerms(env, terminations={"x": height})
    wrapped.reset(seed=1)
    with pytest.raises(polypod.ConfigError, match="return bools"):
        wrapped.step(still)
    with pytest.raises(polypod.ConfigError, match="autoreset disabled"):
        make().sim.terminate(np.ones(16, dtype=np.bool_))


BAD = [
    (np.nan, "nan"),
    (np.inf, "inf"),
    (-np.inf, "-inf"),
    (1e39, "1e+39"),
    (np.float64(-3.5e38), "-3.5e+38"),
]


@pytest.mark.parametrize(("value", "told"), BAD)
def test_a_reward_is_a_finite_number(make, value, told):
    env = make(autoreset="disabled")
    wrapped = CustomTerms(
        env,
        rewards={"bad": Reward(lambda state: np.where(np.arange(16) == 5, value, 0.0), weight=1.0)},
        source="mine.py",
    )
    wrapped.reset()
    with pytest.raises(polypod.ConfigError, match=re.escape(f"mine.py: rewards['bad'] gives {told} for env 5")):
        wrapped.step(np.zeros(env.action_space.shape, dtype=np.float32))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("value", "told"), BAD)
def test_an_observation_is_finite_numbers(make, value, told):
    late = {"on": False}

    def term(state):
        return np.where(late["on"], np.full((16, 2), value), 0.0)

    env = make(autoreset="disabled")
    wrapped = CustomTerms(env, observations={"bad": term})
    wrapped.reset()
    late["on"] = True
    message = re.escape(f"observations['bad'] gives {told} for env 0")
    with pytest.raises(polypod.ConfigError, match=message):
        wrapped.step(np.zeros(env.action_space.shape, dtype=np.float32))
    with pytest.raises(polypod.ConfigError, match=message):
        wrapped.reset()
    with pytest.raises(polypod.ConfigError, match=message):
        CustomTerms(env, observations={"bad": term})


def test_terms_of_other_types_and_sizes_are_refused(make):
    env = make(autoreset="disabled")
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    for weight in (np.nan, np.inf, 1e39, "1", None):
        with pytest.raises(polypod.ConfigError, match=r"rewards\['x'\]\.weight"):
            CustomTerms(env, rewards={"x": Reward(height, weight=weight)})
    wrapped = CustomTerms(env, rewards={"x": Reward(lambda state: np.full(16, 1e38), weight=1e10)})
    wrapped.reset()
    with pytest.raises(
        polypod.ConfigError, match=r"rewards\['x'\] times its weight and step_dt gives 2e\+46 for env 0"
    ):
        wrapped.step(still)
    with pytest.raises(polypod.ConfigError, match=r"rewards\['x'\] is a function; write polypod\.terms\.Reward"):
        CustomTerms(env, rewards={"x": height})
    for value in (["a"] * 16, np.zeros(16, dtype=complex), [None] * 16):
        wrapped = CustomTerms(env, rewards={"x": Reward(lambda state, value=value: value, weight=1.0)})
        wrapped.reset()
        with pytest.raises(polypod.ConfigError, match=r"rewards\['x'\] gives"):
            wrapped.step(still)
        with pytest.raises(polypod.ConfigError, match=r"observations\['x'\] gives"):
            CustomTerms(env, observations={"x": lambda state, value=value: value})
    for value in (np.full(16, np.nan), np.zeros(16, dtype=int), [None] * 16, ["no"] * 16):
        wrapped = CustomTerms(env, terminations={"x": lambda state, value=value: value})
        wrapped.reset()
        with pytest.raises(polypod.ConfigError, match=r"terminations\['x'\] gives .*; return bools"):
            wrapped.step(still)
    sizes = iter((2, 2, 3))
    wrapped = CustomTerms(env, observations={"x": lambda state: np.zeros((16, next(sizes)))})
    wrapped.reset()
    with pytest.raises(polypod.ConfigError, match=r"observations\['x'\] gives shape \(16, 3\)"):
        wrapped.step(still)
    with pytest.raises(polypod.ConfigError, match="call step"):
        wrapped.send(still)


class Told(polypod.VectorEnv):
    """An env with an additional info."""

    def reset(self, **options):
        """As of the env."""
        observations, infos = super().reset(**options)
        return observations, {**infos, "age": self.sim.episode_length, "note": "a word"}

    def step(self, actions):
        """As of the env."""
        *found, infos = super().step(actions)
        return (*found, {**infos, "age": self.sim.episode_length, "note": "a word"})


def test_infos_are_those_of_the_env(actions):
    """All keys, before and after ends; those of the last step of an episode are in `final_info`."""
    plain = polypod.make("velocity_flat_legged", 8, robots=["unitree_go2", "unitree_h1"], seed=1, overrides=SHORT)
    env = Told(
        "velocity_flat_legged", 8, robots=["unitree_go2", "unitree_h1"], seed=1, overrides=SHORT, autoreset="disabled"
    )
    wrapped = CustomTerms(env, terminations={"old": lambda state: state.episode_length >= 9})
    assert plain.reset()[1].keys() | {"age", "note"} == wrapped.reset()[1].keys()
    ends = 0
    for step in range(25):
        drawn = actions(plain, step, scale=0.05)
        of_plain = plain.step(drawn)[4]
        _, _, terminated, truncated, infos = wrapped.step(drawn)
        done = terminated | truncated
        np.testing.assert_array_equal(infos["action_mask"], env.action_mask)
        assert infos["note"] == "a word"
        np.testing.assert_array_equal(infos["age"] == 0, done)
        if done.any():
            ends += done.sum()
            assert infos.keys() == {
                "action_mask",
                "age",
                "note",
                "final_obs",
                "_final_obs",
                "final_info",
                "_final_info",
            }
            assert set(infos["final_info"]) == {"action_mask", "age", "note"}
            assert (infos["final_info"]["age"][done] > 0).all()
            assert infos["_final_obs"] is not infos["_final_info"]
        else:
            assert of_plain.keys() - {"final_obs", "_final_obs", "final_info", "_final_info"} == {"action_mask"}
    assert ends >= 16


def test_a_single_env_has_the_infos_of_one_row():
    env = polypod.single_env.Env("velocity_flat_legged", robots=["unitree_go2"], slots=["L_HIP_YAW"])
    _, infos = env.reset(seed=0)
    assert infos["action_mask"].shape == env.action_space.shape
    assert infos["action_mask"].sum() == 12
    assert env.step(np.zeros(env.action_space.shape))[4]["action_mask"].shape == env.action_space.shape


def test_rsl_rl_learns_with_own_terms(make):
    torch = pytest.importorskip("torch")
    rsl_rl = pytest.importorskip("polypod.rsl_rl")
    plain = make(autoreset="disabled", overrides=SHORT)
    wrapped = CustomTerms(
        plain,
        rewards={"height": Reward(height, weight=1.0)},
        observations={"height": height},
    )
    env = rsl_rl.VecEnv(wrapped)
    assert env.get_observations()["policy"].shape == (16, 49)
    spot = plain.env_ids("spot")
    ended = 0
    for _ in range(25):
        observations, rewards, dones, extras = env.step(torch.zeros(16, 12))
        assert observations["policy"].shape == (16, 49)
        assert rewards.shape == dones.shape == (16,)
        ended += int(dones.sum())
        if dones.any():
            assert "Episode_Reward/spot/height" in extras["log"] or not dones[spot].any()
    assert ended >= 16
