"""The policies in examples/policies do what the pages say of them."""

import json

import numpy as np
import pytest
import torch

from common import ROOT
from polypod import _core
from polypod.compat import tomllib
from polypod.evaluation import evaluate_checkpoint, play_task, rising, tracking
from polypod.policy import load
from polypod.runs import run_dir
from polypod.sim2sim import beginning, on_motions, on_rising

FOLDER = ROOT / "examples" / "policies"
ALL = sorted(path.parent for path in FOLDER.glob("*/manifest.json"))
RECIPE_OF_ROUGH = str(ROOT / "lab" / "recipes" / "rough")
OF_ALL = ("rough_all", "rough_blind")
ROUGH = sorted(folder.name for folder in ALL if folder.name.startswith("rough_") and folder.name not in OF_ALL)


def model(name):
    (found,) = (FOLDER / name).glob("model_*.pt")
    return found


@pytest.mark.parametrize("folder", ALL, ids=lambda folder: folder.name)
def test_they_hold_an_actor_and_nothing_of_the_machine(folder):
    state = torch.load(model(folder.name), weights_only=True)
    assert state.keys() == {"actor_state_dict", "iter", "infos"}
    manifest = json.loads((folder / run_dir.MANIFEST).read_text(encoding="utf-8"))
    bodies = [{**body, "numbers": ""} for body in manifest.get("trained_bodies", [])]
    assert '"/' not in json.dumps({**manifest, "trained_bodies": bodies}), "an absolute path"
    assert manifest["overrides"] == []
    recipe = "rough" if folder.name.startswith("rough") else "skills"
    assert manifest["command"] == f"python -m lab.recipe lab/recipes/{recipe}"


@pytest.mark.parametrize("name", ["getup", "getup_g1", "hind_legs"])
def test_robots_get_up(name):
    found = evaluate_checkpoint(model(name), num_envs=128, threads=2)
    for robot, result in found.robots.items():
        assert result.rising.rate >= rising.ENOUGH, robot


@pytest.mark.parametrize("name", ["getup", "getup_g1"])
def test_robots_get_up_from_where_they_lie(name):
    """The tasks drop robots; here they first lie for two seconds, in the joint angles drawn."""
    policy = load(model(name))
    manifest = policy.manifest
    robots, slots = manifest["robots"], manifest["canonical_joint_names"]
    changes = ["sim.episode_length_s=20.0", "observations.enable_noise=false"]
    sim = _core.VecSim(
        play_task(manifest["task"]),
        128,
        robots=robots,
        seed=3,
        threads=2,
        overrides=changes,
        autoreset="disabled",
        slots=slots,
    )
    goals = rising.goals(sim, tomllib.loads(sim.resolved_config()))
    infos = json.loads(sim.robot_info())
    hold = sim.state("joint_pos") - sim.state("default_joint_pos")
    for robot in robots:
        hold[slice(*sim.env_ids(robot))] /= infos[robot]["action_scale"]
    for _ in range(100):
        sim.step(hold)
    lying = rising.Record(sim, goals)
    lying.add(np.ones(128, dtype=np.bool_))
    assert lying.episodes()["held"].max() == 0.0, "all lie"
    record, run = rising.Record(sim, goals), policy.runner()
    for _ in range(300):
        sim.step(run(sim.observation))
        record.add(np.ones(128, dtype=np.bool_))
    for robot in robots:
        mine = {key: values[slice(*sim.env_ids(robot))] for key, values in record.episodes().items()}
        assert rising.rising(**mine).rate >= rising.ENOUGH, robot


def test_go1_stands_on_its_hind_legs_for_ten_seconds():
    found = evaluate_checkpoint(model("hind_legs"), num_envs=128, threads=2, overrides=["sim.episode_length_s=14.0"])
    assert found.robots["unitree_go1"].rising.least_held_s >= 10.0


def test_robots_get_up_in_mujoco():
    found = on_rising.compare(model("getup"), None, beginning.Options(16))
    assert found.transfers


TRACKING = {
    "tracking_g1": ["unitree_g1"],
    "tracking_h1": ["unitree_h1"],
    "tracking_t1": ["booster_t1"],
    "tracking": ["unitree_g1", "booster_t1"],
}


@pytest.mark.parametrize(("name", "robots"), TRACKING.items())
def test_humanoids_track_the_drawn_motions(name, robots):
    """The policy of three does not follow all walks with H1."""
    found = tracking.measure_checkpoint(model(name), robots, episodes=16, threads=2)
    assert list(found) == robots
    for robot, clips in found.items():
        assert sorted(clips) == ["squat", "turn", "walk", "wave"]
        for clip, result in clips.items():
            assert result.followed >= tracking.SHARE, (robot, clip)


@pytest.mark.parametrize("robot", TRACKING["tracking"])
def test_humanoids_walk_as_drawn_in_mujoco(robot):
    """Both policies of a robot; `lab/recipes/skills` is judged by all motions."""
    alone = f"tracking_{robot.rpartition('_')[2]}"
    for name in (alone, "tracking"):
        found = on_motions.measure_checkpoint(model(name), [robot], ["walk"], episodes=3, threads=1)
        assert found[robot]["walk"].followed == 1.0, name


def on_tiles(name, terrain, *, num_envs, seed):
    """Evaluation on tiles, with as many envs of each robot."""
    overrides = [*(f"scene.terrain.{change}" for change in terrain), "env_shares={}"]
    return evaluate_checkpoint(model(name), num_envs=num_envs, seed=seed, threads=2, overrides=overrides)


@pytest.mark.parametrize("name", ROUGH)
def test_humanoids_climb_stairs_of_fifteen_centimetres(name, monkeypatch):
    """Level 5 alone: steps of 14 to 16 cm, up and down, and the other types of tile."""
    monkeypatch.setenv("POLYPOD_PATH", RECIPE_OF_ROUGH)
    terrain = ("num_rows=1", "num_cols=20", "max_init_terrain_level=0", "difficulty_range=[0.5, 0.6]", "seed=77")
    found = on_tiles(name, terrain, num_envs=160, seed=1)
    (result,) = found.robots.values()
    assert result.success_rate >= 0.9
    share = {kind: tile.success for kind, (tile,) in result.terrain.items()}
    assert len(share) == 6
    assert share.pop("pyramid_stairs") >= 0.85
    assert share.pop("pyramid_stairs_inv") >= 0.85
    assert min(share.values()) >= 0.95


@pytest.mark.parametrize("name", OF_ALL)
def test_one_policy_walks_on_rough_ground_with_robots_of_all_classes(name, monkeypatch):
    """Levels 0 to 5 of tiles that no training saw; a blind policy is judged without stairs."""
    monkeypatch.setenv("POLYPOD_PATH", RECIPE_OF_ROUGH)
    terrain = ("num_rows=6", "num_cols=12", "max_init_terrain_level=5", "difficulty_range=[0.0, 0.6]", "seed=78")
    found = on_tiles(name, terrain, num_envs=19 * 16, seed=5)
    assert len(found.robots) == 19
    if name == "rough_all":
        for robot, result in found.robots.items():
            assert result.success_rate >= 0.8, robot
        return
    for kind in ("random_rough", "hf_pyramid_slope_inv"):
        tiles = [tile for result in found.robots.values() for tile in result.terrain[kind]]
        assert sum(tile.episodes * tile.success for tile in tiles) >= 0.9 * sum(tile.episodes for tile in tiles), kind
