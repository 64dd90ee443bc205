"""A robot or a task given by path trains, and evaluations find it from anywhere."""

import json
from pathlib import Path

from common import ROOT

QUICK = ("--num-envs", "16", "--max-iterations", "1", "--logger", "none", "--set", "sim.episode_length_s=0.4")


def trained_and_evaluated(cli, folder, *arguments):
    """Output of an evaluation in another directory of a training in `folder`."""
    done = cli("train", *QUICK, *arguments)
    assert done.returncode == 0, done.stderr
    (checkpoint,) = folder.glob("logs/rsl_rl/*/*/model_1.pt")
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    relative = Path("..") / checkpoint.relative_to(folder)
    done = cli("eval", "--checkpoint", str(relative), "--json", "out.json", cwd=elsewhere)
    assert done.returncode == 0, done.stderr
    return json.loads((elsewhere / "out.json").read_text())


def test_train_and_evaluate_a_robot_of_ones_own(cli, tmp_path):
    robot = tmp_path / "mine"
    robot.mkdir()
    config = (ROOT / "configs/robots/unitree_go2.toml").read_text()
    config = config.replace('name = "unitree_go2"', 'name = "my_dog"')
    config = config.replace("assets/robots/unitree_go2/robot.urdf", "robot.urdf")
    (robot / "my_dog.toml").write_text(config)
    (robot / "robot.urdf").write_text((ROOT / "assets/robots/unitree_go2/robot.urdf").read_text())
    assert list(trained_and_evaluated(cli, tmp_path, "--robots", "mine/my_dog.toml")["robots"]) == ["my_dog"]


def test_train_and_evaluate_on_a_task_of_ones_own(cli, tmp_path):
    (tmp_path / "mine.toml").write_text('extends = "velocity_flat"\nname = "My-Task-v0"\nrobots = ["spot"]\n')
    assert trained_and_evaluated(cli, tmp_path, "--task", "mine.toml")["task"] == "My-Task-Play-v0"
