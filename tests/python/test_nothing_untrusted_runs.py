"""Nothing that a manifest, a checkpoint or a train config says is executed; broken ones are refused in one line."""

import contextlib
import copy
import json
import os
import pickle
import shutil
import sys
import zipfile
from pathlib import Path

import pytest
import rsl_rl.runners  # noqa: F401 - on its first import it asks git for its version
import torch

import polypod
from common import FLAT_POLICY
from polypod.training import config, run_dir

AUDITED = ("os.system", "os.exec", "os.posix_spawn", "os.fork", "os.forkpty", "subprocess.Popen", "socket.connect")
"""Events of Python's audit hooks that start a process or leave the machine."""

seen: list[str] = []
watching = False


def _hook(event, arguments):
    if watching and (event in AUDITED or (event == "open" and _writes(arguments))):
        seen.append(f"{event} {arguments!r}")


def _writes(arguments):
    path, mode, flags = arguments
    if (
        not isinstance(path, str)
        or path.endswith("/.lock")
        or path.startswith(("/dev/", "/proc/"))
        or "__pycache__" in path
    ):
        return False
    return bool(mode and set(mode) & set("wax+")) or bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))


sys.addaudithook(_hook)


@contextlib.contextmanager
def nothing_started():
    """Fails when a process is started or a file opened for writing meanwhile."""
    global watching
    seen.clear()
    watching = True
    try:
        yield
    finally:
        watching = False
    assert not seen


def test_the_watch_sees_processes_and_files(tmp_path):
    for act in (lambda: os.system("true"), lambda: (tmp_path / "file").write_text("")):
        with pytest.raises(AssertionError), nothing_started():
            act()


@pytest.fixture
def checkpoint(tmp_path):
    """A copy of the policy that comes along, whose manifest knows no checksum."""
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
    "resume": ("train", "--logger", "none", "--max-iterations", "1", "--resume"),
    "init": ("train", "--logger", "none", "--max-iterations", "1", "--num-envs", "64", "--init"),
}
READ_THE_MANIFEST = [name for name in COMMANDS if name != "init"]

EVIL = "touch PWNED"
CODE = {"class_name": "os:system", "init_std": 1.0}


def edit(*path, value):
    """A manifest's change: `value` at `path`, or nothing there."""

    def apply(manifest):
        place = manifest
        for key in path[:-1]:
            place = place[key]
        if value is ...:
            del place[path[-1]]
        else:
            place[path[-1]] = value
        return manifest

    return apply


MANIFESTS = {
    "a command for a distribution": lambda m: edit("policy", "distribution_cfg", value=CODE)(
        edit("policy", "num_actions", value=EVIL)(m)
    ),
    "a distribution by module": edit("policy", "distribution_cfg", "class_name", value="subprocess:Popen"),
    "a network by module": edit("policy", "class_name", value="os:system"),
    "a network of builtins": edit("policy", "class_name", value="builtins:exec"),
    "an activation by module": edit("policy", "activation", value="os:system"),
    "text for a size": edit("policy", "num_obs", value=EVIL),
    "text in a list": edit("policy", "hidden_dims", value=[128, EVIL]),
    "a huge layer": edit("policy", "hidden_dims", value=[1_000_000_000]),
    "many large layers": edit("policy", "hidden_dims", value=[60000] * 60),
    "no layers": edit("policy", "hidden_dims", value=[]),
    "a negative size": edit("policy", "num_actions", value=-12),
    "a size of another task": edit("policy", "num_obs", value=84),
    "infinite deviation": edit("policy", "distribution_cfg", "init_std", value=1e999),
    "no policy": edit("policy", value=...),
    "a policy that is a list": edit("policy", value=[]),
    "a step of nothing": edit("step_dt", value=0.0),
    "no robots": edit("robot_sources", value=[]),
    "robots by number": edit("robot_sources", value=[1, 2]),
    "overrides that are text": edit("overrides", value="sim.dt=1"),
    "a task by number": edit("task", value=7),
    "a later format": edit("format", value=2),
    "a layout without sizes": edit("observation_layout", value=[{"term": "base_lin_vel"}]),
}
for _key in ("format", "task", "robot_sources", "overrides", "step_dt", "observation_layout", "robots", "train_config"):
    MANIFESTS[f"{_key} missing"] = edit(_key, value=...)

BYTES = {
    "nothing": b"",
    "no UTF-8": b"\xff\xfe{}",
    "100,000 brackets": b"[" * 100_000,
    "100,000 objects": b'{"policy":' * 100_000,
    "a list": b"[]",
    "a number": b"1",
    "NaN": b'{"format": NaN}',
    "half of one": (FLAT_POLICY.parent / "manifest.json").read_bytes()[:5000],
}


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


@pytest.mark.parametrize("command", READ_THE_MANIFEST)
@pytest.mark.parametrize("name", MANIFESTS)
def test_a_hostile_manifest(cli, checkpoint, name, command):
    file = checkpoint.parent / "manifest.json"
    file.write_text(json.dumps(MANIFESTS[name](json.loads(file.read_text()))))
    assert "manifest.json" in refused(cli, command, checkpoint)


@pytest.mark.parametrize("command", READ_THE_MANIFEST)
@pytest.mark.parametrize("name", BYTES)
def test_a_broken_manifest(cli, checkpoint, name, command):
    (checkpoint.parent / "manifest.json").write_bytes(BYTES[name])
    assert "manifest.json" in refused(cli, command, checkpoint)


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


BAD_NUMBERS = [
    ("algorithm", key, value)
    for key, values in {
        "gamma": (5.0, -0.1, "nan"),
        "lam": (2.0, "nan", "inf"),
        "clip_param": (-1.0, 0.0, "nan"),
        "desired_kl": (0.0, "nan"),
        "max_grad_norm": (0.0, -1.0, "nan", "inf"),
        "learning_rate": (1e30, "inf", "nan"),
        "entropy_coef": ("nan", -1.0),
        "value_loss_coef": ("inf", -1.0),
        "num_mini_batches": (0, 10**12),
    }.items()
    for value in values
] + [
    ("run", "num_steps_per_env", 10**9),
    ("run", "num_envs", 10**9),
    ("run", "save_interval", 0),
    ("actor", "init_std", "inf"),
    ("actor", "init_std", 1e30),
    ("actor", "activation", '"nope"'),
    ("actor", "hidden_dims", "[1000000000]"),
    ("critic", "hidden_dims", "[60000, 60000]"),
]


@pytest.mark.parametrize(("section", "key", "value"), BAD_NUMBERS)
def test_numbers_of_train_configs_are_in_their_ranges(cli, tmp_path, section, key, value):
    (tmp_path / "mine.toml").write_text(f'extends = "flat"\n[{section}]\n{key} = {value}\n')
    done = cli("train", "--train-config", "mine.toml", "--logger", "none")
    assert done.returncode == 2
    assert "mine.toml" in done.stderr
    assert key in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    "content",
    [b"\xff\xfe", b"a = " + b"[" * 3000, b"\x00", b'extends = "flat"\n' + b"a" * (2 << 20)],
    ids=["no UTF-8", "brackets", "zero", "2 MiB"],
)
def test_broken_train_configs(tmp_path, content):
    (tmp_path / "mine.toml").write_bytes(content)
    with pytest.raises(polypod.ConfigError, match=r"mine\.toml"):
        config.load(str(tmp_path / "mine.toml"))


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
