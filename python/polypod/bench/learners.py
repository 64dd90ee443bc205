"""Time of the parts of a training iteration, for every learner: `polypod bench --learner`."""

import contextlib
import dataclasses
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from statistics import median
from typing import Any

import torch

import polypod
from polypod import _core, provenance
from polypod.bench.report import Progress
from polypod.rsl_rl import VecEnv
from polypod.runs import config, run_dir
from polypod.training.native import CardRunner
from polypod.training.report import Reporter
from polypod.training.runner import Runner
from polypod.training.session import DEFAULT_SEED, runner_of
from polypod.training.workers import Workers

CUDA = "cuda:0"
ON_CARD = "native, CUDA, native arithmetic"
"""Row of the update that has the bits of the CPU."""
ITERATIONS = 3
"""Timed after one that is not."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the trainings."""

    train_config: str = "quick"
    num_envs: int | None = None
    """None: the train config's."""
    threads: int | None = None
    """None: one per core."""
    seed: int = DEFAULT_SEED
    robots: list[str] | None = None
    """None: those of the task."""

    def conditions(self) -> dict[str, Any]:
        """Conditions under which figures of these trainings were measured."""
        info = _core.info()
        return {
            "measured": provenance.measured(),
            "simd": info["simd"],
            "train_config": self.train_config,
            "threads": self.threads or info["threads"],
        }


class Silent(Reporter):
    """Shows nothing."""

    def message(self, text: str) -> None:
        """Shows nothing."""

    def iteration(self, figures: Any) -> None:
        """Shows nothing."""

    def robots(self, stats: Any) -> None:
        """Shows nothing."""


@contextlib.contextmanager
def training(
    options: Options,
    learner: str,
    device: str,
    precision: str = "off",
    workers: Workers | None = None,
    arithmetic: str = "torch",
) -> Iterator[Runner]:
    """A new training in a folder that goes when the context ends.

    Raises ConfigError like `polypod train`.

    Args:
        options: what to train.
        learner: what learns.
        device: where it does.
        precision: `mixed_precision`.
        workers: those that have the other envs; None: there are none.
        arithmetic: of the native learner's update; with "native" a card computes it.
    """
    train_config = config.load(options.train_config)
    algorithm = dataclasses.replace(train_config.algorithm, mixed_precision=precision)
    train_config = dataclasses.replace(train_config, algorithm=algorithm)
    train_config = config.with_run(train_config, num_envs=options.num_envs, arithmetic=arithmetic)
    kind = torch.device(device).type
    train_config = train_config.with_learner_resolved(learner, kind).with_mixed_precision_resolved(kind)
    run = train_config.run
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    share = None if workers is None else workers.share(run.num_envs, run.learner)
    env = polypod.make(
        run.task,
        run.num_envs,
        robots=options.robots,
        seed=options.seed,
        threads=options.threads,
        overrides=run.task_changes,
        share=share,
    )
    with tempfile.TemporaryDirectory() as folder, contextlib.closing(env):
        path = Path(folder)
        run_dir.write_params(path, env.sim, train_config, options.robots, [], "polypod bench")
        vec_env, wants_card = VecEnv(env, device, log_extras=False), arithmetic == "native"
        runner = runner_of(vec_env, train_config, path, device, Silent(), workers, wants_card=wants_card)
        runner.logger.open("none", 0, print)
        yield runner


def measure(options: Options, progress: Progress) -> dict[str, Any]:
    """Seconds per iteration of every learner that this machine has, one after the other."""
    learners = [("native", "cpu", "off"), ("rsl_rl", "cpu", "off"), ("rsl_rl, bfloat16", "cpu", "auto")]
    if torch.cuda.is_available():
        # torch's tensors stay on the CPU
        learners.append((ON_CARD, "cpu", "off"))
        learners += [
            ("native, CUDA", CUDA, "off"),
            ("native, CUDA, bfloat16", CUDA, "on"),
            ("rsl_rl, CUDA", CUDA, "off"),
        ]
    rows: dict[str, dict[str, float]] = {}
    for name, device, precision in learners:
        progress(f"{name} on {device}")
        arithmetic = "native" if name == ON_CARD else "torch"
        with training(options, name.split(",")[0], device, precision, arithmetic=arithmetic) as runner:
            if isinstance(runner, CardRunner) and runner.card is None:
                continue
            if precision == "auto" and runner.cfg["algorithm"]["use_mixed_precision"] is False:
                continue
            rows[name] = _times(runner)
            run = runner.cfg["num_steps_per_env"] * runner.env.num_envs
    return {**options.conditions(), "samples": run, "learners": rows}


def heading(result: Mapping[str, Any], what: str) -> list[str]:
    """Lines before a table that say where its figures were measured."""
    conditions = f"Train config {result['train_config']}, {what}, {result['threads']} threads, {result['simd']}."
    return [provenance.sentence(result["measured"]), conditions, ""]


def _times(runner: Runner) -> dict[str, float]:
    """Medians of the parts of an iteration, s."""
    parts: list[tuple[float, float]] = []
    runner.alg.train_mode()
    observations = runner.env.get_observations()
    for _ in range(ITERATIONS + 1):
        begin = time.perf_counter()
        observations = runner._collect(observations)
        collected = time.perf_counter()
        runner._update(observations)
        if runner.device != "cpu":
            torch.cuda.synchronize()
        parts.append((collected - begin, time.perf_counter() - collected))
        runner.current_learning_iteration += 1
    collection, update = (median(part[k] for part in parts[1:]) for k in (0, 1))
    return {"collection_s": collection, "update_s": update, "iteration_s": collection + update}


def table(result: Mapping[str, Any]) -> str:
    """The figures as Markdown."""
    head = [
        *heading(result, f"{result['samples']} samples an iteration, medians of {ITERATIONS} iterations"),
        "| learner | collection, s | update, s | iteration, s | env-steps/s |",
        "|---|---|---|---|---|",
    ]
    for name, row in result["learners"].items():
        rate = result["samples"] / row["iteration_s"]
        times = (f"{row[key]:.3f}" for key in ("collection_s", "update_s", "iteration_s"))
        head.append(f"| {name} | {' | '.join(times)} | {rate:,.0f} |")
    return "\n".join(head)
