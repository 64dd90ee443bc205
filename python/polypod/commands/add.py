"""`polypod add`."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated

import tyro

from polypod._core import ConfigError
from polypod.commands.arguments import Feet, Locks, Name, PackageDirs, Roles, arg, locked_joints, package_dirs, pairs


@dataclasses.dataclass(frozen=True)
class Add:
    """Add a robot from a URDF, xacro or MJCF file, a folder, a zip file, or another package."""

    source: Annotated[str, tyro.conf.Positional]
    """The file, folder or zip file, robot_descriptions:NAME or mujoco_menagerie:NAME."""
    out: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """The library's folder. Default: the first of POLYPOD_PATH."""
    name: Name = None
    """The robot's name in configs. Default: the name in the file, or of the file."""
    file: Annotated[str | None, arg(metavar="FILE")] = None
    """The file within a folder or zip file, where several could be the robot."""
    root: Annotated[str | None, arg(metavar="BODY")] = None
    """The body of an MJCF scene that is the robot's base. Default: the body with the most joints
    below it."""
    package_dir: PackageDirs = ()
    """Folder of a ROS package in `package://` names and in xacro's `$(find)`. May be repeated."""
    xacro_arg: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="NAME=VALUE")] = ()
    """An argument of a xacro file. May be repeated."""
    foot: Feet = ()
    """The link that is the foot of a leg, where geometry does not tell: LF=toe_link. May be
    repeated."""
    role: Roles = ()
    """The joint of a slot, where geometry does not tell: LF_HFE=thigh_joint. May be repeated."""
    lock: Locks = ()
    """Holds a joint at a position, rad or m: an arm, a payload. May be repeated."""
    force: bool = False
    """Replace an existing robot."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        from polypod.add import add, judge
        from polypod.new_robot import print_standing, training_of
        from polypod.progress import Progress
        from polypod.registration import PATH

        library = [folder for folder in os.environ.get(PATH, "").split(os.pathsep) if folder]
        out = self.out or (Path(library[0]) if library else None)
        if out is None:
            raise ConfigError(f"there is no library to add to; name a folder with --out, or in {PATH}")
        with Progress(len("try 1: drafts")) as progress:
            added = add(
                self.source,
                out,
                file=self.file,
                root=self.root,
                name=self.name,
                package_dirs=package_dirs(self.package_dir),
                arguments=pairs(self.xacro_arg, "--xacro-arg", "NAME=VALUE"),
                feet=pairs(self.foot, "--foot", "LEG=LINK"),
                joint_roles=pairs(self.role, "--role", "SLOT=JOINT"),
                locked_joints=locked_joints(self.lock),
                force=self.force,
                progress=progress,
            )
        new = added.new
        print(new.path)
        for note in added.notes:
            print(f"  {note}")
        if not added.has_license:
            print("  no licence is next to it: look for it before you pass the robot on")
        print_standing(new)
        if added.errors:
            figures = ", ".join(
                f"{each.worst():.0e} of {judge.BOUNDS[dtype]:g} in {dtype}" for dtype, each in added.errors.items()
            )
            print(f"{new.name}: dynamics agree with MuJoCo's model of the file: {figures}")
        is_known = str(out) in library
        path = "" if is_known else f"{PATH}={out} "
        print(f"compare how it moves and stands:  {path}polypod accuracy {new.name}")
        print(f"train it:  {path}{training_of(new, new.name)}")
        return 0
