"""`polypod bench --learner` and `--workers` train and report as they say."""

import json

import pytest
import torch

from polypod.bench import workers
from polypod.bench.learners import Options

TINY = 'extends = "quick"\n[run]\nnum_envs = 32\nnum_steps_per_env = 4\nmax_iterations = 2\n'


def test_learners_are_timed_in_turn(cli, tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    finished = cli("bench", "--learner", "--train-config", "tiny.toml", "--json", "times.json")
    assert finished.returncode == 0, finished.stderr
    result = json.loads((tmp_path / "times.json").read_text())
    assert result["samples"] == 128
    assert {"native", "rsl_rl"} <= result["learners"].keys()
    for name, row in result["learners"].items():
        assert row["iteration_s"] == row["collection_s"] + row["update_s"] > 0.0
        assert f"| {name} |" in finished.stdout


def test_workers_share_the_cores(cli, tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    arguments = ("--workers", "2", "--train-config", "tiny.toml", "--step-threads", "2", "--json", "workers.json")
    finished = cli("bench", *arguments)
    assert finished.returncode == 0, finished.stderr
    row = json.loads((tmp_path / "workers.json").read_text())["workers"]["2"]
    assert row["threads"] == 1
    assert 0.0 < row["wait_s"] < row["iteration_s"]
    # gradients of the networks 83-128-128-128-12 and -1 in lines of 16, inputs padded to 88; and
    # some statistics
    lines = sum(8 * (inputs + 1) for inputs in 2 * (88, 128, 128)) + 2 * 129 + 1
    assert 20 * 64 * lines < row["sent_bytes"] < 20 * 64 * lines + 50_000
    assert "| 2 x 1 |" in finished.stdout
    assert "| 10 Gbit/s |" in finished.stdout


def test_a_network_takes_the_gradients_twice():
    # two workers send all once; four send three quarters twice
    assert workers.limit_s({"1": {"sent_bytes": 0}, "2": {"sent_bytes": 10}}, 5.0) == pytest.approx(4.0)
    assert workers.limit_s({"4": {"sent_bytes": 15}, "2": {"sent_bytes": 10}}, 5.0) == pytest.approx(4.0)


def test_figures_of_gpus_name_them_and_their_messages():
    rows = {
        "1": {"threads": 8, "iteration_s": 0.5, "backend": "none"},
        "2": {"threads": 4, "iteration_s": 0.25, "backend": "nccl"},
        "4": {"threads": 2, "iteration_s": 0.4, "backend": "gloo"},
    }
    result = {**Options().conditions(), "samples": 1000, "device": "cuda", "gpus": ["T4", "T4"], "workers": rows}
    table = workers.table(result)
    assert "updates on 2 x T4" in table
    assert "| 2 x 4 | 2 | nccl | 0.250 | 4,000 | 200% |" in table
    assert "| 4 x 2 | 2 | gloo | 0.400 | 2,500 | 125% |" in table


def test_gpus_that_are_not_there_are_refused(cli, tmp_path):
    if torch.cuda.is_available():
        pytest.skip("there is one")
    finished = cli("bench", "--workers", "1", "--device", "cuda")
    assert finished.returncode == 2
    assert "no CUDA device" in finished.stderr
