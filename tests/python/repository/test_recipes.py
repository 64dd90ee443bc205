"""A recipe trains its stages, goes on where it ended, and its model becomes a bundled policy."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from common import ROOT
from lab import grown, recipe
from polypod import _core, bundled
from polypod.compat import tomllib
from polypod.evaluation import evaluate_checkpoint
from polypod.motions.tracking import terms_of_task
from polypod.networks.policies import NetworkPolicy, load_network
from polypod.networks.transfer import numbers_of
from polypod.new_robot import new_robot
from polypod.runs import config, run_dir
from polypod.training import growth

LEGGED = ROOT / "lab" / "recipes" / "legged"
PLAN = """
bodies = [["--count", "2", "--seed", "1", "--kinds", "quadruped,quadruped_arm", "--prefix", "d"]]
[groups]
dogs = ["solo12"]
[[stages]]
name = "teacher"
config = "teacher.toml"
robots = ["@dogs"]
iterations = 1
[[stages]]
name = "student"
config = "student.toml"
robots = ["@dogs", "@drawn.0"]
iterations = 1
shares = { "@dogs" = 3 }
changes = ["sim.episode_length_s=0.4"]
[stages.teachers]
"@dogs" = "teacher"
"""
SMALL = "num_envs = 8\nnum_steps_per_env = 4\n"


def lab(*words: str) -> str:
    done = subprocess.run([sys.executable, "-m", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, Path]:
    """A small recipe of two stages, and what it leaves."""
    folder, out = tmp_path_factory.mktemp("recipe"), tmp_path_factory.mktemp("out")
    (folder / "plan.toml").write_text(PLAN)
    (folder / "teacher.toml").write_text(f'extends = "teacher"\n[run]\n{SMALL}')
    text = (LEGGED / "student.toml").read_text().replace('"teacher.toml"', f'"{LEGGED / "teacher.toml"}"')
    text = text.replace("num_envs = 4096\n", "").replace("num_steps_per_env = 24\n", SMALL)
    (folder / "student.toml").write_text(text.replace("[512, 256, 128]", "[32]").replace("= 96", "= 16"))
    (folder / "configs").symlink_to(LEGGED / "configs")
    said = lab("lab.recipe", str(folder), "--out", str(out))
    assert "teacher: exit code 0" in said, (out / "teacher.log").read_text()
    assert "student: exit code 0" in said, (out / "student.log").read_text()
    return folder, out


def test_stages_leave_models_and_are_not_trained_again(made):
    folder, out = made
    manifest = json.loads((out / "student" / "manifest.json").read_text())
    assert manifest["robots"] == ["solo12", "d_quadruped_0", "d_quadruped_arm_1"]
    assert manifest["overrides"] == ["sim.episode_length_s=0.4", "env_shares.solo12=3"]
    assert manifest["train_config"]["distillation"]["teachers"]["solo12"] == str(out / "teacher" / "model.pt")
    assert manifest["train_config"]["distillation"]["teachers"]["*"] == str(bundled.checkpoint("quadruped"))
    assert lab("lab.recipe", str(folder), "--out", str(out)).splitlines() == [
        "teacher: is there",
        "student: is there",
    ]


def test_a_stage_may_be_a_mean_of_weights(made):
    """The mean of a bundled policy and of a stage with half that policy's weights."""
    folder, out = made
    stages = """
[[stages]]
name = "other"
mean = { legged = 1.0 }
[[stages]]
name = "beyond"
mean = { legged = 1.5, other = -0.5 }
"""
    (folder / "plan.toml").write_text(PLAN + stages)
    words = ("lab.recipe", str(folder), "--out", str(out), "--stages")
    assert lab(*words, "other") == "other: the mean of legged\n"
    state = torch.load(out / "other" / "model.pt", weights_only=True)
    # a mean of weights in half precision is in single precision
    bundle = torch.load(bundled.checkpoint("legged"), weights_only=True)["actor_state_dict"]
    first = {key: weights.float() if weights.is_floating_point() else weights for key, weights in bundle.items()}
    assert all(torch.equal(state["actor_state_dict"][key], weights) for key, weights in first.items())
    halves = {key: 0.5 * weights if weights.is_floating_point() else weights for key, weights in first.items()}
    kept = {**state, "actor_state_dict": halves}
    run_dir.save_checkpoint(out / "other" / "model.pt", lambda file: torch.save(kept, file))
    assert lab(*words, "beyond,other") == "beyond: the mean of legged, other\nother: is there\n"
    found = torch.load(out / "beyond" / "model.pt", weights_only=True)["actor_state_dict"]
    for key, weights in first.items():
        if weights.is_floating_point():
            assert torch.allclose(found[key], 1.25 * weights), key
    (result,) = evaluate_checkpoint(out / "beyond" / "model.pt", ["solo12"], num_envs=1, steps=2, threads=1).robots
    assert result == "solo12"


