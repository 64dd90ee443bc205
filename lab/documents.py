"""Documents with a part that a program writes, between two marks."""

from pathlib import Path

from polypod import _core
from polypod.files import read_bytes, write_text

MAX_BYTES = 16 << 20
"""Largest size of a document, bytes."""


def marks(name: str) -> tuple[str, str]:
    """The lines around the part called `name`."""
    return f"<!-- {name}:begin -->", f"<!-- {name}:end -->"


def check(document: Path, name: str) -> None:
    """Raises ConfigError where `replace` would."""
    _parts(document, name)


def replace(document: Path, name: str, text: str) -> None:
    """Puts `text` between the marks of a document. Raises ConfigError where it cannot."""
    head, tail = _parts(document, name)
    begin, end = marks(name)
    try:
        write_text(document, f"{head}{begin}\n{text.strip()}\n{end}{tail}")
    except OSError as error:
        raise _core.ConfigError(f"cannot write {document}: {error.strerror}; choose another file") from error


def _parts(document: Path, name: str) -> tuple[str, str]:
    """Text before and after the marks."""
    try:
        content = read_bytes(document, MAX_BYTES).decode()
    except OSError as error:
        raise _core.ConfigError(f"cannot read {document}: {error.strerror}; choose another file") from error
    except UnicodeDecodeError as error:
        raise _core.ConfigError(f"{document} is no text in UTF-8; choose another file") from error
    first, last = marks(name)
    head, begin, rest = content.partition(first)
    _, end, tail = rest.partition(last)
    if not begin or not end:
        raise _core.ConfigError(f"{document} has no lines {first} and {last}; put them where the tables shall stand")
    return head, tail
