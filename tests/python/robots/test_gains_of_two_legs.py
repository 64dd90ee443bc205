"""Drafted gains of the library's robots on two legs against those of their makers."""

import functools
import json
import re

import numpy as np
import pytest
import tomllib

from common import ROOT
from polypod import Simulation, _core
from polypod.new_robot import new_robot

TASK = "velocity_flat_any_legged_play"
ROBOTS = ["unitree_h1", "unitree_g1", "booster_t1", "berkeley_humanoid", "cassie", "limx_tron1", "bolt"]
FACTORS = {"LEG": 2.0, "TORSO": 2.05, "ANKLE": 3.4, "ARM": 1.5}
"""Between what is drafted and what makers chose."""
OF_ONE = {("booster_t1", "LEG"): 4.2, ("booster_t1", "TORSO"): 5.0, ("berkeley_humanoid", "ANKLE"): 5.2}
"""T1 has 200 N m/rad on 30 N m, and Berkeley Humanoid's ankles roll on 1 N m/rad."""
DAMPING_FACTOR = 3.2


def part_of(slot):
    if slot.startswith("TORSO_"):
        return "TORSO"
    if re.search(r"_(SHOULDER|ELBOW|WRIST|FINGER)", slot) or not slot.startswith(("L_", "R_")):
        return "ARM"
    return "ANKLE" if "_ANKLE" in slot else "LEG"


def stiffness(slot, mass, hip_height, effort):
    """The rule of docs/add-a-robot.md, N m/rad."""
    load = mass * 9.81 * hip_height
    leg = 0.41 * (15.0 / mass) ** 0.2 * load
    return {
        "LEG": leg**0.75 * effort**0.25,
        "TORSO": leg**0.5 * effort**0.5,
        "ANKLE": min(effort, leg),
        "ARM": min(0.085 * load, leg),
    }[part_of(slot)]


def info_of(robot):
    sim = _core.VecSim(TASK, 1, robots=[str(robot)], threads=1)
    (info,) = json.loads(sim.robot_info()).values()
    return info


@pytest.fixture(scope="module")
def drafts(tmp_path_factory):
    """The path of each robot's draft, and what is known of the draft and of the robot."""
    folder = tmp_path_factory.mktemp("drafts")

    @functools.cache
    def draft(robot):
        config = tomllib.loads((ROOT / f"configs/robots/{robot}.toml").read_text())
        made = new_robot(ROOT / config["urdf"], folder / f"draft_{robot}.toml")
        return made, info_of(made.path), info_of(robot)

    return draft


def ratios(drafted, made, key):
    """Slot -> what a maker chose over what is drafted."""
    joints = dict(zip(drafted["joint_names"], drafted[key], strict=True))
    own = {slot: joints[made["joint_names"][at]] for slot, at in zip(made["slots"], made["joint_of_slot"], strict=True)}
    known = {slot: made[key][at] for slot, at in zip(made["slots"], made["joint_of_slot"], strict=True)}
    return {slot: known[slot] / own[slot] for slot in known}


@pytest.mark.parametrize("robot", ROBOTS)
def test_gains_are_those_of_makers_within_a_factor(drafts, robot):
    _, drafted, made = drafts(robot)
    for slot, ratio in ratios(drafted, made, "stiffness").items():
        part = part_of(slot)
        factor = OF_ONE.get((robot, part), FACTORS[part])
        assert 1 / factor <= ratio <= factor, (slot, ratio)
    for slot, ratio in ratios(drafted, made, "damping").items():
        assert 1 / DAMPING_FACTOR <= ratio <= DAMPING_FACTOR, (slot, ratio)
    assert drafted["action_scale"] == pytest.approx(made["action_scale"], rel=0.15 if robot != "booster_t1" else 1.0)


def test_gains_of_legs_follow_from_those_of_other_robots(drafts):
    """Leave-one-out: the constant of legs, fitted to six robots, predicts the seventh."""
    found = {}
    for robot in ROBOTS:
        of_legs = ratios(*drafts(robot)[1:], "stiffness")
        found[robot] = np.array([ratio for slot, ratio in of_legs.items() if part_of(slot) == "LEG"])
    for robot in ROBOTS:
        fitted = np.median([np.median(ratio) for other, ratio in found.items() if other != robot])
        assert 0.8 < fitted < 1.25
        worst = np.exp(np.abs(np.log(found[robot] / fitted)).max())
        assert worst < (4.5 if robot == "booster_t1" else 2.3), (robot, worst)


