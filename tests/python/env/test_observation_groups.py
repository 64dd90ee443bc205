"""A task may observe more than the policy sees, and remember.

Groups of terms, `history_length`, privileged terms.
"""

import json

import numpy as np
import pytest

import polypod
from common import ROBOTS
from polypod import _core

CRITIC = (
    'observations.critic=[{term="base_lin_vel"}, {term="joint_pos_rel"}, {term="contact_friction"}, '
    '{term="base_mass_offset"}, {term="base_com_offset"}, {term="feet_contact_force"}, {term="feet_air_time"}, '
    '{term="feet_height"}]'
)
SIZES = {"base_lin_vel": 3, "joint_pos_rel": 12, "contact_friction": 2, "base_mass_offset": 1, "base_com_offset": 3}
SIZES |= {"feet_contact_force": 4, "feet_air_time": 4, "feet_height": 4}


def columns(env, group, name):
    """Columns of a term in a group."""
    start = 0
    for term in json.loads(env.sim.observation_terms(group)):
        if term["term"] == name:
            return slice(start, start + term["size"])
        start += term["size"]
    raise KeyError(name)


def test_another_group_leaves_the_policys_observation_alone(make, actions):
    """Its numbers, its noise, its rewards: bit for bit."""
    env, twin = make(overrides=[CRITIC]), make()
    assert env.sim.observation_groups == {"policy": (0, 48), "critic": (48, 48 + sum(SIZES.values()))}
    assert env.sim.num_obs == env.single_observation_space.shape[0] == twin.sim.num_obs == 48
    assert env.observation_layout == twin.observation_layout
    np.testing.assert_array_equal(env.reset(seed=3)[0], twin.reset(seed=3)[0])
    for step in range(60):
        mine, theirs = env.step(actions(env, step)), twin.step(actions(env, step))
        for array, other in zip(mine[:4], theirs[:4], strict=True):
            np.testing.assert_array_equal(array, other)


def test_what_the_groups_say_of_themselves(make):
    env = make(overrides=[CRITIC])
    terms = json.loads(env.sim.observation_terms("critic"))
    assert {term["term"]: term["size"] for term in terms} == SIZES
    assert env.sim.observation_of("critic").shape == (16, sum(SIZES.values()))
    assert env.sim.observation_of("policy").shape == env.sim.observation.shape == (16, 48)
    for method in (env.sim.observation_of, env.sim.observation_terms, env.sim.final_obs_of):
        with pytest.raises(polypod.UnknownNameError, match="no observation group `critc`"):
            method("critc")


def test_privileged_terms_are_what_the_state_says(make, actions):
    env = make(autoreset="disabled", overrides=[CRITIC, "events.physics_material.enabled=false"])
    env.reset(seed=1)
    for step in range(10):
        env.step(actions(env, step, scale=0.3))
    critic, state = env.sim.observation_of("critic"), env.state

    def term(name):
        return critic[:, columns(env, "critic", name)]

    np.testing.assert_array_equal(term("base_lin_vel"), state.base_lin_vel)
    np.testing.assert_allclose(term("joint_pos_rel"), state.joint_pos - state.default_joint_pos, atol=1e-6)
    np.testing.assert_array_equal(term("feet_air_time"), state.feet_air_time)
    np.testing.assert_allclose(term("feet_height"), state.feet_pos[:, 2::3], atol=1e-5)
    # the task's own friction, times the ground's 1, and masses of the bases drawn from -5 to 5 kg
    friction, mass = term("contact_friction"), term("base_mass_offset")
    np.testing.assert_allclose(friction, np.tile([0.8, 0.6], (16, 1)), atol=1e-6)
    assert 0.1 < np.abs(mass).max() <= 5.0
    forces = term("feet_contact_force")
    assert (forces >= 0.0).all()
    vertical = state.contact_forces[:, 2::3]
    stands = vertical > 1.0
    assert stands.any()
    # the largest of the last three physics steps is no less than that of the last one, up to
    # friction's share
    assert (forces[stands] >= 0.9 * vertical[stands]).all()


def test_privileged_terms_of_any_body(actions):
    """Columns are the batch's feet; those that a robot lacks are masked, and zero."""
    robots = ["unitree_h1", "spot", "phantomx"]
    env = polypod.make("velocity_flat_legged", 6, robots=robots, seed=1, autoreset="disabled", overrides=[CRITIC])
    env.reset(seed=1)
    for step in range(10):
        env.step(actions(env, step, scale=0.1))
    critic, state = env.sim.observation_of("critic"), env.state
    feet = {"unitree_h1": 2, "spot": 4, "phantomx": 6}
    for name, expected in (("feet_air_time", state.feet_air_time), ("feet_height", state.feet_pos[:, 2::3])):
        where = columns(env, "critic", name)
        assert where.stop - where.start == 8  # L, R and the six of a hexapod, which a quadruped shares
        np.testing.assert_allclose(critic[:, where], expected, atol=1e-5)
    where = columns(env, "critic", "feet_contact_force")
    assert (critic[:, where].max(axis=1) > 1.0).all()
    for robot, count in feet.items():
        rows = slice(*env.sim.env_ids(robot))
        mask = np.array(env.sim.observation_mask(robot, "critic"))[where]
        assert mask.sum() == count
        assert not critic[rows, where][:, ~mask].any()


