"""The flat task and its robots are those of the reference: figures of configs, and how they act."""

import json

import numpy as np
import pytest

import polypod
from common import SMALL_TERRAIN, size
from polypod.compat import tomllib

TERMS = {
    "base_lin_vel": (3, 0.1),
    "base_ang_vel": (3, 0.2),
    "projected_gravity": (3, 0.05),
    "velocity_commands": (3, 0.0),
    "joint_pos_rel": (12, 0.01),
    "joint_vel_rel": (12, 1.5),
    "last_action": (12, 0.0),
}
ANYMALS = ["anymal_d", "anymal_c", "anymal_b"]
SMALL = ["unitree_a1", "unitree_go1", "unitree_go2"]


def config(task="velocity_flat", overrides=()):
    env = polypod.make(task, num_envs=8, seed=1, overrides=overrides)
    found = tomllib.loads(env.sim.resolved_config())
    env.close()
    return found


@pytest.fixture(scope="module")
def flat():
    return config()


@pytest.fixture(scope="module")
def reference():
    return config("reference_flat")


def test_observation_terms(make, flat):
    policy = flat["task"]["observations"]["policy"]
    assert {entry["term"]: entry.get("noise", 0.0) for entry in policy} == {name: n for name, (_, n) in TERMS.items()}
    env = make(robots=None, autoreset="disabled", overrides=["observations.enable_noise=false"])
    assert env.observation_layout == [(name, size) for name, (size, _) in TERMS.items()]
    env.reset(seed=2)
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    seen = env.step(still)[0]
    # gravity in base axes: the third row of the rotation that the quaternion stands for, turned
    # round
    w, x, y, z = env.state.base_quat.T
    down = -np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    np.testing.assert_allclose(seen[:, 6:9], down, atol=1e-6)
    np.testing.assert_array_equal(seen[:, 9:12], env.sim.command)
    np.testing.assert_array_equal(seen[:, 36:48], still)


def test_noise_is_uniform_and_as_wide_as_said(make):
    """A reset draws noise last: with and without it the same seed gives the same state."""
    num_envs = size(4000, 40_000)
    with_noise = make(robots=None, num_envs=num_envs).reset(seed=4)[0]
    without = make(robots=None, num_envs=num_envs, overrides=["observations.enable_noise=false"]).reset(seed=4)[0]
    noise = with_noise.astype(np.float64) - without
    column = 0
    for columns, width in TERMS.values():
        block = noise[:, column : column + columns]
        column += columns
        if width == 0.0:
            assert not block.any()
            continue
        assert np.abs(block).max() <= width * (1 + 1e-3)
        assert np.abs(block).max() > 0.99 * width
        # 4 deviations of the estimates: of the mean, and of the variance of a uniform number
        assert np.abs(block.mean(axis=0)).max() < 4 * width / np.sqrt(3 * len(block))
        variance = width**2 / 3
        assert np.abs(block.var(axis=0) / variance - 1).max() < 4 * np.sqrt(0.8 / len(block))
    drawn = noise[:, noise.any(axis=0)]
    correlation = np.corrcoef(drawn.T) - np.eye(drawn.shape[1])
    assert np.abs(correlation).max() < 5 / np.sqrt(len(drawn))


def test_the_description_is_off_in_the_reference(flat, reference):
    for found in (flat, reference):
        assert "morphology" not in [entry["term"] for entry in found["task"]["observations"]["policy"]]
    varied = config("velocity_flat_variation")
    assert varied["task"]["observations"]["policy"][-1]["term"] == "morphology"
    assert varied["task"]["events"]["body_variation"]["enabled"]
    assert not flat["task"]["events"]["body_variation"]["enabled"]


def test_action_scales(flat, reference):
    scales = dict.fromkeys(ANYMALS, 0.5) | dict.fromkeys(SMALL, 0.25) | {"unitree_b2": 0.3, "spot": 0.2}
    assert {name: robot["action_scale"] for name, robot in flat["robots"].items()} == scales
    scales["unitree_b2"] = 0.5
    assert {name: robot["action_scale"] for name, robot in reference["robots"].items()} == scales


def test_times(flat):
    sim = flat["task"]["sim"]
    assert (sim["dt"], sim["decimation"], sim["episode_length_s"], sim["env_spacing"]) == (0.005, 4, 20.0, 4.0)
    env = polypod.make("velocity_flat", num_envs=8)
    assert env.max_episode_length == 1000
    assert env.step_dt == pytest.approx(0.02)


