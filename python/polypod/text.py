"""Text of files, users and commands, as it is printed."""

import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def plain(text: str) -> str:
    """The text in one line, without characters that a terminal obeys in place of showing."""
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in " ".join(text.split()))


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def command_line(words: Iterable[str], given: Mapping[str, Any], repeated: Mapping[str, Iterable[str]] = {}) -> str:
    """A command line that a user may run again.

    Args:
        words: program, command and what has no flag.
        given: values by flag. None and False leave the flag out, True has no value. A list has
            commas between, and a tuple is several words.
        repeated: values of flags that stand before each of their values.
    """
    line = list(words)
    for flag, value in given.items():
        if value is None or value is False:
            continue
        line.append(flag)
        if isinstance(value, tuple):
            line += map(str, value)
        elif value is not True:
            line.append(",".join(map(str, value)) if isinstance(value, list) else str(value))
    for flag, values in repeated.items():
        line += [word for value in values for word in (flag, value)]
    return shlex.join(line)
