"""The command line; `polypod --help` lists what there is."""

import dataclasses
import functools
import json
import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from polypod import _core

# torch, TensorBoard and rsl_rl take seconds to import: each command imports what it needs.

_arg = functools.partial(tyro.conf.arg, help_behavior_hint="")

MAX_THREADS = 1024

Name = Annotated[str | None, _arg(metavar="NAME")]
Count = Annotated[int | None, _arg(metavar="N")]
Robots = Annotated[str | None, _arg(aliases=("--quadrupeds",), metavar="A,B,C")]
RobotNames = Annotated[str | None, _arg(aliases=("--robot",), metavar="A,B,C")]
Velocity = Annotated[tuple[float, float, float] | None, _arg(metavar="VX VY WZ")]
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
    """Name of a file in configs/train (flat, flat_universal, quick, rough), or the path of a .toml. Default: flat."""
    logger: Literal["tensorboard", "none"] = "tensorboard"
    """Where the curves go."""
    resume: Annotated[str | None, _arg(metavar="RUN")] = None
    """Go on with a run: its name, its directory, a checkpoint, or `latest` (also when RUN is left out)."""
    init: Annotated[Path | None, _arg(metavar="FILE")] = None
    """Begin with the networks of this checkpoint, of a run with the same observation and sizes of networks."""
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

    checkpoint: Annotated[tuple[Path, ...], _arg(metavar="FILE [FILE ...]")]
    """A model_<n>.pt beside its manifest.json. Of several, the seeds of one training, the mean and its interval too."""
    json: Annotated[Path | None, _arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    plot: Annotated[Path | None, _arg(metavar="FILE")] = None
    """Also draw them (.png, .svg, .pdf); needs the extra bench."""
    num_envs: Count = None
    """Number of envs. Default: 64 per robot."""
    episodes: int = 1
    """Episodes per env."""
    steps: Count = None
    """Control steps per episode. Default: a whole one."""
    grid: Annotated[tuple[int, int, int] | None, _arg(metavar="NX NY NW")] = None
    """Let each episode hold one command of so many forward and left velocities and yaw rates. Default: drawn anew."""
    randomized: Annotated[bool, _arg(aliases=("--randomised",))] = False
    """With the noise, the pushes and the randomisation of the training."""
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
class Export:
    """Write a trained policy as ONNX and TorchScript, with a manifest; needs the extra export."""

    checkpoint: Path
    """A model_<n>.pt beside its manifest.json."""
    out: Annotated[Path | None, _arg(metavar="DIR")] = None
    """Where to. Default: exported/ beside the checkpoint."""
    robots: RobotNames = None
    """Also one graph per robot named here, with commas between, from its sensors to its joint targets."""
    fold: bool = False
    """The same for all robots that the policy was trained on."""
    formats: Annotated[tuple[Literal["onnx", "torchscript"], ...], _arg(metavar="FORMAT")] = ("onnx", "torchscript")
    """Kinds of files."""


@dataclasses.dataclass(frozen=True)
class Sim2sim:
    """Let the exported policy drive the same robots in MuJoCo, beside polypod; needs the extras export and bench.

    Exit code 3 when a robot falls in more than 5 % of its episodes in MuJoCo, or follows its command by more than
    0.1 m/s worse than in polypod.
    """

    checkpoint: Path
    """A model_<n>.pt beside its manifest.json."""
    robots: RobotNames = None
    """Names of the robots, with commas between. Default: the run's."""
    json: Annotated[Path | None, _arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    num_envs: int = 32
    """Envs per robot."""
    steps: Count = None
    """Control steps per episode. Default: a whole one."""
    command: Velocity = None
    """Forward and left velocity (m/s) and yaw rate (rad/s) for all envs. Default: drawn as the task draws them."""
    dt: Annotated[float | None, _arg(metavar="S")] = None
    """MuJoCo's physics step, s. Default: the task's, on terrain 0.002."""
    integrator: Literal["implicitfast", "RK4"] = "implicitfast"
    """MuJoCo's."""
    friction: Annotated[float | None, _arg(metavar="MU")] = None
    """Of the ground in MuJoCo. Default: the task's static friction."""
    soft_contact: bool = False
    """MuJoCo's default contacts in place of the stiffest ones that the step allows."""
    seed: int = 0
    """Of initial states, commands and delays."""
    set: Overrides = ()
    """Changes the task's configuration, on top of the run's own changes. May be repeated."""


@dataclasses.dataclass(frozen=True)
class Play:
    """Watch a policy in the browser, record it, or film it without a display; needs the extra play."""

    checkpoint: Path
    """A model_<n>.pt beside its manifest.json."""
    robots: RobotNames = None
    """Names of the robots, with commas between. Default: the run's."""
    command: Velocity = None
    """Forward and left velocity (m/s) and yaw rate (rad/s) for all robots. Default: drawn as the task draws them."""
    task: Name = None
    """Name or alias of the task. Default: the run's."""
    num_envs: int = 1
    """Envs per robot."""
    seconds: Annotated[float | None, _arg(metavar="S")] = None
    """Simulated time. Default: without end in the browser, else 10 s."""
    warm_up: Annotated[float, _arg(metavar="S")] = 0.0
    """Simulated before anything is shown, s."""
    record: Annotated[Path | None, _arg(metavar="FILE")] = None
    """Write a recording: .html opens in any browser, .viser in viser's client."""
    video: Annotated[Path | None, _arg(metavar="FILE")] = None
    """Write a film: .gif, .webp or .mp4."""
    fps: int = 25
    """Of the film."""
    size: Annotated[tuple[int, int], _arg(metavar="WIDTH HEIGHT")] = (640, 360)
    """Of the film, pixels."""
    headless: bool = False
    """Neither browser nor file: only the table of how the robots did."""
    port: int = 8080
    """Of the browser's page."""
    seed: int = 0
    """Of every random stream."""
    threads: Count = None
    """Threads of the simulator. Default: one per core."""
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
class Robot:
    """Write a first config for a quadruped of which there is only a URDF: `polypod robot new FILE.urdf`."""

    action: Annotated[Literal["new"], tyro.conf.Positional]
    """new: find the legs and a pose to stand in, choose gains by weight, let the robot stand, write the TOML."""
    file: Annotated[Path, tyro.conf.Positional]
    """The URDF file."""
    name: Name = None
    """The robot's name in configs. Default: that of --out, of the URDF, or of its file."""
    out: Annotated[Path | None, _arg(metavar="FILE")] = None
    """The TOML to write. Default: <name>.toml beside the URDF."""
    package_dir: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], _arg(metavar="NAME=DIR")] = ()
    """Where a ROS package of `package://` names lies. May be repeated."""
    force: bool = False
    """Write over a file that is there."""