def motors(actuators):
    keys = ("stiffness", "damping", "effort_limit", "saturation_effort", "velocity_limit")
    return {group: tuple(motor.get(key) for key in keys) for group, motor in actuators.items()}


def test_actuators(flat, reference):
    anymal, go1 = (80.0, 2.0, 80.0, 120.0, 7.5), (25.0, 0.5, 23.7, 23.7, 30.0)
    expected = {name: {"legs": anymal} for name in ANYMALS} | {
        "unitree_a1": {"legs": (25.0, 0.5, 33.5, 33.5, 21.0)},
        "unitree_go1": {"hips": go1, "knees": (25.0, 0.5, 35.55, 35.55, 30.0)},
        "unitree_go2": {"legs": (25.0, 0.5, 23.5, 23.5, 30.0)},
        "unitree_b2": {"legs": (250.0, 8.0, 200.0, 200.0, 14.0)},
        # the reference limits no speed of Spot's
        "spot": {"hips": (60.0, 1.5, 45.0, None, 1000.0), "knees": (60.0, 1.5, None, None, 1000.0)},
    }
    assert {name: motors(robot["actuators"]) for name, robot in flat["robots"].items()} == expected
    expected |= {name: {"legs": (40.0, 5.0, 80.0, 120.0, 7.5)} for name in ANYMALS}
    expected |= {"unitree_go1": {"hips": go1, "knees": go1}, "unitree_b2": {"legs": (160.0, 5.0, 200.0, 200.0, 14.0)}}
    assert {name: motors(robot["actuators"]) for name, robot in reference["robots"].items()} == expected
    spot = flat["robots"]["spot"]["actuators"]
    assert spot["hips"]["delay"] == spot["knees"]["delay"] == [0, 4]
    efforts = np.array(spot["knees"]["effort_table"])
    # the table's ends and peak as the reference has them
    assert efforts.shape == (101, 2)
    assert efforts[:, 1].max() == pytest.approx(113.236, abs=1e-3)
    np.testing.assert_allclose(efforts[[0, -1]], [[-2.7929, 37.165], [-0.2471, 30.6025]], atol=1e-3)


def test_a_fallen_robot_terminates(make):
    env = make(autoreset="disabled", robots=["unitree_a1", "unitree_go2"])
    env.reset(seed=2)
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    for _ in range(20):
        assert not env.step(still)[2].any()
    # legs folded or stretched as far as they go
    random = np.random.default_rng(1)
    fallen = np.zeros(env.num_envs, dtype=np.bool_)
    for _ in range(300):
        wild = (20 * random.choice([-1, 1], env.action_space.shape)).astype(np.float32)
        terminated = env.step(wild)[2]
        if terminated.any():
            fallen |= terminated
            env.reset(options={"reset_mask": terminated})
    assert fallen.mean() > 0.5
    log = env.sim.log()
    ends = sum(count for name, count in log.items() if name.endswith("/base_contact"))
    assert ends >= fallen.sum()
    assert not any(c for n, c in log.items() if n.endswith("/illegal_state"))


def test_commands(make, flat):
    drawn = flat["task"]["commands"]["base_velocity"]
    assert drawn["lin_vel_x"] == drawn["lin_vel_y"] == drawn["ang_vel_z"] == [-1.0, 1.0]
    assert (drawn["rel_heading_envs"], drawn["heading_control_stiffness"]) == (1.0, 0.5)
    assert drawn["heading_command"]
    assert drawn["heading"] == pytest.approx([-np.pi, np.pi])
    env = make(robots=None, num_envs=size(8000, 80_000))
    observations, _ = env.reset(seed=4)
    command = env.sim.command
    np.testing.assert_array_equal(observations[:, 9:12], command)
    standing = ~command.any(axis=1)
    share = 0.02
    assert abs(standing.mean() - share) < 4 * np.sqrt(share * (1 - share) / env.num_envs)
    moving = command[~standing]
    assert np.abs(moving).max() <= 1.0
    np.testing.assert_allclose(moving[:, :2].mean(axis=0), 0.0, atol=4 / np.sqrt(3 * len(moving)))
    np.testing.assert_allclose(moving[:, :2].var(axis=0), 1 / 3, rtol=4 * np.sqrt(0.8 / len(moving)))
    # half of a uniform heading error, clipped at 1: beyond 2 rad of a half turn
    clipped = np.mean(np.abs(moving[:, 2]) == 1.0)
    expected = 1 - 2 / np.pi
    assert abs(clipped - expected) < 4 * np.sqrt(expected * (1 - expected) / len(moving))


