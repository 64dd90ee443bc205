"""`polypod adapt` makes a policy walk with a robot; its memory, messages and results."""

import dataclasses
import json
import math
import shutil
import signal

import numpy as np
import pytest
import torch
from test_trainings_end_when_robots_walk import FIGURES, bad

from common import MASKED_POLICY, ROOT
from polypod import _core, adapt, bundled
from polypod.compat import tomllib
from polypod.networks.transfer import numbers_of, perceptron_for
from polypod.runs import config, run_dir
from polypod.training import goal, session
from polypod.training.workers import Workers

CONFIG = """
extends = "quick"
[run]
num_envs = 16
num_steps_per_env = 4
max_iterations = 100000
save_interval = 100000
symmetry = false
"""
LEGGED = bundled.checkpoint("legged")
FLAGS = ("--train-config", "tiny.toml", "--threads", "1", "--device", "cpu", "--every", "1")


@pytest.fixture(autouse=True)
def tiny(tmp_path):
    (tmp_path / "tiny.toml").write_text(CONFIG)


@pytest.fixture
def measured(monkeypatch):
    """Lets measurements give figures, one after the other: first those before the training."""

    def give(*figures):
        given = iter(figures)

        class Evaluation:
            def __init__(self, robots):
                self.robots = robots

        class Robot:
            def __init__(self, walking):
                self.walking = walking

        def evaluate(checkpoint, robots=None, **arguments):
            names = robots or run_dir.read_manifest(checkpoint)["robots"]
            return Evaluation({name.rpartition("/")[2].removesuffix(".toml"): Robot(next(given)) for name in names})

        monkeypatch.setattr(adapt, "evaluate_checkpoint", evaluate)
        monkeypatch.setattr(goal, "evaluate_checkpoint", evaluate)

    return give


def test_a_robot_that_walks_needs_no_training(cli, tmp_path, measured):
    measured(FIGURES)
    done = cli("adapt", "unitree_go1", "--checkpoint", "flat", *FLAGS)
    assert done.returncode == 0, done.stderr
    assert "unitree_go1 walks without training" in done.stdout
    assert not list(tmp_path.glob("logs/rsl_rl/*/*"))


def test_a_robot_on_four_legs_may_walk_with_the_policy_of_all_legs(cli, tmp_path, measured):
    measured(bad(0.4), FIGURES)
    done = cli("adapt", "unitree_go1", *FLAGS)
    assert done.returncode == 0, done.stderr
    assert "unitree_go1 walks without training; see it: polypod play --checkpoint legged" in " ".join(
        done.stdout.split()
    )
    assert not list(tmp_path.glob("logs/rsl_rl/*/*"))


def test_it_trains_until_the_robot_walks(cli, tmp_path, measured):
    # before; two measurements, the second with its confirmation
    measured(bad(0.4), bad(0.3), FIGURES, FIGURES)
    done = cli("adapt", "unitree_go1", "--checkpoint", "flat", *FLAGS)
    assert done.returncode == 0, done.stderr
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*_unitree_go1")
    assert [path.name for path in run.glob("model_*.pt")] == ["model_2.pt"]
    text = " ".join(done.stdout.split())
    assert "iteration 1, 0.00 million samples" in text
    assert text.count("unitree_go1, before") == text.count("unitree_go1, after") == 1
    assert "walks after" in text
    manifest = json.loads((run / "manifest.json").read_text())
    assert manifest["command"].startswith("polypod adapt unitree_go1 --checkpoint flat")
    assert manifest["robots"] == ["unitree_go1"]
    # networks and task are the policy's, the rest is the train config's
    of_policy = run_dir.read_manifest(bundled.checkpoint("flat"))
    assert manifest["task"] == of_policy["task"]
    assert manifest["train_config"]["actor"] == of_policy["train_config"]["actor"]
    assert manifest["train_config"]["run"]["num_envs"] == 16


def test_it_returns_3_with_the_best_policy_when_the_time_is_over(cli, tmp_path, measured):
    measured(bad(0.4), bad(0.3), bad(0.3))
    done = cli("adapt", "unitree_go1", "--checkpoint", "flat", *FLAGS, "--max-minutes", "0.0001")
    assert done.returncode == 3, done.stderr
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*")
    (best,) = run.glob("model_*.pt")
    text = " ".join(done.stdout.split())
    assert "it does not walk after" in text
    assert f"polypod adapt unitree_go1 --checkpoint {best.relative_to(tmp_path)}" in text
    # a learner that it names goes on
    measured(FIGURES)
    assert cli("adapt", "unitree_go1", "--checkpoint", str(best), *FLAGS).returncode == 0


