"""A robot's own limits cut a task's commands: draws, headings, evaluations, sim2sim, exports."""

import json

import numpy as np
import pytest

import polypod
from common import size
from polypod import _core
from polypod.evaluation import rollout
from polypod.sim2sim import commands, run

KEYS = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
LIMITS = {
    "unitree_h1": [(0.0, 1.0), (0.0, 0.0), (-1.0, 1.0)],
    "phantomx": [(-0.3, 0.3), (-0.15, 0.15), (-0.8, 0.8)],
    "spot": [(-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0)],
}


def sim(num_envs=96, overrides=(), robots=tuple(LIMITS)):
    return _core.VecSim("velocity_flat_legged", num_envs, robots=list(robots), seed=5, threads=1, overrides=overrides)


def test_ranges_are_the_tasks_within_the_robots():
    found = sim().command_ranges()
    assert {robot: [tuple(ranges[key]) for key in KEYS] for robot, ranges in found.items()} == LIMITS
    narrow = sim(overrides=["commands.base_velocity.lin_vel_x=[0.1,0.2]"]).command_ranges()
    assert [narrow[robot]["lin_vel_x"] for robot in LIMITS] == [[0.1, 0.2]] * 3


@pytest.mark.parametrize("heading", ["true", "false"])
def test_what_is_drawn_lies_within_them(heading):
    changes = [
        f"commands.base_velocity.heading_command={heading}",
        "commands.base_velocity.resampling_time_s=0.06",
        "commands.base_velocity.rel_standing_envs=0.0",
    ]
    batch = sim(overrides=changes)
    batch.reset(seed=5)
    drawn = []
    for _ in range(40):
        batch.step(np.zeros((batch.num_envs, batch.num_actions), dtype=np.float32))
        drawn.append(batch.command.copy())
    drawn = np.stack(drawn)
    for robot, limits in LIMITS.items():
        own = drawn[:, slice(*batch.env_ids(robot))].reshape(-1, 3)
        for column, (low, high) in zip(own.T, np.float32(limits), strict=True):
            assert low <= column.min() <= low + 0.05 * (high - low) + 1e-6
            assert high - 0.05 * (high - low) - 1e-6 <= column.max() <= high


def test_a_robot_without_limits_is_told_what_it_always_was():
    """Company of robots with limits changes none of its draws."""
    alone, among = sim(8, robots=["spot"]), sim(24)
    for batch in (alone, among):
        batch.reset(seed=5)
    np.testing.assert_array_equal(alone.command, among.command[slice(*among.env_ids("spot"))])


def test_limits_may_be_overridden():
    changes = ["robot_overrides.phantomx.commands.base_velocity.lin_vel_x=[-0.1,0.6]"]
    assert sim(overrides=changes).command_ranges()["phantomx"]["lin_vel_x"] == [-0.1, 0.6]


def test_ranges_that_have_nothing_in_common_are_refused():
    with pytest.raises(
        _core.ConfigError,
        match=r"unitree_h1: commands\.base_velocity\.lin_vel_y.*\[0\.5, 1\.0\].*\[0\.0, 0\.0\].*overrides\.unitree_h1",
    ):
        sim(overrides=["commands.base_velocity.lin_vel_y=[0.5,1.0]"])
    with pytest.raises(_core.ConfigError, match="lin_vel_x"):
        sim(overrides=["robot_overrides.spot.commands.base_velocity.lin_vel_x=[1.0,-1.0]"])


def test_a_grid_spans_each_robots_own_ranges():
    grid = rollout._commands(sim(), (3, 3, 3))
    for robot, limits in LIMITS.items():
        corners = [(column.min(), column.max()) for column in grid[robot].T]
        np.testing.assert_allclose(corners, limits, rtol=1e-6)


def test_mujoco_is_given_commands_within_them():
    batch = sim()
    config = {
        "heading": [-3.0, 3.0],
        "heading_command": True,
        "heading_control_stiffness": 5.0,
        "rel_heading_envs": 0.5,
        "rel_standing_envs": 0.0,
        "rel_turning_envs": 0.0,
        "rel_sideways_envs": 0.0,
        "resampling_time_s": 0.5,
    }
    drawn = commands.Commands.draw(config, run._ranges(batch), 500, 0.02, seed=0)
    told = np.stack([drawn.at(step, np.zeros(batch.num_envs)) for step in range(0, 500, 25)])
    for robot, limits in LIMITS.items():
        own = told[:, slice(*batch.env_ids(robot))].reshape(-1, 3)
        for column, (low, high) in zip(own.T, np.float32(limits), strict=True):
            assert low - 1e-6 <= column.min()
            assert column.max() <= high + 1e-6
            assert column.max() - column.min() >= 0.8 * (high - low)


def test_an_export_says_them(exported_policy):
    info = json.loads((exported_policy[0] / "policy.json").read_text())["robot_info"]
    assert info["spot"]["command_ranges"] == {key: [-1.0, 1.0] for key in KEYS}


def test_polypod_make_takes_them_too():
    env = polypod.make("velocity_flat_humanoid", 5, seed=0)
    assert env.sim.command_ranges()["unitree_g1"]["lin_vel_y"] == [-0.5, 0.5]


def test_shares_of_envs_turn_on_the_spot_and_step_aside():
    shares = {"standing": 0.1, "turning": 0.3, "sideways": 0.2}
    overrides = [f"commands.base_velocity.rel_{kind}_envs={share}" for kind, share in shares.items()]
    batch = _core.VecSim("velocity_flat", size(4000, 40_000), seed=3, overrides=overrides)
    batch.reset(3)
    ahead, aside, turn = np.abs(batch.command).T > 0.0
    found = {
        "standing": ~(ahead | aside | turn),
        "turning": turn & ~ahead & ~aside,
        "sideways": aside & ~ahead & ~turn,
    }
    # standing envs are drawn apart from the others
    moving = 1.0 - shares["standing"]
    wanted = {"standing": 0.1, "turning": 0.3 * moving, "sideways": 0.2 * moving}
    for kind, share in wanted.items():
        slack = 4.0 * np.sqrt(share * (1.0 - share) / batch.num_envs)
        assert found[kind].mean() == pytest.approx(share, abs=slack), kind
    # a pure turn is no heading to be reached: the yaw rate stays what it is
    turning, before = found["turning"], batch.command.copy()
    for _ in range(20):
        batch.step(np.zeros((batch.num_envs, batch.num_actions), dtype=np.float32))
    same = turning & (batch.command[:, :2] == 0.0).all(axis=1)
    np.testing.assert_array_equal(batch.command[same], before[same])
    assert same.sum() > 0.9 * turning.sum()


def test_mujoco_is_given_the_same_shares():
    count = 4000
    ranges = {key: np.tile([[-1.0], [1.0]], count) for key in KEYS}
    config = {
        "heading": [-3.0, 3.0],
        "heading_command": True,
        "heading_control_stiffness": 0.5,
        "rel_heading_envs": 1.0,
        "rel_standing_envs": 0.0,
        "rel_turning_envs": 0.3,
        "rel_sideways_envs": 0.2,
        "resampling_time_s": 2.0,
    }
    told = commands.Commands.draw(config, ranges, 10, 0.02, seed=0).at(0, np.full(count, 0.5))
    ahead, aside, turn = np.abs(told).T > 0.0
    assert (turn & ~ahead & ~aside).mean() == pytest.approx(0.3, abs=0.03)
    assert (aside & ~ahead & ~turn).mean() == pytest.approx(0.2, abs=0.03)