@pytest.mark.parametrize(
    ("robot", "pairs"), [("unitree_h1", {6: 7}), ("spot", {0: 3, 2: 5}), ("phantomx", {0: 3, 1: 4, 2: 5})]
)
def test_feet_change_sides_in_the_mirror(robot, pairs):
    """Columns are LF, LM, LH, RF, RM, RH, L, R; absent ones stay where they are."""
    robots = ["unitree_h1", "spot", "phantomx"]
    env = polypod.make("velocity_flat_legged", 3, robots=robots, seed=0, overrides=[CRITIC])
    where = columns(env, "critic", "feet_height")
    across = pairs | {right: left for left, right in pairs.items()}
    image = env.sim.observation_mirror(robot, "critic")[where]
    assert image == [(where.start + across.get(foot, foot), 1.0) for foot in range(8)]


def test_the_policys_terms_are_noisy_and_the_critics_are_not(make, actions):
    env = make(autoreset="disabled", overrides=[CRITIC])
    env.reset(seed=1)
    env.step(actions(env, 0))
    noisy = env.sim.observation[:, columns(env, "policy", "base_lin_vel")]
    difference = np.abs(noisy - env.state.base_lin_vel)
    assert 0.02 < difference.max() <= 0.1 + 1e-6


HISTORY = ("observations.policy.joint_pos_rel.history_length=3", "observations.enable_noise=false")


def test_a_term_remembers(make, actions):
    """The oldest numbers first; an episode begins with its first numbers repeated."""
    short = "sim.episode_length_s=0.4"
    env = make(overrides=[*HISTORY, short])
    twin = make(overrides=["observations.enable_noise=false", short])
    mine, own = columns(env, "policy", "joint_pos_rel"), columns(twin, "policy", "joint_pos_rel")
    assert env.sim.num_obs == 48 + 2 * 12
    assert dict(env.observation_layout)["joint_pos_rel"] == 36
    past = [twin.reset(seed=2)[0][:, own]] * 3
    np.testing.assert_array_equal(env.reset(seed=2)[0][:, mine], np.concatenate(past, axis=1))
    ends = 0
    for step in range(50):
        observations, _, _, _, infos = env.step(actions(env, step))
        theirs, _, terminated, truncated, other = twin.step(actions(env, step))
        done = terminated | truncated
        newest = theirs[:, own]
        for row in np.flatnonzero(done):
            ends += 1
            last = [past[1][row], past[2][row], other["final_obs"][row][own]]
            np.testing.assert_array_equal(infos["final_obs"][row][mine], np.concatenate(last))
        past = [np.where(done[:, None], newest, old) for old in (past[1], past[2])] + [newest]
        np.testing.assert_array_equal(observations[:, mine], np.concatenate(past, axis=1))
    assert ends >= 32


def test_noise_is_remembered_too(make, actions):
    env = make(overrides=HISTORY[:1])
    env.reset(seed=0)
    where = columns(env, "policy", "joint_pos_rel")
    before = env.step(actions(env, 0))[0][:, where]
    after = env.step(actions(env, 1))[0][:, where]
    np.testing.assert_array_equal(after[:, :24], before[:, 12:])


@pytest.mark.parametrize("autoreset", ["next_step", "disabled"])
def test_memory_is_cleared_with_every_kind_of_reset(make, actions, autoreset):
    env = make(autoreset=autoreset, overrides=[*HISTORY, "sim.episode_length_s=0.2"])
    env.reset(seed=2)
    where = columns(env, "policy", "joint_pos_rel")
    for step in range(10):
        terminated, truncated = env.step(actions(env, step))[2:4]
    assert (terminated | truncated).all()
    observations = (
        env.step(actions(env, 0))[0]
        if autoreset == "next_step"
        else env.reset(options={"reset_mask": terminated | truncated})[0]
    )
    oldest, middle, newest = np.split(observations[:, where], 3, axis=1)
    np.testing.assert_array_equal(oldest, newest)
    np.testing.assert_array_equal(middle, newest)
    assert np.abs(newest).max() > 0.0


