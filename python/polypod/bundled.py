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
PRETRAINED = {2: "two_legs"}
"""Perceptrons with which separate networks begin, by the number of legs: folders. They have a
critic, and no command acts with them."""


def checkpoint(name: str = DEFAULT) -> Path:
    """The checkpoint of a bundled policy.

    Raises:
        UnknownNameError: for a name that none has.
        ConfigError: for a package that was installed without them.
    """
    if name not in NAMES:
        raise _core.UnknownNameError(f"there is no bundled policy {name!r}; use one of {', '.join(NAMES)}")
    return _in(NAMES[name], f"policy {name!r}")


def pretrained(legs: int) -> Path | None:
    """The checkpoint with which a separate network of a robot begins; None: there is none.

    Raises:
        ConfigError: for a package that was installed without it.
    """
    return _in(PRETRAINED[legs], f"network for {legs} legs") if legs in PRETRAINED else None


def _in(folder: str, title: str) -> Path:
    """The checkpoint of a folder."""
    found = sorted((FOLDER / folder).glob("model_*.pt"))
    if not found:
        raise _core.ConfigError(f"the bundled {title} is not in {FOLDER}; install polypod again")
    return found[0]


def shown(checkpoint: Path) -> str:
    """Name of a bundled policy, or the path: the form in which commands show a checkpoint."""
    for name, folder in NAMES.items():
        if checkpoint.parent == FOLDER / folder:
            return name
    return str(checkpoint)
