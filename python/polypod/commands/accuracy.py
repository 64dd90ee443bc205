"""`polypod accuracy`."""

import dataclasses
import functools
import sys
from typing import TYPE_CHECKING, Annotated

import tyro

from polypod import _core, provenance
from polypod.commands.arguments import Robots, arg, check_names, names

if TYPE_CHECKING:
    from polypod.accuracy.report import Report


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """Compare robots with MuJoCo's models of their files.

    The exit code is 1 where a figure exceeds its bound.
    """

    robot: Annotated[str | None, tyro.conf.Positional, arg(metavar="ROBOT")] = None
    """A robot's name or the path of its config, built in or added. Default: those of --robots."""
    robots: Robots = None
    """Names or paths of several, with commas between. Default: all."""

    def run(self) -> int:
        """Runs the command and returns its exit code: 1 where a figure exceeds its bound."""
        from polypod.accuracy import report, tables

        if self.robot is not None and self.robots is not None:
            raise _core.ConfigError(f"{self.robot} and --robots: name robots in one of these places")
        robots = names(self.robot) or names(self.robots)
        check_names(None, robots)
        measured = report.measure(robots, functools.partial(print, flush=True))
        print(f"\nMuJoCo {measured.mujoco}. {provenance.sentence(provenance.measured())}")
        for title, rows in tables.sections(measured).items():
            print(f"\n{title}\n\n{rows}")
        return judged(measured)


def judged(measured: "Report", unchanged: str = "") -> int:
    """Prints the verdict, or the figures that exceed their bounds; returns the exit code.

    `unchanged` says what a failure leaves as it was.
    """
    if broken := measured.broken():
        print(f"beyond the bounds of docs/accuracy.md{unchanged}:", *broken, sep="\n", file=sys.stderr)
        return 1
    print(f"\n{measured.verdict()}")
    return 0
