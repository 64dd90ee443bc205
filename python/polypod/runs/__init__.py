"""Files of trainings: train configs, manifests, checkpoints, and how they are found by name."""

from pathlib import Path

from polypod import bundled

LOGS = Path("logs")
"""Folder in which `polypod train` keeps its runs by default."""


def resolve(given: Path | None, log_dir: Path = LOGS) -> Path:
    """A file.

    A run's folder stands for its last checkpoint. Where there is no such file, a bundled policy by
    its name or the last checkpoint of a run by its name.

    Args:
        given: path, name of a bundled policy, or name of a run or the end of it. None: the bundled
            policy for flat ground.
        log_dir: where the runs are.

    Raises:
        ConfigError: for the end of several runs' names.
    """
    if given is None:
        return bundled.checkpoint()
    if _exists(given) and not _is_other_folder(given):
        return _in_folder(given)
    if str(given) in bundled.FOLDERS:
        return bundled.checkpoint(str(given))
    if given.name != str(given) or given.suffix in (".pt", ".onnx") or not _exists(log_dir / "rsl_rl"):
        return given
    # it imports torch
    from polypod.runs.run_dir import find_checkpoint, has_run

    return find_checkpoint(log_dir, str(given)) if has_run(log_dir, str(given)) else given


def _in_folder(path: Path) -> Path:
    """The last checkpoint of a run's folder, or a file as it is."""
    if not path.is_dir():
        return path
    # it imports torch
    from polypod.runs.run_dir import latest_checkpoint

    return latest_checkpoint(path)


def _is_other_folder(path: Path) -> bool:
    """Whether it is a folder without checkpoints, such as one that is called like a policy."""
    try:
        return path.is_dir() and next(path.glob("model_*.pt"), None) is None
    except OSError:  # a folder that may not be read
        return True


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that no file can have
        return False
