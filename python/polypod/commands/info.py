"""`polypod info`."""

import dataclasses

from polypod import _core


@dataclasses.dataclass(frozen=True)
class Info:
    """Show the version, the instruction set in use and the number of threads."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        for key, value in _core.info().items():
            print(f"{key:<10} {value}")
        return 0
