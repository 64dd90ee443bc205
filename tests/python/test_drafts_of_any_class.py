"""`polypod robot new` for bodies of every class, from the URDF alone: drafts load, and stand or say why not."""

import json
from pathlib import Path

import numpy as np
import pytest
import tomllib

import polypod
from polypod import _core, bodies
from polypod.new_robot import new_robot

ROOT = Path(__file__).parents[2]
STANDING = ["unitree_h1", "unitree_g1", "booster_t1", "berkeley_humanoid", "phantomx", "box_quadruped"]
ON_POINTS = ["limx_tron1", "bolt"]


def urdf(robot):
    return ROOT / "assets/robots" / robot / "robot.urdf"


def is_usable(made):
    """It loads, acts and observes."""
    assert "leg: " in _core.check(made.path.parent / tomllib.loads(made.path.read_text())["urdf"], {})
    env = polypod.make("velocity_flat_legged", 2, robots=[str(made.path)], seed=0)
    env.reset()
    for _ in range(10):
        observations = env.step(np.full((2, env.sim.num_actions), 0.1, dtype=np.float32))[0]
    assert np.isfinite(observations).all()
    return env


@pytest.mark.parametrize("robot", STANDING)
def test_a_draft_stands(tmp_path, robot):
    """The library's configs of most of these have published gains on which they do not."""
    made = new_robot(urdf(robot), tmp_path / f"draft_{robot}.toml")
    assert made.standing.holds, made
    assert made.needs_policy is None
    env = is_usable(made)
    (drafted,) = json.loads(env.sim.robot_info()).values()
    (known,) = json.loads(polypod.make("velocity_flat_legged", 1, robots=[robot], seed=0).sim.robot_info()).values()
    assert (drafted["slots"], drafted["class"]) == (known["slots"], known["class"])
    # the height of the pose is about that of the published one
    assert 0.85 < drafted["base_height"] / known["base_height"] < 1.2


@pytest.mark.parametrize("robot", ON_POINTS)
def test_a_biped_without_ankles_needs_a_policy(cli, tmp_path, robot):
    made = new_robot(urdf(robot), tmp_path / f"draft_{robot}.toml")
    assert not made.standing.holds
    assert made.needs_policy == "it has two feet and no ankles: a policy steps to balance it"
    assert made.gain_factor == 1.0
    assert tomllib.loads(made.path.read_text())["reward_set"] in ("point_feet", "limx")
    is_usable(made)
    done = cli("robot", "new", str(urdf(robot)), "--out", str(made.path), "--force")
    assert "a policy steps to balance it" in done.stdout
    assert "--train-config specialist" in done.stdout
    assert "belly" not in done.stdout + done.stderr


@pytest.mark.parametrize("kind", ["quadruped8", "biped", "humanoid", "hexapod"])
def test_a_body_of_no_library_is_drafted(tmp_path, kind):
    """A generated one, of which only the URDF is left."""
    file = tmp_path / "body.urdf"
    file.write_text(bodies.urdf(bodies.draw(kind, "body", np.random.default_rng(7))))
    made = new_robot(file, tmp_path / "draft.toml")
    assert made.standing.holds or made.needs_policy is not None, made
    is_usable(made)


def test_soles_are_flat_and_below_the_centre_of_mass(tmp_path):
    """T1's arms are stretched out at zero joint positions; in the draft they hang."""
    made = new_robot(urdf("booster_t1"), tmp_path / "draft.toml")
    pose = tomllib.loads(made.path.read_text())["default_pose"]
    for side, sign in (("L", -1.0), ("R", 1.0)):
        assert sign * pose[f"{side}_SHOULDER_ROLL"] > 1.2
        assert pose[f"{side}_HIP_PITCH"] + pose[f"{side}_KNEE"] + pose[f"{side}_ANKLE_PITCH"] == pytest.approx(
            0.0, abs=5e-3
        )
        assert pose[f"{side}_KNEE"] > 0.3
