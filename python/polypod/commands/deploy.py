"""`polypod deploy`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from polypod import _core
from polypod.commands.arguments import Name, Overrides, arg, check_names, names, write_json


@dataclasses.dataclass(frozen=True)
class Deploy:
    """Check an exported policy of one robot in both simulators, or write its loop's files.

    Needs the extra export.

    Exit code 3 when the loop does not act as the policy does.
    """

    action: Annotated[Literal["check", "write", "show"], tyro.conf.Positional]
    """check: play the file through its loop in polypod and MuJoCo. write: the file, its contract
    and the loops in Python and C++, in one folder. show: print the contract."""
    file: Annotated[Path, tyro.conf.Positional]
    """A policy_<robot>.onnx of polypod export --robots."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for the files of write."""
    robot: Name = None
    """Name or config of the robot that check plays. Default: the one that the contract names."""
    checkpoint: Annotated[Path | None, arg(metavar="FILE")] = None
    """Policy that check compares with. Default: the policy of the export where it is found, else
    the network in the file."""
    simulators: Annotated[str, arg(metavar="A,B")] = "polypod,mujoco"
    """Simulators in which check plays the file; mujoco needs the extra bench."""
    num_envs: Annotated[int, arg(metavar="N")] = 4
    """Number of robots that check plays side by side."""
    steps: Annotated[int, arg(metavar="N")] = 100
    """Control steps of each robot in check."""
    seed: int = 0
    """Seed of initial states, commands and delays in check."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """File to which check also writes the figures."""
    set: Overrides = ()
    """Changes the task's configuration in check, on top of the run's own changes. May be
    repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        usual = {field.name: field.default for field in dataclasses.fields(self)}
        belongs = {"out": "write"} | dict.fromkeys(_OF_CHECK, "check")
        for key, action in belongs.items():
            if action != self.action and getattr(self, key) != usual[key]:
                raise _core.ConfigError(f"--{key.replace('_', '-')} belongs to polypod deploy {action}; leave it out")
        if self.action == "check":
            return self._check()
        from polypod.deploy import files

        if self.action == "show":
            print(files.shown(self.file))
            return 0
        if self.out is None:
            raise _core.ConfigError("--out is missing: name the folder to write to")
        for path in files.write(self.file, self.out):
            print(path)
        return 0

    def _check(self) -> int:
        check_names(None, None if self.robot is None else [self.robot])
        from polypod.deploy import check, report

        found = check.check(
            self.file,
            check.Options(
                simulators=names(self.simulators) or (),
                num_envs=self.num_envs,
                steps=self.steps,
                seed=self.seed,
                robot=self.robot,
                checkpoint=self.checkpoint,
                overrides=self.set,
            ),
        )
        report.show(found)
        write_json(self.json, found.as_dict())
        return 0 if found.holds else 3


_OF_CHECK = ("robot", "checkpoint", "simulators", "num_envs", "steps", "seed", "json", "set")
