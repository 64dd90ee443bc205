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
"""Policies of the library's robots: names on the command line, and folders."""
OF_STRANGERS = {2: "two_legs"}
"""Policies for robots that nobody prepared, by the number of legs: names on the command line, and
folders. Their manifests name no robots."""
PRETRAINED = {2: "two_legs_pretrained"}
"""Perceptrons with which separate networks begin, by the number of legs: folders. They have a
critic, and no command acts with them."""
FOLDERS = {**NAMES, **{name: name for name in OF_STRANGERS.values()}}
"""Folders of all policies by name."""
DEFAULT = "flat"


def checkpoint(name: str = DEFAULT) -> Path:
    """The checkpoint of a bundled policy.

    Raises:
        UnknownNameError: for a name that none has.
        ConfigError: for a package that was installed without them.
    """
    if name not in FOLDERS:
        raise _core.UnknownNameError(f"there is no bundled policy {name!r}; use one of {', '.join(FOLDERS)}")
    return _in(FOLDERS[name], f"policy {name!r}")


def of_strangers(legs: int) -> Path | None:
    """The checkpoint that acts for robots that nobody prepared; None: there is none.

    Raises:
        ConfigError: for a package that was installed without it.
    """
    return checkpoint(OF_STRANGERS[legs]) if legs in OF_STRANGERS else None


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
    for name, folder in FOLDERS.items():
        if checkpoint.parent == FOLDER / folder:
            return name
    return str(checkpoint)
