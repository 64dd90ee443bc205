"""Nothing that a checkpoint says is executed; broken ones are refused in one line.

Manifests and train configs are those of `test_hostile_files.py`.
"""

import copy
import json
import os
import pickle
import shutil
import zipfile
from pathlib import Path

import pytest
import rsl_rl.runners  # noqa: F401 - on its first import it asks git for its version
import torch

import polypod
from common import FLAT_POLICY
from polypod.runs import config, run_dir
from watched import nothing_started


def test_the_watch_sees_processes_and_files(tmp_path):
    for act in (lambda: os.system("true"), lambda: (tmp_path / "file").write_text("")):
        with pytest.raises(AssertionError), nothing_started():
            act()


@pytest.fixture
def checkpoint(tmp_path):
    """A copy of the bundled policy, whose manifest knows no checksum."""
    path = tmp_path / "run" / FLAT_POLICY.name
    path.parent.mkdir()
    shutil.copy(FLAT_POLICY, path)
    manifest = json.loads((FLAT_POLICY.parent / "manifest.json").read_text())
    del manifest["checkpoints"]
    (path.parent / "manifest.json").write_text(json.dumps(manifest))
    return path


COMMANDS = {
    "eval": ("eval", "--num-envs", "8", "--steps", "1", "--checkpoint"),
    "export": ("export", "--formats", "onnx", "--checkpoint"),
    "play": ("play", "--headless", "--seconds", "0.1", "--checkpoint"),
    "sim2sim": ("sim2sim", "--num-envs", "1", "--steps", "1", "--checkpoint"),
    "robustness": ("robustness", "--num-envs", "1", "--mujoco-envs", "1", "--steps", "1", "--checkpoint"),
    "resume": ("train", "--logger", "none", "--max-iterations", "1", "--resume"),
    "init": ("train", "--logger", "none", "--max-iterations", "1", "--num-envs", "64", "--init"),
}

EVIL = "touch PWNED"


def refused(cli, command, checkpoint):
    """Runs a command that must end with one line and exit code 2, and start and write nothing."""
    before = sorted(path for path in checkpoint.parents[1].rglob("*"))
    with nothing_started():
        done = cli(*COMMANDS[command], str(checkpoint))
    assert done.returncode == 2, done.stdout + done.stderr
    assert done.stderr.startswith("polypod: ")
    assert done.stderr.count("\n") == 1, done.stderr
    assert "bug" not in done.stderr
    assert sorted(path for path in checkpoint.parents[1].rglob("*")) == before
    return done.stderr


class Runs:
    """Pickled, it is a call."""

    def __init__(self, function, *arguments):
        """The call `function(*arguments)`."""
        self.call = function, arguments

    def __reduce__(self):
        return self.call


