"""`polypod sweep`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from polypod.commands.arguments import arg


@dataclasses.dataclass(frozen=True)
class SweepOf:
    """Train several configs and robots with several seeds, and print tables with intervals."""

    file: Annotated[Path, tyro.conf.Positional]
    """A TOML file with seeds, configs and robots; docs/cluster.md describes it."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for the runs. Default: logs/sweeps/<name of the file>. An existing sweep goes on."""
    ray: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Train side by side on the Ray cluster at this address; without ADDRESS on this machine's
    cluster, which is started if there is none. Needs the extra ray."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        from polypod.training import sweep
        from polypod.training.report import Reporter

        found = sweep.read(self.file, self.out or Path("logs") / "sweeps" / self.file.stem)
        reporter = Reporter()
        code = sweep.run(found, reporter) if self.ray is None else sweep.run_on_ray(found, self.ray, reporter)
        if code == 0:
            sweep.report(found, reporter)
        return code
