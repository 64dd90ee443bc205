"""Sweeps: trainings of several configs and robots with several seeds.

One after the other, or on a Ray cluster.

<folder>/<group>/seed_<n>/ is a run with its evaluation, `eval.json`. A sweep that was interrupted
goes on when it is begun again.
"""

import dataclasses
import itertools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from polypod import _core
from polypod.compat import tomllib
from polypod.evaluation import Evaluation, evaluate_checkpoint, summarize
from polypod.files import read_bytes, real_path, write_text
from polypod.runs import run_dir
from polypod.runs.schema import TrainConfig
from polypod.training import session
from polypod.training.report import Reporter
from polypod.training.workers import Workers, is_among_workers

EVALUATION = "eval.json"
MAX_BYTES = 1 << 20
"""Largest size of a sweep's file, bytes."""
MAX_EVALUATION = 64 << 20
"""Largest size of an evaluation, bytes."""
MOST_TRIALS = 10_000
METRIC = "error_vel_xy"
"""Velocity error, m/s, of the exploring policy: the mean over the robots, which early stopping
compares."""

Label = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$")]
"""Name of a config or of robots: part of a folder's name."""
Iterations = Annotated[int, Meta(ge=1, lt=2**31)]


class TrialOptions(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """Flags of `polypod train`, with underscores in place of hyphens."""

    task: str | None = None
    """Name or path of the task."""
    num_envs: Annotated[int, Meta(ge=1, lt=2**31)] | None = None
    """Number of envs, shared out among the robots."""
    robots: list[str] | None = None
    """Names or paths of the robots."""
    max_iterations: Iterations | None = None
    """Learning iterations."""
    train_config: str | None = None
    """Name or path of the train config."""
    learner: str | None = None
    """`auto`, `native` or `rsl_rl`."""
    device: str | None = None
    """`auto`, `cpu` or `cuda`."""
    threads: Annotated[int, Meta(ge=1, le=1024)] | None = None
    """Threads of the simulator, and of the learner on the CPU."""
    set: list[str] | None = None
    """Changes of the task, and with `train.` before the key of the train config."""


class EarlyStopping(msgspec.Struct, forbid_unknown_fields=True):
    """Ray's asynchronous successive halving: of the trials of a rung, the better ones go on."""

    grace_iterations: Iterations
    """Iterations that each trial has."""
    reduction_factor: Annotated[float, Meta(gt=1.0, le=100.0)] = 3.0
    """Factor by which each round reduces the number of trials."""


class SweepFile(msgspec.Struct, forbid_unknown_fields=True):
    """Trainings to compare: `polypod sweep FILE.toml`."""

    seeds: Annotated[list[Annotated[int, Meta(ge=0, lt=2**62)]], Meta(min_length=1)]
    """Seeds of each group's trials."""
    train: TrialOptions = msgspec.field(default_factory=TrialOptions)
    """Options that all trials share."""
    configs: dict[Label, TrialOptions] = {}
    """A group for each, with its own flags on top of those."""
    robots: dict[Label, Annotated[list[str], Meta(min_length=1)]] = {}
    """A group for each, and for each config."""
    early_stopping: EarlyStopping | None = None
    """Ends trials that are behind; without it all run to their end."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """One training of a sweep."""

    group: str
    options: session.Options
    config: TrainConfig

    @property
    def run(self) -> Path:
        """Directory of the trial's run."""
        assert self.options.run is not None
        return self.options.run

    @property
    def iterations(self) -> int:
        """Returns the number of iterations when it is done."""
        return self.config.run.max_iterations


@dataclasses.dataclass(frozen=True)
class Sweep:
    """The trials, in the order of groups and seeds."""

    trials: list[Trial]
    folder: Path
    early_stopping: EarlyStopping | None


def read(file: Path, folder: Path) -> Sweep:
    """Reads a sweep; its runs lie in `folder`. Paths in it are relative to its own folder.

    Raises:
        ConfigError: for a file that cannot be read, unknown keys, options that name nothing or
            contradict each other.
    """
    try:
        tables = tomllib.loads(read_bytes(file, MAX_BYTES).decode())
    except OSError as error:
        raise _core.ConfigError(f"cannot read sweep {file}: {error.strerror}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise _core.ConfigError(f"sweep {file} is not valid TOML: {error}") from error
    try:
        content = msgspec.convert(tables, SweepFile)
    except msgspec.ValidationError as error:
        text, _, place = str(error).partition(" - at `$")
        place = place.rstrip("`").lstrip(".") or "top level"
        raise _core.ConfigError(f"sweep {file}: {place}: {text}; see docs/cluster.md for its keys") from error
    groups = list(itertools.product(list(content.configs) or [""], list(content.robots) or [""]))
    if len(set(content.seeds)) < len(content.seeds):
        raise _core.ConfigError(f"sweep {file}: seeds: one is listed twice; name each once")
    if len(groups) * len(content.seeds) > MOST_TRIALS:
        raise _core.ConfigError(f"sweep {file}: more than {MOST_TRIALS} trials; name fewer seeds, configs or robots")
    trials = []
    for config, robots in groups:
        own = msgspec.to_builtins(content.train) | msgspec.to_builtins(content.configs.get(config, TrialOptions()))
        if robots:
            own["robots"] = content.robots[robots]
        group = "_".join(filter(None, (config, robots))) or file.stem
        for seed in content.seeds:
            trials.append(_trial(own, group, seed, file.parent, folder))
    return Sweep(trials, folder, content.early_stopping)


def _trial(own: Mapping[str, Any], group: str, seed: int, base: Path, folder: Path) -> Trial:
    def placed(name: str) -> str:
        return str(real_path(base / name)) if name.endswith(".toml") else name

    options = {key: value for key, value in own.items() if key != "set"}
    for key in ("task", "train_config"):
        if key in options:
            options[key] = placed(options[key])
    if "robots" in options:
        options["robots"] = [placed(robot) for robot in options["robots"]]
    run = real_path(folder / group / f"seed_{seed}")
    found = session.Options(
        **options, seed=seed, overrides=list(own.get("set", ())), run=run, log_dir=real_path(folder)
    )
    try:
        plan = session.new_plan(found)
    except _core.PolypodError as error:
        raise _core.ConfigError(f"group {group}: {error}") from error
    trial = Trial(group, found, plan.config)
    if (run / run_dir.MANIFEST).is_file():
        begun = run_dir.read_manifest(run / "model_0.pt", as_begun=True)
        ours = (plan.config.as_dict(), plan.seed, plan.overrides)
        if (begun["train_config"], begun["seed"], begun["overrides"]) != ours:
            raise _core.ConfigError(f"{run} was begun with other options; choose another --out, or remove it")
    return trial


def run(sweep: Sweep, reporter: Reporter) -> int:
    """Trains one after the other; returns the exit code.

    Raises:
        ConfigError: for early stopping, which compares trials that run side by side.
    """
    if is_among_workers():
        raise _core.ConfigError("polypod sweep starts its trainings itself; run it without torchrun")
    if sweep.early_stopping is not None:
        raise _core.ConfigError(
            "[early_stopping] compares trials that run side by side: add --ray, or remove the table"
        )
    for number, trial in enumerate(sweep.trials, 1):
        reporter.message(f"trial {number}/{len(sweep.trials)}: {trial.group}, seed {trial.options.seed}")
        signal = train(trial)
        if signal is not None:
            return 128 + signal
    return 0


def train(trial: Trial, watch: Any = None) -> int | None:
    """Trains the rest of a trial, and evaluates it.

    Returns the signal that stopped it, if one did.
    """
    trial.run.mkdir(parents=True, exist_ok=True)
    options = session.next_options(trial.options, trial.run, trial.iterations)
    if options is not None:
        _, runner = session.train_with(options, Workers.alone(), watch)
        runner.env.unwrapped.close()
        if runner.stopped_by is not None:
            return int(runner.stopped_by)
    evaluate(trial)
    return None


def evaluate(trial: Trial) -> bool:
    """Evaluates the last checkpoint of a trial, unless that is done; False where there is none."""
    if not any(trial.run.glob("model_*.pt")):
        return False
    checkpoint, file = run_dir.latest_checkpoint(trial.run), trial.run / EVALUATION
    if file.is_file():
        origin = _evaluation_of(file).checkpoint or {}
        if origin.get("iteration") == run_dir.iterations_of(checkpoint):
            return True
    evaluation = evaluate_checkpoint(checkpoint, threads=trial.options.threads)
    write_text(file, json.dumps(evaluation.as_dict(), indent=2) + "\n")
    return True


def run_on_ray(sweep: Sweep, address: str, reporter: Reporter) -> int:
    """Trains side by side on a Ray cluster; returns the exit code.

    Raises:
        ConfigError: where Ray is missing or cannot be reached, and for trials that fail.
    """
    from polypod.training import on_ray

    ray, tune = on_ray.connected(address, "--ray", "ray.tune")
    cores = int(ray.cluster_resources().get("CPU", 1))
    threads = max(1, cores // len(sweep.trials))
    trials = [_with_threads(trial, trial.options.threads or threads) for trial in sweep.trials]
    most = max(trial.options.threads or 1 for trial in trials)
    gpu = 1 if any(trial.options.device == "cuda" for trial in trials) else 0
    reporter.message(f"Ray: {len(trials)} trials on {cores} cores, {most} for each; {sweep.folder}")

    def work(config: dict[str, int]) -> None:
        trial = trials[config["trial"]]

        def watch(iterations: int, scalars: Mapping[str, float]) -> None:
            tune.report({"iterations": iterations, METRIC: error_of(scalars)})

        train(trial, watch)

    scheduler = None
    if sweep.early_stopping is not None:
        scheduler = tune.schedulers.ASHAScheduler(
            time_attr="iterations",
            # a trial that comes so far ends by itself, after its last checkpoint
            max_t=max(trial.iterations for trial in trials) + 1,
            grace_period=sweep.early_stopping.grace_iterations,
            reduction_factor=sweep.early_stopping.reduction_factor,
        )
    tuner = tune.Tuner(
        tune.with_resources(work, {"cpu": most, "gpu": gpu}),
        param_space={"trial": tune.grid_search(list(range(len(trials))))},
        tune_config=tune.TuneConfig(metric=METRIC, mode="min", scheduler=scheduler),
        run_config=tune.RunConfig(
            name=f"{sweep.folder.name}_ray",
            storage_path=str(real_path(sweep.folder).parent),
            failure_config=tune.FailureConfig(max_failures=on_ray.MOST_FAILURES),
            verbose=1,
        ),
    )
    try:
        errors = tuner.fit().errors
    finally:
        ray.shutdown()
    if errors:
        lines = [line.strip() for line in str(errors[0]).splitlines() if line.strip()]
        raise _core.ConfigError(f"{len(errors)} trials fail: {lines[-1]}; the others are in {sweep.folder}")
    for trial in trials:
        if not evaluate(trial):
            reporter.message(f"polypod: warning: {trial.run} was stopped before its first checkpoint; it is left out")
    return 0


def error_of(scalars: Mapping[str, float]) -> float:
    """Mean velocity error over the robots; infinite before the first episode ends."""
    errors = [value for tag, value in scalars.items() if tag.startswith("Metrics/") and tag.endswith(f"/{METRIC}")]
    return sum(errors) / len(errors) if errors else math.inf


def report(sweep: Sweep, reporter: Reporter) -> None:
    """Prints a table per group, like `polypod eval` of its checkpoints.

    Figures are means and intervals over the seeds.
    """
    groups: dict[str, list[Evaluation]] = {}
    for trial in sweep.trials:
        file = trial.run / EVALUATION
        if file.is_file():
            groups.setdefault(trial.group, []).append(_evaluation_of(file))
    for group, evaluations in groups.items():
        reporter.message(group)
        reporter.summary(summarize(evaluations))


def _evaluation_of(file: Path) -> Evaluation:
    """The evaluation in a file. Raises ConfigError for a file that is none."""
    try:
        return Evaluation.from_dict(json.loads(read_bytes(file, MAX_EVALUATION).decode()))
    except (OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise _core.ConfigError(f"{file} is no evaluation of this version of polypod: {error!r}; remove it") from error


def _with_threads(trial: Trial, threads: int) -> Trial:
    return dataclasses.replace(trial, options=dataclasses.replace(trial.options, threads=threads))
