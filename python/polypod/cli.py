"""The command line: `polypod train | eval | check | accuracy | bench | terrain | list | info`."""

import dataclasses
import functools
import json
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from polypod import _core

# torch, TensorBoard and rsl_rl take seconds to import: each command imports what it needs.

_arg = functools.partial(tyro.conf.arg, help_behavior_hint="")

Name = Annotated[str | None, _arg(metavar="NAME")]
Count = Annotated[int | None, _arg(metavar="N")]
Robots = Annotated[str | None, _arg(aliases=("--quadrupeds",), metavar="A,B,C")]
Overrides = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], _arg(metavar="KEY=VALUE")]


@dataclasses.dataclass(frozen=True)
class Train:
    """Train one policy over many robots."""

    task: Name = None
    """Name or alias of the task (`polypod list`). Default: the train config's."""
    num_envs: Count = None
    """Number of envs, shared out evenly among the robots. Default: the train config's."""
    robots: Robots = None
    """Names of the robots, with commas between (`polypod list`). Default: the task's."""
    max_iterations: Count = None
    """Learning iterations; with --resume, how many more. Default: the train config's; with --resume, what was left."""
    seed: Count = None
    """Of every random stream. Default: 42."""
    train_config: Name = None
    """Name of a file in configs/train (flat, rough, quick), or the path of a .toml. Default: flat."""
    logger: Literal["tensorboard", "none"] = "tensorboard"
    """Where the curves go."""
    resume: Annotated[str | None, _arg(metavar="RUN")] = None
    """Go on with a run: its name, its directory, a checkpoint, or `latest` (also when RUN is left out)."""
    run_name: Name = None
    """Added to the name of the run's directory."""
    log_dir: Path = Path("logs")
    """Runs lie in LOG_DIR/rsl_rl/<experiment>/."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the learner runs; the simulator runs on the CPU."""
    threads: Count = None
    """Threads of the simulator, and of the learner on the CPU. Default: one per core."""
    set: Overrides = ()
    """Changes the task's configuration, e.g. --set sim.episode_length_s=10.0. May be repeated."""


@dataclasses.dataclass(frozen=True)
class Eval:
    """Measure a trained policy: no noise, no pushes, one full episode per env."""

    checkpoint: Path
    """A model_<n>.pt beside its manifest.json."""
    json: Annotated[Path | None, _arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    num_envs: Count = None
    """Number of envs. Default: 64 per robot."""
    episodes: int = 1
    """Episodes per env."""
    steps: Count = None
    """Control steps per episode. Default: a whole one."""
    robots: Robots = None
    """Names of the robots, with commas between; also robots that the policy was not trained on. Default: the run's."""
    task: Name = None
    """Name or alias of the task. Default: the run's."""
    seed: int = 0
    """Of every random stream."""
    threads: Count = None
    """Threads of the simulator and the policy. Default: one per core."""
    set: Overrides = ()
    """Changes the task's configuration, on top of the run's own changes. May be repeated."""


@dataclasses.dataclass(frozen=True)
class Check:
    """Show what a URDF file is read as, with every warning; it needs no config."""

    file: Annotated[Path, tyro.conf.Positional]
    """The URDF file."""
    package_dir: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], _arg(metavar="NAME=DIR")] = ()
    """Where a ROS package of `package://` names lies. May be repeated."""


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """Compare the physics with MuJoCo on the same URDFs."""

    robots: Robots = None
    """Names of the robots, with commas between. Default: all."""
    out: Annotated[Path | None, _arg(metavar="FILE")] = None
    """Also write the tables to this document, between its marks."""
    readme: Annotated[Path | None, _arg(metavar="FILE")] = None
    """Also write the summary to this document, between its marks."""


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure the speed, physics beside MuJoCo in the same run."""

    quick: bool = False
    """Only the main figures, in less than a minute."""
    json: Annotated[Path | None, _arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    plot: Annotated[Path | None, _arg(metavar="FILE")] = None
    """Also plot how the speed scales (.png, .svg, .pdf)."""
    robot: str = "unitree_a1"
    """Whose physics is compared."""
    num_envs: int = 4096
    """Number of envs, but where it is varied."""
    threads: int = 1
    """Threads of the physics figures, polypod's and MuJoCo's."""
    step_threads: Count = None
    """Threads of the whole control steps. Default: one per core."""
    largest: int = 65536
    """Number of envs that the scaling goes up to."""
    seed: int = 0
    """Of every random stream."""


@dataclasses.dataclass(frozen=True)
class Terrain:
    """Save a picture or the mesh of a task's ground."""

    out: Path
    """A .png (shaded map), .stl (triangles) or .npz (heights)."""
    task: str = "velocity_rough"
    """Name or alias of the task."""
    set: Overrides = ()
    """Changes the task's configuration, e.g. --set scene.terrain.seed=1. May be repeated."""


@dataclasses.dataclass(frozen=True)
class List:
    """List the tasks and the robots."""


@dataclasses.dataclass(frozen=True)
class Info:
    """Show the version, the instruction set in use and the number of threads."""


Command = (
    Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[Accuracy, tyro.conf.subcommand("accuracy")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Terrain, tyro.conf.subcommand("terrain")]
    | Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Info, tyro.conf.subcommand("info")]
)