def test_an_interrupt_keeps_what_there_is(cli, tmp_path, measured, monkeypatch):
    """A signal comes during the second measurement; the first one was better."""
    measured(bad(0.4), bad(0.3), bad(0.35))
    measure = goal.UntilWalks._measure

    def interrupted(self, path, seed):
        if path.name == "model_2.pt":
            signal.raise_signal(signal.SIGTERM)
        return measure(self, path, seed)

    monkeypatch.setattr(goal.UntilWalks, "_measure", interrupted)
    done = cli("adapt", "unitree_go1", "--checkpoint", "flat", *FLAGS)
    assert done.returncode == 143, done.stderr
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*")
    assert [path.name for path in run.glob("model_*.pt")] == ["model_1.pt"]
    text = " ".join(done.stdout.split())
    assert "unitree_go1, after" in text
    assert "unitree_go1: interrupted after" in text
    assert "model_1.pt" in text


def test_a_urdf_is_drafted_beside_the_run_and_rewarded_like_the_robot_most_like_it(cli, tmp_path, measured):
    shutil.copy(_core_urdf("solo12"), tmp_path / "My-Dog.urdf")
    # with quadruped, with legged, and after the training
    measured(bad(0.4), bad(0.4), FIGURES, FIGURES)
    done = cli("adapt", "My-Dog.urdf", *FLAGS)
    assert done.returncode == 0, done.stderr
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*_my_dog")
    assert (run / "robot" / "my_dog.toml").is_file()
    manifest = json.loads((run / "manifest.json").read_text())
    assert manifest["robots"] == ["my_dog"]
    # four legs: begun with the policy of joints, whose task has one set for quadrupeds of all
    # weights
    assert manifest["policy"]["class_name"] == "polypod.networks:UrmaModel"
    resolved = tomllib.loads((run / "params" / "env.toml").read_text())
    assert resolved["robots"]["my_dog"]["reward_set"] == "quadruped"
    assert "its description is" in done.stdout


def _core_urdf(robot):

    return ROOT / "assets" / "robots" / robot / "robot.urdf"


def test_a_perceptron_of_many_bodies_learns_one_of_them_and_keeps_its_columns(cli, tmp_path, measured):
    measured(bad(0.4), FIGURES, FIGURES)
    done = cli("adapt", "unitree_h1", "--checkpoint", str(MASKED_POLICY), *FLAGS)
    assert done.returncode == 0, done.stderr
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*")
    (checkpoint,) = run.glob("model_*.pt")
    of_policy, manifest = run_dir.read_manifest(MASKED_POLICY), run_dir.read_manifest(checkpoint)
    assert manifest["robots"] == ["unitree_h1"]
    for key in ("canonical_joint_names", "observation_layout"):
        assert manifest[key] == of_policy[key]
    weights = [run_dir.load_checkpoint(path)["actor_state_dict"] for path in (MASKED_POLICY, checkpoint)]
    assert all(bool(torch.isfinite(value.float()).all()) for value in weights[1].values())
    first = "mlp.0.weight"
    changed = (weights[0][first] != weights[1][first]).any(dim=0)
    # weights of other bodies' joints are as they were
    assert 0 < int(changed.sum()) < len(changed)
    # and the run goes on
    resumed = session.Options(resume=str(run), max_iterations=1, logger="none", device="cpu", threads=1)
    _, runner = session.train_with(resumed, Workers.alone())
    assert runner.current_learning_iteration == 2


def test_a_robot_on_two_legs_may_walk_with_the_policy_of_strangers(cli, tmp_path, measured):
    measured(bad(0.4), bad(0.4), FIGURES)
    done = cli("adapt", "unitree_h1", *FLAGS)
    assert done.returncode == 0, done.stderr
    text = " ".join(done.stdout.split())
    assert "unitree_h1 walks without training; see it: polypod play --checkpoint two_legs" in text
    assert not list(tmp_path.glob("logs/rsl_rl/*/*"))


