"""One training from its options to its final table: a new run, or one that goes on."""

import contextlib
import dataclasses
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

import polypod
from polypod import _core, quick_start, simulated, text
from polypod.evaluation import evaluate_checkpoint
from polypod.motions import tracking
from polypod.python_terms import Terms, load
from polypod.rsl_rl import VecEnv
from polypod.runs import config, run_dir
from polypod.runs.engines import ENGINE, SAME_BITS
from polypod.runs.schema import ALTERNATE, RunConfig, TrainConfig
from polypod.training.goal import UntilWalks, progress_line, threads_of_a_measurement
from polypod.training.gpu import GpuRunner
from polypod.training.graph_runner import GraphRunner
from polypod.training.native import CardRunner, NativeRunner
from polypod.training.report import Reporter
from polypod.training.runner import Runner
from polypod.training.taught_runner import TaughtRunner
from polypod.training.workers import Workers, flat, is_among_workers, threads_of

DEFAULT_SEED = 42
NOT_WALKING = 3
"""Exit code of a training that was to end with walking robots and does not."""


@dataclasses.dataclass(frozen=True)
class Options:
    """The command line of `polypod train`; None: not given."""

    task: str | None = None
    num_envs: int | None = None
    robots: list[str] | None = None
    max_iterations: int | None = None
    seed: int | None = None
    train_config: str | None = None
    learner: str | None = None
    logger: str = "tensorboard"
    log_project: str = "polypod"
    resume: str | None = None
    init: Path | None = None
    terms: Path | None = None
    run_name: str | None = None
    log_dir: Path = Path("logs")
    device: str = "auto"
    threads: int | None = None
    overrides: list[str] = dataclasses.field(default_factory=list)
    until_walks: int | None = None
    run: Path | None = None
    """A directory that was made for the run; None: a new one in `log_dir`. No flag of the command
    line."""
    origin: str | None = None
    """The command line of another command that trains with these options. No flag of `polypod
    train`."""

    @property
    def command(self) -> str:
        """The command line of these options."""
        if self.origin is not None:
            return self.origin
        given = {
            f"--{field.name.replace('_', '-')}": value
            for field in dataclasses.fields(self)
            if field.name not in ("run", "origin", "overrides")
            and (value := getattr(self, field.name)) != field.default
        }
        return text.command_line(("polypod", "train"), given, {"--set": self.overrides})


@dataclasses.dataclass(frozen=True)
class Plan:
    """A training whose options are all resolved."""

    config: TrainConfig
    robots: list[str] | None
    seed: int
    overrides: list[str]
    checkpoint: Path | None
    device: str
    """Where torch's tensors are."""
    terms: Terms | None = None
    slots: tuple[str, ...] = ()
    """Names of actions that the policy has on top of those of its robots."""
    wants_card: bool = False
    """Whether a card is to compute the native learner's updates in native arithmetic."""


def train(options: Options) -> int:
    """Trains, saves, evaluates.

    Returns the exit code: 0, 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP.

    With `until_walks` it is 3 where not all robots walk.

    Raises:
        ConfigError: for options that name nothing, contradict the run to resume, or are out of
            range.
    """
    is_cuda = options.device != "cpu" and torch.cuda.is_available()
    workers = Workers.join(is_cuda)
    reporter, goal = Reporter(quiet=not workers.is_first), None
    if options.until_walks is not None:
        goal = UntilWalks(
            options.until_walks,
            say=lambda point: reporter.message(progress_line(point)),
            threads=options.threads,
            only_promising=True,
            tell=reporter.message,
        )
    try:
        run, runner = train_with(options, workers, goal=goal, reporter=reporter)
    finally:
        workers.close()
    if not workers.is_first:
        return 0 if runner.stopped_by is None else 128 + runner.stopped_by
    runner.env.unwrapped.close()
    checkpoint = run_dir.checkpoint_path(run, runner.current_learning_iteration)
    reporter.message(f"checkpoint {checkpoint}")
    if runner.stopped_by is not None:
        return 128 + runner.stopped_by
    result = None if goal is None else goal.evaluation_of(checkpoint)
    if result is None:
        with threads_of_a_measurement(run_dir.read_manifest(checkpoint), options.threads):
            result = evaluate_checkpoint(checkpoint, threads=options.threads, terms=options.terms)
    reporter.evaluation(result)
    if goal is None or goal.walked:
        return 0
    if goal.best is not None and goal.best.checkpoint != checkpoint:
        reporter.message(f"the best one that was measured: {goal.best.checkpoint}")
    return NOT_WALKING


