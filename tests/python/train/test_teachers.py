"""A student learns from teachers of other robots, slots and terms than its own."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

import polypod
from common import SHORT
from polypod import policy
from polypod.evaluation import evaluate_checkpoint
from polypod.rsl_rl import VecEnv
from polypod.runs import run_dir
from polypod.training import session
from polypod.training.runner import Runner
from polypod.training.taught_runner import TaughtRunner
from polypod.training.teachers import Teachers

SENSED = ("base_ang_vel", "projected_gravity", "velocity_commands", "joint_pos_rel", "joint_vel_rel", "last_action")
STUDENT = [*({"term": term, "history_length": 2} for term in SENSED), {"term": "joint_descriptors"}]
TEACHER = [
    *({"term": term, "history_length": 5} for term in SENSED if term != "velocity_commands"),
    {"term": "joint_descriptors"},
    {"term": "velocity_commands"},
    {"term": "base_lin_vel"},
]
"""All that the teachers read, in another order."""
TASK = "velocity_flat_any_legged"
ROBOTS = ["unitree_go2", "phantomx", "solo12"]
OPTIONS = {"seed": 5, "device": "cpu", "logger": "none"}
STILL = ["observations.enable_noise=false"]


def terms(entries) -> str:
    """A group of terms in TOML."""
    return "[" + ", ".join(f"{{{', '.join(f'{k}={json.dumps(v)}' for k, v in of.items())}}}" for of in entries) + "]"


GROUPS = [f"observations.policy={terms(STUDENT)}", f"observations.teacher={terms(TEACHER)}"]


@pytest.fixture(scope="module")
def specialist(tmp_path_factory) -> Path:
    """A perceptron of the hexapod, which reads the base's velocity."""
    folder = tmp_path_factory.mktemp("specialist")
    options = session.Options(
        **OPTIONS,
        log_dir=folder,
        task="velocity_flat_legged",
        robots=["phantomx"],
        num_envs=8,
        max_iterations=1,
        train_config="specialist",
        overrides=[*SHORT, "train.run.num_steps_per_env=8", "train.actor.hidden_dims=[16]"],
    )
    session.train(options)
    return run_dir.find_checkpoint(folder, "latest")


def paths(specialist: Path) -> dict[str, str]:
    bundled = polypod.runs.resolve(Path("quadruped"))
    return {"phantomx": str(specialist), "*": str(bundled)}


def test_labels_are_what_each_teacher_does_in_its_own_task(specialist):
    """Three bodies move past the end of their episodes, and all labels agree."""
    env = polypod.make(TASK, 7, robots=ROBOTS, seed=3, threads=1, overrides=[*GROUPS, *STILL], autoreset="same_step")
    vec = VecEnv(env, "cpu")
    teachers = Teachers(env.sim, ["teacher"], paths(specialist), "cpu")
    rng = np.random.default_rng(0)
    own = {}
    for robot in ROBOTS:
        path = paths(specialist).get(robot, paths(specialist)["*"])
        loaded = policy.load(path, robots=[robot] if robot != "phantomx" else None)
        own[robot] = (loaded, np.zeros((0,)))
    for step in range(12):
        observations = vec.get_observations()
        labels = teachers(observations).numpy()
        assert labels.shape == (7, env.sim.num_actions)
        assert not labels[~env.sim.action_mask].any()
        for robot in ROBOTS:
            start, stop = env.sim.env_ids(robot)
            wanted = expected(own[robot][0], robot, env.sim, observations["teacher"][start:stop].numpy())
            columns = json.loads(env.sim.robot_info())[robot]["columns"]
            assert np.abs(labels[start:stop][:, columns] - wanted).max() <= 1e-5, (robot, step)
            assert np.abs(wanted).max() > 0.05
        vec.step(torch.from_numpy(rng.normal(0.0, 0.5, (7, env.sim.num_actions)).astype(np.float32)))