def test_a_snapshot_holds_what_is_remembered(make, actions):
    env = make(overrides=[*HISTORY, CRITIC])
    env.reset(seed=0)
    env.step(actions(env, 0))
    data = env.sim.snapshot()
    expected = [(env.step(actions(env, step))[0], env.sim.observation_of("critic").copy()) for step in range(1, 4)]
    env.step(actions(env, 9))
    env.sim.restore(data)
    for step, (policy, critic) in enumerate(expected, start=1):
        np.testing.assert_array_equal(env.step(actions(env, step))[0], policy)
        np.testing.assert_array_equal(env.sim.observation_of("critic"), critic)


def test_mirrors_of_groups_and_memories(make):
    env = make(overrides=[*HISTORY, CRITIC])
    for robot in env.robots:
        for group in ("policy", "critic"):
            mirror = env.sim.observation_mirror(robot, group)
            assert sorted(index for index, _ in mirror) == list(range(len(mirror)))
            # twice mirrored is the same
            assert [mirror[index][0] for index, _ in mirror] == list(range(len(mirror)))
            assert all(mirror[index][1] == sign for index, sign in mirror)
        one = make().sim.observation_mirror(robot)
        where, own = columns(env, "policy", "joint_pos_rel"), slice(12, 24)
        remembered = env.sim.observation_mirror(robot)[where]
        for step in range(3):
            part = remembered[12 * step : 12 * (step + 1)]
            assert [(index - where.start - 12 * step, sign) for index, sign in part] == [
                (index - own.start, sign) for index, sign in one[own]
            ]
    force = columns(env, "critic", "feet_contact_force")
    order = [index - force.start for index, _ in env.sim.observation_mirror("spot", "critic")[force]]
    assert order == [2, 3, 0, 1]  # LF, LH, RF, RH


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("observations.policy.joint_pos_rel.history_length=0", r"observations\.policy\[4\]\.history_length"),
        ("observations.policy.joint_pos_rel.history_length=101", "choose from 1 to 100"),
        ("observations.policy.joint_pos_rel.history_lenght=3", "history_length"),
        ("observations.critic=[]", "the group has no terms"),
        ('observations.critic=[{term="base_lin_vell"}]', "did you mean `base_lin_vel`"),
        ("observations.critic=3", "observations.critic"),
        ("observations.enable_noises=true", "enable_noise"),
        ("observations.polcy=[]", "policy"),
    ],
)
def test_mistakes_are_named(override, said):
    with pytest.raises(polypod.ConfigError, match=said):
        polypod.make("velocity_flat", 8, overrides=[override])


def test_a_file_of_ones_own(tmp_path):
    (tmp_path / "mine.toml").write_text(
        'extends = "velocity_flat"\nname = "Mine-v0"\n[[observations.critic]]\nterm = "base_lin_vel"\n'
        "[observations.policy.joint_vel_rel]\nhistory_length = 2\n"
    )
    env = polypod.make(str(tmp_path / "mine.toml"), robots=ROBOTS)
    assert env.sim.observation_groups == {"policy": (0, 60), "critic": (60, 63)}


def test_joints_are_described_to_the_critic_alone():
    """Terms that the policy's observation lacks are still measured for another group."""
    group = ["observations.critic=[{term='joint_descriptors'}]"]
    robots = ["unitree_go2", "spot"]
    sims = [
        _core.VecSim(task, 2, robots=robots, seed=0, threads=1, overrides=changes)
        for task, changes in (("velocity_flat_play", group), ("velocity_flat_joints_play", []))
    ]
    for sim in sims:
        sim.reset(0)
    alone, beside = sims
    described = alone.observation_of("critic")
    assert (described != 0.0).any()
    np.testing.assert_array_equal(described, beside.observation[:, -described.shape[1] :])


def test_a_teacher_of_quadrupeds_reads_their_bodies_beside_other_robots(tmp_path):
    """Zeros stand for the others; a policy with such zeros would tell no bodies apart."""
    lines = ['extends = "velocity_flat_legged"', 'name = "Taught-v0"', "observations.teacher = [{term='morphology'}]"]
    (tmp_path / "taught.toml").write_text("\n".join(lines))
    sim = _core.VecSim(str(tmp_path / "taught.toml"), 2, robots=["unitree_a1", "unitree_h1"], threads=1)
    sim.reset(3)
    body, none = sim.observation_of("teacher")
    alone = _core.VecSim(str(tmp_path / "taught.toml"), 1, robots=["unitree_a1"], threads=1)
    alone.reset(3)
    np.testing.assert_array_equal(body, alone.observation_of("teacher")[0])
    assert np.abs(body).max() > 0.1
    np.testing.assert_array_equal(none, 0.0)
    (tmp_path / "taught.toml").write_text("\n".join([*lines[:2], "observations.policy = [{term='morphology'}]"]))
    with pytest.raises(_core.ConfigError, match="quadrupeds of twelve joints; unitree_h1 is none"):
        _core.VecSim(str(tmp_path / "taught.toml"), 2, robots=["unitree_a1", "unitree_h1"], threads=1)
