"""Outputs are written whole or not at all, and never replace what is not a regular file."""

import errno
import json
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from common import FLAT_POLICY
from polypod import files

EVAL = ("eval", "--checkpoint", str(FLAT_POLICY), "--num-envs", "8", "--steps", "2", "--robots", "spot", "--json")


def leftovers(folder):
    return [path.name for path in folder.rglob("*.tmp")]


def test_a_pipe_is_read_at_its_other_end(cli, tmp_path):
    pipe, read = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    done = cli(*EVAL, "pipe")
    reader.join(timeout=30)
    assert done.returncode == 0, done.stderr
    assert "spot" in json.loads(read[0])["robots"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_device_stays_one(cli, tmp_path):
    device = tmp_path / "null"
    try:
        os.mknod(device, stat.S_IFCHR | 0o666, os.makedev(1, 3))
        device.write_bytes(b"")
    except OSError as error:
        pytest.skip(f"devices are not made here: {error.strerror}")
    done = cli(*EVAL, "null")
    assert done.returncode == 0, done.stderr
    assert stat.S_ISCHR(device.stat().st_mode)
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


def test_standard_output_prints(cli_process, fork_server, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    done = cli_process(*EVAL, "/dev/stdout")
    assert done.returncode == 0, done.stderr
    assert "spot" in json.loads(done.stdout[done.stdout.index("\n{") :])["robots"]
    # the same where it leads into a file, as that of these processes does
    ended = fork_server.run(*EVAL, "/dev/stdout", cwd=tmp_path)
    assert (ended.code, ended.output) == (0, done.stdout), ended.errors


def test_a_link_stays_and_its_target_is_written(cli, tmp_path):
    (tmp_path / "there").mkdir()
    target, link = tmp_path / "there" / "target.json", tmp_path / "link.json"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    assert cli(*EVAL, "link.json").returncode == 0
    assert link.is_symlink()
    assert "spot" in json.loads(target.read_text())["robots"]
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    assert not leftovers(tmp_path)


def test_a_link_to_nothing_makes_its_target(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "new")
    files.write_text(tmp_path / "link", "text")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "new").read_text() == "text"


@pytest.mark.parametrize("output", [".", "no\0name", "loop", "file/below", "/proc/nothing"])
def test_places_that_cannot_be_written(cli, tmp_path, output):
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "file").write_text("")
    done = cli(*EVAL, output)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("polypod: cannot write")
    assert done.stderr.count("\n") == 1


def test_a_full_device_is_one_line(cli):
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full here")
    done = cli(*EVAL, "/dev/full")
    assert done.returncode == 2
    assert "No space left on device" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("command", ["list", "info"])
def test_full_standard_output_is_one_line(tmp_path, command):
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full here")
    with Path("/dev/full").open("wb") as full:
        arguments = [sys.executable, "-m", "polypod", command]
        done = subprocess.run(arguments, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("polypod: ")
    assert "No space left on device" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.write_text("old")

    def fsync(handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(OSError, match="No space left"):
        files.write_text(file, "new")
    assert file.read_text() == "old"
    assert not leftovers(tmp_path)


def test_stale_temporary_files_alone_are_removed(tmp_path):
    stale = tmp_path / ".model_1.pt.a1b2c3d4.tmp"
    others = [tmp_path / name for name in (".hidden", "mine.tmp", ".mine.tmp", "model_1.pt")]
    for path in (stale, *others):
        path.write_text("")
    files.remove_stale(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(others)
