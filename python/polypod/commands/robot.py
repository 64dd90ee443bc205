"""`polypod robot`."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from polypod.commands.arguments import Locks, Name, PackageDirs, arg, locked_joints, package_dirs, pairs


@dataclasses.dataclass(frozen=True)
class Robot:
    """Write a first config for a robot of which there is only a URDF: `polypod robot new FILE.urdf`."""

    action: Annotated[Literal["new"], tyro.conf.Positional]
    """new: find legs and arms and a pose to stand in, choose gains by weight, let the robot stand, write the TOML."""
    file: Annotated[Path, tyro.conf.Positional]
    """The URDF file."""
    name: Name = None
    """The robot's name in configs. Default: that of --out, of the URDF, or of its file."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """The TOML to write. Default: <name>.toml beside the URDF."""
    package_dir: PackageDirs = ()
    """Where a ROS package of `package://` names lies. May be repeated."""
    foot: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="LEG=LINK")] = ()
    """The link that is the foot of a leg, where the URDF does not tell: LF=toe_link. May be repeated."""
    role: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="SLOT=JOINT")] = ()
    """The joint of a slot, where geometry does not tell: LF_HFE=thigh_joint. May be repeated."""
    lock: Locks = ()
    """Holds a joint at a position, rad or m: an arm, a payload. May be repeated."""
    force: bool = False
    """Write over a file that is there."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        from polypod import new_robot

        feet = pairs(self.foot, "--foot", "LEG=LINK")
        new = new_robot.new_robot(
            self.file,
            self.out,
            self.name,
            package_dirs(self.package_dir),
            feet,
            joint_roles=pairs(self.role, "--role", "SLOT=JOINT"),
            locked_joints=locked_joints(self.lock),
            force=self.force,
        )
        print(new.path)
        for note in new.notes:
            print(f"  {note}")
        standing, envs = new.standing, new_robot.NUM_ENVS
        print(
            f"{new.name}: {envs - standing.falls} of {envs} stand for {new_robot.SECONDS:g} s, the base "
            f"{standing.height:.3f} m high, joints at most {standing.sag:.2f} rad from the default pose"
        )
        if new.gain_factor > 1.0:
            print(f"  gains are {new.gain_factor:.2f} times what weight and leg length ask for: softer ones gave way")
        if standing.carried < new_robot.CARRIED and new.needs_policy is None:
            print(f"  the feet carry {standing.carried:.0%} of the weight: it lies on its belly or its knees")
        if new.needs_policy is not None:
            print(f"  {new.needs_policy}")
        elif not standing.holds:
            print(
                f"polypod: warning: {new.name} does not hold its default pose; look at [default_pose] and [actuators] "
                f"in {new.path}",
                file=sys.stderr,
            )
        others = "" if new.is_quadruped else "--train-config specialist "
        print(f"train it:  polypod train {others}--robots {new.path}")
        return 0
