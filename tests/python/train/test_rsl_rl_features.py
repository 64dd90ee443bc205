"""Train configs switch on asymmetric critics, recurrent networks, RND and distillation."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

import polypod
from common import FLAT_POLICY, SHORT, SMALL_TERRAIN
from polypod.evaluation import evaluate_checkpoint
from polypod.export import export_checkpoint
from polypod.networks.policies import NetworkPolicy
from polypod.policy import load
from polypod.runs import config, run_dir
from polypod.training import session
from polypod.training.runner import Runner

CRITIC = (
    'observations.critic=[{term="base_lin_vel"}, {term="contact_friction"}, {term="feet_contact_force"}, '
    '{term="joint_pos_rel", history_length=2}]'
)
WIDTH = 3 + 2 + 4 + 24
TINY = {"num_envs": 16, "robots": ["spot", "unitree_a1"], "seed": 5, "device": "cpu", "logger": "none"}
BASE = (*SHORT, "train.run.num_steps_per_env=8", "train.actor.hidden_dims=[16]", "train.critic.hidden_dims=[16]")


def train(folder: Path, *overrides: str, iterations: int = 2, **arguments) -> Path:
    """Trains a little; returns the last checkpoint."""
    options = {**TINY, "max_iterations": iterations, "overrides": [*BASE, *overrides], **arguments}
    assert session.train(session.Options(log_dir=folder, **options)) == 0
    return run_dir.find_checkpoint(folder, "latest")


def resume(folder: Path, **arguments) -> None:
    """Goes on for one more iteration."""
    options = {"resume": "latest", "max_iterations": 1, "device": "cpu", "logger": "none", **arguments}
    assert session.train(session.Options(log_dir=folder, **options)) == 0


def test_an_asymmetric_critic(tmp_path):
    """The critic sees both groups, the policy its own; an evaluation and a resume need no more."""
    path = train(tmp_path, CRITIC, 'train.obs_groups.critic=["policy", "critic"]')
    state = run_dir.load_checkpoint(path)
    assert state["actor_state_dict"]["mlp.0.weight"].shape == (16, 48)
    assert state["critic_state_dict"]["mlp.0.weight"].shape == (16, 48 + WIDTH)
    manifest = run_dir.read_manifest(path)
    assert manifest["train_config"]["run"]["learner"] == "native"
    assert manifest["train_config"]["obs_groups"]["critic"] == ["policy", "critic"]
    assert manifest["policy"]["num_obs"] == 48
    assert evaluate_checkpoint(path, num_envs=4, steps=5, threads=1).robots.keys() == {"spot", "unitree_a1"}


def test_an_asymmetric_critic_resumes_bit_for_bit(tmp_path):
    overrides = (CRITIC, 'train.obs_groups.critic=["policy", "critic"]', "train.critic.obs_normalization=true")
    whole = run_dir.load_checkpoint(train(tmp_path / "whole", *overrides, iterations=3))
    train(tmp_path / "parts", *overrides, iterations=2)
    resume(tmp_path / "parts")
    parts = run_dir.load_checkpoint(run_dir.find_checkpoint(tmp_path / "parts", "latest"))
    for network in ("actor_state_dict", "critic_state_dict"):
        for key, value in whole[network].items():
            assert torch.equal(value, parts[network][key]), key


def test_mirror_images_of_all_groups(tmp_path):
    path = train(tmp_path, CRITIC, 'train.obs_groups.critic=["policy", "critic"]', "train.run.symmetry=true")
    assert path.exists()


def test_the_shipped_config_teaches_a_network_of_joints(tmp_path):
    """By the bundled perceptron, which goes by its name."""
    sizes = ("num_envs=16", "num_steps_per_env=4", "actor.joint_dim=8", "actor.num_heads=4", "actor.hidden_dims=[16]")
    changes = [f"train.{'' if text.startswith('actor') else 'run.'}{text}" for text in sizes]
    overrides = [*changes, "train.distillation.gradient_length=2", "sim.episode_length_s=0.4"]
    robots = ["unitree_go2", "spot"]
    options = session.Options(
        log_dir=tmp_path,
        train_config="flat_joints_taught",
        robots=robots,
        max_iterations=1,
        overrides=overrides,
        logger="none",
        device="cpu",
    )
    assert session.train(options) == 0
    checkpoint = run_dir.find_checkpoint(tmp_path, "latest")
    manifest = run_dir.read_manifest(checkpoint)
    assert manifest["policy"]["class_name"] == "polypod.networks:UrmaModel"
    assert Path(manifest["train_config"]["distillation"]["teacher"]).name == FLAT_POLICY.name
    assert list(evaluate_checkpoint(checkpoint, num_envs=2, steps=5).robots) == robots


def test_a_network_of_joints_remembers_and_acts_for_any_bodies(tmp_path, capsys):
    options = session.Options(
        log_dir=tmp_path,
        **TINY,
        train_config="flat_joints",
        max_iterations=1,
        overrides=["observations.policy.joint_pos_rel.history_length=3", "train.run.symmetry=false"],
    )
    assert session.train(options) == 0
    checkpoint = run_dir.find_checkpoint(tmp_path, "latest")
    layout = run_dir.read_manifest(checkpoint)["policy"]["observation_layout"]
    assert {entry["term"]: entry.get("history_length", 1) for entry in layout}["joint_pos_rel"] == 3
    assert export_checkpoint(checkpoint, tmp_path / "exported").difference <= 1e-5
    # bodies with slots that the training had not: the same weights act, and learn together with the
    # critic, to which most numbers are new
    others = {"task": "velocity_flat_legged_joints", "robots": ["phantomx", "unitree_g1"]}
    evaluation = evaluate_checkpoint(checkpoint, num_envs=2, steps=5, **others)
    assert list(evaluation.robots) == others["robots"]
    capsys.readouterr()
    assert session.train(dataclasses.replace(options, **others, init=checkpoint, log_dir=tmp_path / "more")) == 0
    assert "numbers; the others are new to it" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("kind", ["gru", "lstm"])
def test_recurrent_networks(tmp_path, kind, cli):
    recurrent = [
        f"train.{network}.{key}"
        for network in ("actor", "critic")
        for key in ("class_name=RNNModel", f"rnn_type={kind}", "rnn_hidden_dim=12", "rnn_num_layers=1")
    ]
    path = train(tmp_path, *recurrent)
    manifest = run_dir.read_manifest(path)
    assert manifest["policy"]["rnn_type"] == kind
    first, again = (evaluate_checkpoint(path, num_envs=4, steps=20, threads=1) for _ in range(2))
    assert first.robots == again.robots, "an evaluation begins without memories"
    assert cli("play", "--checkpoint", str(path), "--headless", "--seconds", "0.5").returncode == 0


def test_a_recurrent_policy_forgets_at_the_end_of_episodes(tmp_path):
    recurrent = ("class_name=RNNModel", "rnn_type=gru", "rnn_hidden_dim=12", "rnn_num_layers=1")
    path = train(tmp_path, *(f"train.actor.{key}" for key in recurrent), iterations=1)
    policy = load(path).runner()
    assert isinstance(policy, NetworkPolicy)
    rows = np.random.default_rng(0).standard_normal((2, 48), dtype=np.float32)
    first = policy(rows)
    second = policy(rows)
    assert not np.allclose(first, second), "it remembers"
    policy.reset(np.array([True, False]))
    third = policy(rows)
    np.testing.assert_array_equal(third[0], first[0])
    assert not np.allclose(third[1], first[1])


def test_random_network_distillation(tmp_path):
    path = train(tmp_path, "train.rnd={weight=10.0, predictor_hidden_dims=[8], target_hidden_dims=[8]}")
    assert "rnd_state_dict" in run_dir.load_checkpoint(path)
    resume(tmp_path)


def terms(*names: str) -> str:
    """A group of these terms in TOML."""
    return f"[{', '.join(f'{{term = {name!r}}}' for name in names)}]"


def test_a_student_learns_what_its_teacher_does(tmp_path, monkeypatch):
    """The teacher saw velocities.

    The student, with a memory of what its sensors say, comes near to it.
    """
    teacher = train(tmp_path / "teacher", iterations=1)
    sensed = ("base_ang_vel", "projected_gravity", "velocity_commands", "joint_pos_rel", "joint_vel_rel", "last_action")
    whole, student = (terms("base_lin_vel", *sensed), terms(*sensed))
    losses = []

    def recorded(self, observations):
        loss = original(self, observations)
        losses.append(loss["behavior"])
        return loss

    original = Runner._update
    monkeypatch.setattr(Runner, "_update", recorded)
    path = train(
        tmp_path / "student",
        f"observations.teacher={whole}",
        f"observations.policy={student}",
        f'train.distillation={{teacher="{teacher}", gradient_length=4}}',
        "train.algorithm.num_learning_epochs=4",
        iterations=10,
    )
    assert losses[-1] < 0.5 * losses[0]
    assert run_dir.read_manifest(path)["policy"]["num_obs"] == 45
    assert evaluate_checkpoint(path, num_envs=4, steps=5, threads=1).robots
    resume(tmp_path / "student")


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (['train.obs_groups.critic=["policy", "critc"]', CRITIC], "has no group 'critc', but policy, critic"),
        (['train.obs_groups.critic=["policy", "policy"]'], "must name groups, each once"),
        (["train.obs_groups.critic=[]"], "must name groups"),
        (['train.obs_groups.actor=["critic"]'], "a policy sees the group policy alone"),
        (["train.actor.class_name=RNNModel"], "rnn_type is missing"),
        (["train.actor.rnn_type=gru"], "rnn_type is of recurrent networks"),
        (["train.rnd={weight=0.0}"], "must be from 1e-12"),
        (["train.rnd={wait=1.0}"], "unknown key 'wait'; did you mean 'weight'"),
        (['train.distillation={teacher="none.pt", gradient_length=4}'], "has no group 'teacher', but policy; add"),
        (['train.distillation={teacher="none.pt", loss_type="l1"}'], "not one of mse, huber"),
    ],
)
def test_mistakes_are_named(overrides, said, tmp_path):
    options = session.Options(log_dir=tmp_path, **TINY, max_iterations=1, overrides=[*BASE, *overrides])
    with pytest.raises(polypod.ConfigError, match=said):
        session.train(options)
    assert not list(tmp_path.glob("rsl_rl/*/*"))


@pytest.mark.parametrize(
    "override",
    ["rnd={weight=1.0}", 'distillation={teacher="x.pt"}'],
)
def test_the_native_learner_says_what_it_does_not_do(override):
    loaded = config.load("flat", [override])
    assert loaded.with_learner_resolved("auto").run.learner == "rsl_rl"
    with pytest.raises(polypod.ConfigError, match="the native learner"):
        loaded.with_learner_resolved("native")


@pytest.mark.parametrize(
    ("name", "numbers", "overrides"),
    [("rough_blind", 5 * (6 + 36) + 3 + 35, SMALL_TERRAIN), ("flat_asymmetric", 5 * (9 + 36) + 3 + 35, ())],
)
def test_the_configs_that_come_along_train(tmp_path, name, numbers, overrides):
    """A student of the bundled rough policy, and an asymmetric critic with a history."""
    small = ("train.run.num_steps_per_env=8", "train.actor.hidden_dims=[16]", "train.critic.hidden_dims=[16]")
    options = {**TINY, "train_config": name, "max_iterations": 1, "overrides": [*SHORT, *small, *overrides]}
    assert session.train(session.Options(log_dir=tmp_path, **options)) == 0
    path = run_dir.find_checkpoint(tmp_path, "latest")
    assert run_dir.read_manifest(path)["policy"]["num_obs"] == numbers
