"""A limit that a joint lacks is no number: nothing starts, observes, acts or deploys at one."""

import functools
import json
import re

import numpy as np
import pytest

import polypod
from common import ROOT
from go2 import URDF, limits, without_actuator_limits, write_go2
from polypod.compat import tomllib

QUIET = {
    "observations.enable_noise": False,
    "events.push_robot.enabled": False,
    "events.physics_material.enabled": False,
    "events.add_base_mass.enabled": False,
    "events.base_com.enabled": False,
}


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Writes the robot `mine`: a Go2 with an edited URDF, and lines on top of its TOML."""
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path))
    return functools.partial(write_go2, tmp_path)


def make(task="velocity_flat", overrides=QUIET, **options):
    return polypod.make(task, 4, robots=["mine"], seed=1, overrides=overrides, **options)


def by_slot(env, key):
    """Numbers of the joints in the order of the action.

    The slots of a Go2 turn as its joints do.
    """
    info = json.loads(env.sim.robot_info())["mine"]
    assert set(info["slot_signs"]) == {1.0}
    return np.array(info[key])[info["joint_of_slot"]]


def without(joint, side):
    return limits(joint, lambda tag: re.sub(rf'\s{side}="[^"]*"', "", tag))


def with_far(joint, side):
    return limits(joint, lambda tag: re.sub(rf'{side}="[^"]*"', f'{side}="{"-" if side == "lower" else ""}1e6"', tag))


def without_efforts(urdf):
    return re.sub(r'effort="[^"]*"', 'effort="1e12"', urdf)


def continuous(urdf):
    for leg in ("FL", "FR", "RL", "RR"):
        urdf = urdf.replace(f'"{leg}_hip_joint" type="revolute"', f'"{leg}_hip_joint" type="continuous"')
        urdf = without(f"{leg}_hip_joint", "lower")(without(f"{leg}_hip_joint", "upper")(urdf))
    return urdf


EDITS = [
    pytest.param(without("FL_calf_joint", "upper"), id="no upper limit"),
    pytest.param(without("FL_thigh_joint", "lower"), id="no lower limit"),
    pytest.param(with_far("FL_calf_joint", "upper"), id="an upper limit of 1e6 rad"),
    pytest.param(with_far("FL_thigh_joint", "lower"), id="a lower limit of -1e6 rad"),
    pytest.param(continuous, id="no limits"),
]


@pytest.mark.parametrize("edit", EDITS)
def test_episodes_begin_in_the_default_pose(mine, edit):
    mine(edit)
    env = make()
    env.reset()
    np.testing.assert_allclose(env.state.joint_pos[0], by_slot(env, "default_pose"), atol=1e-6)
    zeros = np.zeros(env.action_space.shape, np.float32)
    assert not any(env.step(zeros)[2].any() for _ in range(20))


def test_the_limit_that_is_there_holds(mine):
    mine(without("FL_calf_joint", "upper"), "[reset]\njoint_position = { mode = 'offset', range = [-3.0, 0.0] }\n")
    env = make()
    env.reset()
    lower = json.loads(env.sim.robot_info())["mine"]["lower"]
    joints = env.sim.joint_map("mine")
    (knee,) = (column for column, (name, _) in enumerate(joints) if name == "FL_calf_joint")
    positions = env.state.joint_pos[:, knee]
    # two thirds of the draws are beyond the limit
    assert positions.min() == np.float32(lower[joints[knee][1]])
    assert positions.max() <= -1.5


@pytest.mark.parametrize("edit", EDITS)
@pytest.mark.parametrize("task", ["velocity_flat_joints", "velocity_flat_universal"])
def test_what_is_observed_is_of_the_order_of_one(mine, edit, task):
    for change in (edit, lambda urdf: without_efforts(edit(urdf))):
        mine(change, toml=without_actuator_limits())
        observation, _ = make(task).reset()
        assert np.abs(observation).max() <= 10.0


def test_the_action_space_ends_where_a_target_may_be(mine):
    mine(continuous)
    env = make()
    env.reset()
    np.testing.assert_allclose(env.single_action_space.high[:4], np.pi / 0.25, rtol=1e-6)
    np.testing.assert_allclose(env.single_action_space.low[:4], -np.pi / 0.25, rtol=1e-6)
    env.action_space.seed(0)
    assert np.isfinite(env.step(env.action_space.sample())[1]).all()


@pytest.mark.parametrize("edit", EDITS)
def test_samples_of_the_action_space_are_taken(mine, edit):
    # a scale at which the targets of an ordinary joint are beyond what a step takes
    mine(edit)
    env = make(overrides={**QUIET, "robot_overrides.mine.action_scale": 1e-6})
    env.reset()
    env.action_space.seed(0)
    assert np.isfinite(env.step(env.action_space.sample())[0]).all()


def test_what_deployers_read_says_that_there_is_no_limit(mine):
    mine(continuous)
    info = json.loads(make().sim.robot_info())["mine"]
    hips = ["hip" in name for name in info["joint_names"]]
    for key in ("lower", "upper"):
        assert [limit is None for limit in info[key]] == hips


def test_limits_of_the_urdf_are_the_default(mine):
    mine(toml=without_actuator_limits())
    env = make()
    env.reset()
    info = json.loads(env.sim.robot_info())["mine"]
    assert (by_slot(env, "effort_limit") > 0.0).all()
    kinds = {name.split("_")[1]: limit for name, limit in zip(info["joint_names"], info["effort_limit"], strict=True)}
    assert kinds == pytest.approx({"hip": 23.7, "thigh": 23.7, "calf": 45.43})
    assert np.allclose(polypod.Simulation(URDF, 1).effort_limit, info["effort_limit"])
    for _ in range(10):
        env.step(np.full(env.action_space.shape, 40.0, np.float32))
        efforts, speeds = np.abs(env.state.joint_effort), np.abs(env.state.joint_vel)
        assert (efforts <= by_slot(env, "effort_limit") * (1 + 1e-6)).all()
        # a contact may exceed it for a moment
        assert np.quantile(speeds, 0.9) <= 30.1 * 1.01


def test_limits_of_the_config_come_first(mine):
    toml = without_actuator_limits().replace("damping = 0.5 ", "effort_limit = 10.0\ndamping = 0.5 ")
    mine(toml=toml)
    assert json.loads(make().sim.robot_info())["mine"]["effort_limit"] == [10.0] * 12


def test_motors_without_limits_may_be_weak(mine):
    mine(without_efforts, toml=without_actuator_limits())
    change = {"events.randomize_motor_strength": {"enabled": True, "strength_range": [0.0, 0.0]}}
    env = make(overrides={**QUIET, **change})
    env.reset()
    for _ in range(5):
        observation, reward, *_ = env.step(np.ones(env.action_space.shape, np.float32))
        assert np.isfinite(observation).all()
        assert np.isfinite(reward).all()
    assert (env.state.joint_effort == 0.0).all()


@pytest.mark.parametrize("edit", EDITS)
def test_other_bodies_lack_the_same_limits(mine, edit):
    mine(edit)
    change = {"events.body_variation": {"enabled": True, "size": [0.8, 1.3]}}
    env = make("velocity_flat_universal", {**QUIET, **change})
    observation, _ = env.reset()
    assert np.abs(observation).max() <= 10.0


@pytest.mark.parametrize("edit", EDITS)
def test_soft_limits_are_not_exceeded_within_them(mine, edit):
    mine(edit, "[reset]\nsoft_limit_factor = 1.0\n")
    texts = [f"rewards.unitree.{term}.weight=0" for term in reward_terms()]
    env = make(overrides=[*texts, "rewards.unitree.joint_pos_limits={weight=-1.0}"])
    env.reset()
    assert (env.step(np.zeros(env.action_space.shape, np.float32))[1] == 0.0).all()


def reward_terms():
    task = tomllib.loads((ROOT / "configs/tasks/velocity_flat.toml").read_text())
    return task["rewards"]["unitree"]
