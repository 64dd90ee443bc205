"""The command line: train, resume, eval, list, info; exit codes; one line per mistake."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
import typing
from pathlib import Path

import pytest
import torch
import tyro

import polypod
import polypod.cli
from common import FLAT_POLICY, ROOT

QUICK = ("--num-envs", "64", "--max-iterations", "2", "--logger", "none", "--set", "sim.episode_length_s=1.0")


@pytest.fixture
def main(cli):
    """Runs a command; returns exit code, output and errors."""

    def run(*arguments):
        done = cli(*arguments)
        return done.returncode, done.stdout, done.stderr

    return run


def test_train_resume_and_eval(cli, fork_server, tmp_path):
    done = cli("train", *QUICK, "--robots", "spot,unitree_a1", "--run-name", "mine")
    assert done.returncode == 0, done.stderr
    assert "iteration 2/2" in done.stdout
    assert "err xy" in done.stdout
    (run,) = tmp_path.glob("logs/rsl_rl/*/*_mine")
    assert {path.name for path in run.iterdir()} == {".lock", "manifest.json", "params", "model_2.pt"}
    assert {path.name for path in (run / "params").iterdir()} == {"env.toml", "agent.toml"}
    manifest = json.loads((run / "manifest.json").read_text())
    assert manifest["robots"] == ["spot", "unitree_a1"]
    assert manifest["num_envs"] == 64
    # begun once more by the command that it holds, it is the same training
    command = shlex.split(manifest["command"])
    assert command[:2] == ["polypod", "train"]
    again = tyro.cli(polypod.cli.Train, args=command[2:])
    assert again == tyro.cli(polypod.cli.Train, args=[*QUICK, "--robots", "spot,unitree_a1", "--run-name", "mine"])
    assert len(manifest["canonical_joint_names"]) == len(manifest["joint_maps"]["spot"]) == 12
    assert manifest["policy"]["num_obs"] == sum(entry["size"] for entry in manifest["observation_layout"])
    assert set(manifest["robot_info"]) == {"spot", "unitree_a1"}

    # its directory has all that a run needs to go on: another process resumes it
    ended = fork_server.run("train", "--resume", "--max-iterations", "1", cwd=tmp_path)
    assert ended.code == 0, ended.errors
    assert "iteration 3/3" in ended.output
    assert (run / "model_3.pt").exists()
    assert list(run.glob("events.out.tfevents*")), "tensorboard is the default"

    done = cli(
        "eval", "--checkpoint", str(run / "model_3.pt"), "--json", "out.json", "--num-envs", "8", "--steps", "10"
    )
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "out.json").read_text())
    assert set(figures["robots"]) == {"spot", "unitree_a1"}
    keys = {"error_vel_xy", "error_vel_yaw", "still_error_vel_xy", "still_error_vel_yaw", "fall_rate"}
    assert keys | {"episode_length_s", "reward_per_s"} <= set(figures["robots"]["spot"])
    assert "spot" in done.stdout

    done = cli(
        "eval", "--checkpoint", str(run / "model_3.pt"), "--robots", "anymal_c", "--num-envs", "4", "--steps", "5"
    )
    assert done.returncode == 0, done.stderr
    assert "anymal_c" in done.stdout


def test_every_command_has_a_file_of_its_own():
    folder = Path(polypod.cli.__file__).parent / "commands"
    files = {path.stem for path in folder.glob("*.py")} - {"__init__", "arguments"}
    names = {}
    for command in typing.get_args(polypod.cli.Command):
        kind, subcommand = typing.get_args(command)
        names[subcommand.name] = kind.__module__
    assert names == {name: f"polypod.commands.{name}" for name in files}


def test_list_and_info(main):
    for kind, entries in (("tasks", polypod.tasks()), ("robots", polypod.robots())):
        code, output, _ = main("list", kind)
        assert code == 0
        for entry in entries:
            assert entry["name"] in output
    code, output, _ = main("info")
    assert code == 0
    assert polypod.__version__ in output


def test_the_list_leaves_out_what_is_broken(main, monkeypatch, tmp_path):
    for kind in ("robots", "tasks"):
        folder = tmp_path / "configs" / kind
        folder.mkdir(parents=True)
        (folder / "broken.toml").write_text("name = [")
    (tmp_path / "configs" / "tasks" / "mine.toml").write_text(
        'extends = "velocity_flat"\nname = "Mine-v0"\nrobots = ["spot", "anymal_c"]\n'
    )
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path))
    code, output, errors = main("list")
    assert code == 0
    assert "Mine-v0" in output
    assert "unitree_go2" in output
    assert "broken" not in output
    assert [line.split(": ")[:3] for line in errors.splitlines()] == [
        ["polypod", "warning", str(tmp_path / "configs" / kind / "broken.toml")] for kind in ("robots", "tasks")
    ]
    counts = {entry["name"]: entry["num_robots"] for entry in polypod.tasks()}
    assert (counts["Mine-v0"], counts["Velocity-Flat-Spot-v0"], counts["Velocity-Flat-HeteroQuadruped-v0"]) == (2, 1, 8)
    env = polypod.make("Mine-v0")
    assert env.num_envs == 2
    env.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("train", "--task", "Velocity-Flat"), "did you mean `velocity_flat`"),
        (("train", "--robots", "spott"), "spot"),
        (("train", "--num-envs", "3"), "num_envs"),
        (("train", "--max-iterations", "0"), "--max-iterations"),
        (("train", "--seed", "-1"), "--seed"),
        (("train", "--threads", "0"), "--threads"),
        (
            ("train", "--set", "sim.episode_lenght_s=1"),
            "did you mean `episode_length_s`? (see `polypod show` and `polypod schema`)",
        ),
        (("train", "--set", "rewards.spot.gaitt={weight=1.0}"), "did you mean `gait`? (see `polypod terms`)"),
        (("train", "--set", "train.algorithm.entropy=1"), "did you mean 'entropy_coef'? (see polypod schema)"),
        (("train", "--train-config", "flatt"), "flat"),
        (("train", "--resume"), "no run with a checkpoint"),
        (("train", "--resume", "none"), "neither a checkpoint nor a run"),
        (("train", "--run-name", "a/b"), "--run-name"),
        (("eval", "--checkpoint", "none.pt"), "none.pt"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_mistakes_get_one_line_and_exit_code_2(main, arguments, message):
    code, _, errors = main(*arguments)
    assert code == 2, errors
    assert errors.startswith("polypod: ")
    assert message in errors
    assert errors.count("\n") == 1


@pytest.mark.parametrize("arguments", [("train", "--nonsense"), ("train", "--seed", "abc"), ("eval",), ("walk",)])
def test_unreadable_arguments_get_exit_code_2(main, arguments):
    code, _, errors = main(*arguments)
    assert code == 2
    assert "Traceback" not in errors


def test_internal_errors_get_exit_code_1(main, monkeypatch):
    monkeypatch.setattr(polypod._core, "tasks", lambda: 1 / 0)
    code, _, errors = main("list")
    assert code == 1
    assert "ZeroDivisionError" in errors


def test_a_broken_checkpoint(main, tmp_path):
    (tmp_path / "model_1.pt").write_bytes(b"not a checkpoint")
    code, _, errors = main("eval", "--checkpoint", "model_1.pt")
    assert code == 2
    assert "is not a checkpoint" in errors


def test_a_checkpoint_without_its_manifest(main, tmp_path):
    torch.save({"actor_state_dict": {}}, tmp_path / "model_1.pt")
    code, _, errors = main("eval", "--checkpoint", "model_1.pt")
    assert code == 2
    assert "manifest.json" in errors


def test_a_resumed_run_cannot_change(main, tmp_path):
    run = tmp_path / "logs" / "rsl_rl" / "experiment" / "run"
    run.mkdir(parents=True)
    (run / "manifest.json").write_text("{}")
    (run / "model_1.pt").write_bytes(b"")
    code, _, errors = main("train", "--resume", "latest", "--num-envs", "64")
    assert code == 2
    assert "leave out --num-envs" in errors


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT to a child there")
def test_ctrl_c_saves_a_checkpoint(tmp_path):
    command = [sys.executable, "-m", "polypod", "train", *QUICK, "--max-iterations", "100000"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            if line.startswith("iteration"):
                break
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    (checkpoint,) = tmp_path.glob("logs/rsl_rl/*/*/model_*.pt")
    assert checkpoint.name in output


@pytest.mark.parametrize("given", [{}, {"OMP_WAIT_POLICY": "ACTIVE"}, {"GOMP_SPINCOUNT": "7"}])
def test_idle_threads_leave_the_cores_unless_the_user_says_otherwise(tmp_path, given):
    script = """