def train_with(
    options: Options,
    workers: Workers,
    watch: Callable[[int, Mapping[str, float]], None] | None = None,
    *,
    goal: UntilWalks | None = None,
    plan: Plan | None = None,
    reporter: Reporter | None = None,
) -> tuple[Path, Runner]:
    """Trains with the other workers.

    Args:
        options: the same for all workers.
        workers: the others.
        watch: is told the number of finished iterations and the scalars of each, in worker 0.
        goal: ends the training before its last iteration; of a training in one process.
        plan: what to train; None: what the options say.
        reporter: what the user sees; None: all of a training.

    Returns:
        The run's directory, and what has trained it.

    Raises:
        ConfigError: as `train`.
        SystemExit: in workers that have nothing to say of an error that another one reports.
    """
    if plan is None:
        plan = new_plan(options) if options.resume is None else _resumed_plan(options, workers)
    if goal is not None and workers.count > 1:
        raise _core.ConfigError("--until-walks is of trainings in one process; leave it out, or train without workers")
    _check_same_plan(plan, options, workers)
    device = plan.device
    begin_with = plan.checkpoint or options.init
    if begin_with is not None and workers.is_first:
        run_dir.load_checkpoint(begin_with)  # a broken one is refused before anything is written
    threads = threads_of(workers, options.threads)
    if threads is not None:
        torch.set_num_threads(threads)
    torch.manual_seed(plan.seed)
    run_config = plan.config.run
    terms = plan.terms
    if terms is not None and terms.options is not None and workers.count > 1:
        raise _core.ConfigError("tasks that track motions are trained in one process; train without workers")
    if terms is not None and workers.count > 1:
        raise _core.ConfigError("--terms are of trainings in one process; leave them out, or train without workers")
    env = polypod.make(
        run_config.task,
        run_config.num_envs,
        robots=plan.robots,
        seed=plan.seed,
        threads=threads,
        overrides=[*run_config.task_changes, *plan.overrides],
        share=workers.share(run_config.num_envs, run_config.learner),
        slots=plan.slots,
        terms=terms,
    )
    workers.check_same({"the configuration of task and robots": env.sim.config_hash()}, "use the same files")
    workers.check_same({"the instruction set": env.sim.simd}, "set POLYPOD_SIMD to one that all have")
    reporter = reporter or Reporter(quiet=not workers.is_first)

    def new_run() -> str:
        run = options.run or run_dir.create(options.log_dir, env.sim.experiment_name, options.run_name)
        run_dir.write_params(run, env.sim, plan.config, plan.robots, plan.overrides, options.command, terms, plan.slots)
        return str(run)

    run = Path(workers.from_first(new_run)) if plan.checkpoint is None else plan.checkpoint.parent
    with run_dir.locked(run) if workers.is_first else contextlib.nullcontext():
        with _kept_if_begun(run, plan.checkpoint is None and workers.is_first):
            env.sim.set_dump_dir(run if run.is_dir() else None)
            vec_env = VecEnv(env, device, log_extras=False, clip_actions=run_config.clip_actions)
            runner = runner_of(vec_env, plan.config, run, device, reporter, workers, wants_card=plan.wants_card)
            runner.watch, runner.goal = watch, goal
            if plan.checkpoint is not None:
                runner.load(str(plan.checkpoint))
            elif options.init is not None:
                runner.start_from(options.init)
            iterations = _iterations_to_do(options, run_config, runner.current_learning_iteration)
        among = f", each of {workers.count} workers" if workers.count > 1 else ""
        learner = _learner(run_config.learner, device, vec_env.card is not None, isinstance(runner, GraphRunner))
        if isinstance(runner, CardRunner) and runner.card is not None:
            learner += f", its update on {runner.card} with the bits of the CPU"
        reporter.message(
            f"{env.sim.task_name}: {run_config.num_envs} envs of {', '.join(env.sim.robots)}; "
            f"simulator {env.sim.threads} threads{among}, {learner}; {run}"
        )
        if (why := _why(env.sim)) is not None:
            reporter.message(f"polypod: {why}")
        runner.logger.open(
            options.logger if workers.is_first else "none",
            runner.current_learning_iteration,
            lambda problem: reporter.message(f"polypod: warning: {problem}"),
            options.log_project,
        )
        if goal is not None:
            goal.begin()
        try:
            runner.learn(iterations, init_at_random_ep_len=plan.checkpoint is None)
        finally:
            runner.logger.close()
    return run, runner


