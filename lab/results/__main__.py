"""Writes the tables and pictures of docs/results.md: `python -m lab.results`."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from lab import results
from polypod import _core
from polypod.commands.arguments import Name, arg


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Makes tables and pictures out of trainings and evaluations."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder <folder>/<group>/<run>/ with manifests, TensorBoard's events and the JSON files of
    eval and sim2sim. Or the same folder packed by `tar -cJf results.tar.xz -C FOLDER .`"""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the tables to this document, between its marks."""
    media: Annotated[Path | None, arg(metavar="DIR")] = None
    """Also draw curves per robot and maps of the evaluations into this folder."""
    score: Annotated[float, arg(metavar="M/S")] = results.DEFAULT_SCORE
    """Velocity error (m/s) of the exploring policy; the iterations until it is reached are
    counted."""
    baseline: Name = None
    """Count to the error that this group ends with instead: to compare fine-tuning with training
    from scratch."""


def main(arguments: Sequence[str]) -> int:
    """Prints the tables and the names of the pictures; returns the exit code: 2 for bad input."""
    given = tyro.cli(Arguments, prog="python -m lab.results", args=arguments)
    try:
        found = results.read(given.folder)
        for file in found.skipped:
            print(f"lab.results: {file} is neither an evaluation nor a comparison with MuJoCo", file=sys.stderr)
        text, drawn = results.write(found, given.out, given.media, given.score, given.baseline)
    except _core.PolypodError as error:
        print(f"lab.results: {error}", file=sys.stderr)
        return 2
    print(text, *drawn, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
