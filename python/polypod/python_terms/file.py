"""The Python file of a task's terms: `--terms FILE`."""

import hashlib
import importlib.util
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from polypod import _core
from polypod.files import read_bytes, real_path
from polypod.python_terms.declarations import Declared, Memory, Reward, Termination, Terms, declared_by

MAX_BYTES = 1 << 20
"""Largest size of a file of terms, bytes."""


def load(path: Path) -> Terms:
    """Runs a file for the terms that it declares.

    Terms are functions under the decorators of `polypod.terms`, arrays of `polypod.terms.memory`,
    and the entries of the dicts `rewards` and `terminations`.

    Raises:
        ConfigError: for a file that cannot be read or run, and for one that declares no term.
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
        raise failed(f"--terms {path}", path, "cannot be run", error) from error
    for kind in ("observations", "events", "commands", "curricula", "curriculum"):
        entries = getattr(module, kind, None)
        if isinstance(entries, Mapping) and not all(isinstance(entry, Declared) for entry in entries.values()):
            raise _core.ConfigError(
                f"--terms {path} defines {kind} in a dict; put a decorator of polypod.terms above each function, such "
                "as @polypod.terms.observation(size=3)"
            )
    declared: list[Declared | Memory | tuple[str, Reward]] = [
        *_rewards(path, getattr(module, "rewards", {})),
        *_terminations(path, getattr(module, "terminations", {})),
        *declared_by(vars(module).values()),
    ]
    source = f"--terms {path}"
    terms = Terms.of(declared, source, path=real_path(path), sha256=hashlib.sha256(data).hexdigest())
    if terms.is_empty:
        raise _core.ConfigError(
            f"--terms {path} defines no terms; put a decorator such as @polypod.terms.reward(weight=1.0) above a "
            "function"
        )
    return terms


def _rewards(path: Path, rewards: Any) -> list[tuple[str, Reward]]:
    if not isinstance(rewards, Mapping):
        return []
    for name, term in rewards.items():
        if not isinstance(term, Reward):
            raise _core.ConfigError(
                f"--terms {path}: rewards[{name!r}] is a {type(term).__name__}; write polypod.terms.Reward(function, "
                "weight=1.0)"
            )
    return list(rewards.items())


def _terminations(path: Path, terminations: Any) -> list[Termination]:
    if not isinstance(terminations, Mapping):
        return []
    for name, term in terminations.items():
        if not callable(term):
            raise _core.ConfigError(f"--terms {path}: terminations[{name!r}] is no function of the state")
    return [
        term if isinstance(term, Termination) else Termination(name=str(name), function=term)
        for name, term in terminations.items()
    ]


def failed(source: str, path: Path | None, what: str, error: Exception) -> _core.ConfigError:
    """An error of the user's code, with the innermost line of the file that led to it."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if path is not None and real_path(frame.filename) == real_path(path)]
    line = getattr(error, "lineno", None) if isinstance(error, SyntaxError) else own[-1].lineno if own else None
    where = f"{source}, line {line}" if line else source
    begin = f"{where}: " if where else ""
    return _core.ConfigError(f"{begin}{what}: {type(error).__name__}: {error}")
