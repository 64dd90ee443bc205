"""Files that a tool generates: writing them, and checking that they are the present ones."""

import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[1]


def main(arguments: list[str], usage: str | None, out: Path, text: Callable[[], str]) -> int:
    """Writes a file, or with --check says whether it is the present one; the exit code.

    Args:
        arguments: of the command line.
        usage: printed for others than --check.
        out: the file.
        text: what it holds.
    """
    if arguments not in ([], ["--check"]):
        print(usage, file=sys.stderr)
        return 2
    if not arguments:
        out.write_text(text())
    elif out.read_text() != text():
        print(f"{out.relative_to(ROOT)} is out of date; run python tools/{Path(sys.argv[0]).name}", file=sys.stderr)
        return 1
    return 0
