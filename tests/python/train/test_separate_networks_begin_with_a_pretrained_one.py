"""`polypod adapt` begins a separate network on two legs with a bundled one, and says so."""

import json
import shutil

import pytest
import torch
from test_adapt import CONFIG, FLAGS, _core_urdf, measured
from test_trainings_end_when_robots_walk import FIGURES, bad

from polypod import adapt, bundled
from polypod.evaluation import evaluate_checkpoint
from polypod.runs import run_dir
from polypod.training import growth

__all__ = ["measured"]
SEPARATE = (*FLAGS, "--separate", "always")
BEGINS = "a separate network begins with a bundled one"


@pytest.fixture(autouse=True)
def tiny(tmp_path):
    (tmp_path / "tiny.toml").write_text(CONFIG.replace('"quick"', '"adapt_separate"'))
    shutil.copy(_core_urdf("berkeley_humanoid"), tmp_path / "my_biped.urdf")


@pytest.fixture
def pretrained(tmp_path, monkeypatch):
    """A copy of the bundled network, to change."""
    shutil.copytree(bundled.FOLDER, tmp_path / "policies")
    monkeypatch.setattr(bundled, "FOLDER", tmp_path / "policies")
    return bundled.pretrained(2)


def test_the_training_begins_with_it_and_keeps_what_is_better(cli, tmp_path, measured, monkeypatch):
    grown = {}
    start_from = adapt.session.Runner.start_from

    def watched(self, path):
        grown.update(torch.load(path, weights_only=True))
        start_from(self, path)

    monkeypatch.setattr(adapt.session.Runner, "start_from", watched)
    # the policy, what the network begins with, a measurement with its confirmation
    measured(bad(0.4), bad(0.3), FIGURES, FIGURES)
    done = cli("adapt", "my_biped.urdf", *SEPARATE)
    assert done.returncode == 0, done.stderr
    text = " ".join(done.stdout.split())
    assert f"my_biped: {BEGINS}: 0 of 1 walk; my_biped: " in text
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*_my_biped")
    assert [path.name for path in run.glob("model_*.pt")] == ["model_1.pt"]
    # the critic, too
    old = run_dir.load_checkpoint(bundled.pretrained(2))
    for network in ("actor_state_dict", "critic_state_dict"):
        assert torch.equal(grown[network]["mlp.2.weight"], old[network]["mlp.2.weight"].float())
    assert float(grown["actor_state_dict"]["distribution.std_param"].min()) >= growth.LEAST_STD


def test_a_robot_that_walks_at_once_is_not_trained(cli, tmp_path, measured):
    measured(bad(0.4), FIGURES)
    done = cli("adapt", "my_biped.urdf", *SEPARATE)
    assert done.returncode == 0, done.stderr
    text = " ".join(done.stdout.split())
    assert f"{BEGINS}: 1 of 1 walk" in text
    assert "my_biped walks without training; see it: polypod play --checkpoint logs/" in text
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*_my_biped")
    (checkpoint,) = run.glob("model_*.pt")
    manifest = run_dir.read_manifest(checkpoint)
    assert manifest["checkpoints"].keys() == {"model_0.pt"}
    assert manifest["overrides"] == ["robot_overrides.my_biped.reward_set=two_legs"]
    assert evaluate_checkpoint(checkpoint, num_envs=2, threads=1).robots.keys() == {"my_biped"}


def test_it_stays_where_no_measurement_is_better(cli, tmp_path, measured):
    measured(bad(0.4), bad(0.3), bad(0.35), bad(0.3))
    done = cli("adapt", "my_biped.urdf", *SEPARATE, "--max-minutes", "0.0001")
    assert done.returncode == 3, done.stderr
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*_my_biped")
    assert [path.name for path in run.glob("model_*.pt")] == ["model_0.pt"]
    assert "model_0.pt; go on with" in " ".join(done.stdout.split())


def test_from_scratch_begins_without(cli, tmp_path, measured):
    measured(bad(0.4), FIGURES, FIGURES)
    done = cli("adapt", "my_biped.urdf", *SEPARATE, "--from-scratch")
    assert done.returncode == 0, done.stderr
    assert "a separate network begins from scratch" in done.stdout
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*_my_biped")
    assert "--from-scratch" in json.loads((run / "manifest.json").read_text())["command"]


