"""Pictures by matplotlib, drawn to files."""

import io
from pathlib import Path
from typing import Any, BinaryIO

from polypod import _core, extras
from polypod.files import write_filled

_DPI = 90
_COLORS = 256


def pyplot_for(purpose: str) -> Any:
    """Draws to files, by matplotlib's pyplot. Raises ConfigError without matplotlib."""
    extras.package("matplotlib", purpose, "bench").use("Agg")
    return extras.package("matplotlib.pyplot", purpose, "bench")


def save(figure: Any, out: Path, instead: str = "file") -> None:
    """Writes a figure.

    Raises ConfigError, with what to choose another of `instead`, where that is not possible.
    """
    try:
        kind = out.suffix.lstrip(".") or "png"
        write_filled(out, lambda file: _fill(figure, file, kind))
    except (OSError, ValueError) as error:
        raise _core.ConfigError(f"cannot write {out}: {error}; choose another {instead}") from error


def _fill(figure: Any, file: BinaryIO, kind: str) -> None:
    """A PNG has a palette of `_COLORS`: a third of the size."""
    if kind != "png":
        figure.savefig(file, dpi=_DPI, format=kind)
        return
    image = extras.package("PIL.Image", "drawing", "bench")  # matplotlib needs it too
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=_DPI, format="png")
    picture = image.open(drawn).convert("RGB").quantize(_COLORS)
    picture.save(file, format="png", optimize=True)