def test_a_robot_on_two_legs_begins_with_the_policy_of_all_legs(cli, tmp_path, measured):
    """A student has no critic: a new one learns first."""
    measured(bad(0.4), bad(0.4), bad(0.4), FIGURES, FIGURES)  # 16 envs first, then that of strangers
    noise = "observations.enable_noise=true"
    done = cli("adapt", "unitree_h1", *FLAGS, "--set", noise)
    assert done.returncode == 0, done.stderr
    assert "begins with legged" in done.stdout
    assert "it has no critic; a new one learns" in " ".join(done.stdout.split())
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*")
    (checkpoint,) = run.glob("model_*.pt")
    manifest = run_dir.read_manifest(checkpoint)
    assert manifest["policy"]["hidden_dims"] == [512, 256, 128]
    assert "distillation" not in manifest["train_config"]
    # the new critic learns first; the policy, which was taught with good sensors, is as it was
    assert manifest["train_config"]["algorithm"]["critic_warmup_iterations"] == adapt.CRITIC_WARMUP
    # the later one of two changes of a key counts: the given one
    overrides = manifest["overrides"]
    assert overrides.index(adapt.NO_NOISE) < overrides.index(noise)
    own, other = (run_dir.load_checkpoint(path)["actor_state_dict"] for path in (checkpoint, LEGGED))
    assert all(torch.equal(own[key], other[key]) for key in own if "moments" not in key)
    assert "critic_state_dict" in run_dir.load_checkpoint(checkpoint)