def next_options(options: Options, run: Path, target: int) -> Options | None:
    """Options to begin a run, or to go on from its last checkpoint; None: it is done."""
    if not any(run.glob("model_*.pt")):
        return dataclasses.replace(options, run=run, max_iterations=target)
    checkpoint = run_dir.latest_checkpoint(run)
    left = target - run_dir.iterations_of(checkpoint)
    if left <= 0:
        return None
    return Options(
        resume=str(checkpoint),
        max_iterations=left,
        learner=options.learner,
        logger=options.logger,
        log_project=options.log_project,
        terms=options.terms,
        log_dir=options.log_dir,
        device=options.device,
        threads=options.threads,
    )


def _check_same_plan(plan: Plan, options: Options, workers: Workers) -> None:
    """Refuses workers that would train something else.

    Raises ConfigError, which names the difference.
    """
    versions = {
        "polypod": polypod.__version__,
        "torch": str(torch.__version__),
        "rsl_rl": version("rsl-rl-lib"),
        "numpy": np.__version__,
    }
    workers.check_same({f"{name}'s version": number for name, number in versions.items()}, "install the same")
    workers.check_same(flat(plan.config.as_dict()), "use the same train config")
    begun = {
        "--robots": plan.robots,
        "--seed": plan.seed,
        "--set": plan.overrides,
        "--max-iterations": options.max_iterations,
        "--resume": options.resume is not None,
        "--init": options.init is not None,
        "--device": torch.device(plan.device).type,
    }
    workers.check_same(begun, "use the same command line")


@contextlib.contextmanager
def _kept_if_begun(run: Path, is_new: bool) -> Iterator[None]:
    """Removes the directory of a new run that cannot even begin."""
    try:
        yield
    except (Exception, SystemExit):
        if is_new:
            shutil.rmtree(run, ignore_errors=True)
        raise


def new_plan(options: Options) -> Plan:
    """Plan of a new run.

    Raises ConfigError for options that contradict each other or name nothing.
    """
    of_task, of_training = config.split_overrides(options.overrides)
    train_config = config.load(options.train_config or config.DEFAULT, of_training)
    if options.run_name is not None and (
        Path(options.run_name).name != options.run_name or len(options.run_name) > 100
    ):
        raise _core.ConfigError(
            f"--run-name {options.run_name[:100]!r} is part of a directory's name; "
            "leave out slashes, and use 100 letters at most"
        )
    return settle(options, train_config, of_task, options.robots)


