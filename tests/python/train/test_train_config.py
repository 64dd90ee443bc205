"""Train configs are checked, and errors name file, key and remedy."""

import dataclasses

import pytest

import polypod
from polypod.compat import tomllib
from polypod.runs import config, run_dir, schema
from polypod.training import session
from polypod.training.session import Options, train_with
from polypod.training.workers import Workers


@pytest.mark.parametrize("name", ["flat", "flat_universal", "rough", "quick"])
def test_shipped_configs_are_complete(name):
    cfg = config.load(name).rsl_rl_cfg()
    assert cfg["algorithm"]["class_name"] == "PPO"
    assert cfg["num_steps_per_env"] == 24


def test_the_reference_hyperparameters():
    flat = config.load("flat")
    assert flat.actor.hidden_dims == flat.critic.hidden_dims == [128, 128, 128]
    assert (flat.algorithm.gamma, flat.algorithm.lam, flat.algorithm.desired_kl) == (0.99, 0.95, 0.01)
    assert config.load("rough").actor.hidden_dims == [512, 256, 128]


def test_a_file_extends_a_shipped_one(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('extends = "flat"\n[algorithm]\ngamma = 0.98\n')
    mine, flat = config.load(str(path)), config.load("flat")
    assert mine.algorithm.gamma == 0.98
    assert mine.run == flat.run


def test_a_file_extends_several_of_which_the_later_wins(tmp_path):
    """Layers follow the rules of tasks: in order, each file once, paths relative to it."""
    (tmp_path / "long.toml").write_text("[run]\nmax_iterations = 7000\nsave_interval = 7\n")
    (tmp_path / "short.toml").write_text('extends = "flat"\n[run]\nmax_iterations = 70\n')
    (tmp_path / "mine.toml").write_text(
        'extends = ["rough", "long.toml", "short.toml"]\n[algorithm]\ngamma = 0.98\n[actor.hidden_dims]\n1 = 64\n'
    )
    mine = config.load(str(tmp_path / "mine.toml"))
    assert (mine.run.max_iterations, mine.run.save_interval) == (70, 7)
    assert mine.algorithm.gamma == 0.98
    # `flat` is below `rough` already and is not put on top of it by short.toml
    assert mine.run.task == "velocity_rough"
    assert mine.critic.hidden_dims == [512, 256, 128]
    assert mine.actor.hidden_dims == [512, 64, 128]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('extends = ["flat", 3]\n', "extends = 3 is no name"),
        ('extends = ["flat", "flatt"]\n', "flatt"),
        ('extends = "flat"\n[actor.hidden_dims]\n3 = 64\n', "hidden_dims.3: there is no such element"),
        ('extends = "flat"\n[algorithm]\ngama = 0.98\n', "'gama'; did you mean 'gamma'"),
        ('extends = "flat"\n[algorithn]\n', "'algorithn'; did you mean 'algorithm'"),
        ('extends = "flat"\n[run]\nnum_envs = "many"\n', r"\[run\] num_envs = 'many' must be of type int"),
        ('extends = "flat"\n[run]\nnum_envs = 0\n', "num_envs = 0 must be greater than 0"),
        ('extends = "flat"\n[actor]\nhidden_dims = [1.5]\n', r"hidden_dims\[0\] = 1.5"),
        ('extends = "flat"\n[algorithm]\nschedule = "warm"\n', "adaptive, fixed"),
        ('extends = "flatt"\n', "flat"),
        (
            'extends = "flat"\n[run]\nnormalize_advantage_per_robot = true\n'
            "[algorithm]\nnormalize_advantage_per_mini_batch = true\n",
            "exclude each other",
        ),
        (
            'extends = "flat"\n[actor]\nclass_name = "UrmaModel"\n',
            "'UrmaModel' is not one of MLPModel, RNNModel, polypod",
        ),
        ('extends = "flat"\n[actor]\nnum_heads = 4\n', r"\[actor\] num_heads is of networks of joints"),
        (f'extends = "flat"\n[actor]\nclass_name = "{schema.URMA}"\njoint_dim = 8\n', "num_heads = None must be at"),
        ('extends = "flat"\n[actor]\nleg_heads = 4\n', r"\[actor\] leg_heads is of networks of joints"),
        ('extends = "flat_joints"\n[actor]\nleg_heads = 33\n', r"\[actor\] leg_heads = 33 must be from 1 to num_heads"),
        ('extends = "flat"\n[actor]\nhidden_dims = []\n', r"hidden_dims = \[\] must hold"),
        ('extends = "flat"\n[run]\ntask_changes = ["sim.decimation=2"]\n', "begin with commands., events., rewards."),
        (
            'extends = "flat"\n[run]\ntask_changes = ["physics.engine=avian"]\n',
            "begin with commands., events., rewards.",
        ),
        ("[run]\nnum_envs = 1\n", "extends"),
        ("[run\n", "not valid TOML"),
    ],
)
def test_errors(tmp_path, text, message):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(polypod.ConfigError, match=message):
        config.load(str(path))