@pytest.mark.parametrize("robot", ["unitree_g1", "berkeley_humanoid"])
def test_a_draft_says_the_rule_and_the_limits_of_its_urdf(drafts, robot):
    made, drafted, _ = drafts(robot)
    mass, height = drafted["mass"], drafted["base_height"] + drafted["hip_height"]
    for slot, joint in zip(drafted["slots"], drafted["joint_of_slot"], strict=True):
        stiff = stiffness(slot, mass, height, drafted["effort_limit"][joint])
        assert drafted["stiffness"][joint] == pytest.approx(stiff, rel=0.051), slot
    groups = tomllib.loads(made.path.read_text())["actuators"]
    assert {joint for group in groups.values() for joint in group["joints"]} >= {"*_KNEE", "*_ANKLE_ROLL"}


LIMITS = re.compile(r'(effort|velocity)="[^"]*"')


@pytest.mark.parametrize("limit", ["0", "1000"])
@pytest.mark.parametrize("robot", ["unitree_h1", "unitree_g1", "berkeley_humanoid"])
def test_limits_that_no_motor_has_follow_from_the_body(drafts, tmp_path, robot, limit):
    _, known, _ = drafts(robot)
    text = (ROOT / f"assets/robots/{robot}/robot.urdf").read_text()
    text = LIMITS.sub(lambda found: f'{found[1]}="{limit}"', text)
    made = new_robot(write(tmp_path / "robot.urdf", text), tmp_path / "robot.toml")
    drafted = info_of(made.path)
    for slot, joint in zip(drafted["slots"], drafted["joint_of_slot"], strict=True):
        if part_of(slot) != "ARM":
            ratio = drafted["stiffness"][joint] / known["stiffness"][joint]
            # an ankle of Berkeley Humanoid is four times as weak as the other one
            assert 1 / 2.1 <= ratio <= (2.5 if robot != "berkeley_humanoid" else 3.0), (slot, ratio)
    assert all(limit > 0.0 for key in ("effort_limit", "velocity_limit") for limit in drafted[key])
    assert made.path.read_text().count("assumed: not in the URDF") >= 4


@pytest.mark.parametrize("robot", ["unitree_h1", "unitree_g1", "booster_t1"])
def test_no_joint_of_a_draft_is_at_its_limit_and_arms_hang(drafts, robot):
    made, drafted, _ = drafts(robot)
    for joint, name in enumerate(drafted["joint_names"]):
        low, high = drafted["lower"][joint], drafted["upper"][joint]
        margin = min(drafted["default_pose"][joint] - low, high - drafted["default_pose"][joint])
        assert margin >= 0.04 * (high - low), name
    # the link of a joint follows those above it
    places = Simulation(made.path, threads=1).link_pose()[0][0, 1:]
    slots = dict(zip(drafted["slots"], drafted["joint_of_slot"], strict=True))
    for side in ("L", "R"):
        shoulder = places[slots[f"{side}_SHOULDER_PITCH"]]
        arm = [joint for slot, joint in slots.items() if slot.startswith(side) and part_of(slot) == "ARM"]
        below = shoulder - places[max(arm, key=lambda joint: np.linalg.norm(places[joint] - shoulder))]
        # forearms of G1 point forward at zero
        assert below[2] > 0.6 * np.linalg.norm(below), (side, below)


def test_an_effort_limit_that_an_exporter_wrote_into_every_joint_is_no_motors(tmp_path):
    """1 N m in every joint of H1."""
    text = (ROOT / "assets/robots/unitree_h1/robot.urdf").read_text()
    known = info_of(new_robot(write(tmp_path / "known.urdf", text), tmp_path / "known.toml").path)
    assert 'effort="200"' in text
    for effort in ("200", "300", "40", "18"):
        text = text.replace(f'effort="{effort}"', 'effort="1"')
    made = new_robot(write(tmp_path / "h1.urdf", text), tmp_path / "h1.toml")
    drafted = info_of(made.path)
    for slot, joint in zip(drafted["slots"], drafted["joint_of_slot"], strict=True):
        for key in ("effort_limit", "stiffness"):
            assert 0.4 < drafted[key][joint] / known[key][joint] < 2.5 or part_of(slot) == "ARM", (slot, key)
    assert "assumed: the URDF's is no motor's" in made.path.read_text()
    told = [note for note in made.notes if "the URDF's effort limit of 1 N m is no motor's, for " in note]
    assert {name for name in drafted["joint_names"] if any(name in note for note in told)} == set(
        drafted["joint_names"]
    )


def write(file, text):
    file.write_text(text)
    return file