def test_a_teacher_holds_the_joints_that_it_never_had():
    """The arm stays at its default pose, and the legs do what they do without an arm."""
    robots = ["anymal_b_kinova", "anymal_b"]
    changes = [*GROUPS, *STILL]
    env = polypod.make(TASK, 4, robots=robots, seed=3, threads=1, overrides=changes, autoreset="same_step")
    vec = VecEnv(env, "cpu")
    path = {"*": str(polypod.runs.resolve(Path("quadruped")))}
    holds, sees = (Teachers(env.sim, ["teacher"], path, "cpu", holds=holds) for holds in (True, False))
    loaded = policy.load(Path("quadruped"), robots=["anymal_b"])
    columns = json.loads(env.sim.robot_info())["anymal_b"]["columns"]
    arm = np.array([slot.startswith("ARM_") for slot in env.sim.canonical_joint_names])
    rng = np.random.default_rng(0)
    for _ in range(4):
        observations = vec.get_observations()
        held, seen = holds(observations).numpy(), sees(observations).numpy()
        assert not held[:, arm].any()
        assert np.abs(seen[:2, arm]).max() > 0.05
        wanted = expected(loaded, "anymal_b", env.sim, observations["teacher"].numpy())
        assert np.abs(held[:, columns] - wanted).max() <= 1e-5
        vec.step(torch.from_numpy(rng.normal(0.0, 0.5, (4, env.sim.num_actions)).astype(np.float32)))


def expected(loaded, robot, student, seen) -> np.ndarray:
    """Actions of a policy's own `act` for its observation, written out term by term."""
    slots, mine = student.canonical_joint_names, loaded.joint_names
    blocks, start = {}, 0
    for entry in TEACHER:
        history = entry.get("history_length", 1)
        size = next(size for term, size in group_sizes(student) if term == entry["term"])
        blocks[entry["term"]] = (seen[:, start : start + size], history)
        start += size
    rows = []
    for entry in loaded.manifest["observation_layout"]:
        block, history = blocks[entry["term"]]
        if block.shape[1] % len(slots) == 0:
            numbers = block.reshape(len(block), -1, len(slots))
            full = np.zeros((len(block), numbers.shape[1], len(mine)), np.float32)
            for column, slot in enumerate(mine):
                if slot in slots:
                    full[:, :, column] = numbers[:, :, slots.index(slot)]
            block = full.reshape(len(block), -1)
        rows.append(block[:, -entry["size"] :])  # the latest control steps
    actions = loaded.act(np.concatenate(rows, axis=1))
    info = json.loads(student.robot_info())[robot]
    return actions[:, [mine.index(slot) for slot in info["slots"]]]


def group_sizes(sim):
    return [(term["term"], term["size"]) for term in json.loads(sim.observation_terms("teacher"))]


def options_of(specialist, folder, changes, distillation, **options):
    """Options of a training of a student of `ROBOTS`; `distillation` are keys of its section."""
    named = ", ".join(f"{json.dumps(robot)}={json.dumps(path)}" for robot, path in paths(specialist).items())
    return session.Options(
        **OPTIONS,
        **options,
        log_dir=folder,
        task=TASK,
        robots=ROBOTS,
        train_config="any_legged",
        overrides=[
            *GROUPS,
            *SHORT,
            "train.run.symmetry=false",
            *changes,
            f"train.distillation={{teachers={{{named}}}, gradient_length=1, {distillation}}}",
        ],
    )


