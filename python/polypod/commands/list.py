"""`polypod list`."""

import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import tyro

from polypod import _core, bundled

Kind = Literal["all", "tasks", "robots", "policies", "train_configs", "commands"]
Task = Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class List:
    """List tasks, robots, bundled policies, train configs and kinds of commands."""

    kind: Annotated[Kind, tyro.conf.Positional] = "all"
    """Kind of things to list. `tasks` also lists the tasks that are made for one robot."""
    json: bool = False
    """Print JSON in place of a table."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        kinds: dict[str, Any] = {
            "tasks": _core.tasks,
            "robots": _core.robots,
            "policies": _policies,
            "train_configs": _core.train_configs,
            "commands": _commands,
        }
        listed = {name: entries() for name, entries in kinds.items() if self.kind in ("all", name)}
        if self.json:
            print(json.dumps(listed, indent=2))
        else:
            self._print(listed)
        for problem in _core.broken_configs():
            print(f"polypod: warning: {problem}", file=sys.stderr)
        return 0

    def _print(self, listed: dict[str, Any]) -> None:
        if "tasks" in listed:
            own, made = _split(listed["tasks"])
            print("tasks")
            for task in own if self.kind == "all" else listed["tasks"]:
                print(f"  {task['name']:<44} {', '.join(task['aliases'])}".rstrip())
            if made and self.kind == "all":
                print(f"  and {len(made)} for one robot alone, such as {made[0]['name']}:")
                print("  polypod list tasks")
        if "robots" in listed:
            print("robots")
            for robot in listed["robots"]:
                print(f"  {robot['name']:<44} {robot['title']}")
        if "policies" in listed:
            print("policies")
            for policy in listed["policies"]:
                print(f"  {policy['name']:<44} {policy['file']}")
        if "train_configs" in listed:
            print("train configs")
            for config in listed["train_configs"]:
                print(f"  {config['name']:<44} {config['title']}".rstrip())
        if "commands" in listed:
            print("commands")
            for command in listed["commands"]:
                print(f"  {command['name']:<44} {command['description']}")


def _policies() -> list[dict[str, str]]:
    return [{"name": name, "file": str(bundled.checkpoint(name))} for name in bundled.FOLDERS]


def _commands() -> list[dict[str, Any]]:
    return [{"name": name, **spec} for name, spec in json.loads(_core.command_specs()).items()]


def _split(tasks: Sequence[Task]) -> tuple[list[Task], list[Task]]:
    """Tasks with a file, and the single-robot tasks made from them, which have no other name."""
    return [task for task in tasks if task["aliases"]], [task for task in tasks if not task["aliases"]]
