"""`polypod list`."""

import dataclasses
import sys

from polypod import _core


@dataclasses.dataclass(frozen=True)
class List:
    """List the tasks and the robots."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        print("tasks")
        for task in _core.tasks():
            print(f"  {task['name']:<40} {', '.join(task['aliases'])}")
        print("robots")
        for robot in _core.robots():
            print(f"  {robot['name']:<40} {robot['title']}")
        for problem in _core.broken_configs():
            print(f"polypod: warning: {problem}", file=sys.stderr)
        return 0
