"""`polypod check`."""

import dataclasses
import tempfile
from pathlib import Path
from typing import Annotated

import tyro

from polypod import _core, simulated
from polypod.commands.arguments import Locks, PackageDirs, locked_joints, package_dirs


@dataclasses.dataclass(frozen=True)
class Check:
    """Show what a URDF file or a robot is read as, with every warning; a file needs no config."""

    file: Annotated[Path, tyro.conf.Positional]
    """The URDF file, or a robot: its name, or the path of its config."""
    package_dir: PackageDirs = ()
    """Folder of a ROS package in `package://` names. May be repeated."""
    lock: Locks = ()
    """Holds a joint at a position, rad or m. May be repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        dirs, held = package_dirs(self.package_dir), locked_joints(self.lock)
        is_name = self.file.name == str(self.file) and not self.file.suffix and not _exists(self.file)
        if is_name or self.file.suffix == ".toml":
            print(_of_robot(str(self.file), dirs, held), end="")
        else:
            print(_core.check(self.file, dirs, held), end="")
        return 0


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that no file can have
        return True


def _of_robot(source: str, dirs: dict[str, str], held: dict[str, float]) -> str:
    """Says how the URDF of a robot is read, with the joints held that its config holds.

    Raises ConfigError.
    """
    from polypod.new_robot import TASK_OF_OTHERS
    from polypod.robot_files import urdf_file

    _core.check_names(None, [source])
    sim = _core.VecSim(TASK_OF_OTHERS, 1, robots=[source], threads=1)
    config = simulated.config(sim)["robots"][sim.robots[0]]
    place = urdf_file(source, config["urdf"])
    folder = Path() if place is None else place.parent
    dirs = {**{name: str(folder / path) for name, path in config.get("package_dirs", {}).items()}, **dirs}
    held = {**config.get("locked_joints", {}), **held}
    if place is not None:
        return _core.check(place, dirs, held)
    with tempfile.TemporaryDirectory() as built_in:
        copy = Path(built_in) / "robot.urdf"
        copy.write_text(_core.robot_urdf(source), encoding="utf-8")
        try:
            return _core.check(copy, dirs, held).replace(str(copy), config["urdf"])
        except _core.PolypodError as error:
            raise type(error)(str(error.args[0]).replace(str(copy), config["urdf"])) from error
