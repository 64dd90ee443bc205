"""A training survives a full disk and writes its curves later.

A user who may not read a run is told so.
"""

import contextlib
import errno
import os
import subprocess
import tempfile
import time
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from common import FLAT_POLICY
from polypod.training.curves import Curves

NOBODY = 65534


def steps_of(folder, tag="Loss/learning_rate"):
    return [event.step for event in EventAccumulator(str(folder)).Reload().Scalars(tag)]


class FullFile:
    """A file on a disk that takes half of a write and no more, for a while."""

    def __init__(self, file):
        """Wraps a file."""
        self.file, self.full = file, True

    def __getattr__(self, name):
        return getattr(self.file, name)

    def write(self, data):
        """Writes all, or half."""
        if self.full:
            self.file.write(data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self.file.write(data)


def test_curves_wait_for_the_disk(tmp_path):
    said = []
    curves = Curves(tmp_path, None, said.append)
    curves._file = FullFile(curves._file)
    for step in range(10):
        curves._file.full = 3 <= step < 6
        curves.add_scalar("a", 0.5 * step, step)
        curves.flush()
    curves.close()
    assert len(said) == 1
    assert "No space left on device" in said[0]
    assert steps_of(tmp_path, "a") == list(range(10))


def test_curves_of_a_resumed_run_replace_later_ones(tmp_path):
    for begin, purge in ((0, None), (3, 3)):
        curves = Curves(tmp_path, purge, print)
        for step in range(begin, 5):
            curves.add_scalar("a", float(step), step)
        curves.close()
    assert len(list(tmp_path.iterdir())) == 2
    assert steps_of(tmp_path, "a") == list(range(5))


def test_curves_without_a_disk_do_not_end_a_training(tmp_path):
    said = []
    curves = Curves(tmp_path / "nothing", None, said.append)
    curves.add_scalar("a", 1.0, 1)
    curves.close()
    assert len(said) == 1


@pytest.fixture
def small_disk(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", disk], capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip("disks are not mounted here")
    yield disk
    subprocess.run(["umount", disk], check=True)


def test_a_disk_that_fills_up_and_empties_again(fork_server, tmp_path, small_disk):
    arguments = ("--num-envs", "64", "--robots", "spot", "--max-iterations", "60", "--log-dir", "disk")
    fork_server.start(("train", *arguments), tmp_path, seconds=120)

    def wait_for(done):
        end = time.monotonic() + 60.0
        while not done():
            assert time.monotonic() < end
            time.sleep(0.01)

    wait_for(lambda: list(small_disk.glob("rsl_rl/*/*/events*")))
    filler = small_disk / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    wait_for(lambda: b"the curves wait" in (tmp_path / ".output").read_bytes())
    filler.unlink()
    done = fork_server.ended()
    assert done.code == 0, done.errors
    assert not done.errors
    (run,) = small_disk.glob("rsl_rl/*/*")
    assert steps_of(run) == list(range(60))
    assert (run / "model_60.pt").is_file()


@pytest.mark.parametrize(
    "arguments",
    [
        ("eval", "--checkpoint", "closed/model_1.pt"),
        ("export", "--checkpoint", "closed/model_1.pt"),
        ("play", "--headless", "--checkpoint", "closed/model_1.pt"),
        ("sim2sim", "--checkpoint", "closed/model_1.pt"),
        ("train", "--resume", "closed/model_1.pt"),
        ("train", "--resume", "closed"),
        ("train", "--resume", "latest", "--log-dir", "closed"),
        ("train", "--num-envs", "64", "--log-dir", "closed"),
        ("train", "--init", "closed/model_1.pt"),
        ("train", "--train-config", "closed/mine.toml"),
        ("terrain", "--out", "closed/map.png"),
        ("eval", "--checkpoint", str(FLAT_POLICY), "--num-envs", "8", "--steps", "1", "--json", "closed/a.json"),
    ],
    ids=lambda arguments: " ".join(arguments[:3:2]),
)
def test_a_folder_that_is_closed_to_the_reader(fork_server, arguments):
    with tempfile.TemporaryDirectory() as name:  # pytest's folders are closed to others altogether
        folder, closed = Path(name), Path(name) / "closed"
        folder.chmod(0o777)
        closed.mkdir()
        (closed / "model_1.pt").write_bytes(b"")
        closed.chmod(0)
        try:
            done = fork_server.run(*arguments, cwd=folder, user=NOBODY if os.geteuid() == 0 else None)
        finally:
            closed.chmod(0o700)
    assert done.code == 2, done.output + done.errors
    assert "closed" in done.errors
    assert "Permission denied" in done.errors or "latest" in arguments
    assert done.errors.count("\n") == 1, done.errors
