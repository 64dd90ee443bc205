"""`polypod accuracy`."""

import dataclasses
import functools
from pathlib import Path
from typing import Annotated

from polypod.commands.arguments import Robots, arg, names


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """Compare the physics with MuJoCo on the same URDFs."""

    robots: Robots = None
    """Names of the robots, with commas between. Default: all."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the tables to this document, between its marks."""
    readme: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the summary to this document, between its marks."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        from polypod.accuracy import markdown, report

        for document in (self.out, self.readme):
            if document is not None:
                report.check_document(document)
        measured = report.measure(names(self.robots), functools.partial(print, flush=True))
        tables, summary = markdown.tables(measured), markdown.summary(measured)
        print(f"\n{tables}\n\n{summary}")
        for document, text in ((self.out, tables), (self.readme, summary)):
            if document is not None:
                report.replace_block(document, text)
        return 0
