"""Run directories: where they lie, what is in them, how they are found again.

<log dir>/rsl_rl/<experiment>/<YYYY-mm-dd_HH-MM-SS>[_<run name>]/
    manifest.json        what a policy of this run needs to be used elsewhere, and the SHA-256 of each checkpoint
    .lock                held by the training that is at it
    params/env.toml      the resolved task and robots
    params/agent.toml    the resolved train config
    model_<n>.pt         the training's state after n iterations
    events.out.tfevents* TensorBoard's scalars
    broken_*.polypod     the first state of each robot that broke, if one did, for `polypod-sim replay`
"""

import contextlib
import hashlib
import io
import json
import pickle
import platform
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO

import filelock
import numpy as np
import tomli_w
import torch

from polypod import _core, descriptions, simulated
from polypod.files import read_bytes, real_path, remove_stale, write_bytes, write_text
from polypod.provenance import git_state
from polypod.python_terms import Terms
from polypod.runs import manifest
from polypod.runs.schema import TrainConfig

MANIFEST = "manifest.json"
LOCK = ".lock"
MAX_CHECKPOINT = 4 << 30
"""Bytes of a checkpoint, at most."""
_NETWORKS = ("actor_state_dict", "critic_state_dict", "student_state_dict", "teacher_state_dict")
"""Keys of the networks in checkpoints; a learner has some of them."""
_DTYPES = (
    *(torch.float32, torch.float64, torch.float16, torch.bfloat16),
    *(torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
)
"""Types of the tensors of a checkpoint."""
_SQUARES = ("._var", "._std", ".count")
"""Ends of the names of statistics that are sums or means of squares, or counts."""
_CHECKPOINT = re.compile(r"model_(\d+)\.pt")
_RUN = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_(.+)")


def create(log_dir: Path, experiment: str, run_name: str | None) -> Path:
    """Makes the directory of a new run. Raises ConfigError where it cannot be written."""
    stem = datetime.now().strftime("%Y-%m-%d_%H-%M-%S") + (f"_{run_name}" if run_name else "")
    parent = log_dir / "rsl_rl" / experiment
    for suffix in ("", *(f"-{n}" for n in range(2, 100))):
        run = parent / (stem + suffix)
        try:
            run.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise _core.ConfigError(f"cannot create {run}: {error.strerror}; choose another --log-dir") from error
        return run
    raise _core.ConfigError(f"{parent / stem} exists already; choose another --run-name")


def find_checkpoint(log_dir: Path, run: str) -> Path:
    """The checkpoint that `run` names.

    "latest", a checkpoint file, a run's directory, or its name or the end of it.

    The end of a name, such as the --run-name of the training, must be that of one run alone.

    Raises:
        ConfigError: where there is no such run, and where several end so.
    """
    path = Path(run)
    try:
        if path.is_file():
            return path
        if path.is_dir():
            return latest_checkpoint(path)
    except PermissionError as error:
        raise _core.ConfigError(f"cannot read {run}: {error.strerror}; ask its owner for a copy") from error
    except OSError:  # a name that is none, such as one of 5000 letters
        pass
    runs = _runs(log_dir)
    if run == "latest":
        if not runs:
            raise _core.ConfigError(f"no run with a checkpoint under {log_dir / 'rsl_rl'}; train one, or set --log-dir")
        return latest_checkpoint(runs[-1])
    matching = _matching(runs, run)
    if not matching:
        raise _core.ConfigError(
            f"{run[:80]!r} is neither a checkpoint nor a run under {log_dir / 'rsl_rl'}; "
            'pass a path, the name of a run or the end of it, or "latest"'
        )
    if len(matching) > 1:
        names = ", ".join(str(directory) for directory in matching)
        raise _core.ConfigError(f"{run[:80]!r} is the end of several runs: {names}; pass one of these")
    return latest_checkpoint(matching[0])


def has_run(log_dir: Path, run: str) -> bool:
    """Whether any run with a checkpoint has this name, or a name that ends so."""
    return bool(_matching(_runs(log_dir), run))


def _runs(log_dir: Path) -> list[Path]:
    """All runs with a checkpoint, the newest last."""
    found = (manifest.parent for manifest in log_dir.glob(f"rsl_rl/*/*/{MANIFEST}"))
    return sorted(
        (run for run in found if _checkpoints(run)),
        key=lambda directory: (directory.name, directory.stat().st_mtime),
    )


def _matching(runs: Sequence[Path], run: str) -> list[Path]:
    """The run of this name; where there is none, those with this --run-name.

    Else those whose names end so.
    """
    ways: tuple[Callable[[Path], bool], ...] = (
        lambda directory: directory.name == run,
        lambda directory: _run_name(directory) == run,
        lambda directory: bool(run) and directory.name.endswith(f"_{run}"),
    )
    for place, way in enumerate(ways):
        found = [directory for directory in runs if way(directory)]
        if found:
            # one name in several experiments: the newest run
            return found[-1:] if place == 0 else found
    return []


def _run_name(run: Path) -> str | None:
    """Part of a run directory's name that `--run-name` added."""
    match = _RUN.fullmatch(run.name)
    return match[1] if match is not None else None


def latest_checkpoint(run: Path) -> Path:
    """The checkpoint of `run` with the most iterations. Raises ConfigError when there is none."""
    checkpoints = _checkpoints(run)
    if not checkpoints:
        raise _core.ConfigError(f"{run} holds no checkpoint (model_<n>.pt)")
    return checkpoints[-1]


def iterations_of(checkpoint: Path) -> int:
    """Finished iterations, by the checkpoint's name. Raises ConfigError for another name."""
    match = _CHECKPOINT.fullmatch(checkpoint.name)
    if match is None:
        raise _core.ConfigError(f"{checkpoint} is not named model_<n>.pt; name it as polypod train does")
    return int(match[1])


def checkpoint_path(run: Path, iterations: int) -> Path:
    """Path of the checkpoint after `iterations` iterations."""
    return run / f"model_{iterations}.pt"


def load_checkpoint(path: Path, map_location: str | torch.device = "cpu") -> dict[str, Any]:
    """Reads a checkpoint; nothing in the file is executed.

    Raises:
        ConfigError: for a file that is no checkpoint, that is damaged, whose SHA-256 differs from
            the manifest next to it, or whose weights are not all finite.
    """
    return checkpoint_of(read_checkpoint(path), path, map_location)


def read_checkpoint(path: Path) -> bytes:
    """The bytes of a checkpoint. Raises ConfigError, like `load_checkpoint`, for a damaged file."""
    try:
        data = read_bytes(path, MAX_CHECKPOINT)
    except OSError as error:
        raise _core.ConfigError(f"cannot read {path}: {error.strerror}") from error
    _check_sum(path, data)
    return data


def checkpoint_of(data: bytes, path: Path, map_location: str | torch.device = "cpu") -> dict[str, Any]:
    """The checkpoint that bytes are.

    `path` names them in errors. Raises ConfigError like `load_checkpoint`.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if (broken := archive.testzip()) is not None:
                raise zipfile.BadZipFile(f"{broken} is not as it was written")
        with warnings.catch_warnings():
            # warnings about tensors that are refused below
            warnings.simplefilter("ignore")
            state = torch.load(io.BytesIO(data), map_location=map_location, weights_only=True)
    except pickle.UnpicklingError as error:  # torch's message is advice to trust the file
        raise _core.ConfigError(
            f"{path} is not a checkpoint: it asks for code, and a checkpoint holds numbers alone; use another file"
        ) from error
    except Exception as error:  # torch has no common class for the ways in which a file can be broken
        reason = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise _core.ConfigError(f"{path} is not a checkpoint: {reason}") from error
    if not isinstance(state, dict) or not isinstance(state.get("actor_state_dict"), dict):
        raise _core.ConfigError(f"{path} is not a checkpoint of polypod: it holds no 'actor_state_dict'")
    if type(state.get("iter", 0)) is not int or not 0 <= state.get("iter", 0) < 2**63:
        raise _core.ConfigError(f"{path}: iter is not a number of iterations; use another checkpoint")
    for place, tensor in _tensors(state):
        _check_plain(tensor, f"{path}: {place}")
    for name in _NETWORKS:
        weights = state.get(name)
        if weights is not None:
            _check_weights(weights, f"{path}: {name}")
    return state


def _tensors(state: dict[Any, Any]) -> Iterator[tuple[str, torch.Tensor]]:
    """All tensors of a checkpoint and where they are."""
    inside: list[tuple[str, Any]] = [("", state)]
    seen: set[int] = set()
    while inside:
        place, value = inside.pop()
        if isinstance(value, torch.Tensor):
            yield place, value
        elif isinstance(value, dict | list | tuple):
            if id(value) in seen:
                continue
            seen.add(id(value))
            parts = value.items() if isinstance(value, dict) else enumerate(value)
            inside += [(f"{place} {str(key)[:80]}".lstrip(), part) for key, part in parts]


def _check_plain(tensor: torch.Tensor, place: str) -> None:
    """Refuses a tensor that is not an ordinary array, before anything is computed with it.

    A few bytes can stand for an array that no memory holds: one of a sparse layout, or one that
    repeats its numbers.
    """
    is_ordinary = type(tensor) in (torch.Tensor, torch.nn.Parameter) and not tensor.is_nested
    if not is_ordinary or tensor.layout is not torch.strided:
        raise _core.ConfigError(f"{place} is a tensor of a kind that no checkpoint holds; use another file")
    if tensor.dtype not in _DTYPES or tensor.device.type == "meta":
        raise _core.ConfigError(
            f"{place} is of {tensor.dtype} on {tensor.device.type}, which no checkpoint holds; use another file"
        )
    if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
        raise _core.ConfigError(
            f"{place} has the shape {list(tensor.shape)}, but fewer numbers in the file than that; use another file"
        )


def _check_weights(weights: Any, place: str) -> None:
    """Refuses what is no network's state, and numbers that float32 does not hold."""
    if not isinstance(weights, dict) or not all(isinstance(key, str) for key in weights):
        raise _core.ConfigError(f"{place} is not a network's state; use another checkpoint")
    for key, value in weights.items():
        if not isinstance(value, torch.Tensor) or not (value.is_floating_point() or value.dtype is torch.int64):
            raise _core.ConfigError(f"{place} {key} holds no weights; use another checkpoint")
        if not bool(torch.isfinite(value.float()).all()):
            raise _core.ConfigError(f"{place} {key} holds a number that is not finite; use an earlier checkpoint")
        if key.endswith(_SQUARES) and bool((value < 0).any()):
            raise _core.ConfigError(f"{place} {key} holds a number below 0; use an earlier checkpoint")


def _check_sum(path: Path, data: bytes) -> None:
    """Compares a checkpoint with the manifest next to it, if that knows the file."""
    beside = path.parent / MANIFEST
    known = manifest.read(beside).get("checkpoints", {}).get(path.name) if beside.is_file() else None
    if known is not None and known != hashlib.sha256(data).hexdigest():
        raise _core.ConfigError(
            f"{path} is damaged or another run's: its SHA-256 is not the one in {beside}; "
            "copy both again, or use another checkpoint"
        )


def read_manifest(checkpoint: Path, *, as_begun: bool = False) -> dict[str, Any]:
    """The manifest next to a checkpoint; see `manifest.read`.

    Raises ConfigError when it is missing or broken.
    """
    return manifest.read(checkpoint.parent / MANIFEST, as_begun=as_begun)


def save_checkpoint(path: Path, fill: Callable[[BinaryIO], Any]) -> None:
    """Writes a checkpoint, whole or not at all, and its SHA-256 to the manifest next to it.

    A process may be killed at any point between: a checkpoint without an entry is read, by its own
    checksums alone.

    Raises:
        OSError: where it cannot be written.
        ConfigError: where the run's directory is gone.
    """
    beside = path.parent / MANIFEST
    if not beside.is_file():
        raise _core.ConfigError(
            f"{path.parent} is gone, and the run with it; train anew, or copy the directory back and resume"
        )
    buffer = io.BytesIO()
    fill(buffer)
    content = json.loads(beside.read_text(encoding="utf-8"))
    sums: dict[str, str] = content.setdefault("checkpoints", {})
    if sums.pop(path.name, None) is not None:
        write_text(beside, json.dumps(content, indent=2) + "\n")
    write_bytes(path, buffer.getbuffer())
    sums[path.name] = hashlib.sha256(buffer.getbuffer()).hexdigest()
    write_text(beside, json.dumps(content, indent=2) + "\n")


def remove_checkpoint(path: Path) -> None:
    """Removes a checkpoint and its entry in the manifest next to it.

    Raises OSError where it cannot be removed.
    """
    path.unlink(missing_ok=True)
    beside = path.parent / MANIFEST
    content = json.loads(beside.read_text(encoding="utf-8"))
    if content.get("checkpoints", {}).pop(path.name, None) is not None:
        write_text(beside, json.dumps(content, indent=2) + "\n")


@contextlib.contextmanager
def locked(run: Path) -> Iterator[None]:
    """Locks a run's directory against other trainings, and clears a killed one's leftovers.

    Raises:
        ConfigError: where another training is at it.
    """
    lock = filelock.FileLock(run / LOCK)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout as error:
        raise _core.ConfigError(f"{run} is being trained by another process; wait for it, or stop it") from error
    except OSError as error:
        raise _core.ConfigError(
            f"cannot write to {run}: {error.strerror}; copy the run to where it can be written"
        ) from error
    try:
        remove_stale(run)
        yield
    finally:
        lock.release()


def write_params(
    run: Path,
    sim: _core.VecSim,
    config: TrainConfig,
    robots: list[str] | None,
    overrides: list[str],
    command: str,
    terms: Terms | None = None,
    slots: Sequence[str] = (),
) -> None:
    """Writes the manifest and `params/`.

    `robots` are the names or paths that the run was begun with.
    """
    write_text(run / "params" / "env.toml", sim.resolved_config())
    write_text(run / "params" / "agent.toml", tomli_w.dumps(config.as_dict()))
    manifest = manifest_of(sim, config, robots, overrides, command)
    if slots:
        manifest["slots"] = list(slots)
    if terms is not None and terms.options is not None:
        manifest["motions"] = dict(terms.options)
    if terms is not None and terms.path is not None:
        # a record of what was run; it is never run by itself
        manifest["terms"] = {"file": terms.path.name, "sha256": terms.sha256}
        write_bytes(run / "params" / "terms.py", terms.path.read_bytes())
    write_text(run / MANIFEST, json.dumps(manifest, indent=2) + "\n")


def manifest_of(
    sim: _core.VecSim, config: TrainConfig, robots: list[str] | None, overrides: list[str], command: str
) -> dict[str, Any]:
    """Manifest of this run: all that its policies need elsewhere, and their origin."""
    infos = simulated.robots(sim)
    return {
        "format": 1,
        "command": command,
        "task": sim.task_name if _is_known(sim.task_name) else config.run.task,
        "experiment": sim.experiment_name,
        "robot_sources": [source(robot) for robot in robots or sim.robots],
        "overrides": overrides,
        "seed": sim.seed,
        "num_envs": sim.total_num_envs,
        "step_dt": sim.step_dt,
        "config_hash": sim.config_hash(),
        "canonical_joint_names": sim.canonical_joint_names,
        "observation_layout": [{"term": term, "size": size} for term, size in sim.observation_layout],
        "policy": {"num_obs": sim.num_obs, "num_actions": sim.num_actions, **config.policy_cfg(sim)},
        "robots": sim.robots,
        "robot_info": infos,
        "joint_maps": {robot: _joint_map(infos[robot]) for robot in sim.robots},
        **_trained_bodies(sim, robots, overrides),
        "train_config": config.as_dict(),
        "versions": {
            "polypod": _core.__version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "rsl_rl": version("rsl-rl-lib"),
            "numpy": np.__version__,
        },
        "git": git_state(),
    }


def _trained_bodies(sim: _core.VecSim, robots: list[str] | None, overrides: list[str]) -> dict[str, Any]:
    """The descriptions of the bodies of a training, of a policy that reads them."""
    if not any(term == descriptions.TERM for term, _ in sim.observation_layout):
        return {}
    task = sim.task_name if _is_known(sim.task_name) else descriptions.TASK
    return {"trained_bodies": descriptions.to_manifest(descriptions.describe(robots or sim.robots, task, overrides))}


def _joint_map(info: simulated.RobotInfo) -> list[dict[str, Any]]:
    """Returns name, column, joint, joint index and sign (-1: turns the other way) of each slot."""
    names, joints = info["joint_names"], info["joint_of_slot"]
    rows = zip(info["slots"], info["columns"], joints, info["slot_signs"], strict=True)
    return [
        {"slot": slot, "column": column, "joint": names[joint], "index": joint, "sign": sign}
        for slot, column, joint, sign in rows
    ]


def _checkpoints(run: Path) -> list[Path]:
    numbered = [(int(match[1]), path) for path in run.iterdir() if (match := _CHECKPOINT.fullmatch(path.name))]
    return [path for _, path in sorted(numbered)]


def source(name: str) -> str:
    """A robot's or task's name, or the absolute path of its config, to find it again."""
    return str(real_path(name)) if name.endswith(".toml") else name


def _is_known(task: str) -> bool:
    return any(task == entry["name"] for entry in _core.tasks())