def test_a_student_of_many_bodies_learns_from_all(specialist, tmp_path, monkeypatch, capsys):
    losses, shares = [], []

    def recorded(self, observations):
        loss = original(self, observations)
        losses.append(loss)
        shares.append(self.alg.teacher_share)
        return loss

    original = TaughtRunner._update
    monkeypatch.setattr(TaughtRunner, "_update", recorded)
    changes = (
        *("train.run.num_steps_per_env=8", "train.algorithm.num_learning_epochs=4"),
        *("train.algorithm.learning_rate=0.003", "train.actor.joint_dim=32", "train.actor.num_heads=8"),
        *("train.actor.hidden_dims=[64]", "train.critic.hidden_dims=[16]", "train.actor.init_std=0.3"),
    )
    distillation = "teacher_share=1.0, teacher_iterations=5"
    options = options_of(specialist, tmp_path, changes, distillation, num_envs=12, max_iterations=16)
    assert session.train(options) == 0
    assert losses[-1]["behavior"] < 0.2 * losses[0]["behavior"]
    for robot in ROBOTS:
        assert losses[-1][f"behavior/{robot}"] < 0.8 * losses[0][f"behavior/{robot}"]
    assert np.isclose(np.mean([losses[-1][f"behavior/{robot}"] for robot in ROBOTS]), losses[-1]["behavior"])
    assert shares[:3] == pytest.approx([1.0, 0.8, 0.6])
    assert shares[5:] == [0.0] * 11
    checkpoint = run_dir.find_checkpoint(tmp_path, "latest")
    assert "teacher_state_dict" not in run_dir.load_checkpoint(checkpoint)
    assert sorted(evaluate_checkpoint(checkpoint, num_envs=3, steps=3, threads=1).robots) == sorted(ROBOTS)
    resumed = session.Options(resume=str(checkpoint), max_iterations=1, device="cpu", logger="none")
    assert session.train(resumed) == 0
    assert losses[-1]["behavior"] < 1.5 * losses[-2]["behavior"]
    capsys.readouterr()
    more = dataclasses.replace(options, init=checkpoint, max_iterations=1, log_dir=tmp_path / "more")
    without = [change for change in options.overrides if "distillation" not in change]
    assert session.train(dataclasses.replace(more, overrides=without)) == 0
    assert "it has no critic; a new one learns" in " ".join(capsys.readouterr().out.split())
    state = run_dir.load_checkpoint(run_dir.find_checkpoint(tmp_path / "more", "latest"))
    learnt = run_dir.load_checkpoint(checkpoint)["actor_state_dict"]
    assert torch.allclose(state["actor_state_dict"]["mlp.code.weight"], learnt["mlp.code.weight"], atol=0.05)


@pytest.mark.parametrize(("weights", "share"), [("robots", 1 / 3), ("envs", 4 / 6)])
def test_shares_of_envs_may_weigh_robots_and_the_rate_may_fall(specialist, tmp_path, monkeypatch, weights, share):
    rates, sums = [], []

    def recorded(self, observations):
        rates.extend(float(group["lr"]) for group in self._optimizer().param_groups)
        first, stop = self.env.unwrapped.sim.env_ids("unitree_go2")
        total = self.alg._weights.sum()
        sums.append(float(self.alg._weights[first:stop].sum() / total))
        assert float(total) == pytest.approx(1.0)
        loss = original(self, observations)
        errors = {robot: loss[f"behavior/{robot}"] for robot in ROBOTS}
        others = (1.0 - share) / 2
        mean = share * errors["unitree_go2"] + others * (errors["phantomx"] + errors["solo12"])
        assert loss["behavior"] == pytest.approx(mean, rel=1e-4)
        return loss

    original = TaughtRunner._update
    monkeypatch.setattr(TaughtRunner, "_update", recorded)
    changes = ("env_shares.unitree_go2=4", "train.algorithm.learning_rate=0.003")
    distillation = f"weights='{weights}', final_learning_rate=0.001"
    options = options_of(specialist, tmp_path, changes, distillation, num_envs=12, max_iterations=3)
    assert session.train(options) == 0
    assert rates == pytest.approx([0.003, 0.002, 0.001])
    assert sums == pytest.approx([share] * 3)


