"""Packages of the extras, asked for when they are needed."""

import importlib
from typing import Any

from polypod import _core

_DISTRIBUTIONS = {"PIL": "pillow"}
"""Names in the package index that are not those of the modules."""


def package(module: str, purpose: str, extra: str) -> Any:
    """The module. Raises ConfigError, with the extra to install, where it is missing."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        top = module.partition(".")[0]
        if error.name is None or error.name.partition(".")[0] != top:
            raise
        name = _DISTRIBUTIONS.get(top, top)
        raise _core.ConfigError(
            f"{purpose} needs the package {name}; install the {extra} extra: pip install 'polypod[{extra}]'"
        ) from error


def missing(error: ModuleNotFoundError, module: str, extra: str) -> ModuleNotFoundError:
    """Returns the error of importing a module whose package is missing.

    It names the extra to install.
    """
    name = (error.name or "a package").partition(".")[0]
    text = f"{module} needs the package {_DISTRIBUTIONS.get(name, name)}; pip install 'polypod[{extra}]'"
    return ModuleNotFoundError(text, name=error.name)