def settle(
    options: Options,
    train_config: TrainConfig,
    overrides: list[str],
    robots: list[str] | None,
    slots: Sequence[str] = (),
) -> Plan:
    """Plan of a new run with a train config at hand.

    Args:
        options: flags, of which task, robots, train config and overrides are not read where the
            others say them.
        train_config: what to train, with the device, learner and precision still open.
        overrides: `key=value` pairs of the task.
        robots: names, or paths of configs; None: those of the task.
        slots: names of actions that the policy has on top of those of its robots.

    Raises:
        ConfigError: as `new_plan`.
    """
    device = _device(options, train_config)
    train_config = config.with_run(
        train_config,
        task=run_dir.source(options.task or train_config.run.task),
        num_envs=options.num_envs,
        max_iterations=options.max_iterations,
    ).with_teacher_located()
    if options.terms is not None:
        terms: Terms | None = load(options.terms)
    else:
        terms, overrides = tracking.terms_of_task(train_config.run.task, robots, overrides)
    if terms is not None:
        overrides = tracking.widths(terms, terms.in_overrides(overrides))
    kind = torch.device(device).type
    train_config = train_config.with_learner_resolved(options.learner, kind)
    train_config = train_config.with_mixed_precision_resolved(kind)
    if train_config.run.max_iterations < 1:
        raise _core.ConfigError("--max-iterations must be at least 1")
    seed = DEFAULT_SEED if options.seed is None else options.seed
    wants_card = _wants_card(options, train_config)
    return Plan(train_config, robots, seed, overrides, None, device, terms, tuple(slots), wants_card)


def _resumed_plan(options: Options, workers: Workers) -> Plan:
    """Plan of a resumed run; it continues unchanged, so its options cannot be given again.

    Another engine with the same bits changes nothing.
    """
    engine = [change for change in options.overrides if change in SAME_BITS]
    fixed: dict[str, Any] = {
        "--task": options.task,
        "--num-envs": options.num_envs,
        "--robots": options.robots,
        "--seed": options.seed,
        "--train-config": options.train_config,
        "--run-name": options.run_name,
        "--init": options.init,
        "--set": [change for change in options.overrides if change not in SAME_BITS] or None,
    }
    given = [flag for flag, value in fixed.items() if value is not None]
    if given:
        raise _core.ConfigError(
            f"a resumed run goes on as it was begun: leave out {', '.join(given)}, or train anew without --resume"
        )

    def find() -> tuple[str, dict[str, Any]]:
        checkpoint = run_dir.find_checkpoint(options.log_dir, str(options.resume))
        return str(checkpoint), run_dir.read_manifest(checkpoint, as_begun=True)

    path, manifest = workers.from_first(find)
    checkpoint = Path(path)
    train_config = config.parse(manifest["train_config"], f"{checkpoint.parent / run_dir.MANIFEST}: train_config")
    device = _device(options, train_config)
    terms = _terms_again(options, manifest)
    train_config = train_config.with_learner_resolved(options.learner, torch.device(device).type)
    robots, seed, overrides = manifest["robot_sources"], manifest["seed"], manifest["overrides"]
    if engine:
        overrides = [change for change in overrides if not change.startswith(ENGINE)] + engine[-1:]
    slots = tuple(manifest.get("slots", ()))
    wants_card = _wants_card(options, train_config)
    return Plan(train_config, robots, seed, overrides, checkpoint, device, terms, slots, wants_card)


def _terms_again(options: Options, manifest: dict[str, Any]) -> Terms | None:
    """The terms of a run that goes on.

    A manifest names no code, so the file is named on the command line once more.
    """
    began = manifest.get("terms")
    if (own := manifest.get("motions")) is not None and options.terms is None:
        return tracking.of_manifest(own, str(options.resume))
    if began is None and options.terms is not None:
        raise _core.ConfigError("--terms: this run was begun without; leave them out, or train anew without --resume")
    if began is None or options.terms is None:
        if began is None:
            return None
        raise _core.ConfigError(f"this run was begun with --terms {began['file']}; name the file again")
    terms = load(options.terms)
    if terms.sha256 != began["sha256"]:
        raise _core.ConfigError(
            f"--terms {options.terms} is not the file that this run was begun with; take that one, or train anew with "
            "--init"
        )
    return terms