@pytest.mark.parametrize("engine", ["articulated", "auto", "cuda"])
def test_engines_of_the_same_bits_are_of_the_training_alone(tmp_path, engine):
    path = tmp_path / "mine.toml"
    path.write_text(f'extends = "flat"\n[run]\ntask_changes = ["physics.engine={engine}"]\n')
    assert config.load(str(path)).run.task_changes == [f"physics.engine={engine}"]


def test_changes_of_the_task_are_of_the_training_alone(tmp_path):
    def params(*overrides):
        options = Options(
            train_config="quick",
            num_envs=16,
            max_iterations=1,
            logger="none",
            log_dir=tmp_path,
            device="cpu",
            robots=["spot"],
            overrides=list(overrides),
        )
        run, runner = train_with(options, Workers.alone())
        runner.env.unwrapped.close()
        manifest = run_dir.read_manifest(run_dir.checkpoint_path(run, 1))
        return tomllib.loads((run / "params/env.toml").read_text()), manifest

    env, manifest = params()
    assert env["task"]["commands"]["base_velocity"]["resampling_time_s"] == 7.0
    assert manifest["overrides"] == []
    env, manifest = params("commands.base_velocity.resampling_time_s=9.0")
    assert env["task"]["commands"]["base_velocity"]["resampling_time_s"] == 9.0
    assert manifest["overrides"] == ["commands.base_velocity.resampling_time_s=9.0"]


def test_a_config_of_an_older_run_is_that_of_a_perceptron():
    """Manifests from before there was a choice name no class."""
    tables = config.load("flat").as_dict()
    for section in ("actor", "critic"):
        del tables[section]["class_name"]
    assert config.parse(tables, "manifest") == config.load("flat")


def test_a_file_cannot_extend_itself(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(f'extends = "{path}"\n')
    with pytest.raises(polypod.ConfigError, match="extends itself"):
        config.load(str(path))


def test_a_file_extends_the_one_that_it_hides(tmp_path, monkeypatch):
    """By its name, in POLYPOD_PATH, as tasks and robots do.

    A path in it begins at its own folder.
    """
    folder = tmp_path / "configs" / "train"
    folder.mkdir(parents=True)
    (folder / "long.toml").write_text("[run]\nsave_interval = 7\n")
    (folder / "quick.toml").write_text('extends = ["quick", "long.toml"]\n[algorithm]\ngamma = 0.98\n')
    built_in = config.load("quick")
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path))
    mine = config.load("quick")
    assert (mine.algorithm.gamma, mine.run.save_interval) == (0.98, 7)
    assert mine.run == dataclasses.replace(built_in.run, save_interval=7)
    assert config.load(str(folder / "quick.toml")) == mine
    (folder / "own.toml").write_text('extends = "own"\n')
    with pytest.raises(polypod.ConfigError, match=r"`own` extends itself: .*own\.toml"):
        config.load("own")


def test_a_missing_file(tmp_path):
    with pytest.raises(polypod.ConfigError, match="cannot read"):
        config.load(str(tmp_path / "none.toml"))


def test_goals_move_linearly_from_start_to_end() -> None:
    base = config.load("flat").as_dict()
    base["run"]["max_iterations"] = 100
    base["algorithm"] |= {"entropy_coef": 0.01, "desired_kl": 0.02}
    assert config.parse(base, "test").goals(99) == (0.01, 0.02)
    fading = config.parse({**base, "anneal": {"start": 0.5, "entropy_coef": 0.0, "desired_kl": 0.01}}, "test")
    assert fading.goals(0) == fading.goals(49) == (0.01, 0.02)
    assert fading.goals(74) == pytest.approx((0.005, 0.015))
    assert fading.goals(99) == fading.goals(1000) == (0.0, 0.01)
    assert config.parse(fading.as_dict(), "test") == fading


@pytest.mark.parametrize(
    "wrong",
    [{"start": 1.5}, {"start": -0.1}, {"entropy_coef": -1.0}, {"desired_kl": 0.0}, {"desired_kl": float("nan")}],
)
def test_goals_out_of_range_are_refused(wrong) -> None:
    base = config.load("quick").as_dict()
    with pytest.raises(polypod.ConfigError, match=rf"\[anneal\] {next(iter(wrong))}"):
        config.parse({**base, "anneal": base["anneal"] | wrong}, "test")


def test_a_mirror_loss_needs_mirror_images() -> None:
    base = config.load("flat").as_dict()
    base["algorithm"]["mirror_loss_coef"] = 1.0
    expected = r"\[algorithm\] mirror_loss_coef = 1.0 .* \[run\] symmetry is false; set symmetry to true or"
    with pytest.raises(polypod.ConfigError, match=expected):
        config.parse(base, "test")
    for symmetry in (True, "alternate"):
        made = config.parse({**base, "run": base["run"] | {"symmetry": symmetry}}, "test")
        assert made.native_options()["algorithm"]["mirror_loss_coef"] == 1.0


def test_the_learners_device_decides_mixed_precision(monkeypatch):
    asked = []
    monkeypatch.setattr(session, "_device", lambda *_: "cuda:0")
    monkeypatch.setattr(schema, "_computes_in_bfloat16", lambda kind: asked.append(kind) or True)
    plan = session.new_plan(session.Options(train_config="quick", learner="rsl_rl"))
    assert asked == ["cuda"]
    assert plan.config.algorithm.mixed_precision == "on"
