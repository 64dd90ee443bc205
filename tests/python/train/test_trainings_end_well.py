"""A training that is stopped, disturbed or starved loses nothing, and goes on."""

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
import torch

import polypod
from common import TINY
from polypod.runs import run_dir
from polypod.training import runner as module
from polypod.training import session
from polypod.training.runner import Runner

TRAIN = (
    *("train", "--logger", "none", "--num-envs", "64", "--robots", "spot", "--seed", "5"),
    *("--set", "sim.episode_length_s=1.0"),
)


def start(folder, *arguments, **options):
    """A training in a separate process, at its first iteration or later."""
    command = [sys.executable, "-m", "polypod", *TRAIN, *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, cwd=folder, **pipes, **options)
    for line in process.stdout:
        if line.startswith("iteration"):
            break
    return process


@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGHUP", 129)])
def test_a_signal_saves_and_the_resumed_training_has_the_same_bits(cli, tmp_path, name, code):
    process = start(tmp_path, "--max-iterations", "100000")
    time.sleep(0.1)
    process.send_signal(getattr(signal, name))
    _, errors = process.communicate(timeout=60)
    assert process.returncode == code, errors
    assert "Traceback" not in errors
    saved = run_dir.find_checkpoint(tmp_path / "logs", "latest")
    stopped = int(saved.stem.removeprefix("model_"))
    assert cli("train", "--logger", "none", "--resume", str(saved), "--max-iterations", "2").returncode == 0
    (tmp_path / "whole").mkdir()
    assert cli(*TRAIN, "--max-iterations", str(stopped + 2), cwd=tmp_path / "whole").returncode == 0
    resumed = run_dir.load_checkpoint(saved.with_name(f"model_{stopped + 2}.pt"))
    whole = run_dir.load_checkpoint(run_dir.find_checkpoint(tmp_path / "whole" / "logs", "latest"))
    assert resumed["iter"] == whole["iter"] == stopped + 2
    for part in ("actor_state_dict", "critic_state_dict"):
        for key, value in whole[part].items():
            assert torch.equal(resumed[part][key], value), key
    assert torch.equal(resumed["infos"]["sim"], whole["infos"]["sim"])


def test_an_ignored_signal_stays_ignored(tmp_path):
    process = start(
        tmp_path, "--max-iterations", "100000", preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)
    )
    process.send_signal(signal.SIGHUP)
    time.sleep(0.3)
    assert process.poll() is None
    process.terminate()
    process.communicate(timeout=60)
    assert process.returncode == 143


def test_a_signal_that_comes_twice_at_once_is_one(monkeypatch):
    """A scheduler tells the whole group of `make train`, and make tells its child again."""
    said = []
    runner = Runner.__new__(Runner)
    runner.stopped_by, runner.reporter = None, SimpleNamespace(message=said.append)
    with runner._stop_on_signals():
        for _ in range(3):
            signal.raise_signal(signal.SIGTERM)
        assert runner.stopped_by == signal.SIGTERM
        assert len(said) == 1
        monkeypatch.setattr(module, "SAME_SIGNAL_S", 0.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)


def test_ctrl_c_twice_ends_at_once():
    runner = Runner.__new__(Runner)
    runner.stopped_by, runner.reporter = None, SimpleNamespace(message=lambda text: None)
    with runner._stop_on_signals():
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_two_trainings_do_not_share_a_run(cli, tmp_path):
    process = start(tmp_path, "--max-iterations", "100000")
    try:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
        checkpoint = run_dir.find_checkpoint(tmp_path / "logs", "latest")
        with run_dir.locked(checkpoint.parent):
            done = cli("train", "--resume", str(checkpoint), "--max-iterations", "1")
        assert done.returncode == 2
        assert "another process" in done.stderr
    finally:
        process.kill()
    assert cli("train", "--logger", "none", "--resume", str(checkpoint), "--max-iterations", "1").returncode == 0


def test_a_run_whose_directory_disappears_stops(tmp_path):
    process = start(tmp_path, "--max-iterations", "100000")
    shutil.rmtree(tmp_path / "logs")
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "is gone" in errors
    assert errors.count("\n") == 1, errors
    assert not (tmp_path / "logs").exists()


def test_a_full_disk_is_tried_again_at_the_next_save(cli, tmp_path, monkeypatch):
    save, failures = run_dir.save_checkpoint, []

    def full_at_first(path, fill):
        if len(failures) < 2:
            failures.append(path)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(path, fill)

    monkeypatch.setattr(run_dir, "save_checkpoint", full_at_first)
    (tmp_path / "mine.toml").write_text('extends = "flat"\n[run]\nsave_interval = 1\n')
    done = cli(*TRAIN, "--train-config", "mine.toml", "--max-iterations", "3")
    assert done.returncode == 0, done.stderr
    assert " ".join(done.stdout.split()).count("No space left on device") == 2
    (run,) = (tmp_path / "logs").glob("rsl_rl/*/*")
    assert [path.name for path in run.glob("model_*.pt")] == ["model_3.pt"]


def test_a_disk_that_stays_full_is_one_line(cli, monkeypatch):
    def full(path, fill):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(run_dir, "save_checkpoint", full)
    done = cli(*TRAIN, "--max-iterations", "1")
    assert done.returncode == 2
    assert "No space left on device" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_training_that_cannot_begin_leaves_no_directory(tmp_path, trained_run, monkeypatch):
    def fail(self, path):
        raise polypod.ConfigError("no")

    monkeypatch.setattr(Runner, "start_from", fail)
    options = session.Options(log_dir=tmp_path, device="cpu", logger="none", max_iterations=1, init=trained_run, **TINY)
    with pytest.raises(polypod.ConfigError, match="no"):
        session.train(options)
    assert not list(tmp_path.glob("rsl_rl/*/*"))


def test_a_checkpoint_without_an_entry_is_read(tmp_path, trained_run):
    """A process may be killed between a checkpoint and its entry in the manifest."""
    run = tmp_path / "run"
    shutil.copytree(trained_run.parent, run)
    path = run / trained_run.name

    def fill(file):
        torch.save(torch.load(trained_run, weights_only=True), file)

    def killed(*arguments):
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_dir, "write_bytes", killed)
        with pytest.raises(KeyboardInterrupt):
            run_dir.save_checkpoint(path, fill)
    assert path.name not in run_dir.read_manifest(path)["checkpoints"]
    run_dir.load_checkpoint(path)
