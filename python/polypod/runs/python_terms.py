"""Rewards and terminations of a user's Python file: `polypod train --terms FILE`."""

import hashlib
import importlib.util
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from polypod import _core
from polypod.files import read_bytes, real_path
from polypod.state import State
from polypod.terms import Reward

MAX_BYTES = 1 << 20
"""Largest size of a file of terms, bytes."""


@dataclass(frozen=True)
class PythonTerms:
    """Terms that a file defines."""

    path: Path
    sha256: str
    """Checksum of the file, hexadecimal."""
    rewards: Mapping[str, Reward]
    terminations: Mapping[str, Callable[[State], Any]]


def load(path: Path) -> PythonTerms:
    """Runs a file for its dicts `rewards` and `terminations`, see `polypod.terms.CustomTerms`.

    Raises:
        ConfigError: for a file that cannot be read or run, and for one that defines neither.
    """
    try:
        data = read_bytes(path, MAX_BYTES)
    except OSError as error:
        raise _core.ConfigError(f"cannot read --terms {path}: {error.strerror}") from error
    spec = importlib.util.spec_from_file_location("polypod_terms", path)
    if path.suffix != ".py" or spec is None or spec.loader is None:
        raise _core.ConfigError(f"--terms {path} is no Python file; its name ends in .py")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise _failed(path, "cannot be run", error) from error
    rewards, terminations = getattr(module, "rewards", {}), getattr(module, "terminations", {})
    if getattr(module, "observations", {}):
        raise _core.ConfigError(
            f"--terms {path} defines observations, which eval, play and export would need too; "
            "add an observation term in Rust (docs/write-a-term.md), or train with polypod.terms.CustomTerms"
        )
    if not isinstance(rewards, Mapping) or not isinstance(terminations, Mapping) or not (rewards or terminations):
        raise _core.ConfigError(
            f"--terms {path} defines no terms; write rewards = {{'name': polypod.terms.Reward(function, weight=1.0)}}"
        )
    for name, term in rewards.items():
        if not isinstance(term, Reward):
            raise _core.ConfigError(
                f"--terms {path}: rewards[{name!r}] is a {type(term).__name__}; write polypod.terms.Reward(function, "
                "weight=1.0)"
            )
    for name, term in terminations.items():
        if not callable(term):
            raise _core.ConfigError(f"--terms {path}: terminations[{name!r}] is no function of the state")
    return PythonTerms(
        real_path(path),
        hashlib.sha256(data).hexdigest(),
        {name: replace(term, function=_named(path, name, term.function)) for name, term in rewards.items()},
        {name: _named(path, name, term) for name, term in terminations.items()},
    )


def _named(path: Path, name: str, function: Callable[[State], Any]) -> Callable[[State], Any]:
    """The function, whose errors name file and term."""

    def call(state: State) -> Any:
        try:
            return function(state)
        except Exception as error:
            raise _failed(path, f"the term {name!r} failed", error) from error

    return call


def _failed(path: Path, what: str, error: Exception) -> _core.ConfigError:
    """An error of the user's code, with the innermost line of the file that led to it."""
    frames = [
        frame for frame in traceback.extract_tb(error.__traceback__) if real_path(frame.filename) == real_path(path)
    ]
    line = getattr(error, "lineno", None) if isinstance(error, SyntaxError) else frames[-1].lineno if frames else None
    where = f"{path}, line {line}" if line else str(path)
    return _core.ConfigError(f"--terms {where}: {what}: {type(error).__name__}: {error}")
