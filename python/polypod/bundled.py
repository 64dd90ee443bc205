"""Policies that come with polypod."""

from pathlib import Path

from polypod import _core

FOLDER = Path(__file__).parent / "policies"
NAMES = {
    "flat": "flat_universal",
    "rough": "rough_universal",
    "legged": "any_legged",
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


def shown(checkpoint: Path) -> str:
    """Name of a bundled policy, or the path: the form in which commands show a checkpoint."""
    for name, folder in NAMES.items():
        if checkpoint.parent == FOLDER / folder:
            return name
    return str(checkpoint)