@dataclasses.dataclass(frozen=True)
class ResultsOf:
    """Make tables and pictures out of trainings and evaluations."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder <folder>/<group>/<run>/ with manifests, TensorBoard's events and the JSON files of eval and sim2sim. Or
    the same folder packed by `tar -cJf results.tar.xz -C FOLDER .`"""
    out: Annotated[Path | None, _arg(metavar="FILE")] = None
    """Also write the tables to this document, between its marks."""
    media: Annotated[Path | None, _arg(metavar="DIR")] = None
    """Also draw curves per robot and maps of the evaluations into this folder; needs the extra bench."""
    score: Annotated[float | None, _arg(metavar="M/S")] = None
    """Velocity error (m/s) of the exploring policy; the iterations until it is reached are counted. Default: 0.25."""
    baseline: Name = None
    """Count to the error that this group ends with instead: to compare fine-tuning with training from scratch."""


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
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Sim2sim, tyro.conf.subcommand("sim2sim")]
    | Annotated[Play, tyro.conf.subcommand("play")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[Robot, tyro.conf.subcommand("robot")]
    | Annotated[Accuracy, tyro.conf.subcommand("accuracy")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[ResultsOf, tyro.conf.subcommand("results")]
    | Annotated[Terrain, tyro.conf.subcommand("terrain")]
    | Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Info, tyro.conf.subcommand("info")]
)