def test_neighbours_that_walked_have_to_walk_at_the_end(cli, tmp_path, measured):
    # the robot does not walk, of two neighbours one does; the robot walks and the neighbour has
    # forgotten; both walk
    before = (bad(0.4), FIGURES, bad(0.4))
    forgotten, done_ = (FIGURES, bad(0.4), bad(0.4)), (FIGURES, FIGURES, bad(0.4))
    measured(*before, *forgotten, *done_, *done_)
    done = cli("adapt", "unitree_go1", "--checkpoint", "quadruped", *FLAGS, "--neighbours", "2")
    assert done.returncode == 0, done.stderr
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*")
    assert (run / "model_2.pt").exists()
    robots = json.loads((run / "manifest.json").read_text())["robots"]
    assert robots[:2] == ["unitree_go1", "unitree_go2"]
    assert len(robots) == 3
    # the robot has the envs of both, in the training alone
    manifest = json.loads((run / "manifest.json").read_text())
    assert manifest["train_config"]["run"]["task_changes"][-1] == "env_shares.unitree_go1=2"
    assert not [change for change in manifest["overrides"] if change.startswith("env_shares")]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nobody",), "nobody"),
        (("nothing.urdf",), "nothing.urdf"),
        (("unitree_go1", "--neighbours", "-1"), "--neighbours -1 must be from 0 to 1000"),
        (("unitree_go1", "--max-minutes", "0"), "--max-minutes 0"),
        (("unitree_go1", "--max-minutes", "nan"), "--max-minutes nan"),
        (("unitree_go1", "--every", "0"), "--every 0 must be at least 1"),
        (("unitree_go1", "--lock", "a=0"), "--lock is of a URDF"),
        (("unitree_go1", "--train-config", "nothing"), "nothing"),
        (("unitree_go1", "--checkpoint", "nothing.pt"), "nothing.pt"),
        (("unitree_h1", "--checkpoint", "flat", *FLAGS), "twelve joints"),
        (("unitree_go1", "--separate", "always", "--neighbours", "1", *FLAGS), "--neighbours"),
        (("unitree_h1", "--from-scratch", "--checkpoint", "legged", *FLAGS), "--from-scratch is of a separate network"),
    ],
    ids=lambda value: " ".join(value[:3]) if isinstance(value, tuple) else "",
)
def test_mistakes_are_named_and_leave_nothing(cli, tmp_path, arguments, said):
    done = cli("adapt", *arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert said in done.stderr
    assert not list(tmp_path.glob("logs/rsl_rl/*/*"))


def test_the_settings_are_a_train_config_of_its_own():
    settings = config.load(adapt.TRAIN_CONFIG)
    assert settings.run.task == "velocity_flat_any_legged"
    assert settings.run.num_envs * settings.run.num_steps_per_env <= 10_000
    on_gpu, separate = config.load(adapt.ON_GPU), config.load(adapt.SEPARATE)
    assert on_gpu.run.num_envs > settings.run.num_envs
    # a separate network has its own task and sizes
    assert separate.actor.class_name == "MLPModel"
    assert separate.run.task == "velocity_flat_teacher"


AT_ONCE = {"fall_rate": 1.0, "turn_reached": math.nan, "drift_xy": math.nan}
LATER = {"fall_rate": 1.0, "turn_reached": 0.9, "drift_xy": math.nan}
"""Figures of robots that fall within a second, and when they are told to step aside."""


def test_a_policy_that_falls_at_once_gives_way_to_a_separate_network(cli, tmp_path, measured, monkeypatch):
    falls = dataclasses.replace(bad(0.4), **AT_ONCE)
    # with a GPU; without one the policy goes on
    monkeypatch.setattr(adapt, "_has_gpu", lambda options: True)
    measured(falls, falls, FIGURES, FIGURES)
    (tmp_path / "tiny.toml").write_text(CONFIG.replace('"quick"', '"teacher"'))
    done = cli("adapt", "unitree_h1", *FLAGS, "--from-scratch")
    assert done.returncode == 0, done.stderr
    assert "a separate network begins from scratch" in done.stdout
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*")
    (checkpoint,) = run.glob("model_*.pt")
    manifest = run_dir.read_manifest(checkpoint)
    assert manifest["policy"]["class_name"] == "MLPModel"
    assert manifest["task"] == "Velocity-Flat-Teacher-v0"
    assert manifest["overrides"] == []


@pytest.mark.parametrize(("robot", "own_set"), [("berkeley_humanoid", "two_legs"), ("bolt", "two_points")])
def test_a_separate_network_on_two_legs_is_paid_in_units_of_the_body(cli, tmp_path, measured, robot, own_set):
    """A draft has no set of its task, and the nearest robot's may be for ten times its weight."""
    shutil.copy(_core_urdf(robot), tmp_path / "my_biped.urdf")
    measured(bad(0.4), FIGURES, FIGURES)
    (tmp_path / "tiny.toml").write_text(CONFIG.replace('"quick"', '"adapt_separate"'))
    done = cli("adapt", "my_biped.urdf", "--separate", "always", "--from-scratch", *FLAGS)
    assert done.returncode == 0, done.stderr
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*_my_biped")
    resolved = tomllib.loads((run / "params" / "env.toml").read_text())
    assert resolved["robots"]["my_biped"]["reward_set"] == own_set
    # the changes of the train config count in the training alone
    assert resolved["task"]["rewards"]["two_legs"]["scaled_torques_l2"]["weight"] == -1.0
    assert json.loads((run / "manifest.json").read_text())["overrides"] == [
        f"robot_overrides.my_biped.reward_set={own_set}"
    ]


def test_a_separate_network_that_is_not_finished_is_named_and_goes_on(cli, tmp_path, measured, monkeypatch):
    falls = dataclasses.replace(bad(0.4), **AT_ONCE)
    monkeypatch.setattr(adapt, "_has_gpu", lambda options: True)
    # no measurement beats the policy: of 16 envs, of strangers' policy, of what the network begins
    # with, of the training
    measured(falls, falls, falls, falls, falls)
    (tmp_path / "tiny.toml").write_text(CONFIG.replace('"quick"', '"teacher"'))
    done = cli("adapt", "unitree_h1", *FLAGS, "--max-minutes", "0.0001")
    assert done.returncode == 3, done.stderr
    (run,) = tmp_path.glob("logs/rsl_rl/adapt/*")
    (unfinished,) = run.glob("model_*.pt")
    text = " ".join(done.stdout.split())
    assert "The best policy is legged; the separate network does not beat it yet" in text
    model = unfinished.relative_to(tmp_path)
    go_on = f"polypod adapt unitree_h1 --checkpoint {model} --train-config adapt_separate"
    assert text.endswith(go_on)
    # as the command says, but for the size of the training
    measured(falls, FIGURES, FIGURES)
    words = go_on.split()[1:-2]
    done = cli(*words, *FLAGS)
    assert done.returncode == 0, done.stderr
    assert f"begins with {model}" in " ".join(done.stdout.split())


def test_a_network_that_goes_on_keeps_its_reward_set():
    """A set in units of the body gives way to no other robot's."""
    own = "robot_overrides.my_biped.reward_set=two_legs"
    manifest = {"task": "velocity_flat_teacher", "overrides": [own]}
    arguments = ("folder/my_biped.toml", "my_biped", ["unitree_h1"], ["sim.dt=0.005"])
    assert adapt._changes(manifest, *arguments) == [own, "sim.dt=0.005"]
    assert adapt._changes({**manifest, "overrides": []}, *arguments)[0] == own.replace("two_legs", "h1")


@pytest.mark.parametrize(
    ("options", "has_gpu", "falls", "begins"),
    [
        ({}, True, AT_ONCE, True),
        ({}, True, LATER, False),
        ({}, True, {}, False),
        # without a GPU robots on two legs alone
        ({}, False, AT_ONCE, False),
        ({"robot": "bolt"}, False, AT_ONCE, True),
        ({"robot": "bolt"}, False, LATER, False),
        ({"neighbours": 1}, True, AT_ONCE, False),
        ({"checkpoint": LEGGED}, True, AT_ONCE, False),
        ({"checkpoint": LEGGED, "separate": "always"}, True, AT_ONCE, True),
        ({"separate": "always"}, False, {}, True),
        ({"separate": "never"}, True, AT_ONCE, False),
    ],
)
def test_when_a_separate_network_begins(monkeypatch, options, has_gpu, falls, begins):
    monkeypatch.setattr(adapt, "_has_gpu", lambda options: has_gpu)
    before, given = dataclasses.replace(FIGURES, **falls), {"robot": "spot", **options}
    assert adapt._is_separate(adapt.Options(**given), given["robot"], before) is begins


@pytest.mark.parametrize(
    ("robot", "has_gpu", "falls", "counts"),
    [
        ("spot", True, AT_ONCE, [16, 64]),
        ("spot", True, LATER, [16, 64, 64]),
        ("unitree_h1", True, {}, [16, 64]),
        ("unitree_h1", False, AT_ONCE, [16, 64]),
        ("spot", False, AT_ONCE, [64, 64]),
    ],
)
def test_a_policy_that_falls_at_once_is_measured_no_further(monkeypatch, tmp_path, robot, has_gpu, falls, counts):
    """The separate network needs the time more."""
    found = []

    def measured(checkpoint, robots, changes, options, envs_per_robot=64):
        found.append(envs_per_robot)
        return {robot: dataclasses.replace(FIGURES, **falls)}

    monkeypatch.setattr(adapt, "_has_gpu", lambda options: has_gpu)
    monkeypatch.setattr(adapt, "_measured", measured)
    adapt._start(adapt.Options(robot), tmp_path, adapt.Progress())
    assert found == counts


def test_the_first_look_takes_one_thread(monkeypatch, tmp_path):
    """On a busy machine a small batch waits long for the threads of torch."""
    found = {}

    def evaluated(checkpoint, robots, *, num_envs, **arguments):
        found[num_envs] = torch.get_num_threads()
        return evaluation({})

    evaluation = dataclasses.make_dataclass("Evaluation", ["robots"])
    monkeypatch.setattr(adapt, "evaluate_checkpoint", evaluated)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        for count in (adapt.GLANCE, adapt.ENVS_PER_ROBOT):
            adapt._measured(LEGGED, ["bolt"], [], adapt.Options("bolt"), count)
        assert found == {adapt.GLANCE: 1, adapt.ENVS_PER_ROBOT: 2}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)


