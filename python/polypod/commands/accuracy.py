"""`polypod accuracy`."""

import dataclasses
import functools
import sys
from pathlib import Path
from typing import Annotated

from polypod.commands.arguments import Robots, arg, names


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """Compare the physics with MuJoCo on the same URDFs; fails where a figure exceeds its bound."""

    robots: Robots = None
    """Names of the robots, with commas between. Default: all."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the tables to this document, between its marks."""
    readme: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the summary to this document, between its marks."""

    def run(self) -> int:
        """Runs the command and returns its exit code: 1 where a figure exceeds its bound."""
        from polypod.accuracy import markdown, report

        documents = [document for document in (self.out, self.readme) if document is not None]
        for document in documents:
            report.check_document(document)
        measured = report.measure(names(self.robots), functools.partial(print, flush=True))
        tables, summary = markdown.tables(measured), markdown.summary(measured)
        print(f"\n{tables}\n\n{summary}")
        if broken := measured.broken():
            kept = f"; {' and '.join(map(str, documents))} left unchanged" if documents else ""
            print(f"beyond the bounds of python/polypod/accuracy/bounds.py{kept}:", *broken, sep="\n", file=sys.stderr)
            return 1
        for written, text in ((self.out, tables), (self.readme, summary)):
            if written is not None:
                report.replace_block(written, text)
        return 0