def test_commands_are_drawn_every_ten_seconds(make, flat):
    assert flat["task"]["commands"]["base_velocity"]["resampling_time_s"] == 10.0
    quiet = ["commands.base_velocity.rel_standing_envs=0.0", "events.push_robot.enabled=false"]
    env = make(num_envs=8, robots=["unitree_go2"], overrides=quiet)
    env.reset(seed=2)
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    first = env.sim.command[:, :2].copy()
    for _ in range(500):
        _, _, terminated, truncated, _ = env.step(still)
        assert not (terminated | truncated).any()
        np.testing.assert_array_equal(env.sim.command[:, :2], first)
    env.step(still)
    assert (env.sim.command[:, :2] != first).all()


def test_the_references_spawn_heights(reference):
    env = polypod.make("reference_flat", num_envs=8)
    height = dict.fromkeys(ANYMALS, 0.6) | {"unitree_a1": 0.42, "unitree_go1": 0.4, "unitree_go2": 0.4}
    for name, robot in json.loads(env.sim.robot_info()).items():
        margin = reference["robots"][name]["reset"]["spawn_margin"]
        if name in height:
            assert robot["base_height"] + margin == pytest.approx(height[name], abs=1e-4)
        else:
            # the reference's height would put its feet into the ground
            assert margin == 0.0
            assert robot["base_height"] > {"unitree_b2": 0.55, "spot": 0.5}[name]


def test_joint_resets(flat):
    for name, robot in flat["robots"].items():
        reset = robot["reset"]
        narrow = name in SMALL
        expected = {"mode": "scale", "range": [1.0, 1.0] if narrow else [0.8, 1.2]}
        if name == "spot":
            expected = {"mode": "offset", "range": [-0.05, 0.05]}
        assert reset["joint_position"] == expected, name
        assert reset["joint_velocity"] == {"range": [0.0, 0.0]}
        assert reset["base_velocity"] == {"range": [0.0, 0.0] if narrow else [-0.5, 0.5]}
        assert reset["soft_limit_factor"] == (1.0 if name == "spot" else 0.9 if narrow else 0.95)
        added = [-1.0, 3.0] if narrow else [-5.0, 5.0]
        assert robot["randomization"]["base_mass_offset"] == added


def test_surfaces(flat, reference):
    ground = flat["task"]["scene"]["ground"]
    assert (ground["static_friction"], ground["dynamic_friction"], ground["restitution"]) == (1.0, 1.0, 0.0)
    assert ground["friction_combine"] == "multiply"
    material = reference["task"]["robot_material"]
    assert (material["static_friction"], material["dynamic_friction"], material["restitution"]) == (0.8, 0.6, 0.0)
    assert not reference["task"]["events"]["physics_material"]["enabled"]
    assert reference["task"]["events"]["add_base_mass"] == {
        "mode": "startup",
        "enabled": True,
        "recompute_inertia": False,
    }


def test_rough_rewards():
    """Changes on rough ground, and nothing else."""
    flat, rough = config()["task"]["rewards"], config("velocity_rough", SMALL_TERRAIN)["task"]["rewards"]
    changed = {
        (group, term, key): (rough[group][term][key], value)
        for group, terms in flat.items()
        for term, values in terms.items()
        for key, value in values.items()
        if rough[group][term][key] != value
    }
    assert {key: new for key, (new, _) in changed.items()} == {
        ("anymal", "flat_orientation_l2", "weight"): 0.0,
        ("anymal", "dof_torques_l2", "weight"): -1.0e-5,
        ("anymal", "feet_air_time", "weight"): 0.125,
        ("unitree", "flat_orientation_l2", "weight"): 0.0,
        ("unitree", "feet_air_time", "weight"): 0.01,
        ("unitree_large", "flat_orientation_l2", "weight"): 0.0,
        ("unitree_large", "dof_torques_l2", "weight"): -1.0e-5,
    }
    assert {group: set(terms) for group, terms in flat.items()} == {group: set(terms) for group, terms in rough.items()}
