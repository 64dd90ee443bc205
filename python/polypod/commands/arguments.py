"""Types of arguments that several commands share, with readers of values and writers of figures."""

import dataclasses
import functools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import tyro

from polypod import _core

arg = functools.partial(tyro.conf.arg, help_behavior_hint="")

MAX_THREADS = 1024

Name = Annotated[str | None, arg(metavar="NAME")]
Count = Annotated[int | None, arg(metavar="N")]
Robots = Annotated[str | None, arg(metavar="A,B,C")]
RobotNames = Annotated[str | None, arg(aliases=("--robot",), metavar="A,B,C")]
Velocity = Annotated[tuple[float, float, float] | None, arg(metavar="VX VY WZ")]
Overrides = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="KEY=VALUE")]
PackageDirs = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="NAME=DIR")]
Feet = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="LEG=LINK")]
Roles = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="SLOT=JOINT")]
Locks = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="JOINT=POSITION")]


Options = TypeVar("Options")


def options_of(kind: type[Options], command: Any, **others: Any) -> Options:
    """Options of the library that have the values of a command's fields of the same names.

    Args:
        kind: a dataclass.
        command: the dataclass of the command line.
        others: values of fields that have another name, type or default there.
    """
    known = {field.name for field in dataclasses.fields(cast(Any, kind))}
    same = {field.name: getattr(command, field.name) for field in dataclasses.fields(command) if field.name in known}
    return kind(**{**same, **others})


def names(text: str | None) -> list[str] | None:
    """Names with commas between."""
    return None if text is None else [name.strip() for name in text.split(",")]


def check_names(task: str | None, robots: Sequence[str] | None, overrides: Sequence[str] = ()) -> None:
    """Reads the configs that these name, before anything slow is imported.

    Raises UnknownNameError and ConfigError.
    """
    from polypod.registration import task_of

    if task is None:
        overrides = ()
    _core.check_names(None if task is None else task_of(task), list(robots or ()), list(overrides))


def positive(value: int | None, flag: str) -> int | None:
    """The value of a flag that counts something. Raises ConfigError."""
    if value is not None and not 1 <= value < 2**31:
        raise _core.ConfigError(f"{flag} {value} must be at least 1 and less than 2^31")
    return value


def thread_count(value: int | None, flag: str) -> int | None:
    """A number of threads. Raises ConfigError."""
    if value is not None and not 1 <= value <= MAX_THREADS:
        raise _core.ConfigError(f"{flag} {value} must be from 1 to {MAX_THREADS}; leave it out for one per core")
    return value


def torch_threads(value: int | None) -> int | None:
    """The value of `--threads`, which torch uses from here on. Raises ConfigError."""
    threads = thread_count(value, "--threads")
    import torch

    if threads is not None:
        torch.set_num_threads(threads)
    return threads


def pairs(texts: Sequence[str], flag: str, metavar: str) -> dict[str, str]:
    """Values by name, of texts NAME=VALUE. Raises ConfigError."""
    values = {}
    for text in texts:
        name, _, value = text.partition("=")
        if not name or not value:
            raise _core.ConfigError(f"{flag} {text} is not {metavar}")
        values[name] = value
    return values


def package_dirs(texts: Sequence[str]) -> dict[str, str]:
    """Folders of ROS packages by name, of NAME=DIR pairs. Raises ConfigError."""
    return pairs(texts, "--package-dir", "NAME=DIR")


def locked_joints(texts: Sequence[str]) -> dict[str, float]:
    """Positions of joints that are held, of JOINT=POSITION pairs. Raises ConfigError."""
    positions = {}
    for joint, text in pairs(texts, "--lock", "JOINT=POSITION").items():
        try:
            positions[joint] = float(text)
        except ValueError:
            raise _core.ConfigError(f"--lock {joint}={text}: {text} is no position; write rad or m") from None
    return positions


def write_json(path: Path | None, content: dict[str, Any]) -> None:
    """Writes figures to the file of `--json`, if there is one. Raises ConfigError."""
    from polypod.files import write_text

    if path is None:
        return
    try:
        write_text(path, json.dumps(content, indent=2) + "\n")
    except OSError as error:
        raise _core.ConfigError(f"cannot write {path}: {error.strerror}; choose another --json") from error
