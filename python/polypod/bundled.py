"""Policies that come with polypod."""

from pathlib import Path

from polypod import _core

FOLDER = Path(__file__).parent / "policies"
NAMES = {
    "flat": "flat_universal",
    "rough": "rough_universal",
    "legged": "legged_masked",
    "quadruped": "quadruped",
}
"""Names on the command line, and folders."""
DEFAULT = "flat"


def checkpoint(name: str = DEFAULT) -> Path:
    """The checkpoint of a bundled policy.

    Raises:
        UnknownNameError: for a name that none has.
        ConfigError: for a package that was installed without them.
    """
    if name not in NAMES:
        raise _core.UnknownNameError(f"there is no bundled policy {name!r}; use one of {', '.join(NAMES)}")
    found = sorted((FOLDER / NAMES[name]).glob("model_*.pt"))
    if not found:
        raise _core.ConfigError(f"the bundled policy {name!r} is not in {FOLDER}; install polypod again")
    return found[0]


LOGS = Path("logs")
"""Where `polypod train` keeps its runs, unless it is told otherwise."""


def resolve(given: Path | None, log_dir: Path = LOGS) -> Path:
    """A file; where there is no such file, a bundled policy by its name or the last checkpoint of a run by its name.

    Args:
        given: path, name of a bundled policy, or name of a run or the end of it. None: the bundled policy for flat
            ground.
        log_dir: where the runs are.

    Raises:
        ConfigError: for the end of several runs' names.
    """
    if given is None:
        return checkpoint()
    if _exists(given):
        return given
    if str(given) in NAMES:
        return checkpoint(str(given))
    if given.name != str(given) or given.suffix in (".pt", ".onnx") or not _exists(log_dir / "rsl_rl"):
        return given
    # it imports torch
    from polypod.training.run_dir import find_checkpoint, has_run

    return find_checkpoint(log_dir, str(given)) if has_run(log_dir, str(given)) else given


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that no file can have
        return False


def shown(checkpoint: Path) -> str:
    """Name of a bundled policy, or the path: the form in which commands show a checkpoint."""
    for name, folder in NAMES.items():
        if checkpoint.parent == FOLDER / folder:
            return name
    return str(checkpoint)
