"""Packages of the extras, asked for when they are needed."""

import importlib
from typing import Any

from polypod import _core


def package(module: str, purpose: str, extra: str) -> Any:
    """The module. Raises ConfigError, with the extra to install, where it is missing."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != module.partition(".")[0]:
            raise
        raise _core.ConfigError(
            f"{purpose} needs the package {error.name}; install the {extra} extra: pip install 'polypod[{extra}]'"
        ) from error
