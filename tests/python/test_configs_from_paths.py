"""A robot or a task given by the path of its config trains, and evaluations find it again from anywhere."""

import json
from pathlib import Path

ROOT = Path(__file__).parents[2]


QUICK = ("--num-envs", "16", "--max-iterations", "1", "--logger", "none", "--set", "sim.episode_length_s=0.4")


def test_train_and_evaluate_a_robot_of_ones_own(cli, tmp_path):
    robot = tmp_path / "mine"
    robot.mkdir()
    config = (ROOT / "configs/robots/unitree_go2.toml").read_text()
    config = config.replace('name = "unitree_go2"', 'name = "my_dog"')
    config = config.replace("assets/robots/unitree_go2/robot.urdf", "robot.urdf")
    (robot / "my_dog.toml").write_text(config)
    (robot / "robot.urdf").write_text((ROOT / "assets/robots/unitree_go2/robot.urdf").read_text())
    done = cli("train", *QUICK, "--robots", "mine/my_dog.toml")
    assert done.returncode == 0, done.stderr
    (checkpoint,) = tmp_path.glob("logs/rsl_rl/*/*/model_1.pt")
    (tmp_path / "elsewhere").mkdir()
    relative = Path("..") / checkpoint.relative_to(tmp_path)
    done = cli("eval", "--checkpoint", str(relative), "--json", "out.json", cwd=tmp_path / "elsewhere")
    assert done.returncode == 0, done.stderr
    assert list(json.loads((tmp_path / "elsewhere" / "out.json").read_text())["robots"]) == ["my_dog"]


def test_train_and_evaluate_on_a_task_of_ones_own(cli, tmp_path):
    (tmp_path / "mine.toml").write_text('extends = "velocity_flat"\nname = "My-Task-v0"\nrobots = ["spot"]\n')
    done = cli("train", *QUICK, "--task", "mine.toml")
    assert done.returncode == 0, done.stderr
    (checkpoint,) = tmp_path.glob("logs/rsl_rl/*/*/model_1.pt")
    (tmp_path / "elsewhere").mkdir()
    relative = Path("..") / checkpoint.relative_to(tmp_path)
    done = cli("eval", "--checkpoint", str(relative), "--json", "out.json", cwd=tmp_path / "elsewhere")
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "elsewhere" / "out.json").read_text())["task"] == "My-Task-v0"