PICKLES = {
    "a command": Runs(os.system, EVIL),
    "a command among the weights": {"actor_state_dict": Runs(os.system, EVIL)},
    "exec": {"actor_state_dict": {}, "infos": Runs(exec, "open('PWNED', 'w')")},
    "an import": Runs(__import__, "antigravity"),
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("wrapped", [True, False], ids=["torch", "bare"])
@pytest.mark.parametrize("name", PICKLES)
def test_a_pickle_that_runs_code(cli, checkpoint, name, wrapped, command):
    if wrapped:
        torch.save(PICKLES[name], checkpoint)
    else:
        checkpoint.write_bytes(pickle.dumps(PICKLES[name]))
    message = refused(cli, command, checkpoint)
    assert "is not a checkpoint" in message
    assert "weights_only" not in message, "torch's advice is to trust the file"


def _with(change):
    def damage(path):
        state = torch.load(path, weights_only=True)
        change(state)
        torch.save(state, path)

    return damage


def _poison(state):
    next(iter(state["actor_state_dict"].values()))[0] = float("nan")


CHECKPOINTS = {
    "nothing": lambda path: path.write_bytes(b""),
    "half of one": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "a zip of nothing": lambda path: zipfile.ZipFile(path, "w").close(),
    "NaN": _with(_poison),
    "a list for weights": _with(lambda state: state.update(actor_state_dict=[1.0])),
    "weights by number": _with(lambda state: state.update(actor_state_dict={1: torch.zeros(3)})),
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("name", CHECKPOINTS)
def test_a_broken_checkpoint(cli, checkpoint, name, command):
    CHECKPOINTS[name](checkpoint)
    assert str(checkpoint) in refused(cli, command, checkpoint)


@pytest.mark.parametrize("key", ["infos", "iter", "optimizer_state_dict", "critic_state_dict"])
def test_a_checkpoint_without_what_a_resumed_training_needs(cli, trained_run, tmp_path, key):
    path = _copy_of(trained_run, tmp_path)
    _with(lambda state: state.pop(key))(path)
    assert "resume" in refused(cli, "resume", path) or key != "infos"


@pytest.mark.parametrize("key", ["sim", "rng", "cuda_rng", "logger", "reward_scale"])
@pytest.mark.parametrize("value", [..., 7, "text", []], ids=["missing", "number", "text", "list"])
def test_a_checkpoint_with_other_infos(cli, trained_run, tmp_path, key, value):
    if (key, value) in (
        ("cuda_rng", []),
        ("reward_scale", ...),
        ("reward_scale", 7),
        ("reward_scale", "text"),
        ("reward_scale", []),
    ):
        pytest.skip("this run has no such state")
    if key == "cuda_rng" and value in (7, "text"):
        pytest.skip("read on a GPU only")
    path = _copy_of(trained_run, tmp_path)
    _with(lambda state: state["infos"].pop(key) if value is ... else state["infos"].update({key: value}))(path)
    refused(cli, "resume", path)


def _copy_of(checkpoint: Path, folder: Path) -> Path:
    """A copy of a run, whose manifest vouches for no checkpoint."""
    run = folder / "run"
    shutil.copytree(checkpoint.parent, run)
    manifest = json.loads((run / "manifest.json").read_text())
    del manifest["checkpoints"]
    (run / "manifest.json").write_text(json.dumps(manifest))
    return run / checkpoint.name


def test_every_flipped_bit_is_noticed(trained_run, tmp_path):
    path = _copy_of(trained_run, tmp_path)
    shutil.copy(trained_run.parent / "manifest.json", path.parent)
    whole = path.read_bytes()
    run_dir.load_checkpoint(path)
    for index in range(0, len(whole), len(whole) // 40):
        damaged = bytearray(whole)
        damaged[index] ^= 1 << index % 8
        path.write_bytes(damaged)
        with pytest.raises(polypod.ConfigError, match="damaged"):
            run_dir.load_checkpoint(path)


def test_a_flipped_bit_of_a_weight_is_noticed_without_a_manifest(tmp_path):
    path = tmp_path / FLAT_POLICY.name
    whole = FLAT_POLICY.read_bytes()
    for index in range(len(whole) // 4, len(whole) * 3 // 4, len(whole) // 20):
        damaged = bytearray(whole)
        damaged[index] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(polypod.ConfigError, match="is not a checkpoint"):
            run_dir.load_checkpoint(path)


@pytest.mark.parametrize("content", [b"", b"\x00" * (2 << 20)], ids=["nothing", "2 MiB"])
def test_broken_train_configs(tmp_path, content):
    (tmp_path / "mine.toml").write_bytes(content)
    with pytest.raises(polypod.ConfigError, match=r"mine\.toml"):
        config.load(str(tmp_path / "mine.toml"))


@pytest.mark.parametrize("brackets", [b"[", b'{"policy":'])
def test_a_manifest_of_100_000_brackets(cli, checkpoint, brackets):
    (checkpoint.parent / "manifest.json").write_bytes(brackets * 100_000)
    assert "manifest.json" in refused(cli, "eval", checkpoint)


def test_a_chain_of_train_configs_has_an_end(tmp_path):
    for number in range(1200):
        (tmp_path / f"{number}.toml").write_text(f'extends = "{tmp_path / str(number + 1)}.toml"\n')
    with pytest.raises(polypod.ConfigError, match="chain"):
        config.load(str(tmp_path / "0.toml"))


def test_a_train_config_is_no_device():
    with pytest.raises(polypod.ConfigError):
        config.load("/dev/zero.toml")


def test_the_shipped_manifests_vouch_for_their_checkpoints():
    manifest = run_dir.read_manifest(FLAT_POLICY)
    assert FLAT_POLICY.name in manifest["checkpoints"]
    other = copy.deepcopy(manifest)
    assert other == json.loads((FLAT_POLICY.parent / "manifest.json").read_text())
