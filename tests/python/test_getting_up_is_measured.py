"""Evaluations say how many robots get up in time, and how long they stay up."""

import dataclasses
import math

import numpy as np
import pytest

from polypod.compat import tomllib
from polypod.evaluation import evaluate, rising
from polypod.evaluation.results import Evaluation
from polypod.training.report import Reporter
from polypod.vector_env import simulator


class Sim:
    """Two robots of one kind whose height is given."""

    num_envs, step_dt = 3, 0.5

    def __init__(self):
        """Lies down."""
        self.height = np.zeros((3, 1), dtype=np.float32)

    def env_ids(self, robot):
        """All rows."""
        assert robot == "one"
        return 0, 3

    def state(self, field):
        """Height, or an upright base."""
        return self.height if field == "base_height" else np.tile(np.float32([0.0, 0.0, -1.0]), (3, 1))


def record(heights, running=None):
    """Episodes of a robot that must be 1 m high; heights [steps, 3]."""
    sim = Sim()
    found = rising.Record(sim, {"one": rising.Goal(np.array([0.0, 0.0, 1.0]), 1.0)})
    for step, row in enumerate(heights):
        sim.height[:, 0] = row
        found.add(np.ones(3, dtype=np.bool_) if running is None else running[step])
    return found.episodes()


def test_a_robot_is_up_from_when_it_stays_so():
    heights = np.zeros((10, 3))
    heights[3:, 0] = 0.95  # up after 1.5 s, to the end
    heights[3:6, 1] = 0.95  # lies down again
    heights[9, 2] = 0.95  # too late to say
    found = record(heights)
    assert found["up"].tolist() == [1.5, math.inf, math.inf]
    assert found["held"].tolist() == [3.5, 1.5, 0.5]
    figures = rising.rising(**found)
    assert figures.rate == pytest.approx(1 / 3)
    assert figures.time_s == 1.5
    assert figures.held_s == pytest.approx(5.5 / 3)


def test_up_after_four_seconds_is_too_late():
    heights = np.zeros((12, 3))
    heights[8:, 0] = heights[9:, 1] = 1.0
    figures = rising.rising(**record(heights))
    assert figures.rate == pytest.approx(1 / 3)
    assert figures.time_s == pytest.approx(4.25)


def test_an_episode_that_fails_is_not_up():
    running = np.ones((10, 3), dtype=np.bool_)
    running[8:, 0] = False
    found = record(np.ones((10, 3)), running)
    assert found["up"].tolist() == [math.inf, 0.0, 0.0]
    assert found["held"].tolist() == [4.0, 5.0, 5.0]
    nobody = rising.rising(**record(np.zeros((4, 3))))
    assert nobody.rate == 0.0
    assert math.isnan(nobody.time_s)


@pytest.mark.parametrize(
    ("degrees", "height", "wanted"), [(19.0, 0.91, True), (21.0, 0.91, False), (19.0, 0.89, False)]
)
def test_up_is_near_the_direction_and_the_height_that_the_task_rewards(degrees, height, wanted):
    goal = rising.Goal(np.array([1.0, 0.0, 0.0]), 1.0)
    turn = math.radians(degrees)
    gravity = -np.array([[math.cos(turn), math.sin(turn), 0.0]])
    assert rising.is_up(goal, gravity, np.array([height])).tolist() == [wanted]


@pytest.mark.parametrize(("task", "up", "share"), [("getup_flat", [0, 0, 1], 1.0), ("hind_legs_flat", [1, 0, 0], 1.5)])
def test_goals_are_those_of_the_task_s_rewards(task, up, share):
    sim = simulator(None, task, 1, robots=["unitree_go1"], threads=1)
    goal = rising.goals(sim, tomllib.loads(sim.resolved_config()))["unitree_go1"]
    assert goal.up.tolist() == up
    assert goal.height == pytest.approx(share * 0.321768, rel=1e-3)


def test_an_evaluation_tells_it_and_its_file_keeps_it(capsys):
    def still(observation):
        return np.zeros((len(observation), 12), dtype=np.float32)

    # the default pose is up from the beginning
    level = ["events.reset_base.roll=[0.0, 0.0]", "events.reset_base.pitch=[0.0, 0.0]"]
    level += ["events.reset_joints_within_limits_range.enabled=false", "sim.episode_length_s=2.0"]
    found = evaluate(still, "getup_flat", ["anymal_d"], num_envs=4, overrides=level)
    figures = found.robots["anymal_d"].rising
    assert figures.rate == 1.0
    assert figures.time_s < 0.5
    assert figures.least_held_s > 1.5
    assert Evaluation.from_dict(found.as_dict()) == dataclasses.replace(found)
    Reporter().evaluation(found)
    assert "up within 4 s" in capsys.readouterr().out
    lying = evaluate(still, "getup_flat", ["anymal_d"], num_envs=32, steps=150)
    assert lying.robots["anymal_d"].rising.rate < 0.5
    walking = evaluate(still, "velocity_flat", ["anymal_d"], num_envs=2, steps=5)
    assert walking.robots["anymal_d"].rising is None
