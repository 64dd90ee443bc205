"""Bars on standard error that show how far several parts of a long run are."""

from importlib.util import find_spec
from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID


class Progress:
    """A bar for each part of a run on a terminal; none elsewhere, or without the package rich."""

    def __init__(self, width: int) -> None:
        """Looks at standard error; names of parts are `width` letters wide."""
        self._bars = _bars(width)
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> "Progress":
        """Shows the bars."""
        if self._bars is not None:
            self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leaves them as they are."""
        if self._bars is not None:
            self._bars.stop()

    def __call__(self, name: str, done: int, total: int) -> None:
        """Moves the bar of a part; its first move adds it."""
        if self._bars is None:
            return
        if name not in self._tasks:
            self._tasks[name] = self._bars.add_task(name, total=total)
        self._bars.update(self._tasks[name], completed=done)


def _bars(width: int) -> "Bars | None":
    if find_spec("rich") is None:
        return None
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        return None
    name = TextColumn(f"{{task.description:<{width}}}")
    return Progress(name, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), console=console)
