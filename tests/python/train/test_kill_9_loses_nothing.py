"""A training that is killed at any moment leaves whole files.

Once resumed, it ends as if nobody had killed it.
"""

import contextlib
import os
import random
import re
import signal
import time

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from common import size
from polypod.compat import tomllib
from polypod.runs import manifest, run_dir
from same_bits import equal

ITERATIONS = 8
TRAIN = (
    *("train", "--train-config", "mine.toml", "--num-envs", "64", "--robots", "spot", "--seed", "5"),
    *("--set", "sim.episode_length_s=1.0", "--max-iterations", str(ITERATIONS)),
)
CONFIG = 'extends = "flat"\n[run]\nsave_interval = 1\n[algorithm]\nnum_learning_epochs = 1\n'
AIMS = {
    "checkpoint": re.compile(r"\.model_(\d+)\.pt\..*\.tmp"),
    "manifest": re.compile(r"\.manifest\.json\..*\.tmp"),
    "between": re.compile(r"model_(\d+)\.pt"),
    "curves": re.compile(r"events\.out\..*"),
    "any": None,
}
"""Moments of a kill by the file that is seen then: half a checkpoint or manifest, a checkpoint that
the manifest does not know yet, new curves; "any": some time after a save."""
KILLS = size([("checkpoint", 0), ("manifest", 1), ("any", 2)], [(list(AIMS)[n % 5], n) for n in range(30)])


@pytest.fixture(scope="session")
def undisturbed(built_once, fork_server):
    """The run of a training that nobody kills."""

    def train(folder):
        (folder / "mine.toml").write_text(CONFIG)
        done = fork_server.run(*TRAIN, cwd=folder, seconds=150)
        assert done.code == 0, done.errors

    (run,) = built_once("undisturbed", train).glob("logs/rsl_rl/*/*")
    return run


def names(run):
    with contextlib.suppress(FileNotFoundError):
        return {entry.name: entry.stat().st_size for entry in os.scandir(run)}
    return {}


def wait_for(folder, done, seconds=60.0):
    """Waits until `done` says so of the files of the run in `folder`."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for run in folder.glob("logs/rsl_rl/*/*"):
            while time.monotonic() < end:
                if done(names(run)):
                    return run
    raise AssertionError("the training has not come so far")


def kill_at(process, folder, aim, draw):
    """Kills a training after one of its saves but the last.

    Returns its run and the files seen before.
    """
    after = draw.randrange(1, ITERATIONS - 1)
    run = wait_for(folder, lambda files: f"model_{after}.pt" in files)
    if AIMS[aim] is None:
        time.sleep(draw.uniform(0.0, 0.2))
    else:
        before = names(run)
        wait_for(
            folder,
            lambda files: any(AIMS[aim].fullmatch(name) and files[name] != before.get(name) for name in files),
            20,
        )
    seen = names(run)
    os.kill(process, signal.SIGKILL)
    return run, seen


def check_whole(run):
    """Every file under its final name is whole."""
    known = manifest.read(run / run_dir.MANIFEST).get("checkpoints", {})
    assert all((run / name).is_file() for name in known)
    for path in run.glob("model_*.pt"):
        state = run_dir.load_checkpoint(path)
        assert path.name == f"model_{state['iter']}.pt"
    for path in run.glob("params/*.toml"):
        tomllib.loads(path.read_text())
    return steps_of(run)


def steps_of(run):
    """Iterations of which the curves have a learning rate."""
    curves = EventAccumulator(str(run)).Reload()
    if "Loss/learning_rate" not in curves.Tags()["scalars"]:
        return []
    return [event.step for event in curves.Scalars("Loss/learning_rate")]


@pytest.mark.parametrize(("aim", "seed"), KILLS)
def test_kill(fork_server, undisturbed, tmp_path, aim, seed, record_property):
    (tmp_path / "mine.toml").write_text(CONFIG)
    process = fork_server.start(TRAIN, tmp_path, seconds=120)
    run, seen = kill_at(process, tmp_path, aim, random.Random(seed))
    assert fork_server.ended().code == -signal.SIGKILL

    steps = check_whole(run)
    assert steps == list(range(len(steps)))
    left = names(run)
    record_property("stale", [name for name in left if name.endswith(".tmp")])
    saved = {name for name in seen if re.fullmatch(r"model_\d+\.pt", name)}
    assert saved <= left.keys(), "a checkpoint that was there is lost"
    for path in run.glob("model_*.pt"):
        assert equal(path, undisturbed / path.name)

    done = fork_server.run("train", "--resume", str(run), cwd=tmp_path, seconds=120)
    assert done.code == 0, done.errors
    check_whole(run)
    assert steps_of(run) == list(range(ITERATIONS))
    assert not list(run.glob(".*.tmp"))
    assert equal(run / f"model_{ITERATIONS}.pt", undisturbed / f"model_{ITERATIONS}.pt")
