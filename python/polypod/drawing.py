"""Pictures by matplotlib, drawn to files."""

from pathlib import Path
from typing import Any

from polypod import _core, extras
from polypod.files import write_filled


def pyplot_for(purpose: str) -> Any:
    """Draws to files, by matplotlib's pyplot. Raises ConfigError without matplotlib."""
    extras.package("matplotlib", purpose, "bench").use("Agg")
    return extras.package("matplotlib.pyplot", purpose, "bench")


def save(figure: Any, out: Path, instead: str = "file") -> None:
    """Writes a figure. Raises ConfigError, with what to choose another of `instead`, where that is not possible."""
    try:
        kind = out.suffix.lstrip(".") or "png"
        write_filled(out, lambda file: figure.savefig(file, dpi=110, format=kind))
    except (OSError, ValueError) as error:
        raise _core.ConfigError(f"cannot write {out}: {error}; choose another {instead}") from error
