"""Every file of `tests/data/hostile` goes to every command that reads its kind.

None has its way.
"""

import resource
import shutil
import subprocess
from pathlib import Path

import pytest
import rsl_rl.runners  # noqa: F401 - on its first import it asks git for its version

from common import FLAT_POLICY, ROOT
from watched import nothing_started

PROGRAM = ROOT / "target" / "release" / "polypod-sim"
HOSTILE = ROOT / "tests" / "data" / "hostile"
GRAPH = FLAT_POLICY.parent / "exported" / "policy.onnx"

TINY = ("--num-envs", "8", "--steps", "1")
TRAIN = ("train", "--logger", "none", "--max-iterations", "1", "--num-envs", "64")
COMMANDS = {
    "eval": ("eval", *TINY, "--checkpoint"),
    "export": ("export", "--formats", "onnx", "--checkpoint"),
    "play": ("play", "--headless", "--seconds", "0.1", "--checkpoint"),
    "sim2sim": ("sim2sim", "--num-envs", "1", "--steps", "1", "--checkpoint"),
    "resume": ("train", "--logger", "none", "--max-iterations", "1", "--resume"),
    "init": (*TRAIN, "--init"),
}
"""Commands of `polypod` that read a checkpoint and its manifest."""


def files(folder, pattern="*"):
    """The files of one kind, in a fixed order."""
    return sorted(path.relative_to(HOSTILE).as_posix() for path in (HOSTILE / folder).glob(pattern))


def contents(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def ended_well(done):
    """Checks that a command ended in order, whether it took its file or not."""
    said = done.stdout + done.stderr
    assert done.returncode in (0, 2), said
    assert "Traceback" not in said
    assert "panicked" not in said
    if done.returncode == 2:
        assert done.stderr.strip()
    return done


def _no_file_grows():
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def program(folder, *arguments):
    """Runs `polypod-sim`, to which the system gives no file to write to."""
    before = contents(folder)
    command = [PROGRAM, *arguments]
    options = {"capture_output": True, "encoding": "utf-8", "errors": "replace", "timeout": 20}
    done = subprocess.run(command, cwd=folder, preexec_fn=_no_file_grows, check=False, **options)
    assert contents(folder) == before
    return ended_well(done)


def watched(cli, *arguments, cwd):
    """Runs `polypod`, which must start and write nothing."""
    before = contents(cwd)
    with nothing_started():
        done = cli(*arguments, cwd=cwd)
    assert contents(cwd) == before
    return ended_well(done)


@pytest.fixture
def run(tmp_path):
    """A folder with the bundled policy; the manifest is still to come."""
    path = tmp_path / "run" / FLAT_POLICY.name
    path.parent.mkdir()
    shutil.copy(FLAT_POLICY, path)
    return path


def refused_as_manifest(cli, command, run, file):
    shutil.copy(HOSTILE / file, run.parent / "manifest.json")
    done = watched(cli, *COMMANDS[command], str(run), cwd=run.parents[1])
    assert done.returncode == 2
    assert "manifest.json" in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("file", [file for file in files("manifests") if not file.endswith("/run_sound.json")])
def test_a_manifest_of_a_run(cli, run, file, command):
    refused_as_manifest(cli, command, run, file)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_sound_manifest_is_taken(cli, run, command):
    """The only faults of the other manifests are their changes."""
    shutil.copy(HOSTILE / "manifests" / "run_sound.json", run.parent / "manifest.json")
    done = cli(*COMMANDS[command], str(run))
    assert "manifest.json" not in done.stderr
    if command not in ("resume", "init"):  # the bundled policy has no critic and no optimiser
        assert done.returncode in (0, 3), done.stderr


@pytest.mark.parametrize("file", files("manifests"))
def test_a_manifest_of_an_export(tmp_path, file):
    shutil.copy(HOSTILE / file, tmp_path / "policy.json")
    (tmp_path / "policy.onnx").symlink_to(GRAPH)
    done = program(tmp_path, "play", "--policy", "policy.onnx", *TINY)
    assert (done.returncode == 0) == file.endswith("/export_sound.json"), done.stderr
    if done.returncode:
        assert done.stderr.startswith("error: "), done.stderr
        assert done.stderr.count("\n") == 1, done.stderr


@pytest.mark.parametrize("file", files("train_configs"))
def test_a_train_config(cli, tmp_path, file):
    shutil.copy(HOSTILE / file, tmp_path)
    name = Path(file).name
    done = watched(cli, *TRAIN[:-2], "--train-config", name, cwd=tmp_path)
    assert done.returncode == 2, done.stdout
    assert done.stderr.startswith("polypod: ")
    assert done.stderr.count("\n") == 1, done.stderr
    text = (HOSTILE / file).read_bytes().decode(errors="replace")
    if text.count("\n") == 3:  # one number out of its range
        assert name in done.stderr
        assert text.splitlines()[2].split(" = ")[0] in done.stderr


@pytest.mark.parametrize("file", files("toml"))
def test_a_config_of_a_robot_or_a_task(cli, tmp_path, file):
    shutil.copy(HOSTILE / file, tmp_path)
    name = Path(file).name
    eval_ = (*COMMANDS["eval"], str(FLAT_POLICY))
    for flag in ("--robots", "--task"):
        program(tmp_path, "rollout", *TINY, flag, name)
        program(tmp_path, "play", "--policy", str(GRAPH), *TINY, flag, name)
        watched(cli, *eval_, flag, name, cwd=tmp_path)
    program(tmp_path, "inspect", "--robot", name)
    program(tmp_path, "soak", "--minutes", "0.001", "--num-envs", "8", "--robots", name)
    watched(cli, "sim2sim", *COMMANDS["sim2sim"][1:], str(FLAT_POLICY), "--robots", name, cwd=tmp_path)


@pytest.mark.parametrize("file", files("urdf"))
def test_a_urdf(cli, tmp_path, file):
    shutil.copy(HOSTILE / file, tmp_path)
    name = Path(file).name
    program(tmp_path, "check", name)
    program(tmp_path, "check", name, "--package-dir", "a=/")
    watched(cli, "check", name, cwd=tmp_path)
    before = contents(tmp_path)
    ended_well(cli("robot", "new", name, "--out", "new.toml"))
    assert contents(tmp_path).keys() - before.keys() <= {tmp_path / "new.toml"}


@pytest.mark.parametrize("file", files("dumps") + files("snapshots"))
def test_a_dump(tmp_path, file):
    done = program(tmp_path, "replay", str(HOSTILE / file))
    assert done.returncode == 2


def test_the_folder_stays_small():
    assert sum(path.stat().st_size for path in HOSTILE.rglob("*") if path.is_file()) < 100_000
