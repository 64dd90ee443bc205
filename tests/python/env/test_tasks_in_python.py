"""A task written in Python alone: own observation, command, event, curriculum, termination, curve.

Every env, learner and command shows and does the same with it.
"""

import json
import re

import numpy as np
import pytest
import torch

import polypod
from common import ROOT
from lab import terms_cost
from polypod import term_list, terms
from polypod.rsl_rl import VecEnv
from polypod.runs import run_dir

EXAMPLE = ROOT / "examples" / "jump_task.py"
SHORT = ["sim.episode_length_s=0.6"]
LINE = ("train", "--num-envs", "16", "--robots", "unitree_go2,spot", "--logger", "none")
LINE += ("--set", "sim.episode_length_s=0.6", "--set", "train.run.num_steps_per_env=8")
LINE += ("--set", "train.actor.hidden_dims=[16]", "--set", "train.critic.hidden_dims=[16]")
ROBOTS = ["unitree_go2", "spot"]
TRACKING = "track_lin_vel_xy_exp"


def make(declared, num_envs=8, **options):
    options = {"robots": ROBOTS, "seed": 3, "threads": 1, "overrides": SHORT, **options}
    return polypod.make(options.pop("task", "velocity_flat"), num_envs, terms=declared, **options)


def drive(env, steps, seed=0):
    """Observations, rewards and ends of steps with drawn actions."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(steps):
        actions = rng.uniform(-1.0, 1.0, (env.num_envs, env.sim.num_actions)).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(actions)
        rows.append((observation.copy(), reward.copy(), terminated | truncated))
    return rows


def same(one, other):
    return all(np.array_equal(a, b) for x, y in zip(one, other, strict=True) for a, b in zip(x, y, strict=True))


@terms.observation(size=1, units="m", history_length=3)
def height(env):
    """Height of the base."""
    return env.base_height


@terms.observation(size=1, mirror="per_joint", group="critic", robots=["spot"])
def effort(env):
    """Torques."""
    return env.joint_effort


def test_no_step_goes_past_the_terms():
    sim = make([height]).sim
    assert sim.device_arrays() is None
    with pytest.raises(polypod.ConfigError, match="terms in Python take part"):
        sim.step_device()


def test_columns_follow_the_task_s_own_in_every_view_of_the_env():
    env = make([height])
    plain = make(None)
    assert env.observation_layout == [*plain.observation_layout, ("height", 3)]
    first, _ = env.reset(seed=3)
    own = plain.reset(seed=3)[0]
    assert env.single_observation_space.shape == (own.shape[1] + 3,) == first.shape[1:]
    np.testing.assert_array_equal(first[:, :-3], own)
    # a new episode's history is filled with its first number
    np.testing.assert_array_equal(first[:, -3:], np.repeat(env.state.base_height[:, None], 3, axis=1))
    (entry,) = [entry for entry in json.loads(env.sim.observation_terms()) if entry["term"] == "height"]
    assert entry["units"] == "m"
    assert entry["history_length"] == 3
    assert entry["source"] == "measured"
    assert entry["description"] == "Height of the base."


def test_history_moves_by_one_in_each_step_and_begins_anew():
    env = make([height])
    env.reset(seed=3)
    before, ended = env.sim.observation[:, -3:].copy(), 0
    for observation, _, done in drive(env, 40):
        now = observation[:, -3:]
        np.testing.assert_array_equal(now[~done, :2], before[~done, 1:])
        assert (now[done, 0] == now[done, 2]).all()
        ended += int(done.sum())
        before = now
    assert ended >= env.num_envs


def test_final_observations_are_of_the_episode_that_ended():
    env = make([height])
    env.reset(seed=3)
    actions = np.zeros(env.action_space.shape, dtype=np.float32)
    for _ in range(40):
        before = env.sim.observation[:, -3:].copy()
        observation, _, terminated, truncated, infos = env.step(actions)
        for row in np.flatnonzero(terminated | truncated):
            np.testing.assert_array_equal(infos["final_obs"][row][-3:-1], before[row, 1:])
            assert infos["final_obs"][row][-1] != observation[row, -1]
            return
    pytest.fail("no episode ended")


def test_without_terms_of_its_own_the_simulation_keeps_every_bit():
    @terms.metric()
    def speed(env):
        return env.base_lin_vel[:, 0]

    env, plain = make([speed]), make(None)
    env.reset(seed=3)
    plain.reset(seed=3)
    assert same(drive(env, 60), drive(plain, 60))
    log = env.sim.log()
    assert set(log) > {"Metrics/spot/speed", "Metrics/unitree_go2/speed"}
    theirs = plain.sim.log()
    assert {key: log[key] for key in theirs} == theirs


def test_masks_mirror_and_columns_of_joints():
    env = make([effort], task="velocity_flat_legged", robots=["unitree_go2", "spot", "unitree_g1"], num_envs=6)
    n = env.sim.num_actions
    columns = env.sim.observation_groups["critic"]
    assert columns[1] - columns[0] == n
    drive(env, 3)
    seen = env.sim.observation_of("critic")
    spot = slice(*env.sim.env_ids("spot"))
    np.testing.assert_array_equal(seen[spot], env.state.joint_effort[spot])
    assert np.abs(seen[spot]).sum() > 0.0
    assert not seen[: spot.start].any()
    assert not seen[spot.stop :].any()
    assert not any(env.sim.observation_mask("unitree_go2", "critic"))
    assert env.sim.observation_mask("spot", "critic") == list(env.action_mask[spot.start])
    assert env.sim.observation_mirror("spot", "critic") == env.sim.action_mirror("spot")
    # rsl_rl's view shows the same group
    adapter = VecEnv(env)
    np.testing.assert_array_equal(adapter.get_observations()["critic"].numpy(), seen)


def test_noise_depends_on_the_seed_and_the_env_alone():
    @terms.observation(size=2, noise=0.5)
    def nothing(env):
        return np.zeros((env.num_envs, 2))

    one, two = make([nothing]), make([nothing], robots=["spot"], num_envs=6)
    one.reset(seed=9)
    two.reset(seed=9)
    spot = slice(*one.sim.env_ids("spot"))
    np.testing.assert_array_equal(one.sim.observation[spot, -2:], two.sim.observation[: spot.stop - spot.start, -2:])
    assert 0.0 < np.abs(one.sim.observation[:, -2:]).max() <= 0.5
    assert len(np.unique(one.sim.observation[:, -2:])) == 2 * one.num_envs
    quiet = make([nothing], overrides=["observations.enable_noise=false"])
    assert not quiet.sim.observation[:, -2:].any()


@terms.command(size=2, resampling_time_s=(0.1, 0.2))
def target(env, ids):
    """A place."""
    return env.random.uniform(-1.0, 1.0, ids, 2)


def test_commands_are_sampled_by_each_env_s_stream_and_observed():
    env, small = make([target]), make([target], robots=["spot"], num_envs=4)
    for of in (env, small):
        of.reset(seed=5)
    spot = slice(*env.sim.env_ids("spot"))
    values, changes = env.sim.observation[:, -2:].copy(), np.zeros(env.num_envs)
    for _ in range(25):
        for of in (env, small):
            of.step(np.zeros(of.action_space.shape, dtype=np.float32))
        seen = env.sim.observation[:, -2:]
        np.testing.assert_array_equal(seen[spot], small.sim.observation[:, -2:])
        changes += (seen != values).all(axis=1)
        values = seen.copy()
    # 25 steps of 0.02 s, every 0.1 to 0.2 s
    assert (changes >= 2).all()
    assert (changes <= 5).all()
    assert np.abs(values).max() <= 1.0


def test_events_happen_when_they_say():
    happened = []

    @terms.event(mode="startup")
    def begin(env, ids):
        happened.append(("startup", ids.tolist()))

    @terms.event(mode="reset", robots=["spot"])
    def fresh(env, ids):
        happened.append(("reset", ids.tolist()))

    @terms.event(mode="interval", interval_range_s=(0.1, 0.1))
    def again(env, ids):
        happened.append(("interval", ids.tolist()))

    env = make([begin, fresh, again], num_envs=4)
    every = [0, 1, 2, 3]
    assert happened == [("startup", every), ("reset", [2, 3])]
    happened.clear()
    drive(env, 5)
    assert happened == [("interval", every)]
    happened.clear()
    env.reset(options={"reset_mask": np.array([True, False, False, True])})
    assert happened == [("reset", [3])]
    env.reset(seed=1)
    assert happened[1:] == [("startup", every), ("reset", [2, 3])]


def test_curricula_change_weights_ranges_and_curves():
    told = []

    @terms.curriculum()
    def harder(env, ids):
        told.append((ids.tolist(), np.abs(env.episode_reward("own")[ids]).min()))
        env.set_weight(TRACKING, 2.5)
        env.set_weight("own", 7.0)
        env.sim.set_command_ranges("spot", lin_vel_x=(0.1, 0.2))
        return 3.0

    @terms.reward(weight=1.0)
    def own(env):
        return np.ones(env.num_envs)

    env = make([harder, own])
    robots = [robot for robot in ROBOTS if TRACKING in env.sim.reward_terms(robot)]
    ends = np.stack([done for _, _, done in drive(env, 31)])
    assert sorted(row for ids, _ in told for row in ids) == sorted(np.argwhere(ends)[:, 1].tolist())
    # one reward per second of each step before the first end
    assert told[0][1] == pytest.approx(0.02 * (1 + np.argwhere(ends)[0, 0]))
    assert robots
    assert [env.sim.reward_weights(robot)[TRACKING] for robot in robots] == [2.5] * len(robots)
    assert env.sim.command_ranges()["spot"]["lin_vel_x"] == [0.1, 0.2]
    # commands are drawn from these ranges
    env.reset(seed=3)
    drawn = env.sim.command[env.env_ids("spot"), 0]
    assert (np.abs(drawn) <= np.float32(0.2)).all(), drawn
    assert (drawn > 0.0).any(), drawn


def test_what_a_curriculum_of_the_task_sets_is_not_set_otherwise(tmp_path):
    task = tmp_path / "staged.toml"
    task.write_text(
        'name = "Staged-v0"\nextends = "velocity_flat"\n'
        "[curriculum.commands_vel]\nvelocity_stages = [{ step = 100, lin_vel_x = [-0.5, 0.5] }]\n"
        f'[curriculum.later]\nterm = "modify_reward_weight"\nterm_name = "{TRACKING}"\nweight = 2.0\nnum_steps = 9\n'
    )
    sim = polypod.VecSim(str(task), 8)
    with pytest.raises(polypod.ConfigError, match="curriculum"):
        sim.set_command_ranges("spot", lin_vel_x=(0.1, 0.2))
    with pytest.raises(polypod.ConfigError, match="curriculum"):
        sim.set_reward_weight("unitree_go2", TRACKING, 3.0)


def test_a_snapshot_goes_on_bit_for_bit():
    env, other = make(str(EXAMPLE)), make(str(EXAMPLE))
    drive(env, 50)
    data = env.sim.snapshot()
    expected = drive(env, 50, seed=1)
    log = env.sim.log()
    other.sim.restore(data)
    assert same(drive(other, 50, seed=1), expected)
    # episodes before the snapshot count in both logs
    assert other.sim.log() == log
    assert other.sim.snapshot() == env.sim.snapshot()
    assert "Curriculum/higher/level" in log
    with pytest.raises(polypod.ConfigError, match="holds no memory of terms"):
        other.sim.restore(make(None).sim.snapshot())
    with pytest.raises(polypod.ConfigError, match=r"another|other"):
        make([height]).sim.restore(data)


def checkpoint(folder):
    return run_dir.find_checkpoint(folder, "latest")


@pytest.mark.parametrize("learner", ["native", "rsl_rl"])
def test_the_example_trains_resumes_is_evaluated_played_and_exported(learner, cli, tmp_path):
    train = (*LINE, "--terms", str(EXAMPLE), "--learner", learner)
    done = cli(*train, "--max-iterations", "3", "--log-dir", "whole")
    assert done.returncode == 0, done.stderr
    assert re.search(r"terms of jump_task.py take \d+\.\d % of a step|terms of jump_task.py take [\d.]+%", done.stdout)
    assert cli(*train, "--max-iterations", "2", "--log-dir", "parts").returncode == 0
    resume = ("train", "--resume", "--log-dir", "parts", "--max-iterations", "1", "--logger", "none")
    done = cli(*resume, "--terms", str(EXAMPLE))
    assert done.returncode == 0, done.stderr
    whole, parts = checkpoint(tmp_path / "whole"), checkpoint(tmp_path / "parts")
    one, other = run_dir.load_checkpoint(whole), run_dir.load_checkpoint(parts)
    for key, value in one["actor_state_dict"].items():
        assert torch.equal(value, other["actor_state_dict"][key]), key
    assert torch.equal(one["infos"]["sim"], other["infos"]["sim"])
    if learner == "rsl_rl":
        return
    short = ("--num-envs", "4", "--steps", "10")
    done = cli("eval", "--checkpoint", str(whole), *short)
    assert done.returncode == 2
    assert "observes jump_height, clock, which jump_task.py computes; name that file with --terms" in done.stderr
    done = cli("eval", "--checkpoint", str(whole), *short, "--terms", str(EXAMPLE))
    assert done.returncode == 0, done.stderr
    done = cli("play", "--checkpoint", str(whole), "--headless", "--seconds", "0.2", "--terms", str(EXAMPLE))
    assert done.returncode == 0, done.stderr
    done = cli("export", "--checkpoint", str(whole), "--out", "exported")
    assert done.returncode == 0, done.stderr
    contract = next((tmp_path / "exported").rglob("*.json")).read_text()
    assert "jump_height" in contract
    assert "clock" in contract
    line = ("sim2sim", "--checkpoint", str(whole), "--robots", "spot,unitree_go2", "--steps", "5", "--num-envs", "2")
    done = cli(*line)
    assert done.returncode == 2
    assert "observes jump_height, clock, which jump_task.py computes; name that file with --terms" in done.stderr
    done = cli(*line, "--terms", str(EXAMPLE), "--json", "sim2sim.json")
    assert done.returncode == 3, done.stderr
    found = json.loads((tmp_path / "sim2sim.json").read_text())
    assert "--terms" in found["command"]
    assert [robot["mujoco"]["episode_length_s"] for robot in found["robots"].values()] == pytest.approx([0.1, 0.1])


def test_the_example_resets_to_the_states_that_it_gives():
    env = make(str(EXAMPLE), overrides=["sim.episode_length_s=0.2"])
    env.reset(seed=3)
    for step in range(25):
        begun = env.sim.episode_length == 0
        assert begun.any() == (step % 10 == 0), step
        rows = np.flatnonzero(begun)
        speed = env.state.base_lin_vel[rows]
        np.testing.assert_allclose(speed[rows % 2 == 1], np.tile([0.0, 0.0, 1.0], (rows.size // 2, 1)), atol=1e-6)
        assert np.abs(speed[rows % 2 == 0] - [0.0, 0.0, 1.0]).sum(axis=1).min(initial=1.0) > 1e-4
        env.step(np.zeros((env.num_envs, env.sim.num_actions), dtype=np.float32))


def test_terms_of_other_projects_run_on_different_bodies():
    file = EXAMPLE.with_name("terms_of_others.py")
    env = make(str(file), task="velocity_rough_legged", robots=["spot", "unitree_g1"])
    env.reset(seed=3)
    rewards = np.stack([reward for _, reward, _ in drive(env, 60)])
    assert np.isfinite(rewards).all()
    curves = env.sim.log()
    for robot in ("spot", "unitree_g1"):
        for term in env.sim.terms.rewards:
            assert term == "contact_forces" or curves[f"Episode_Reward/{robot}/{term}"] != 0.0, (robot, term)
        assert curves[f"Metrics/{robot}/mean_action_acc"] > 0.1
    assert env.sim.observation_of("critic").shape[1] == 2 * len(env.feet_names)
    assert file.read_text().count("\n") < 150
    # no built-in term is written again
    assert not env.sim.terms.rewards.keys() & term_list.read()["rewards"].keys()


def test_terms_of_other_projects_have_their_formulas():
    env = make(str(EXAMPLE.with_name("terms_of_others.py")), task="velocity_rough_legged", robots=["unitree_g1"])
    env.reset(seed=3)
    view, found = env.sim.view, env.sim.terms.rewards
    tilted = {"base_pos": [0.0, 0.0, 1.0], "base_quat": [np.cos(0.3), 0.0, np.sin(0.3), 0.0]}
    env.sim.set_state(None, **tilted, base_lin_vel=[0.5, 0.0, 0.0], base_ang_vel=[0.0, 0.0, 0.4])
    env.sim.set_command(np.tile(np.float32([0.2, 0.1, 0.3]), (env.num_envs, 1)))
    view.refresh()
    wanted = {
        "track_linear_velocity": np.exp(-(0.3**2 + 0.1**2) / 0.25),
        "track_angular_velocity": np.exp(-(0.1**2) / 0.5),
        "track_lin_vel_xy_yaw_frame_exp": np.exp(-((0.2 - 0.5 * np.cos(0.6)) ** 2 + 0.1**2) / 0.25),
        "track_ang_vel_z_world_exp": np.exp(-((0.3 - 0.4 * np.cos(0.6)) ** 2) / 0.25),
        "body_ang_vel": (0.4 * np.sin(0.6)) ** 2,
        "pose": 1.0,
    }
    env.sim.set_state(None, joint_pos=env.state.default_joint_pos, joint_vel=np.zeros_like(env.state.joint_pos))
    view.refresh()
    for name, value in wanted.items():
        np.testing.assert_allclose(found[name](view), value, rtol=1e-4, err_msg=name)
    # a body of one stiff piece: inertia times angular velocity
    still = found["angular_momentum"](view)
    env.sim.set_state(None, base_ang_vel=[0.0, 0.0, 0.8])
    view.refresh()
    np.testing.assert_allclose(found["angular_momentum"](view), 4.0 * still, rtol=1e-4)


def test_terms_of_the_table_of_costs_are_the_same_in_both_languages():
    rust = [terms_cost.in_rust(name) for name in terms_cost.WEIGHTS]
    env = terms_cost.make(8, rust, [terms_cost.in_python(name) for name in terms_cost.WEIGHTS])
    env.reset(seed=3)
    drive(env, 60)
    for name in terms_cost.WEIGHTS:
        one, other = (env.sim.view.episode_reward(term) for term in (name, f"own_{name}"))
        assert np.abs(one).max() > 1e-4, name
        np.testing.assert_allclose(other, one, rtol=1e-3, atol=1e-6, err_msg=name)


def test_terms_may_compute_with_torch():
    def declared(lib):
        height = (lambda env: torch.tensor(env.base_height)) if lib is torch else (lambda env: env.base_height)
        return [
            terms.observation(size=1, name="high")(lambda env: 2.0 * height(env)),
            terms.reward(weight=1.0, name="cost")(lambda env: lib.square(height(env))),
            terms.termination(name="low")(lambda env: height(env) < 0.2),
        ]

    assert same(*(drive(make(declared(lib)), 40) for lib in (np, torch)))


def test_a_term_may_end_episodes_as_out_of_time():
    @terms.termination(time_out=True)
    def far(env):
        return (env.episode_length >= 4) & (np.arange(env.num_envs) < 3)

    @terms.termination()
    def fallen(env):
        return (env.episode_length >= 4) & (np.arange(env.num_envs) == 2)

    env = make([far, fallen], overrides=["sim.episode_length_s=20.0", "terminations={}"])
    env.reset(seed=3)
    actions = np.zeros((env.num_envs, env.sim.num_actions), dtype=np.float32)
    for step in range(4):
        _, _, terminated, truncated, infos = env.step(actions)
        assert (terminated | truncated).any() == (step == 3)
    np.testing.assert_array_equal(np.flatnonzero(truncated), [0, 1])
    np.testing.assert_array_equal(np.flatnonzero(terminated), [2])
    np.testing.assert_array_equal(np.flatnonzero(infos["_final_obs"]), [0, 1, 2])
    np.testing.assert_array_equal(env.sim.episode_length[:4], [0, 0, 0, 4])
    curves = env.sim.log()
    assert curves["Episode_Termination/unitree_go2/far"] == 3.0
    assert curves["Metrics/unitree_go2/fall_rate"] == pytest.approx(1 / 3)


def test_the_native_learner_s_loop_in_python_is_the_one_in_rust(cli, tmp_path):
    (tmp_path / "speed.py").write_text(
        "from polypod import terms\n@terms.metric()\ndef speed(env):\n    return env.base_lin_vel[:, 0]\n"
    )
    line = (*LINE, "--learner", "native", "--max-iterations", "2", "--set", "train.run.clip_actions=0.5")
    assert cli(*line, "--log-dir", "plain").returncode == 0
    done = cli(*line, "--log-dir", "terms", "--terms", "speed.py")
    assert done.returncode == 0, done.stderr
    one, other = (run_dir.load_checkpoint(checkpoint(tmp_path / name)) for name in ("plain", "terms"))
    for key, value in one["actor_state_dict"].items():
        assert torch.equal(value, other["actor_state_dict"][key]), key


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (
            "@terms.observation(size=2)\ndef a(env):\n    return env.base_height",
            r"observations\['a'\] gives shape \(8,\)",
        ),
        (
            "@terms.observation(size=1)\ndef a(env):\n    return env.base_height * np.nan",
            r"observations\['a'\] gives nan",
        ),
        (
            "@terms.observation(size=1)\ndef a(env):\n    return env.base_hight",
            "line 5: the term 'a' failed: Attribute",
        ),
        ("@terms.observation(size=0)\ndef a(env):\n    pass", r"observation 'a': size = 0 must be a whole number"),
        (
            "@terms.observation(size=1, mirror='x')\ndef a(env):\n    pass",
            "observation 'a': mirror = 'x' is not one of",
        ),
        ("@terms.command(size=1)\ndef a(env, ids):\n    return [1.0]", r"commands\['a'\] gives shape \(1, 1\)"),
        ("@terms.event(mode='interval')\ndef a(env, ids):\n    pass", "event 'a': interval events alone have interval"),
        ("@terms.event(mode='often')\ndef a(env, ids):\n    pass", "event 'a': mode = 'often' is not one of startup"),
        ("@terms.event(mode='reset')\ndef a(env, ids):\n    1 / 0", "line 5: the term 'a' failed: ZeroDivisionError"),
        ("@terms.metric(robots=['sopt'])\ndef a(env):\n    pass", r"metrics\['a'\].robots: there is no 'sopt'"),
        ("@terms.observation(size=1)\ndef a(env):\n    env.base_pos[:] = 0.0", "read-only"),
        ("terms.memory('a b')", "memory 'a b': write a name of letters"),
    ],
)
def test_a_term_that_is_wrong_is_named_with_its_file(body, said, tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(f"import numpy as np\nfrom polypod import terms\n{body}\n")
    with pytest.raises(polypod.ConfigError, match=said) as caught:
        make(str(path))
    assert str(path) in str(caught.value)


def test_a_simulation_without_its_terms_does_not_step_on_zeros():
    overrides = [*SHORT, height.override()]
    env = polypod.make("velocity_flat", 2, robots=["spot"], overrides=overrides)
    with pytest.raises(polypod.ConfigError, match=r"the terms height are computed by .*--terms FILE"):
        env.step(np.zeros(env.action_space.shape, dtype=np.float32))
