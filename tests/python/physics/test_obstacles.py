"""A policy walks up a ramp and onto a box that the task's scene puts there."""

import numpy as np
import pytest

from common import FLAT_POLICY
from polypod import _core
from polypod.evaluation import load_policy
from polypod.runs import run_dir

CALM = [
    "observations.enable_noise=false",
    "events.push_robot.enabled=false",
    "events.reset_base.x=[0.0, 0.0]",
    "events.reset_base.y=[0.0, 0.0]",
    "events.reset_base.yaw=[0.0, 0.0]",
]
ROBOTS = ["unitree_a1", "unitree_go1", "unitree_go2", "unitree_b2"]


def climbed(task: str, robot: str) -> float:
    """How far the base rises in 6 s of walking forward at 0.6 m/s, m: the median of 16 robots.

    From the mean of the first half second, on level ground, to the highest of a later one: bobbing
    does not count.
    """
    manifest = run_dir.read_manifest(FLAT_POLICY)
    policy = load_policy(run_dir.load_checkpoint(FLAT_POLICY), manifest["policy"])
    sim = _core.VecSim(task, 16, robots=[robot], seed=0, overrides=CALM)
    sim.set_command(np.tile(np.float32([0.6, 0.0, 0.0]), (16, 1)))
    heights = np.zeros((301, 16))
    standing = np.ones(16, dtype=bool)
    for step in range(300):
        sim.step(policy(sim.observation))
        standing &= ~(sim.terminated | sim.truncated)
        # velocity, turn rate and gravity in base axes come first
        velocity, down = sim.observation[:, 0:3], sim.observation[:, 6:9]
        rise = np.where(standing, -(velocity * down).sum(axis=1) * sim.step_dt, 0.0)
        heights[step + 1] = heights[step] + rise
    assert standing.mean() > 0.5, f"{robot} falls in {task}"
    means = heights[1:].reshape(12, 25, 16).mean(axis=1)
    return float(np.median(means.max(axis=0) - means[0]))


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_policy_climbs_a_ramp_onto_a_box(robot: str) -> None:
    assert climbed("velocity_flat_universal", robot) < 0.06
    assert climbed("velocity_obstacles", robot) == pytest.approx(0.2, abs=0.06)
