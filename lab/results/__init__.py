"""`python -m lab.results`: tables and pictures from the files of trainings and evaluations."""

from pathlib import Path

from lab import documents
from lab.results import pictures, tables
from lab.results.runs import Results, read
from polypod.files import real_path

MARK = "results"
"""Name of the part of a document that holds the tables."""
DEFAULT_SCORE = 0.25
"""Velocity error, m/s, of an exploring policy to which iterations are counted: a third of a
standing robot's."""

__all__ = ["DEFAULT_SCORE", "MARK", "Results", "read", "write"]


def write(
    results: Results,
    out: Path | None = None,
    media: Path | None = None,
    score: float = DEFAULT_SCORE,
    baseline: str | None = None,
) -> tuple[str, list[Path]]:
    """The tables as Markdown, and the pictures drawn.

    Args:
        results: the return value of `read`.
        out: document to write the tables to, between its marks; None: none.
        media: folder for the pictures; None: none are drawn.
        score: velocity error, m/s, whose reaching is counted in iterations.
        baseline: group whose final error is the score instead.

    Raises:
        ConfigError: for a document without marks, a file that cannot be written, a baseline that is
            none.
    """
    if out is not None:
        documents.check(out, MARK)
    text = tables.document(results, score, baseline)
    drawn = [] if media is None else pictures.draw(results, media)
    if out is not None:
        where = {file: _relative(file, out) for file in drawn}
        images = "\n\n".join(f"![{file.stem.replace('_', ' ')}]({place})" for file, place in where.items())
        documents.replace(out, MARK, f"{text}\n\n{images}" if images else text)
    return text, drawn


def _relative(file: Path, document: Path) -> str:
    folder = real_path(document).parent
    place = real_path(file)
    return place.relative_to(folder).as_posix() if place.is_relative_to(folder) else place.as_posix()
