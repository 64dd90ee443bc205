"""`polypod check`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from polypod import _core
from polypod.commands.arguments import Locks, PackageDirs, locked_joints, package_dirs


@dataclasses.dataclass(frozen=True)
class Check:
    """Show what a URDF file is read as, with every warning; it needs no config."""

    file: Annotated[Path, tyro.conf.Positional]
    """The URDF file."""
    package_dir: PackageDirs = ()
    """Where a ROS package of `package://` names lies. May be repeated."""
    lock: Locks = ()
    """Holds a joint at a position, rad or m. May be repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        print(_core.check(self.file, package_dirs(self.package_dir), locked_joints(self.lock)), end="")
        return 0
