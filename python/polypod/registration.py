"""Gymnasium's registry: every task of polypod is `polypod/<task name>`."""

import os
import warnings
from collections.abc import Sequence

import gymnasium

from polypod import _core

NAMESPACE = "polypod/"
PATH = "POLYPOD_PATH"
"""Environment variable with the user's folders of configs."""


def register_tasks() -> None:
    """Registers each task with Gymnasium.

    `gymnasium.make_vec` gives the batch, `gymnasium.make` one robot.

    A broken config in `POLYPOD_PATH` is a warning here and an error when it is used; all others are
    registered. Where a folder is not there, only the built-in tasks are registered, with a warning.
    """
    try:
        tasks = _core.tasks()
        # polypod's own configs are sound, and reading all of them again takes as long as the tasks
        broken = _core.broken_configs() if os.environ.get(PATH) else []
    except _core.PolypodError as error:
        warnings.warn(f"polypod registers only its own tasks with Gymnasium: {error}", RuntimeWarning, stacklevel=2)
        tasks, broken = _built_in_tasks(), []
    for problem in broken:
        warnings.warn(f"polypod leaves out a broken config: {problem}", RuntimeWarning, stacklevel=2)
    for task in tasks:
        env_id = NAMESPACE + task["name"]
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="polypod.single_env:Env",
                vector_entry_point="polypod.vector_env:make_for_gymnasium",
                kwargs={"task_id": task["name"]},
            )


def _built_in_tasks() -> "list[_core.TaskEntry]":
    """The tasks without those of `POLYPOD_PATH`, which the core reads in every call."""
    folders = os.environ.pop(PATH, None)
    try:
        return _core.tasks()
    finally:
        if folders is not None:
            os.environ[PATH] = folders


def num_robots(task: str, overrides: Sequence[str] = ()) -> int:
    """Number of robots of a task by one of its names or its path, at least 1.

    Raises:
        UnknownNameError: for a name that does not exist.
        ConfigError: for a config or an override that cannot be used.
    """
    return max(1, len(_core.task_robots(task, list(overrides))))


def task_of(task_id: str) -> str:
    """The core's name of a task that may be given as a Gymnasium id.

    Raises TypeError for anything but a text.
    """
    if not isinstance(task_id, str):
        raise TypeError(
            f"the task is a {type(task_id).__name__}; pass a name or a path as text, such as 'velocity_flat' "
            "(polypod.tasks() lists the names)"
        )
    return task_id.removeprefix(NAMESPACE)