def test_task_observation_and_sizes_are_the_pretrained_networks(pretrained, tmp_path):
    """The learner's settings are those of the train config."""
    file = pretrained.parent / "manifest.json"
    manifest = json.loads(file.read_text())
    manifest["task"] = "Velocity-Flat-Legged-v0"
    manifest["overrides"] = ["observations.enable_noise=false", "sim.episode_length_s=3"]
    manifest["train_config"]["actor"]["hidden_dims"] = [64, 32]
    manifest["train_config"]["run"]["num_envs"] = 7
    file.write_text(json.dumps(manifest))
    options = adapt.Options("berkeley_humanoid", overrides=("train.run.num_envs=16",))
    start = adapt.Start("berkeley_humanoid", "berkeley_humanoid", [], [], bundled.checkpoint("legged"), [], {})
    _, plan = adapt._plan(options, start, tmp_path, True, pretrained)
    assert plan.config.run.task == "Velocity-Flat-Legged-v0"
    assert plan.config.actor.hidden_dims == [64, 32]
    assert plan.config.run.num_envs == 16
    assert plan.config.algorithm.desired_kl == adapt.config.load("adapt_separate").algorithm.desired_kl
    assert plan.overrides == ["observations.enable_noise=false"]


def test_other_sizes_begin_from_scratch(cli, tmp_path, measured):
    measured(bad(0.4), bad(0.4), FIGURES, FIGURES)
    words = ("adapt", "my_biped.urdf", *SEPARATE, "--set", "train.actor.hidden_dims=[32]")
    done = cli(*words)
    assert done.returncode == 2
    assert "--set train.actor.hidden_dims=[32]: the separate network begins with a bundled one" in done.stderr
    assert not list(tmp_path.glob("logs/rsl_rl/*/*"))
    assert cli(*words, "--from-scratch").returncode == 0


def test_one_without_a_critic_lets_a_new_one_learn_first(pretrained):
    state = torch.load(pretrained, weights_only=True)
    del state["critic_state_dict"]
    run_dir.save_checkpoint(pretrained, lambda file: torch.save(state, file))
    settings = adapt._own_train_config(adapt.Options("bolt"), pretrained)
    assert settings.algorithm.critic_warmup_iterations == adapt.CRITIC_WARMUP


@pytest.mark.parametrize("what", ["file", "network", "nothing"])
def test_a_broken_one_is_named_in_a_line(cli, tmp_path, measured, pretrained, what):
    if what == "file":
        pretrained.write_bytes(pretrained.read_bytes()[:-100])
        said = "model_"
    elif what == "network":
        state = torch.load(pretrained, weights_only=True)
        state["critic_state_dict"]["mlp.0.weight"] = torch.zeros(256, 7)
        run_dir.save_checkpoint(pretrained, lambda file: torch.save(state, file))
        said = "its critic is no perceptron of the observation of Velocity-Flat-Teacher-v0"
    else:
        pretrained.unlink()
        said = "the bundled network for 2 legs is not in"
    measured(bad(0.4))
    done = cli("adapt", "my_biped.urdf", *SEPARATE)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert said in done.stderr
    assert not list(tmp_path.glob("logs/rsl_rl/*/*"))


@pytest.mark.parametrize("legs", sorted(bundled.PRETRAINED))
def test_bundled_ones_hold_weights_and_no_paths(legs):
    checkpoint = bundled.pretrained(legs)
    state = torch.load(checkpoint, weights_only=True)
    assert state.keys() == {"actor_state_dict", "critic_state_dict", "iter", "infos"}
    weights = [*state["actor_state_dict"].values(), *state["critic_state_dict"].values()]
    assert checkpoint.stat().st_size <= 1.1 * sum(tensor.nbytes for tensor in weights) + 20_000
    manifest = run_dir.read_manifest(checkpoint)
    assert manifest["robot_sources"] == manifest["robots"]
    assert {len(info["legs"]) for info in manifest["robot_info"].values()} == {legs}
    text = (checkpoint.parent / "manifest.json").read_text()
    assert not [word for word in text.split('"') if word.startswith("/") and len(word) > 1]
