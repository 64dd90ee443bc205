"""The gate of nanoG1: its commands, its figures by hand, its bounds."""

import json

import numpy as np
import pytest

from polypod.evaluation import gate
from polypod.evaluation.gate import BOUNDS, Gate

GOOD = Gate(
    battery_falls=1,
    battery_perf=0.9,
    action_jerk_rms=0.21,
    ang_vel_xy_rms=0.21,
    yaw_rate_rms=0.2,
    leg_qvel_rms=1.22,
    walk_falls=0,
)


def test_each_bound_alone_decides():
    assert GOOD.passes
    for name, bound in BOUNDS.items():
        worse = bound - 0.01 if name == "battery_perf" else bound + 0.01
        for value in (worse, float("nan")):
            missed = Gate(**{**vars(GOOD), name: value})
            assert missed.missed == [name]
            assert not missed.passes


def test_actions_that_alternate_have_their_jerk_and_those_of_the_arms_do_not_count(monkeypatch):
    monkeypatch.setattr(gate, "WALK_S", 0.2)
    monkeypatch.setattr(gate, "BATTERY_S", 0.1)
    seen = []

    def policy(observations):
        seen.append(len(observations))
        actions = np.zeros((len(observations), 19), dtype=np.float32)
        actions[:] = 0.05 * (-1) ** len(seen)
        actions[:, arms] *= 100.0 if len(observations) == 1 else 0.0
        return actions

    from polypod import _core

    info = json.loads(_core.VecSim("velocity_flat_legged_play", 1, robots=["unitree_h1"]).robot_info())["unitree_h1"]
    arms = [
        column
        for slot, column in zip(info["slots"], info["columns"], strict=True)
        if not any(part in slot for part in ("HIP", "KNEE", "ANKLE"))
    ]
    assert len(arms) == 9
    (found,) = gate.measure(policy, "velocity_flat_legged", ["unitree_h1"], threads=1).values()
    assert found.action_jerk_rms == pytest.approx(0.1)
    assert found.battery_falls == found.walk_falls == 0
    assert 0.0 < found.battery_perf < 1.0
    assert min(found.leg_qvel_rms, found.ang_vel_xy_rms, found.yaw_rate_rms) > 0.0
    # five steps of 24 envs, ten of one
    assert seen == [24] * 5 + [1] * 10


def test_the_command_line_says_who_passes(cli, tmp_path, monkeypatch):
    monkeypatch.setattr(gate, "WALK_S", 0.2)
    monkeypatch.setattr(gate, "BATTERY_S", 0.1)
    flags = ("--checkpoint", "legged", "--robots", "unitree_g1", "--gate")
    done = cli("eval", *flags, "--json", "gate.json")
    assert done.returncode == 3, done.stderr
    assert "0 of 1 pass nanoG1's gate" in done.stdout
    content = json.loads((tmp_path / "gate.json").read_text())
    assert content["bounds"] == BOUNDS
    assert content["robots"]["unitree_g1"]["passes"] is False
    done = cli("eval", *flags, "--steps", "5")
    assert done.returncode == 2
    assert "leave out --steps" in done.stderr