def of_three(specialist, folder, iterations, *changes):
    """Options of a short distillation."""
    small = ("run.num_steps_per_env=6", "actor.joint_dim=16", "actor.hidden_dims=[32]")
    overrides = [f"train.{change}" for change in (*small, *changes)]
    return options_of(specialist, folder, overrides, "teacher_share=0.5", num_envs=6, max_iterations=iterations)


def test_a_distillation_goes_on_as_if_it_had_not_stopped(specialist, tmp_path):
    """Weights, moments of Adam and curves are the same bits."""
    assert session.train(of_three(specialist, tmp_path / "whole", 3)) == 0
    assert session.train(of_three(specialist, tmp_path / "half", 2)) == 0
    half = run_dir.find_checkpoint(tmp_path / "half", "latest")
    assert session.train(session.Options(resume=str(half), max_iterations=1, device="cpu", logger="none")) == 0
    whole, again = (
        run_dir.load_checkpoint(run_dir.find_checkpoint(tmp_path / name, "latest")) for name in ("whole", "half")
    )
    assert whole["iter"] == again["iter"] == 3
    for name, tensor in whole["actor_state_dict"].items():
        assert torch.equal(tensor, again["actor_state_dict"][name]), name
    states = [state["optimizer_state_dict"]["state"] for state in (whole, again)]
    assert states[0].keys() == states[1].keys() != set()
    for key, moments in states[0].items():
        for name, tensor in moments.items():
            assert torch.equal(tensor, states[1][key][name]), (key, name)
    # a deviation is not learned, all else is
    assert sum(bool(moments["exp_avg_sq"].any()) for moments in states[0].values()) == len(states[0]) - 2


def test_each_step_of_adam_learns_from_one_control_step_in_turn(specialist, tmp_path, monkeypatch):
    """A loop in plain torch over the stored samples moves the weights as the training does."""
    found = {}

    def collected(self, observations):
        found["before"] = {name: value.clone() for name, value in self.alg.student.state_dict().items()}
        observations = original(self, observations)
        storage = self.alg.storage
        found["samples"] = (storage.observations["policy"].clone(), storage.privileged_actions.clone())
        return observations

    def updated(self, observations):
        figures = update(self, observations)
        student = self.alg.student
        found["after"] = {name: value.detach().clone() for name, value in student.named_parameters()}
        student.load_state_dict(found["before"])
        adam = torch.optim.Adam(student.parameters(), lr=1e-3)
        mask = torch.from_numpy(self.env.unwrapped.sim.action_mask).float()
        weights = mask / mask.sum(dim=1, keepdim=True) / len(mask)
        for step in list(range(6)) * 2:
            seen, labels = (of[step] for of in found["samples"])
            adam.zero_grad()
            loss = ((student.mlp(seen)[:, 0] - labels).square() * weights).sum()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(student.parameters(), 1.0)
            adam.step()
        for name, value in student.named_parameters():
            if name == "mlp.attention.bias":
                continue  # a softmax is the same for any: its gradient is rounding, of which Adam makes whole steps
            torch.testing.assert_close(value.detach(), found["after"][name], rtol=1e-4, atol=1e-5, msg=name)
            found[name] = float((value.detach() - found["before"][name]).abs().max())
        return figures

    original, update = TaughtRunner._collect, TaughtRunner._update
    monkeypatch.setattr(TaughtRunner, "_collect", collected)
    monkeypatch.setattr(TaughtRunner, "_update", updated)
    epochs = ("algorithm.num_learning_epochs=2", "algorithm.mixed_precision='off'", "actor.obs_normalization=false")
    assert session.train(of_three(specialist, tmp_path, 1, *epochs)) == 0
    moved = [found[name] for name in found["after"] if not name.startswith(("mlp.deviation", "mlp.attention.bias"))]
    assert min(moved) > 1e-4


