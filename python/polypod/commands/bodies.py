"""`polypod bodies`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from polypod.commands.arguments import arg, names, positive


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Generate random robots as a library: `polypod bodies generate FOLDER --count 1000`."""

    action: Annotated[Literal["generate"], tyro.conf.Positional]
    """generate: sample lengths, derive masses, gains and poses, write URDFs, TOMLs and tasks."""
    folder: Annotated[Path, tyro.conf.Positional]
    """Folder to write. Add it to POLYPOD_PATH to use it."""
    count: Annotated[int, arg(metavar="N")] = 100
    """Number of bodies; kinds take turns."""
    seed: int = 0
    """Seed of the draws. A body depends on it, on its number and on the kinds alone."""
    kinds: Annotated[str, arg(metavar="A,B,C")] = "quadruped,quadruped8,biped,humanoid,hexapod"
    """Kinds of bodies: four legs of three joints or of two, two legs, two legs with arms, six legs;
    also quadruped_arm, four legs with an arm on the base."""
    prefix: Annotated[str, arg(metavar="NAME")] = "body"
    """Prefix of the robots' names."""
    wide: bool = False
    """Let bodies on two and four legs also differ in hips, joint limits, motors and gains, as
    robots of makers do; on two legs in arms, waist, head, canted axes and place of the base frame
    too."""
    force: bool = False
    """Replace existing files."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        from polypod import bodies

        positive(self.count, "--count")
        kinds = names(self.kinds) or []
        made = bodies.generate(self.folder, self.count, self.seed, kinds, self.prefix, force=self.force, wide=self.wide)
        joints = [len(body.joints) for body in made]
        masses = [body.mass for body in made]
        print(
            f"{self.folder}: {len(made)} bodies of {min(joints)} to {max(joints)} joints and {min(masses):.1f} to "
            f"{max(masses):.0f} kg"
        )
        print(f"train them:  POLYPOD_PATH={self.folder} polypod train --task {bodies.TASK}")
        return 0
