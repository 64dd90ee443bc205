"""Names by which tasks that track motions are known; nothing here needs an extra."""

from collections.abc import Sequence

from polypod import _core
from polypod.compat import tomllib
from polypod.python_terms.sim import declared_in

PREFIX = "motions."
"""Beginning of the overrides that are options of tracking tasks."""
COMMAND = "motion_command"
"""Observation by which a task tracks motions."""


def split(overrides: Sequence[str]) -> tuple[list[str], list[str]]:
    """Changes of the task, and of the options without `motions.`."""
    own = [text.removeprefix(PREFIX) for text in overrides if text.startswith(PREFIX)]
    return [text for text in overrides if not text.startswith(PREFIX)], own


def observes_motions(task: str, changes: Sequence[str]) -> bool:
    """Whether a task with these changes tracks motions. Raises as `explain_task`."""
    _, resolved = _core.explain_task(task, list(changes))
    return any(name == COMMAND for _, name in declared_in(tomllib.loads(resolved)))