def test_the_kernels_of_a_card_are_made_with_one_robot():
    """Here by the CPU, whose engine takes the same options."""
    sim = adapt._smallest("articulated")
    assert (sim.num_envs, len(sim.robots), sim.device_arrays()) == (1, 1, None)


def test_a_critic_goes_on_for_another_body():
    """The critic of ANYmal B without and with an arm.

    Shared numbers keep their weights, new ones begin with zeros.
    """
    groups = ["policy", "critic"]
    sims = [
        _core.VecSim("velocity_flat_any_legged", 1, robots=[robot], threads=1)
        for robot in ("anymal_b", "anymal_b_kinova")
    ]
    of, wanted = (numbers_of(sim, groups) for sim in sims)
    assert len(set(of)) == len(of) == sum(sims[0].observation_of(group).shape[1] for group in groups)
    assert set(of) < set(wanted)

    def network(width):
        torch.manual_seed(0)
        layers = torch.nn.Sequential(torch.nn.Linear(width, 4), torch.nn.ELU(), torch.nn.Linear(4, 1))
        state = {f"mlp.{key}": value for key, value in layers.state_dict().items()}
        moments = {f"obs_normalizer.{key}": torch.rand(1, width) + 0.5 for key in ("_mean", "_var", "_std")}
        return {**state, **moments}

    old, own = network(len(of)), network(len(wanted))
    moved = perceptron_for(old, of, own, wanted)
    values = dict(zip(wanted, np.random.default_rng(0).standard_normal(len(wanted)), strict=True))

    def value(state, numbers):
        x = torch.tensor([values[number] for number in numbers], dtype=torch.float32)
        x = (x - state["obs_normalizer._mean"]) / state["obs_normalizer._std"]
        hidden = torch.nn.functional.elu(x @ state["mlp.0.weight"].T + state["mlp.0.bias"])
        return float(hidden @ state["mlp.2.weight"].T + state["mlp.2.bias"])

    assert value(moved, wanted) == pytest.approx(value(old, of), rel=1e-4)
    # networks of other sizes start again
    assert perceptron_for({**old, "mlp.2.weight": torch.zeros(1, 5)}, of, own, wanted) is None
