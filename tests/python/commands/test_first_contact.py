"""A newcomer's first commands work, or say in one line what to type instead."""

import json
import subprocess
import sys

import numpy as np
import pytest
from rich.console import Console

import polypod
from polypod import _core, bundled
from polypod import cli as program
from polypod.cli import COMMANDS
from polypod.commands import info
from polypod.runs import config, run_dir
from polypod.tables import Rows


def test_the_version(cli):
    for words in (("--version",), ("-V",), ("--version", "list"), ("-V", "-V"), ("-V", "--nothing", "x")):
        done = cli(*words)
        assert (done.returncode, done.stdout) == (0, f"polypod {polypod.__version__}\n")


def test_the_list_has_what_the_flags_take(cli):
    """`train --help` sends to it for tasks, robots and train configs."""
    said = cli("list").stdout
    for name in ("velocity_flat", "unitree_go2", "flat", "legged_finish", "quick"):
        assert f"  {name} " in said or f" {name}\n" in said, name
    configs = json.loads(cli("list", "train_configs", "--json").stdout)["train_configs"]
    assert {"name": "quick", "file": "configs/train/quick.toml"}.items() <= next(
        entry for entry in configs if entry["name"] == "quick"
    ).items()
    assert all(entry["title"] for entry in configs)


def test_the_help_names_what_is_usual_first(cli):
    """No flag is listed under an odd name, and no choice is None."""
    said = cli("train", "--help").stdout
    assert "--quadrupeds" not in said
    assert "None" not in said
    assert "--learner {auto,native,rsl_rl}" in said
    for command in ("train", "eval", "accuracy"):
        assert "--robots A,B,C" in cli(command, "--help").stdout
    line = ("train", "--num-envs", "8", "--max-iterations", "1", "--logger", "none")
    for spelling in (("--quadrupeds", "spott"), ("--quadrupeds=spott",)):
        done = cli(*line, *spelling)
        assert done.returncode == 2
        assert "did you mean `spot`?" in done.stderr