def test_a_model_becomes_a_policy_of_the_library(made, tmp_path):
    _, out = made
    words = (str(out / "student" / "model.pt"), str(tmp_path / "policy"), "--task", "velocity_flat_any_legged")
    lab("lab.bundle", *words)
    (model,) = (tmp_path / "policy").glob("model_*.pt")
    manifest = json.loads((tmp_path / "policy" / "manifest.json").read_text())
    assert manifest["robots"] == ["solo12"]
    assert [body["name"] for body in manifest["trained_bodies"]] == ["solo12", "d_quadruped_0", "d_quadruped_arm_1"]
    assert str(out) not in json.dumps(manifest)
    # an arm that was drawn has slots that no robot of the library has
    assert not [slot for slot in manifest["canonical_joint_names"] if slot.startswith("ARM_")]
    columns = [joint["column"] for joint in manifest["joint_maps"]["solo12"]]
    assert columns == manifest["robot_info"]["solo12"]["columns"] == list(range(12))
    found = evaluate_checkpoint(model, ["solo12", "unitree_h1"], num_envs=2, steps=3, threads=1)
    assert sorted(found.robots) == ["solo12", "unitree_h1"]


def test_a_policy_may_keep_large_weights_in_half_precision(made, tmp_path):
    model = str(made[1] / "teacher" / "model.pt")
    lab("lab.bundle", model, str(tmp_path / "policy"), "--task", "velocity_flat_teacher", "--actor", "--half")
    (kept,) = (tmp_path / "policy").glob("model_*.pt")
    whole = torch.load(model, weights_only=True)["actor_state_dict"]
    half = torch.load(kept, weights_only=True)["actor_state_dict"]
    assert {half[key].dtype for key in whole if whole[key].numel() > 4096} == {torch.float16}
    assert all(torch.equal(half[key], whole[key]) for key in whole if whole[key].numel() <= 4096)
    (result,) = evaluate_checkpoint(kept, ["solo12"], num_envs=1, steps=2, threads=1).robots
    assert result == "solo12"


def test_a_network_to_begin_with_knows_no_path(made, tmp_path):
    """Its robots may be files of another machine."""
    model = str(made[1] / "student" / "model.pt")
    lab("lab.bundle", model, str(tmp_path / "policy"), "--half", "--pretrained", "polypod train")
    (kept,) = (tmp_path / "policy").glob("model_*.pt")
    manifest = run_dir.read_manifest(kept)
    assert manifest["robot_sources"] == ["solo12", "d_quadruped_0", "d_quadruped_arm_1"]
    assert (manifest["command"], manifest["overrides"]) == ("polypod train", [])
    assert str(made[1]) not in (tmp_path / "policy" / "manifest.json").read_text()
    assert run_dir.load_checkpoint(kept).keys() >= {"actor_state_dict", "iter"}


@pytest.mark.parametrize("words", [(), ("--actor",)])
def test_a_policy_may_go_without_its_critic(made, tmp_path, words):
    model = str(made[1] / "teacher" / "model.pt")
    lab("lab.bundle", model, str(tmp_path / "policy"), "--task", "velocity_flat_teacher", *words)
    (kept,) = (tmp_path / "policy").glob("model_*.pt")
    assert ("critic_state_dict" in torch.load(kept, weights_only=True)) == (not words)


@pytest.mark.parametrize("folder", sorted((ROOT / "lab" / "recipes").iterdir()), ids=lambda folder: folder.name)
def test_recipes_can_be_run(folder, tmp_path, monkeypatch):
    """Stages name configs and tasks that load, robots of the library, and stages before them."""
    plan = recipe.read(folder)
    drafts = tmp_path / "configs" / "robots"
    drafts.mkdir(parents=True)
    for name in plan.drafts:
        new_robot(recipe.LIBRARY / name / "robot.urdf", drafts / f"drafted_{name}.toml")
    drawn = tuple(f"{words[words.index('--prefix') + 1]}_" for words in plan.bodies)
    for name, variant in plan.locked.items():
        if variant["robot"].startswith(drawn):
            continue
        whole = drafts / f"drafted_{variant['robot']}.toml"
        joints = recipe.held(whole, variant["joints"])
        recipe.draft(recipe.LIBRARY / variant["robot"] / "robot.urdf", drafts / f"{name}.toml", joints)
    monkeypatch.setenv("POLYPOD_PATH", os.pathsep.join([str(tmp_path), *recipe.packages(plan)]))
    library = {entry["name"] for entry in _core.robots()}
    known, tasks = set(bundled.NAMES), {}
    for stage in plan.stages:
        if stage.mean:
            assert set(stage.mean) <= known, stage.name
            assert sum(stage.mean.values()) == pytest.approx(1.0), stage.name
            known.add(stage.name)
            continue
        file = folder / stage.config
        task = config.load(str(file) if file.is_file() else stage.config).run.task
        names = [name for name in stage.robots if not name.startswith("@drawn.")]
        robots = plan.robots(names, tmp_path, without=stage.without)
        robots = [name for name in robots if not name.startswith(drawn)]
        assert set(robots) <= library, stage.name
        changes = tuple(change for change in stage.changes if not change.startswith("train."))
        tasks.setdefault((task, changes), set()).update(robots)
        assert {*stage.teachers.values(), *([stage.init] if stage.init else [])} <= known, stage.name
        known.add(stage.name)
    for (task, changes), robots in tasks.items():
        if robots:
            _, own = terms_of_task(task, sorted(robots), changes)
            _core.VecSim(task, len(robots), robots=sorted(robots), overrides=own, threads=1)


