"""Tables of figures that fit the terminal."""

import math
import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

_PLAIN_WIDTH = 120
"""Width of output that no terminal shows, characters."""
_GAPS = (2, 1)
"""Spaces between columns, the preferred number first."""


def console_of_output() -> Console:
    """A console on standard output: as wide as the terminal, else `_PLAIN_WIDTH`."""
    return Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH, soft_wrap=False, highlight=False)


def shown(value: float, form: str) -> str:
    """A figure in this format; a dash where it was not measured, NaN."""
    return "-" if math.isnan(value) else format(value, form)


class Rows:
    """A column of names and columns of figures."""

    def __init__(self, name: str, *figures: str) -> None:
        """Table with these headers."""
        self._lines = [(name, *figures)]

    def add_row(self, name: str, *figures: str) -> None:
        """Adds a line: a name and its figures."""
        self._lines.append((name, *figures))

    def print(self, console: Console) -> None:
        """Prints the table.

        Figures that are too many for a line follow in a second table with the same names.
        """
        widths = [max(map(len, column)) for column in zip(*self._lines, strict=True)]
        gap = next((gap for gap in _GAPS if sum(widths) + gap * (len(widths) - 1) <= console.width), _GAPS[0])
        for columns in _blocks(widths, gap, console.width):
            table = Table(box=None, pad_edge=False, padding=(0, gap, 0, 0))
            for column in columns:
                table.add_column(self._lines[0][column], justify="right" if column else "left", no_wrap=True)
            for line in self._lines[1:]:
                table.add_row(*(line[column] for column in columns))
            console.print(table)


def _blocks(widths: Sequence[int], gap: int, width: int) -> list[list[int]]:
    """Columns of each table: the names, then as many figures as fit, at least one."""
    blocks, used = [[0]], widths[0]
    for column in range(1, len(widths)):
        if used + gap + widths[column] > width and len(blocks[-1]) > 1:
            blocks.append([0])
            used = widths[0]
        blocks[-1].append(column)
        used += gap + widths[column]
    return blocks