def main(arguments: Sequence[str]) -> int:
    """Runs one command and returns the exit code: 0, 2 for bad input, 1 for internal errors, 130 after Ctrl-C."""
    command = tyro.cli(Command, prog="polypod", description=_DESCRIPTION, args=_with_bare_resume(arguments))
    try:
        return _run(command)
    except _core.PolypodError as error:
        print(f"polypod: {_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except Exception:
        traceback.print_exc()
        print("polypod: this is a bug; please report the lines above and the command", file=sys.stderr)
        return 1


_DESCRIPTION = "Trains one locomotion policy over many legged robots, on ordinary CPUs."


def _run(command: Train | Eval | Check | Accuracy | Bench | Terrain | List | Info) -> int:
    match command:
        case Train():
            return _train(command)
        case Eval():
            return _eval(command)
        case Check():
            print(_core.check(command.file, _package_dirs(command.package_dir)), end="")
        case Accuracy():
            return _accuracy(command)
        case Bench():
            return _bench(command)
        case Terrain():
            from polypod import terrain

            print(terrain.save(command.task, command.out, command.set))
        case List():
            print("tasks")
            for task in _core.tasks():
                print(f"  {task['name']:<40} {', '.join(task['aliases'])}")
            print("robots")
            for robot in _core.robots():
                print(f"  {robot['name']:<40} {robot['title']}")
        case Info():
            for key, value in _core.info().items():
                print(f"{key:<10} {value}")
    return 0


def _train(command: Train) -> int:
    from polypod.training import session

    return session.train(
        session.Options(
            task=command.task,
            num_envs=command.num_envs,
            robots=_names(command.robots),
            max_iterations=command.max_iterations,
            seed=command.seed,
            train_config=command.train_config,
            logger=command.logger,
            resume=command.resume,
            run_name=command.run_name,
            log_dir=command.log_dir,
            device=command.device,
            threads=_positive(command.threads, "--threads"),
            overrides=list(command.set),
        )
    )


def _eval(command: Eval) -> int:
    import torch

    from polypod.evaluation import evaluate_checkpoint
    from polypod.training.report import Reporter
    from polypod.training.run_dir import write_text

    threads = _positive(command.threads, "--threads")
    if threads is not None:
        torch.set_num_threads(threads)
    evaluation = evaluate_checkpoint(
        command.checkpoint,
        task=command.task,
        robots=_names(command.robots),
        num_envs=command.num_envs,
        episodes=command.episodes,
        steps=command.steps,
        seed=command.seed,
        threads=threads,
        overrides=list(command.set),
    )
    Reporter().evaluation(evaluation)
    if command.json is not None:
        try:
            write_text(command.json, json.dumps(evaluation.as_dict(), indent=2) + "\n")
        except OSError as error:
            raise _core.ConfigError(f"cannot write {command.json}: {error.strerror}; choose another --json") from error
    return 0


def _package_dirs(pairs: Sequence[str]) -> dict[str, str]:
    folders = {}
    for pair in pairs:
        name, _, folder = pair.partition("=")
        if not name or not folder:
            raise _core.ConfigError(f"--package-dir {pair} is not NAME=DIR")
        folders[name] = folder
    return folders


def _accuracy(command: Accuracy) -> int:
    from polypod.accuracy import markdown, report

    for document in (command.out, command.readme):
        if document is not None:
            report.check_document(document)
    measured = report.measure(_names(command.robots), functools.partial(print, flush=True))
    tables, summary = markdown.tables(measured), markdown.summary(measured)
    print(f"\n{tables}\n\n{summary}")
    for document, text in ((command.out, tables), (command.readme, summary)):
        if document is not None:
            report.replace_block(document, text)
    return 0


def _bench(command: Bench) -> int:
    from polypod import bench
    from polypod.training.run_dir import write_text

    for value, flag in (
        (command.num_envs, "--num-envs"),
        (command.threads, "--threads"),
        (command.largest, "--largest"),
    ):
        _positive(value, flag)
    options = bench.Options(
        robot=command.robot,
        num_envs=command.num_envs,
        threads=command.threads,
        step_threads=_positive(command.step_threads, "--step-threads"),
        seed=command.seed,
        quick=command.quick,
        largest=command.largest,
    )
    result = bench.measure(options, functools.partial(print, file=sys.stderr, flush=True))
    print(bench.table(result))
    if command.json is not None:
        try:
            write_text(command.json, json.dumps(result, indent=2) + "\n")
        except OSError as error:
            raise _core.ConfigError(f"cannot write {command.json}: {error.strerror}; choose another --json") from error
    if command.plot is not None:
        bench.picture(result, command.plot)
    return 0


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [name.strip() for name in text.split(",")]


def _positive(value: int | None, flag: str) -> int | None:
    if value is not None and value < 1:
        raise _core.ConfigError(f"{flag} {value} must be at least 1")
    return value


def _with_bare_resume(arguments: Sequence[str]) -> list[str]:
    """`--resume` without a value stands for `--resume latest`."""
    completed = []
    for argument, following in zip(arguments, [*arguments[1:], "--"], strict=True):
        completed.append(argument)
        if argument == "--resume" and following.startswith("-"):
            completed.append("latest")
    return completed


def _one_line(error: Exception) -> str:
    """The message of `error`; KeyError among its bases would put it in quotes."""
    text = error.args[0] if error.args and isinstance(error.args[0], str) else str(error)
    return " ".join(text.split())