def test_a_student_that_remembers_learns_in_the_loop_of_rsl_rl(specialist, tmp_path, monkeypatch):
    kinds, losses = [], []

    def recorded(self, observations):
        kinds.append(type(self))
        losses.append(update(self, observations)["behavior"])
        return {"behavior": losses[-1]}

    update = Runner._update
    monkeypatch.setattr(Runner, "_update", recorded)
    changes = ("class_name='RNNModel'", "rnn_type='gru'", "rnn_hidden_dim=32", "rnn_num_layers=1", "init_std=0.2")
    options = of_three(specialist, tmp_path, 6, "algorithm.learning_rate=0.003")
    options = dataclasses.replace(
        options,
        robots=["unitree_go2", "solo12"],
        train_config="flat",
        overrides=[*options.overrides, *(f"train.actor.{change}" for change in changes)],
    )
    options.overrides[:] = [change for change in options.overrides if "joint_dim" not in change]
    assert session.train(options) == 0
    assert set(kinds) == {Runner}
    assert losses[-1] < 0.8 * losses[0]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (["train.distillation={teachers={phantomx=PHANTOMX}}"], "names no teacher of (solo12|unitree_go2)"),
        (["train.distillation={teachers={phantonx=PHANTOMX}}"], "'phantonx' is no robot .* did you mean 'phantomx'"),
        (["train.distillation={teachers={'*'=PHANTOMX}}"], "was trained without the joints .*HAA"),
        (["train.distillation={teacher=PHANTOMX, teachers={'*'=PHANTOMX}}"], "needs either teacher"),
        (["train.distillation={loss_type='mse'}"], "needs either teacher"),
        (["train.distillation={teacher=PHANTOMX, teacher_share=0.5}"], "teacher_share is of"),
        (["train.distillation={teacher=PHANTOMX, weights='envs'}"], "weights is of"),
        (["train.distillation={teacher=PHANTOMX, final_learning_rate=0.001}"], "final_learning_rate is of"),
        (["train.distillation={teachers={'*'='quadruped'}, teacher_share=1.5}"], "must be from 0 to 1"),
        (["train.distillation={teachers={'*'=3}}"], r"teachers.* must be of type"),
        (["train.distillation={teachers={'*'='quadruped'}, weights='joints'}"], "weights = 'joints' is not one of"),
        (
            ["train.distillation={teachers={'*'='quadruped'}, unknown_joints='moved'}"],
            "unknown_joints = 'moved' is not one of seen, held",
        ),
        (["train.distillation={teachers={'*'=PHANTOMX}, unknown_joints='held'}"], "joints it does not know at all"),
        (["train.distillation={teachers={'*'='quadruped'}, final_learning_rate=0.0}"], "must be above 0 and at most 1"),
        (["train.distillation={teacher='quadruped'}"], "for bodies with the same joints.*distillation.teachers"),
        (
            ["train.distillation={teachers={'*'='quadruped'}}", f"observations.teacher={terms(STUDENT)}"],
            "reads the term base_ang_vel, 4 control steps before the present one, which the observation groups teacher",
        ),
        (
            [
                "train.distillation={teachers={'*'='quadruped'}}",
                f"observations.teacher={terms([*TEACHER[:2], {**TEACHER[2], 'scale': 0.5}, *TEACHER[3:]])}",
            ],
            "reads the term joint_pos_rel with scale = 1.0, and the student's task gives it with scale = 0.5",
        ),
    ],
)
def test_mistakes_are_named(changes, said, specialist, tmp_path):
    changes = [change.replace("PHANTOMX", json.dumps(str(specialist))) for change in changes]
    options = session.Options(
        **OPTIONS,
        log_dir=tmp_path,
        task=TASK,
        robots=ROBOTS,
        num_envs=3,
        max_iterations=1,
        train_config="any_legged",
        overrides=[*GROUPS, "train.run.symmetry=false", *changes],
    )
    with pytest.raises(polypod.ConfigError, match=said):
        session.train(options)
    assert not list(tmp_path.glob("rsl_rl/*/*"))
