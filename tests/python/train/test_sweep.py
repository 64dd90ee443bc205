"""A sweep trains configs and robots with several seeds and ends in tables.

It goes on where it was interrupted.
"""

import json
import re

import pytest

from polypod.runs import run_dir
from polypod.training.sweep import EVALUATION, error_of, read
from same_bits import equal

SWEEP = """
seeds = [1, 2]

[train]
num_envs = 32
max_iterations = 2
set = ["sim.episode_length_s=0.4"]
device = "cpu"
threads = 1

[configs.plain]
train_config = "mine.toml"

[configs.alternate]
train_config = "mine.toml"
learner = "native"
max_iterations = 1

[robots]
one = ["spot"]
two = ["spot", "unitree_a1"]
"""
CONFIG = 'extends = "flat"\n[run]\nsave_interval = 1\nnum_steps_per_env = 8\n'


@pytest.fixture
def write(tmp_path):
    """Writes a sweep next to its train config."""

    def file(text):
        (tmp_path / "mine.toml").write_text(CONFIG)
        (tmp_path / "sweep.toml").write_text(text)
        return tmp_path / "sweep.toml"

    return file


def test_a_sweep_is_a_table_per_group_and_goes_on(cli, write, tmp_path, monkeypatch):
    file = write(SWEEP.replace("one = ", "# one = "))
    done = cli("sweep", str(file), "--out", "out")
    assert done.returncode == 0, done.stderr
    groups = ("plain_two", "alternate_two")
    tables = done.stdout[done.stdout.index("\nplain_two\n") :]
    assert re.findall(r"^(\w+)$", tables, re.MULTILINE) == list(groups)
    assert tables.count("2 policies, Velocity-Flat-HeteroQuadruped-Play-v0") == 2
    for robot in ("spot", "unitree_a1"):
        assert len(re.findall(rf"^{robot} .*±.* of 2$", tables, re.MULTILINE)) == 2
    for group, iterations in zip(groups, (2, 1), strict=True):
        for seed in (1, 2):
            run = tmp_path / "out" / group / f"seed_{seed}"
            assert run_dir.latest_checkpoint(run).name == f"model_{iterations}.pt"
            assert run_dir.read_manifest(run / "model_1.pt")["seed"] == seed
            assert json.loads((run / EVALUATION).read_text())["checkpoint"]["iteration"] == iterations

    run = tmp_path / "out" / "plain_two" / "seed_2"
    measured = (run / EVALUATION).read_text()
    for broken in ("{", "[]", json.dumps({**json.loads(measured), "robots": {"spot": {}}})):
        (run / EVALUATION).write_text(broken)
        refused = cli("sweep", str(file), "--out", "out")
        assert refused.returncode == 2
        assert f"{EVALUATION} is no evaluation" in refused.stderr
    (run / EVALUATION).write_text(measured)

    last = run / "model_2.pt"
    last.rename(tmp_path / "model_2.pt")
    manifest = json.loads((run / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    untouched = [path for path in (tmp_path / "out").rglob("model_*.pt") if path.parent != run]
    before = {path: path.stat().st_mtime_ns for path in untouched}
    again = cli("sweep", str(file), "--out", "out")
    assert again.returncode == 0, again.stderr
    assert {path: path.stat().st_mtime_ns for path in untouched} == before
    assert "iteration 2/2" in again.stdout
    assert equal(last, tmp_path / "model_2.pt")

    other = cli(
        "sweep", str(write(SWEEP.replace("sim.episode_length_s=0.4", "sim.episode_length_s=0.6"))), "--out", "out"
    )
    assert other.returncode == 2
    assert "with other options" in other.stderr


def test_groups_are_configs_times_robots(write, tmp_path):
    sweep = read(write(SWEEP), tmp_path / "out")
    groups = [trial.group for trial in sweep.trials]
    assert groups == [f"{c}_{r}" for c in ("plain", "alternate") for r in ("one", "two") for _ in range(2)]
    assert [trial.options.seed for trial in sweep.trials] == [1, 2] * 4
    last = sweep.trials[-1]
    assert last.options.robots == ["spot", "unitree_a1"]
    assert last.options.train_config == str(tmp_path / "mine.toml"), "paths are relative to the sweep"
    assert (last.iterations, last.config.run.num_steps_per_env) == (1, 8)
    alone = read(write("seeds = [3]"), tmp_path / "out")
    assert [trial.group for trial in alone.trials] == ["sweep"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seeds = []", "seeds"),
        ("seeds = [1, 1]", "listed twice"),
        ("seeds = [-1]", "seeds"),
        ("", "seeds"),
        ("seeds = 1 1", "TOML"),
        ("seeds = [1]\n[train]\nnum_env = 3", "num_env"),
        ("seeds = [1]\n[train]\nnum_envs = 0", "train.num_envs"),
        ('seeds = [1]\n[train]\ntrain_config = "nothing"', "nothing"),
        ('seeds = [1]\n[configs."../up"]\nnum_envs = 8', "configs"),
        ("seeds = [1]\n[robots]\nnone = []", "robots"),
        ("seeds = [1]\n[early_stopping]\ngrace_iterations = 5", "--ray"),
    ],
)
def test_what_is_wrong_with_a_sweep_is_named(cli, write, tmp_path, text, message):
    done = cli("sweep", str(write(text)), "--out", "out")
    assert done.returncode == 2, done.stdout
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_early_stopping_compares_velocity_errors():
    assert error_of(
        {"Metrics/spot/error_vel_xy": 0.2, "Metrics/b2/error_vel_xy": 0.4, "Loss/value": 3.0}
    ) == pytest.approx(0.3)
    assert error_of({"Loss/value": 3.0}) == float("inf")
