"""`polypod robot`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from polypod.commands.arguments import Feet, Locks, Name, PackageDirs, Roles, arg, locked_joints, package_dirs, pairs


@dataclasses.dataclass(frozen=True)
class Robot:
    """Write a first config next to a URDF: `polypod robot new FILE.urdf`.

    `polypod add` also copies and compares it.
    """

    action: Annotated[Literal["new"], tyro.conf.Positional]
    """new: find legs and arms and a pose to stand in, choose gains by weight, let the robot stand,
    write the TOML."""
    file: Annotated[Path, tyro.conf.Positional]
    """The URDF file."""
    name: Name = None
    """The robot's name in configs. Default: that of --out, of the URDF, or of its file."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """The TOML to write. Default: <name>.toml next to the URDF."""
    package_dir: PackageDirs = ()
    """Folder of a ROS package in `package://` names. May be repeated."""
    foot: Feet = ()
    """The link that is the foot of a leg, where the URDF does not tell: LF=toe_link. May be
    repeated."""
    role: Roles = ()
    """The joint of a slot, where geometry does not tell: LF_HFE=thigh_joint. May be repeated."""
    lock: Locks = ()
    """Holds a joint at a position, rad or m: an arm, a payload. May be repeated."""
    force: bool = False
    """Replace an existing file."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        from polypod import new_robot
        from polypod.progress import Progress

        feet = pairs(self.foot, "--foot", "LEG=LINK")
        with Progress(len("try 1: drafts")) as progress:
            new = new_robot.new_robot(
                self.file,
                self.out,
                self.name,
                package_dirs(self.package_dir),
                feet,
                joint_roles=pairs(self.role, "--role", "SLOT=JOINT"),
                locked_joints=locked_joints(self.lock),
                force=self.force,
                progress=progress,
            )
        print(new.path)
        for note in new.notes:
            print(f"  {note}")
        new_robot.print_standing(new)
        print(f"train it:  {new_robot.training_of(new, str(new.path))}")
        return 0
