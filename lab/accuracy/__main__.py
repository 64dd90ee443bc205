"""Compares the physics with MuJoCo and writes the tables: `python -m lab.accuracy`."""

import dataclasses
import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from lab import documents
from lab.accuracy import markdown, report
from polypod import _core
from polypod.commands.accuracy import judged
from polypod.commands.arguments import Robots, arg, check_names, names

MARK = "accuracy"
"""Name of the part of a document that holds the tables."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Compares robots with MuJoCo, and the solver and the engines with one another.

    The exit code is 1 where a figure exceeds its bound; the documents are unchanged then.
    """

    robots: Robots = None
    """Names or paths of robots, with commas between. Default: all of the library."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the tables to this document, between its marks."""
    readme: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the summary to this document, between its marks."""


def run(given: Arguments) -> int:
    """Measures, prints and writes; returns the exit code. Raises ConfigError."""
    documents_ = [document for document in (given.out, given.readme) if document is not None]
    for document in documents_:
        documents.check(document, MARK)
    robots = names(given.robots)
    check_names(None, robots)
    measured = report.measure(robots, functools.partial(print, flush=True))
    command = markdown.COMMAND if robots is None else f"python -m lab.accuracy --robots {','.join(robots)}"
    tables, summary = markdown.tables(measured, command), markdown.summary(measured)
    print(f"\n{tables}\n\n{summary}")
    kept = f"; {' and '.join(map(str, documents_))} left unchanged" if documents_ else ""
    code = judged(measured, kept)
    if code == 0:
        for written, text in ((given.out, tables), (given.readme, summary)):
            if written is not None:
                documents.replace(written, MARK, text)
    return code


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 2 for bad input."""
    given = tyro.cli(Arguments, prog="python -m lab.accuracy", args=arguments)
    try:
        return run(given)
    except _core.PolypodError as error:
        print(f"lab.accuracy: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