def main(arguments: Sequence[str]) -> int:
    """Runs one command and returns the exit code: 0, 2 for bad input, 1 for internal errors, 130 after Ctrl-C.

    `sim2sim` returns 3 for a policy that does not hold its bounds in MuJoCo. `train` returns 143 after SIGTERM and 129
    after SIGHUP.
    """
    try:
        for argument in arguments:
            if not _is_text(argument):
                raise _core.ConfigError(f"{argument!r} is no text in UTF-8; rename the file, or correct the argument")
        command = tyro.cli(
            Command, prog="polypod", description=_DESCRIPTION, args=_with_bare_resume(arguments) or ["--help"]
        )
        _check_seed(command)
        code = _run(command)
        sys.stdout.flush()
        return code
    except _core.PolypodError as error:
        print(f"polypod: {_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
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
        traceback.print_exc()
        print("polypod: this is a bug; please report the lines above and the command", file=sys.stderr)
        return 1


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


_DESCRIPTION = "Trains one locomotion policy over many legged robots, on ordinary CPUs."


def _run(
    command: Train
    | Eval
    | Export
    | Sim2sim
    | Play
    | Check
    | Robot
    | Accuracy
    | Bench
    | ResultsOf
    | Terrain
    | List
    | Info,
) -> int:
    match command:
        case Train():
            return _train(command)
        case Eval():
            return _eval(command)
        case Export():
            return _export(command)
        case Sim2sim():
            return _sim2sim(command)
        case Play():
            return _play(command)
        case Check():
            print(_core.check(command.file, _package_dirs(command.package_dir)), end="")
        case Robot():
            return _new_robot(command)
        case Accuracy():
            return _accuracy(command)
        case Bench():
            return _bench(command)
        case ResultsOf():
            return _results(command)
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
            for problem in _core.broken_configs():
                print(f"polypod: warning: {problem}", file=sys.stderr)
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
            init=command.init,
            run_name=command.run_name,
            log_dir=command.log_dir,
            device=command.device,
            threads=_threads(command.threads, "--threads"),
            overrides=list(command.set),
        )
    )


def _eval(command: Eval) -> int:
    import torch

    from polypod.evaluation import evaluate_checkpoints, plot, summarize
    from polypod.training.report import Reporter

    threads = _threads(command.threads, "--threads")
    if threads is not None:
        torch.set_num_threads(threads)
    if not command.checkpoint:
        raise _core.ConfigError("--checkpoint names no file; pass one model_<n>.pt or more")
    evaluations = evaluate_checkpoints(
        command.checkpoint,
        task=command.task,
        robots=_names(command.robots),
        num_envs=command.num_envs,
        episodes=command.episodes,
        steps=command.steps,
        seed=command.seed,
        threads=threads,
        overrides=list(command.set),
        grid=command.grid,
        randomized=command.randomized,
    )
    summary = summarize(evaluations)
    reporter = Reporter()
    for checkpoint, evaluation in zip(command.checkpoint, evaluations, strict=True):
        if len(evaluations) > 1:
            reporter.message(str(checkpoint))
        reporter.evaluation(evaluation)
    if len(evaluations) > 1:
        reporter.summary(summary)
    _write_json(command.json, summary.as_dict() if len(evaluations) > 1 else evaluations[0].as_dict())
    if command.plot is not None:
        plot.picture(summary, command.plot)
    return 0


def _export(command: Export) -> int:
    from polypod.export import export_checkpoint

    if not command.formats:
        raise _core.ConfigError("--formats names none; choose onnx, torchscript or both")
    done = export_checkpoint(
        command.checkpoint, command.out, _names(command.robots), fold=command.fold, formats=command.formats
    )
    for change in done.changes:
        print(f"polypod: warning: {change}", file=sys.stderr)
    for file in done.files:
        print(file)
    if "onnx" in command.formats:
        print(f"onnxruntime differs from torch by at most {done.difference:.1e}")
    return 0


def _sim2sim(command: Sim2sim) -> int:
    from polypod import sim2sim
    from polypod.sim2sim.report import Progress, show

    options = sim2sim.Options(
        envs_per_robot=command.num_envs,
        steps=command.steps,
        seed=command.seed,
        command=command.command,
        dt=command.dt,
        integrator=command.integrator,
        friction=command.friction,
        soft_contact=command.soft_contact,
        overrides=command.set,
    )
    with Progress() as progress:
        comparison = sim2sim.compare(command.checkpoint, _names(command.robots), options, progress)
    show(comparison)
    _write_json(command.json, comparison.as_dict())
    return 0 if comparison.transfers else 3