def test_a_stage_resembles_an_earlier_one_and_leaves_robots_out(tmp_path):
    text = (
        PLAN
        + """
[[stages]]
name = "left_out"
like = "student"
iterations = 2
without = ["solo12"]
robots = ["@dogs", "drafted_solo12", "spot"]
"""
    )
    (tmp_path / "plan.toml").write_text(text)
    plan = recipe.read(tmp_path)
    _, student, left_out = plan.stages
    assert (left_out.config, left_out.seed, left_out.iterations) == (student.config, student.seed, 2)
    words = recipe.command(plan, left_out, tmp_path, None)
    assert words[words.index("--robots") + 1] == "spot"
    assert "sim.episode_length_s=0.4" in words
    assert not [word for word in words if "solo12" in word]


def test_a_table_may_stand_for_many_stages(tmp_path):
    text = (
        PLAN
        + """
[[stages]]
name = "{key}_longer"
each = { solo = "solo12", dog = "spot" }
like = "student"
init = "{key}"
robots = ["{value}", "drafted_{value}"]
shares = { "{value}" = 2 }
"""
    )
    (tmp_path / "plan.toml").write_text(text)
    solo, dog = recipe.read(tmp_path).stages[-2:]
    assert (solo.name, solo.init, solo.robots) == ("solo_longer", "solo", ("solo12", "drafted_solo12"))
    assert (dog.name, dog.init, dog.shares) == ("dog_longer", "dog", {"spot": 2})
    assert dog.config == "student.toml"


def test_joints_are_held_of_a_group_of_robots(tmp_path):
    text = PLAN + '[[held]]\nrobots = ["@dogs", "spot"]\nsuffix = "stiff"\njoints = ["*_HAA"]\n'
    (tmp_path / "plan.toml").write_text(text)
    joints = ["*_HAA"]
    made = recipe.read(tmp_path)
    assert made.locked == {
        "solo12_stiff": {"robot": "solo12", "joints": joints},
        "spot_stiff": {"robot": "spot", "joints": joints},
    }
    assert made.groups["dogs_stiff"] == ["solo12_stiff"]


def test_bodies_are_drafted_and_drafts_hold_joints(tmp_path, monkeypatch):
    words = ("--count", "2", "--seed", "1", "--kinds", "biped,quadruped", "--prefix", "d", "--wide")
    unnamed = ("--count", "1", "--seed", "1", "--kinds", "biped", "--prefix", "e")
    named = ("@dogs", "drafted_bolt", "stiff", "rigid")
    stage = recipe.Stage(name="first", config="student.toml", robots=named)
    plan = recipe.Recipe(
        folder=tmp_path,
        stages=(stage,),
        groups={"dogs": ("d_biped_0",)},
        bodies=((*words, recipe.DRAFTED), words, unnamed),
        drafts=("bolt", "spot"),
        locked={
            "stiff": {"robot": "bolt", "joints": ["*_HIP_ROLL"]},
            "rigid": {"robot": "d_biped_0", "joints": ["*_HIP_ROLL"]},
        },
    )
    recipe.draw(plan, tmp_path, [stage])
    assert not recipe.bodies_folder(tmp_path, 2).exists(), "no stage names these"
    drafted, drawn = (recipe.bodies_folder(tmp_path, n) / "configs" / "robots" / "d_biped_0.toml" for n in (0, 1))
    assert "Drafted by" in drafted.read_text()
    assert "Drafted by" not in drawn.read_text()
    tables = [tomllib.loads(file.read_text()) for file in (drafted, drawn)]
    assert tables[0]["reward_set"] == tables[1]["reward_set"]
    quadruped = tomllib.loads((drafted.parent / "d_quadruped_1.toml").read_text())
    assert (quadruped["reward_set"], "variation" in quadruped) == ("quadruped", True), "a draft has ranges of its own"
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path / "drafts"))
    assert not (tmp_path / "drafts/configs/robots/drafted_spot.toml").exists()
    robots = ["drafted_bolt", "stiff", str(drafted), "rigid"]
    infos = json.loads(_core.VecSim(recipe.TASK, 4, robots=robots, threads=1).robot_info())
    for whole, fewer in (
        (infos["drafted_bolt"], infos["stiff"]),
        (infos["d_biped_0"], infos["rigid"]),
    ):
        assert [slot for slot in whole["slots"] if "HIP_ROLL" not in slot] == fewer["slots"]
        assert fewer["mass"] == pytest.approx(whole["mass"])


