"""Gymnasium's registry: every task of polypod is `polypod/<task name>`."""

import gymnasium

from polypod import _core

NAMESPACE = "polypod/"


def register_tasks() -> None:
    """Registers each task for `gymnasium.make_vec`; there is no single env to be had from `gymnasium.make`."""
    for task in _core.tasks():
        env_id = NAMESPACE + task["name"]
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, vector_entry_point="polypod.vector_env:make", kwargs={"task_id": task["name"]})


def task_of(task_id: str) -> str:
    """The core's name of a task that may be given as a Gymnasium id."""
    return task_id.removeprefix(NAMESPACE)
