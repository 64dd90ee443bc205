"""Trainings and sweeps on a Ray cluster equal one process, even if a worker is killed."""

import os
import re
import signal
import subprocess
import sys
import time

import pytest

import polypod.cli
from polypod.runs import run_dir
from same_bits import equal

try:
    import ray
except ModuleNotFoundError:
    ray = None

needs_ray = pytest.mark.skipif(ray is None, reason="Ray is not installed: pip install 'polypod[ray]'")

LONGEST_S = 400.0
"""How long Ray may take for a command: each of its processes imports torch."""
CONFIG = 'extends = "flat"\n[run]\nsave_interval = 2\nnum_steps_per_env = 12\n'
TRAIN = ("--num-envs", "64", "--robots", "spot,unitree_a1", "--seed", "5", "--set", "sim.episode_length_s=1.0")


@pytest.mark.parametrize("command", [("train", "--ray"), ("sweep", "sweep.toml", "--ray", "somewhere:1")])
def test_the_missing_extra_is_named(monkeypatch, tmp_path, capsys, command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweep.toml").write_text("seeds = [1]")
    monkeypatch.setitem(sys.modules, "ray", None)
    assert polypod.cli.main(command) == 2
    assert "pip install 'polypod[ray]'" in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()


def test_workers_are_rays(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert polypod.cli.main(["train", "--workers", "2"]) == 2
    assert "torchrun" in capsys.readouterr().err
    monkeypatch.setenv("WORLD_SIZE", "2")
    for command in (["train", "--ray"], ["sweep", "sweep.toml"]):
        (tmp_path / "sweep.toml").write_text("seeds = [1]")
        assert polypod.cli.main(command) == 2
        assert "without torchrun" in capsys.readouterr().err


def start(folder, *words):
    """Starts `polypod` in a separate process."""
    (folder / "mine.toml").write_text(CONFIG)
    output = (folder / "output.txt").open("w")
    command = [sys.executable, "-m", "polypod", *words]
    # a separate cluster, whatever else runs on this machine
    environment = {**os.environ, "RAY_ADDRESS": "local"}
    return subprocess.Popen(command, cwd=folder, stdout=output, stderr=subprocess.STDOUT, env=environment)


def last_worker(folder):
    """The process of a worker that Ray has started, by its own words."""
    return int(re.findall(r"pid=(\d+)\) world_rank=1", (folder / "output.txt").read_text())[-1])


@needs_ray
def test_a_killed_worker_is_replaced_and_changes_nothing(tmp_path):
    words = ("train", "--train-config", "mine.toml", *TRAIN, "--device", "cpu", "--max-iterations", "60")
    alone = start(tmp_path, *words, "--log-dir", "alone")
    assert alone.wait(LONGEST_S) == 0
    training = start(tmp_path, *words, "--log-dir", "ray", "--ray", "--workers", "2")
    end = time.monotonic() + LONGEST_S
    while not list(tmp_path.glob("ray/rsl_rl/*/*/model_4.pt")):
        assert time.monotonic() < end
        assert training.poll() is None, (tmp_path / "output.txt").read_text()
        time.sleep(0.02)
    killed = last_worker(tmp_path)
    os.kill(killed, signal.SIGKILL)
    assert training.wait(LONGEST_S) == 0, (tmp_path / "output.txt").read_text()
    said = (tmp_path / "output.txt").read_text()
    assert f"process {killed} on" in said, "the worker is named"
    assert said.count("Started training worker group") >= 2
    one, two = (run_dir.find_checkpoint(tmp_path / log, "latest") for log in ("alone", "ray"))
    assert one.name == two.name == "model_60.pt"
    assert equal(one, two)


@needs_ray
def test_a_sweep_on_ray_is_one_table(tmp_path):
    (tmp_path / "sweep.toml").write_text(
        'seeds = [1, 2, 3]\n[train]\nnum_envs = 32\nrobots = ["spot"]\nset = ["sim.episode_length_s=0.4"]\n'
        'device = "cpu"\ntrain_config = "mine.toml"\nmax_iterations = 6\n[configs.a]\n[configs.b]\nlearner = "rsl_rl"\n'
        "[early_stopping]\ngrace_iterations = 3\n"
    )
    assert start(tmp_path, "sweep", "sweep.toml", "--out", "out", "--ray").wait(LONGEST_S) == 0, (
        tmp_path / "output.txt"
    ).read_text()
    said = (tmp_path / "output.txt").read_text()
    for group in "ab":
        assert len(list(tmp_path.glob(f"out/{group}/seed_*/eval.json"))) == 3
        assert re.search(rf"\| {group} \| `Velocity-Flat-HeteroQuadruped-v0` \| 1 \| 3 \| 1, 2, 3 \|", said)
    iterations = {run_dir.iterations_of(run_dir.latest_checkpoint(run)) for run in tmp_path.glob("out/*/seed_*")}
    assert 6 in iterations
    assert min(iterations) < 6, "the worse ones were stopped early"