def test_a_grown_perceptron_moves_the_joints_as_before(made, tmp_path, monkeypatch):
    """Solo 12's teacher with Spot's joints, action scale and description."""
    monkeypatch.setenv("POLYPOD_PATH", str(ROOT / "lab" / "recipes" / "wide"))
    task = "velocity_flat_wide_teacher"
    (tmp_path / "wide.toml").write_text(f'extends = "teacher"\n[run]\ntask = "{task}"\n')
    grown.grow(made[1] / "teacher" / "model.pt", str(tmp_path / "wide.toml"), ["spot"], tmp_path / "grown.pt")
    manifest = json.loads((made[1] / "teacher" / "manifest.json").read_text())
    before = _core.VecSim(manifest["task"], 1, robots=["solo12"], threads=1)
    after = _core.VecSim(task, 1, robots=["spot"], threads=1)
    known, wanted = (numbers_of(sim, ["policy"]) for sim in (before, after))
    seen = np.random.default_rng(1).standard_normal(len(wanted)).astype(np.float32)
    scale = 0.25 / 0.2
    told = [seen[wanted.index(number)] / (scale if number[1] == "last_action" else 1.0) for number in known]
    file = torch.load(made[1] / "teacher" / "model.pt", weights_only=True)
    new = torch.load(tmp_path / "grown.pt", weights_only=True)
    policy = {**manifest["policy"], "num_obs": len(wanted)}
    old_net, new_net = load_network(file, manifest["policy"]), load_network(new, policy)
    old = NetworkPolicy(old_net, len(known))(np.array([told], dtype=np.float32))
    assert NetworkPolicy(new_net, len(wanted))(seen[None]) == pytest.approx(old * scale, rel=1e-3, abs=1e-4)
    assert float(new["actor_state_dict"]["distribution.std_param"].min()) >= growth.LEAST_STD


def test_iterations_take_the_place_of_the_plans(made, tmp_path):
    folder, _ = made
    (plan := tmp_path / "recipe").mkdir()
    for file in folder.iterdir():
        (plan / file.name).symlink_to(file)
    (plan / "plan.toml").unlink()
    (plan / "plan.toml").write_text(PLAN.replace("iterations = 1\n", "iterations = 5\n"))
    words = ("--out", str(tmp_path / "out"), "--stages", "teacher", "--iterations", "1")
    assert "model_1.pt" in lab("lab.recipe", str(plan), *words)


def test_folds_leave_each_robot_out_once(tmp_path):
    """No fold begins with a policy that saw its robots."""
    plan = recipe.read(ROOT / "lab" / "recipes" / "wide")
    folds = [stage for stage in plan.stages if stage.name in {"fold_1", "fold_2", "fold_3", "fold_4"}]
    library = {entry["name"] for entry in _core.robots()}
    assert sorted(robot for fold in folds for robot in fold.without) == sorted(library)
    for fold in folds:
        assert not fold.init
        seen = plan.robots(fold.robots, tmp_path, without=fold.without)
        with_more_legs = {*plan.groups["quadrupeds"], "phantomx"}
        assert library.intersection(seen) == with_more_legs.difference(fold.without)
        assert not [robot for robot in seen if robot.removeprefix("drafted_") in fold.without]
        words = " ".join(recipe.command(plan, fold, tmp_path, None))
        assert not [robot for robot in fold.without if f"={robot}" in words or f".{robot}=" in words]
        (longer,) = (stage for stage in plan.stages if stage.name == f"{fold.name}_longer")
        assert (longer.init, longer.without, longer.robots) == (fold.name, fold.without, fold.robots)


def test_the_recipe_of_the_bundled_policy_has_all_robots(tmp_path):
    plan = recipe.read(LEGGED)
    library = {entry["name"] for entry in _core.robots()}
    manifest = json.loads((bundled.checkpoint("legged").parent / "manifest.json").read_text())
    assert sorted(manifest["robots"]) == sorted(library) == sorted(plan.robots(plan.stages[-1].robots, tmp_path))
