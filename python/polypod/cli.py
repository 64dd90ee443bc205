"""The command line; `polypod --help` lists what there is."""

import difflib
import os
import sys
import traceback
import typing
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Annotated, Any

import tyro

from polypod import _core, interrupts
from polypod.commands.accuracy import Accuracy
from polypod.commands.adapt import Adapt
from polypod.commands.add import Add
from polypod.commands.bench import Bench
from polypod.commands.bodies import Bodies
from polypod.commands.check import Check
from polypod.commands.compare import Compare
from polypod.commands.deploy import Deploy
from polypod.commands.eval import Eval
from polypod.commands.export import Export
from polypod.commands.film import FilmOf
from polypod.commands.info import Info
from polypod.commands.list import List
from polypod.commands.motions import Motions
from polypod.commands.play import Play
from polypod.commands.robot import Robot
from polypod.commands.robustness import Robustness
from polypod.commands.schema import SchemaOf
from polypod.commands.show import Show
from polypod.commands.sim2sim import Sim2sim
from polypod.commands.sweep import SweepOf
from polypod.commands.terms import Terms
from polypod.commands.terrain import Terrain
from polypod.commands.train import Train
from polypod.text import plain

Command = (
    Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Adapt, tyro.conf.subcommand("adapt")]
    | Annotated[SweepOf, tyro.conf.subcommand("sweep")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Deploy, tyro.conf.subcommand("deploy")]
    | Annotated[Sim2sim, tyro.conf.subcommand("sim2sim")]
    | Annotated[Robustness, tyro.conf.subcommand("robustness")]
    | Annotated[Play, tyro.conf.subcommand("play")]
    | Annotated[FilmOf, tyro.conf.subcommand("film")]
    | Annotated[Motions, tyro.conf.subcommand("motions")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[Add, tyro.conf.subcommand("add")]
    | Annotated[Robot, tyro.conf.subcommand("robot")]
    | Annotated[Bodies, tyro.conf.subcommand("bodies")]
    | Annotated[Accuracy, tyro.conf.subcommand("accuracy")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Terrain, tyro.conf.subcommand("terrain")]
    | Annotated[Show, tyro.conf.subcommand("show")]
    | Annotated[Terms, tyro.conf.subcommand("terms")]
    | Annotated[SchemaOf, tyro.conf.subcommand("schema")]
    | Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Info, tyro.conf.subcommand("info")]
)

COMMANDS: tuple[str, ...] = tuple(typing.get_args(command)[1].name for command in typing.get_args(Command))
"""Names of the commands."""


def main(arguments: Sequence[str]) -> int:
    """Runs one command.

    Returns the exit code: 0, 2 for bad input, 1 for internal errors, 130 after Ctrl-C.

    `sim2sim`, `robustness` and `deploy check` return 3 for a policy that does not hold its bounds,
    `adapt` and `train --until-walks` for one that does not walk. `train` and `adapt` return 143
    after SIGTERM and 129 after SIGHUP.
    """
    if arguments and arguments[0] in _VERSION:
        # as in most programs, nothing else counts then
        print(f"polypod {_core.__version__}")
        return 0
    try:
        for argument in arguments:
            if not _is_text(argument):
                raise _core.ConfigError(f"{argument!r} is no text in UTF-8; rename the file, or correct the argument")
        _check_command(arguments)
        command = tyro.cli(
            Command,
            prog="polypod",
            description=_DESCRIPTION,
            args=_with_bare_flags(_respelled(arguments)) or ["--help"],
        )
        _check_seed(command)
        _check_packages(arguments[0])
        code = _run(command)
        sys.stdout.flush()
        return code
    except _core.PolypodError as error:
        print(f"polypod: {_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return interrupts.ended()
    except BrokenPipeError:
        _drop_output()
        return 1
    except OSError as error:
        _drop_output()
        place = f" {error.filename}" if error.filename else " the output"
        print(f"polypod: cannot read or write{place}: {error.strerror or error}; choose another place", file=sys.stderr)
        return 2
    except MemoryError:
        print("polypod: out of memory; choose smaller sizes, such as --num-envs", file=sys.stderr)
        return 2
    except Exception:
        if interrupts.happened():
            # a library has turned the KeyboardInterrupt within its import into another error
            return interrupts.ended()
        traceback.print_exc()
        print("polypod: this is a bug; please report the lines above and the command", file=sys.stderr)
        return 1


def _check_command(arguments: Sequence[str]) -> None:
    """Raises UnknownNameError for a first word that is no command."""
    if not arguments or arguments[0].startswith("-") or arguments[0] in COMMANDS:
        return
    near = difflib.get_close_matches(arguments[0], COMMANDS, n=1)
    guess = f"did you mean {near[0]!r}? " if near else ""
    raise _core.UnknownNameError(
        f"there is no command {arguments[0][:80]!r}; {guess}Commands: {', '.join(COMMANDS)}; see polypod --help"
    )


def _is_text(argument: str) -> bool:
    try:
        argument.encode()
    except UnicodeEncodeError:
        return False
    return True


def _drop_output() -> None:
    """Lets what standard output does not take go, so that Python's end does not try again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _check_seed(command: Any) -> None:
    seed = getattr(command, "seed", None)
    if seed is not None and not 0 <= seed < 2**64:
        raise _core.ConfigError(f"--seed {seed} must be from 0 to 2^64 - 1")


_TRAIN_EXTRA = {
    "filelock": "filelock",
    "msgspec": "msgspec",
    "rich": "rich",
    "rsl_rl": "rsl-rl-lib",
    "tensordict": "tensordict",
    "torch": "torch",
}
"""Modules of the extra train and their packages."""
_WITH_POLICIES = ("adapt", "compare", "eval", "export", "film", "play", "robustness", "sim2sim", "sweep", "train")
"""Commands that need the extra train."""


def _check_packages(command: str) -> None:
    """Raises ConfigError where a package that a command needs is missing."""
    if command not in _WITH_POLICIES:
        return
    missing = [package for module, package in _TRAIN_EXTRA.items() if find_spec(module) is None]
    if missing:
        raise _core.ConfigError(
            f"the command {command} needs {', '.join(missing)}; install the train extra: pip install 'polypod[train]'"
        )


_DESCRIPTION = """Trains one locomotion policy over many legged robots, on ordinary CPUs.

-V, --version  Show the version and exit."""


def _run(command: Any) -> int:
    code: int = command.run()
    return code


_VERSION = ("--version", "-V")
_SPELLINGS = {"--quadrupeds": "--robots", "--randomised": "--randomized", "--no-randomised": "--no-randomized"}
"""Spellings of flags that are taken and that no help lists."""


def _respelled(arguments: Sequence[str]) -> list[str]:
    """The arguments with the spellings that the commands know."""
    respelled = []
    for argument in arguments:
        flag, is_joined, value = argument.partition("=")
        respelled.append(_SPELLINGS.get(flag, flag) + is_joined + value)
    return respelled


_BARE = {"--resume": "latest", "--ray": "auto"}
"""Values of flags that are given without a value."""


def _with_bare_flags(arguments: Sequence[str]) -> list[str]:
    """`--resume` without a value stands for `--resume latest`, and `--ray` for `--ray auto`."""
    completed = []
    for argument, following in zip(arguments, [*arguments, "--"][1:], strict=True):
        completed.append(argument)
        if argument in _BARE and following.startswith("-"):
            completed.append(_BARE[argument])
    return completed


def _one_line(error: Exception) -> str:
    """The message of `error`; KeyError among its bases would put it in quotes."""
    text = error.args[0] if error.args and isinstance(error.args[0], str) else str(error)
    return plain(text)