@pytest.mark.parametrize(
    ("module", "package", "extra"),
    [
        ("sb3", "stable_baselines3", "learners"),
        ("torchrl", "torchrl", "learners"),
        ("rllib", "ray", "learners"),
        ("rsl_rl", "torch", "train"),
    ],
)
def test_an_adapter_without_its_package_names_the_extra(module, package, extra):
    script = f"""
import sys
sys.modules[{package!r}] = None
try:
    import polypod.{module}
except ModuleNotFoundError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=100, check=True)
    assert done.stdout.startswith(f"polypod.{module} needs the package ")
    assert f"pip install 'polypod[{extra}]'" in done.stdout


@pytest.mark.parametrize(("word", "meant"), [("trian", "train"), ("evaluate", "eval"), ("simsim", "sim2sim")])
def test_an_unknown_command_gets_the_nearest_one(cli, word, meant):
    done = cli(word)
    assert done.returncode == 2
    assert f"there is no command '{word}'; did you mean '{meant}'?" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_command_like_no_other_gets_the_list(cli):
    assert ", ".join(COMMANDS) in cli("zzzz").stderr


SLOW = ("torch", "rsl_rl", "polypod.training.session", "matplotlib", "mujoco")


@pytest.mark.parametrize(
    "line",
    [
        "train --robots spott",
        "train --task velocity_flatt",
        "train --train-config flatt",
        "train --set sim.episode_lenght_s=1",
        "train --set train.algorithm.entropy_coeff=0",
        "eval --checkpoint x.pt --robots spott",
        "play --checkpoint x.pt --task velocity_flatt",
        "sim2sim --checkpoint x.pt --robots spott",
        "export --checkpoint x.pt --robots spott",
    ],
)
def test_wrong_names_are_refused_before_anything_slow_is_imported(line, tmp_path):
    code = (
        "import sys\n"
        "from polypod.__main__ import main\n"
        "code = main()\n"
        f"print([name for name in {SLOW} if name in sys.modules])\n"
        "sys.exit(code)\n"
    )
    command = [sys.executable, "-c", code, *line.split()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2, done.stderr
    assert done.stdout == "[]\n"
    assert "did you mean" in done.stderr
    assert done.stderr.count("\n") == 1


def test_an_unknown_task_does_not_print_all_names(cli):
    done = cli("train", "--task", "Velocity-Flat-HeteroQuadrupd-v0")
    assert "did you mean `Velocity-Flat-HeteroQuadruped-v0`" in done.stderr
    assert "velocity_obstacles" not in done.stderr
    assert "`list`" in done.stderr


def test_the_command_line_of_the_reference_works_as_printed(cli, tmp_path):
    done = cli(
        *("train", "--task=Isaac-Velocity-Flat-HeteroQuadruped-v0", "--num_envs=64"),
        *("--quadrupeds", "anymal_d,unitree_go2", "--headless", "--max_iterations=1", "--logger", "none"),
        *("--set", "sim.episode_length_s=1.0"),
    )
    assert done.returncode == 0, done.stderr
    (checkpoint,) = tmp_path.glob("logs/rsl_rl/*/*/model_1.pt")
    assert run_dir.read_manifest(checkpoint)["robots"] == ["anymal_d", "unitree_go2"]


def test_isaac_labs_prefix_is_known_everywhere():
    env = polypod.make("Isaac-Velocity-Flat-Spot-v0", num_envs=1, seed=0)
    assert env.sim.task_name == "Velocity-Flat-Spot-v0"
    env.close()
    with pytest.raises(polypod.UnknownNameError, match="there is no task `Isaac-Velocity-Flat-Spott-v0`"):
        polypod.make("Isaac-Velocity-Flat-Spott-v0", num_envs=1)


def test_settings_of_ppo_from_the_command_line(cli, tmp_path):
    done = cli(
        *("train", "--num-envs", "64", "--max-iterations", "1", "--robots", "spot", "--logger", "none"),
        *("--set", "sim.episode_length_s=1.0", "--set", "train.algorithm.entropy_coef=0.0125"),
        *("--set", "train.actor.hidden_dims=[32, 16]", "--set", "train.actor.activation=relu"),
    )
    assert done.returncode == 0, done.stderr
    (checkpoint,) = tmp_path.glob("logs/rsl_rl/*/*/model_1.pt")
    manifest = run_dir.read_manifest(checkpoint)
    assert manifest["train_config"]["algorithm"]["entropy_coef"] == 0.0125
    assert manifest["policy"]["hidden_dims"] == [32, 16]
    assert manifest["policy"]["activation"] == "relu"
    assert manifest["overrides"] == ["sim.episode_length_s=1.0"]
    assert "--set train.algorithm.entropy_coef=0.0125" in manifest["command"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("train.algorithm.entropy_coef=x", "entropy_coef"),
        ("train.algorithm.gamma=1.5", "gamma = 1.5 must be from 0 to 1"),
        ("train.algorithm", "no `=`"),
        ("train.algoritm.gamma=1", "algoritm"),
        ("train.actor.hidden_dims=0", "hidden_dims"),
    ],
)
def test_wrong_settings_are_refused(text, said):
    of_task, of_training = config.split_overrides([text, "sim.dt=0.002"])
    assert of_task == ["sim.dt=0.002"]
    with pytest.raises(polypod.ConfigError, match=said):
        config.load("flat", of_training)


def test_info_says_what_a_bug_report_needs(cli, monkeypatch):
    monkeypatch.setenv("POLYPOD_SIMD", _core.info()["simd"])
    printed = cli("info").stdout
    wanted = {"version", "simd", "threads", "python", "system", "processor", "torch", "rsl-rl-lib", "numpy", "package"}
    assert wanted | {"POLYPOD_SIMD"} <= {line.split()[0] for line in printed.splitlines()}
    assert np.__version__ in printed
    assert info._version("no-such-package") == "not installed"


def test_lists_as_json(cli):
    listed = json.loads(cli("list", "--json").stdout)
    policies = [{"name": name, "file": str(bundled.checkpoint(name))} for name in bundled.FOLDERS]
    train_configs = listed.pop("train_configs")
    assert {"flat", "quick", "rough_universal"} <= {config["name"] for config in train_configs}
    commands = {command["name"]: command["columns"] for command in listed.pop("commands")}
    kinds = {"base_velocity", "foot_placement", "gait", "heading", "jump", "none", "pose", "position"}
    assert kinds == set(commands)
    assert commands["pose"] == ["height", "roll", "pitch"]
    assert listed == {"tasks": polypod.tasks(), "robots": polypod.robots(), "policies": policies}
    assert json.loads(cli("list", "robots", "--json").stdout) == {"robots": polypod.robots()}


def test_a_list_shows_each_task_once_and_counts_those_of_one_robot(cli):
    short, long = cli("list").stdout, cli("list", "tasks").stdout
    made = [task["name"] for task in polypod.tasks() if not task["aliases"]]
    assert f"and {len(made)} for one robot alone" in short
    for name in made:
        assert name in long
    assert "spot" not in long.split()


@pytest.mark.parametrize("width", [40, 79, 80, 100, 120])
def test_tables_fit_the_terminal(width):
    headers = ("reward/s", "err xy", "still", "err yaw", "still", "falls", "length", "power", "CoT", "slip")
    rows = Rows("robot", *headers)
    for robot in ("anymal_d", "unitree_go2_with_arm"):
        rows.add_row(robot, "-0.12", "0.123", "0.937", "0.124", "0.600", "100.0%", "20.0 s", "1234", "0.55", "0.66")
    console = Console(width=width, record=True, file=None, quiet=False)
    with console.capture() as capture:
        rows.print(console)
    printed = capture.get()
    assert "…" not in printed
    assert max(map(len, printed.splitlines())) <= width
    words = printed.split()
    for word in (*headers[0:1], "xy", "yaw", "falls", "length", "power", "CoT", "slip", "100.0%", "1234", "0.66"):
        assert word in words, word
    assert printed.count("unitree_go2_with_arm") == printed.count("anymal_d") == printed.count("robot")


def test_bundled_policies_go_by_their_names(cli, tmp_path):
    done = cli("play", "--headless", "--seconds", "0.2")
    assert done.returncode == 0, done.stderr
    assert "Velocity-Flat-Universal-Play-v0" in done.stdout
    done = cli("eval", "--checkpoint", "rough", "--num-envs", "8", "--steps", "2")
    assert done.returncode == 0, done.stderr
    assert "Rough" in done.stdout
    # a file of that name comes first
    (tmp_path / "flat").write_bytes(b"no checkpoint")
    assert "flat is not a checkpoint" in cli("eval", "--checkpoint", "flat").stderr
    with pytest.raises(polypod.UnknownNameError, match="use one of flat, rough"):
        bundled.checkpoint("hills")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_names_no_default_that_is_none(command, capsys):
    with pytest.raises(SystemExit):
        program.main([command, "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "(default: None)" not in shown