import os, sys
sys.argv = ["polypod", "info"]
from polypod.__main__ import main
assert "torch" not in sys.modules
main()
print({name: os.environ[name] for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT") if name in os.environ})
"""
    environ = {name: value for name, value in os.environ.items() if name not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    command = [sys.executable, "-c", script]
    output = subprocess.check_output(command, cwd=tmp_path, text=True, timeout=60, env=environ | given)
    assert output.splitlines()[-1] == str(given or {"GOMP_SPINCOUNT": "1000"})


def test_check_takes_robots_as_well(main, tmp_path, monkeypatch):
    code, output, _ = main("check", "anymal_b_kinova")
    assert code == 0
    # the fingers are held, as its config says
    assert "(assets/robots/anymal_b_kinova/robot.urdf)" in output
    assert "18 joints" in output
    library = tmp_path / "mine"
    for folder in ("configs/robots", "assets/robots/dog"):
        (library / folder).mkdir(parents=True)
    (library / "assets/robots/dog/robot.urdf").write_text(polypod._core.robot_urdf("unitree_go2"))
    config = library / "configs/robots/dog.toml"
    config.write_text('extends = "unitree_go2"\nname = "dog"\ntitle = "dog"\nurdf = "assets/robots/dog/robot.urdf"\n')
    monkeypatch.setenv("POLYPOD_PATH", str(library))
    for robot in ("dog", str(config)):
        code, output, _ = main("check", robot, "--lock", "FL_calf_joint=-1.5")
        assert code == 0
        assert f"({library / 'assets/robots/dog/robot.urdf'})" in output
        assert "11 joints" in output
    code, _, errors = main("check", "spott")
    assert code == 2
    assert "did you mean `spot`?" in errors


def test_check(main, tmp_path):
    folder = ROOT / "tests" / "data" / "urdf"
    code, output, _ = main("check", str(folder / "mixed.urdf"))
    assert code == 0
    for words in ("5.900 kg", "slide", "no legged robot", 'joint "float"'):
        assert words in output
    text = (folder / "meshed.urdf").read_text().replace('filename="meshes/', 'filename="package://cubes/')
    (tmp_path / "robot.urdf").write_text(text)
    code, output, _ = main("check", "robot.urdf", "--package-dir", f"cubes={folder / 'meshes'}")
    assert code == 0
    assert "\nquadruped (+" in output
    assert "hull of 8 points" in output
    assert "its collision meshes are missing; the box of its inertia" in main("check", "robot.urdf")[1]


@pytest.mark.parametrize("content", [b"", b"\xff\x00\x89", b"<robot>" * 100_000, b"<robot name='r'/>"])
def test_check_refuses_in_one_line(main, tmp_path, content):
    (tmp_path / "robot.urdf").write_bytes(content)
    for arguments in (("robot.urdf",), (str(tmp_path),), ("nowhere.urdf",)):
        code, output, errors = main("check", *arguments)
        assert (code, output) == (2, "")
        assert errors.startswith(f"polypod: {arguments[0]}: ")
        assert errors.count("\n") == 1


def test_check_wants_folders_by_name(main):
    code, _, errors = main("check", "robot.urdf", "--package-dir", "folder")
    assert code == 2
    assert "NAME=DIR" in errors


def test_without_arguments_there_is_help(main):
    code, output, _ = main()
    assert code == 0
    assert "train" in output


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("eval", "--task", "velocity_flat"), "takes observations of 83 numbers, and the task gives 48"),
        (("eval", "--seed", "-1"), "--seed -1 must be from 0"),
        (("eval", "--seed", "18446744073709551616"), "--seed 18446744073709551616"),
        (("eval", "--grid", "100000", "100000", "100000"), "more than 1,000,000 commands"),
        (("play", "--port", "99999"), "--port 99999 must be from 0 to 65535"),
        (("play", "--video", "a.gif", "--size", "100000", "100000"), "from 16 to 4096 pixels"),
        (("sim2sim", "--dt", "nan"), "--dt nan must be from"),
        (("sim2sim", "--dt", "inf"), "--dt inf must be from"),
        (("sim2sim", "--friction", "nan"), "--friction nan must be from"),
        (("sim2sim", "--command", "nan", "0", "0"), "finite"),
    ],
)
def test_options_out_of_range(main, arguments, said):
    command, *options = arguments
    code, _, errors = main(command, "--checkpoint", str(FLAT_POLICY), *options)
    assert code == 2
    assert said in errors
    assert errors.count("\n") == 1
