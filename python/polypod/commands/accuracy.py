"""`polypod accuracy`."""

import dataclasses
import functools
import sys
from pathlib import Path
from typing import Annotated

import tyro

from polypod import _core
from polypod.commands.arguments import Robots, arg, check_names, names


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """Compare robots with MuJoCo's models of their files.

    The exit code is 1 where a figure exceeds its bound.
    """

    robot: Annotated[str | None, tyro.conf.Positional, arg(metavar="ROBOT")] = None
    """A robot's name or the path of its config, built in or added. Default: those of --robots."""
    robots: Robots = None
    """Names or paths of several, with commas between. Default: all."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the tables to this document, between its marks."""
    readme: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the summary to this document, between its marks."""

    def run(self) -> int:
        """Runs the command and returns its exit code: 1 where a figure exceeds its bound."""
        from polypod.accuracy import markdown, report

        if self.robot is not None and self.robots is not None:
            raise _core.ConfigError(f"{self.robot} and --robots: name robots in one of these places")
        documents = [document for document in (self.out, self.readme) if document is not None]
        for document in documents:
            report.check_document(document)
        robots = names(self.robot) or names(self.robots)
        check_names(None, robots)
        measured = report.measure(robots, functools.partial(print, flush=True))
        command = markdown.COMMAND if robots is None else f"polypod accuracy {','.join(robots)}"
        tables, summary = markdown.tables(measured, command), markdown.summary(measured)
        print(f"\n{tables}" if robots else f"\n{tables}\n\n{summary}")
        if broken := measured.broken():
            kept = f"; {' and '.join(map(str, documents))} left unchanged" if documents else ""
            print(f"beyond the bounds of python/polypod/accuracy/bounds.py{kept}:", *broken, sep="\n", file=sys.stderr)
            return 1
        print(f"\n{measured.verdict()}")
        for written, text in ((self.out, tables), (self.readme, summary)):
            if written is not None:
                report.replace_block(written, text)
        return 0
