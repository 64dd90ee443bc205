"""`polypod results`."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import tyro

from polypod.commands.arguments import Name, arg


@dataclasses.dataclass(frozen=True)
class ResultsOf:
    """Make tables and pictures out of trainings and evaluations."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder <folder>/<group>/<run>/ with manifests, TensorBoard's events and the JSON files of eval and sim2sim. Or
    the same folder packed by `tar -cJf results.tar.xz -C FOLDER .`"""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the tables to this document, between its marks."""
    media: Annotated[Path | None, arg(metavar="DIR")] = None
    """Also draw curves per robot and maps of the evaluations into this folder; needs the extra bench."""
    score: Annotated[float | None, arg(metavar="M/S")] = None
    """Velocity error (m/s) of the exploring policy; the iterations until it is reached are counted. Default: 0.25."""
    baseline: Name = None
    """Count to the error that this group ends with instead: to compare fine-tuning with training from scratch."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        from polypod import results

        found = results.read(self.folder)
        for file in found.skipped:
            print(f"polypod: warning: {file} is neither an evaluation nor a comparison with MuJoCo", file=sys.stderr)
        score = results.DEFAULT_SCORE if self.score is None else self.score
        text, drawn = results.write(found, self.out, self.media, score, self.baseline)
        print(text)
        for file in drawn:
            print(file)
        return 0