def _play(command: Play) -> int:
    from polypod.play import session
    from polypod.play.report import show

    player = session.play(
        session.Options(
            checkpoint=command.checkpoint,
            robots=_names(command.robots),
            command=command.command,
            task=command.task,
            envs_per_robot=command.num_envs,
            seconds=command.seconds,
            warm_up=command.warm_up,
            record=command.record,
            video=command.video,
            fps=command.fps,
            size=command.size,
            headless=command.headless,
            port=command.port,
            seed=command.seed,
            threads=_threads(command.threads, "--threads"),
            overrides=list(command.set),
        )
    )
    show(player)
    for file in (command.record, command.video):
        if file is not None:
            print(file)
    return 0


def _write_json(path: Path | None, content: dict[str, Any]) -> None:
    from polypod.files import write_text

    if path is None:
        return
    try:
        write_text(path, json.dumps(content, indent=2) + "\n")
    except OSError as error:
        raise _core.ConfigError(f"cannot write {path}: {error.strerror}; choose another --json") from error


def _package_dirs(pairs: Sequence[str]) -> dict[str, str]:
    folders = {}
    for pair in pairs:
        name, _, folder = pair.partition("=")
        if not name or not folder:
            raise _core.ConfigError(f"--package-dir {pair} is not NAME=DIR")
        folders[name] = folder
    return folders


def _new_robot(command: Robot) -> int:
    from polypod import new_robot

    new = new_robot.new_robot(
        command.file, command.out, command.name, _package_dirs(command.package_dir), force=command.force
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
    if not standing.holds:
        print(
            f"polypod: warning: {new.name} does not hold its default pose; look at [default_pose] and [actuators] in "
            f"{new.path}",
            file=sys.stderr,
        )
    print(f"train it:  polypod train --robots {new.path}")
    return 0


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

    for value, flag in (
        (command.num_envs, "--num-envs"),
        (command.largest, "--largest"),
    ):
        _positive(value, flag)
    _threads(command.threads, "--threads")
    options = bench.Options(
        robot=command.robot,
        num_envs=command.num_envs,
        threads=command.threads,
        step_threads=_threads(command.step_threads, "--step-threads"),
        seed=command.seed,
        quick=command.quick,
        largest=command.largest,
    )
    result = bench.measure(options, functools.partial(print, file=sys.stderr, flush=True))
    print(bench.table(result))
    _write_json(command.json, result)
    if command.plot is not None:
        bench.picture(result, command.plot)
    return 0


def _results(command: ResultsOf) -> int:
    from polypod import results

    found = results.read(command.folder)
    for file in found.skipped:
        print(f"polypod: warning: {file} is neither an evaluation nor a comparison with MuJoCo", file=sys.stderr)
    score = results.DEFAULT_SCORE if command.score is None else command.score
    text, drawn = results.write(found, command.out, command.media, score, command.baseline)
    print(text)
    for file in drawn:
        print(file)
    return 0


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [name.strip() for name in text.split(",")]


def _positive(value: int | None, flag: str) -> int | None:
    if value is not None and not 1 <= value < 2**31:
        raise _core.ConfigError(f"{flag} {value} must be at least 1 and less than 2^31")
    return value


def _threads(value: int | None, flag: str) -> int | None:
    if value is not None and not 1 <= value <= MAX_THREADS:
        raise _core.ConfigError(f"{flag} {value} must be from 1 to {MAX_THREADS}; leave it out for one per core")
    return value


def _with_bare_resume(arguments: Sequence[str]) -> list[str]:
    """`--resume` without a value stands for `--resume latest`."""
    completed = []
    for argument, following in zip(arguments, [*arguments, "--"][1:], strict=True):
        completed.append(argument)
        if argument == "--resume" and following.startswith("-"):
            completed.append("latest")
    return completed


def _one_line(error: Exception) -> str:
    """The message of `error`; KeyError among its bases would put it in quotes."""
    text = error.args[0] if error.args and isinstance(error.args[0], str) else str(error)
    return " ".join(text.split())