def _iterations_to_do(options: Options, run_config: RunConfig, done: int) -> int:
    if options.resume is None:
        return run_config.max_iterations
    count = run_config.max_iterations - done if options.max_iterations is None else options.max_iterations
    if count < 1:
        raise _core.ConfigError(
            f"this run has finished its {run_config.max_iterations} iterations; set --max-iterations to how many more"
        )
    return count


def _device(options: Options, train_config: TrainConfig) -> str:
    if train_config.run.arithmetic == "native":
        return "cpu"  # a card computes without torch
    name, learner = options.device, options.learner or train_config.run.learner
    if name == "auto":
        share_gpus = is_among_workers() and torch.cuda.device_count() < int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        name = "cuda" if torch.cuda.is_available() and not (learner == "native" and share_gpus) else "cpu"
    if name == "cpu":
        return "cpu"
    if not torch.cuda.is_available():
        raise _core.ConfigError("--device cuda, but torch finds no CUDA device; use --device cpu or auto")
    return f"cuda:{torch.cuda.current_device() if is_among_workers() else 0}"


def _wants_card(options: Options, train_config: TrainConfig) -> bool:
    if train_config.run.arithmetic != "native" or options.device == "cpu":
        return False
    return options.device != "auto" or torch.cuda.is_available()


def runner_of(
    env: VecEnv,
    train_config: TrainConfig,
    run: Path,
    device: str,
    reporter: Reporter,
    workers: Workers | None = None,
    *,
    wants_card: bool = False,
) -> Runner:
    """Returns the runner of the config's learner, with new networks.

    The learner must be resolved. `wants_card`: see `Plan`.
    """
    if train_config.run.learner == "native" and torch.device(device).type == "cpu":
        kind = CardRunner if wants_card else NativeRunner
        return kind(env, train_config, run, device, reporter, workers)
    # a policy that acts where the simulator's steps are: nothing of a step leaves the card. It acts
    # there as well where an engine has chosen the CPU by time, which must not decide the policy.
    is_timed = _engine(env.unwrapped.sim) == "auto" and env.could_have_card
    acts_on_card = train_config.can_be_graphs and (env.card is not None or is_timed)
    if train_config.run.learner == "native" and not acts_on_card:
        return GpuRunner(env, train_config, run, device, reporter, workers)
    if train_config.can_be_graphs and (torch.device(device).type == "cuda" or train_config.run.symmetry == ALTERNATE):
        return GraphRunner(env, train_config, run, device, reporter, workers)
    quick_start.import_compiler()
    if train_config.distils_without_memory:
        return TaughtRunner(env, train_config, run, device, reporter, workers)
    runner = Runner(env, train_config, run, device, reporter, workers)
    if train_config.distillation is not None and train_config.distillation.teacher is not None:
        runner.learn_from(Path(train_config.distillation.teacher))
    return runner


def _engine(sim: _core.VecSim) -> str | None:
    """The engine that the task names."""
    engine: str | None = simulated.config(sim)["task"].get("physics", {}).get("engine")
    return engine


def _why(sim: _core.VecSim) -> str | None:
    """Why the CPU or a card makes the control steps, where the task's engine leaves that open."""
    engine = _engine(sim)
    if engine == "auto" and (choice := sim.choice_of_engine) is not None:
        return f"{ENGINE}auto: {choice}"
    lacks = sim.lacks_on_device() if engine == "cuda" else None
    return f"{ENGINE}cuda: the CPU makes all but the physics: no form on the card has {lacks}" if lacks else None


def _learner(learner: str, device: str, has_steps_on_card: bool, acts_on_card: bool) -> str:
    if has_steps_on_card or (acts_on_card and learner == "native"):
        steps = "its steps, " if has_steps_on_card else ""
        return f"{steps}the policy and the {learner} learner's update on {torch.cuda.get_device_name(device)}"
    if learner == "native":
        of_update = "" if device == "cpu" else f", its update on {torch.cuda.get_device_name(device)}"
        return f"native learner on the same{of_update}"
    where = f"{torch.get_num_threads()} CPU threads" if device == "cpu" else torch.cuda.get_device_name(device)
    return f"rsl_rl on {where}"
