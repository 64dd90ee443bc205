"""Measurements of the speed, and their report."""

import dataclasses
import os
from collections.abc import Callable, Mapping
from statistics import median
from typing import Any

from polypod import _core, provenance
from polypod.bench import physics, sampling
from polypod.bench.steps import control_steps
from polypod.mujoco_model import reference

Progress = Callable[[str], None]
"""Is told what comes next."""
SECONDS = 1.0
"""Length of a timing that is not quick, s."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the measurements."""

    robot: str = "unitree_a1"
    """Robot of the physics figures."""
    num_envs: int = 4096
    threads: int = 1
    """Threads of the physics figures; whole control steps use `step_threads`."""
    step_threads: int | None = None
    """None: all cores."""
    seed: int = 0
    quick: bool = False
    """Whether the main figures alone are measured, in less than a minute."""
    largest: int = 65536
    """Envs that the scaling goes up to."""


def measure(options: Options, progress: Progress) -> dict[str, Any]:
    """Runs all benchmarks.

    Raises ConfigError without MuJoCo, UnknownNameError for an unknown robot.
    """
    seconds, rounds = (0.4, 3) if options.quick else (SECONDS, 5)
    step_threads = step_threads_of(options)
    info = _core.info()
    result: dict[str, Any] = {
        "polypod": info["version"],
        "mujoco": reference.version(),
        "simd": info["simd"],
        "threads": options.threads,
        "step_threads": step_threads,
        "cpu": provenance.cpu(),
        "measured": provenance.measured(),
        "cores": os.cpu_count(),
        "num_envs": options.num_envs,
        "robot": options.robot,
        "seed": options.seed,
    }
    progress(f"physics of {options.robot}, {options.threads} threads, beside MuJoCo {result['mujoco']}")
    result["physics"] = _physics(options, seconds, rounds)
    progress(f"whole control steps, {step_threads} threads")
    steps: dict[str, sampling.Sample] = {}
    for suffix, overrides in _engines().items():
        for name, task in (("env_step", "velocity_flat"), ("rough", "velocity_rough")):
            sample = control_steps(task, options.num_envs, step_threads, options.seed, overrides=overrides)
            steps[name + suffix] = sample
    for name, rate in sampling.medians(sampling.rates(steps, seconds, rounds)).items():
        result[name] = {"env_steps_per_s": rate}
    if not options.quick:
        _scaling(options, result, progress)
    return result


def _has_card() -> bool:
    """Whether the engine of cards can be used."""
    return not _core.cuda().startswith("not used: ")


def _engines() -> dict[str, list[str]]:
    """Suffix of the figures and overrides of each engine: the card's too, where it can be used."""
    return {"": []} | ({"_cuda": ["physics.engine=cuda"]} if _has_card() else {})


def _physics(options: Options, seconds: float, rounds: int) -> dict[str, float | None]:
    name, threads, seed = options.robot, options.threads, options.seed
    # MuJoCo's rate does not depend on the number of envs; its samples shall be short
    few = min(options.num_envs, 256 * threads)
    samples = {
        "env_steps_per_s": physics.polypod(name, options.num_envs, threads, seed),
        "mujoco_steps_per_s": physics.rollout(name, few, threads, seed),
    }
    batch = physics.batch(name, few, threads, seed)
    if batch is not None:
        samples["mujoco_batch_steps_per_s"] = batch
    # a card steps all envs at once
    on_card = physics.warp(name, options.num_envs, seed)
    if on_card is not None:
        samples["mujoco_warp_steps_per_s"] = on_card
    if _has_card():
        samples["cuda_steps_per_s"] = physics.polypod(name, options.num_envs, threads, seed, engine="cuda")
    if not options.quick:
        samples["mujoco_one_iteration_steps_per_s"] = physics.rollout(name, few, threads, seed, iterations=1)
    measured = sampling.rates(samples, seconds, rounds)
    figures: dict[str, float | None] = {"mujoco_batch_steps_per_s": None, "batch_ratio": None}
    figures |= sampling.medians(measured)
    # ratios of samples of one round: a slower machine slows all of them
    for ratio, mine, other in (
        ("ratio", "env_steps_per_s", "mujoco_steps_per_s"),
        ("batch_ratio", "env_steps_per_s", "mujoco_batch_steps_per_s"),
        ("warp_ratio", "cuda_steps_per_s", "mujoco_warp_steps_per_s"),
    ):
        if mine in measured and other in measured:
            pairs = zip(measured[mine], measured[other], strict=True)
            figures[ratio] = median(ours / theirs for ours, theirs in pairs)
    return figures


def step_rate(options: Options, **arguments: Any) -> float:
    """Median rate of whole control steps, env-steps/s; `arguments` as of `control_steps`."""
    given = {"task": "velocity_flat", "num_envs": options.num_envs, "threads": step_threads_of(options), **arguments}
    sample = control_steps(**given, seed=options.seed)
    return sampling.medians(sampling.rates({"rate": sample}, SECONDS, 3))["rate"]


def step_threads_of(options: Options) -> int:
    """Threads of the whole control steps."""
    return options.step_threads or os.cpu_count() or 1


def _scaling(options: Options, result: dict[str, Any], progress: Progress) -> None:
    """Rates of whole control steps over envs and threads."""
    sizes, size = [], 1
    while size <= options.largest:
        sizes.append(size)
        size *= 4
    result["scaling_num_envs"] = {}
    for size in sizes:
        progress(f"{size} envs of {options.robot}")
        result["scaling_num_envs"][size] = step_rate(
            options, task=task_of(options.robot), num_envs=size, robots=[options.robot]
        )
    threads, result["scaling_threads"] = 1, {}
    while threads <= (os.cpu_count() or 1):
        progress(f"{threads} threads")
        result["scaling_threads"][threads] = step_rate(options, threads=threads)
        threads *= 2


def task_of(name: str) -> str:
    """The flat task if it has the robot, else the one with a reward set for every robot."""
    return "velocity_flat" if name in _core.task_robots("velocity_flat") else "velocity_flat_legged"


def table(result: Mapping[str, Any]) -> str:
    """The figures as Markdown."""
    p = result["physics"]
    rows = [
        (f"physics, {result['robot']}, {result['threads']} threads", p["env_steps_per_s"], "env-physics-steps/s"),
        (f"mujoco.rollout, MuJoCo {result['mujoco']}, feet only", p["mujoco_steps_per_s"], "env-physics-steps/s"),
    ]
    if p["mujoco_batch_steps_per_s"] is not None:
        name = f"mujoco.batch, MuJoCo {result['mujoco']}, feet only"
        rows.append((name, p["mujoco_batch_steps_per_s"], "env-physics-steps/s"))
    for key, words in (
        ("mujoco_one_iteration_steps_per_s", "mujoco.rollout, one solver iteration"),
        ("cuda_steps_per_s", f"physics on the card, {result['robot']}"),
        ("mujoco_warp_steps_per_s", "MuJoCo Warp on the card, feet only"),
    ):
        if key in p:
            rows.append((words, p[key], "env-physics-steps/s"))
    rows.append(
        (f"flat control step, {result['step_threads']} threads", result["env_step"]["env_steps_per_s"], "env-steps/s")
    )
    rows.append(
        (f"rough control step, {result['step_threads']} threads", result["rough"]["env_steps_per_s"], "env-steps/s")
    )
    for key, words in (
        ("env_step_cuda", "flat control step on the card"),
        ("rough_cuda", "rough control step on the card"),
    ):
        if key in result:
            rows.append((words, result[key]["env_steps_per_s"], "env-steps/s"))
    for key, words in (
        ("scaling_num_envs", "{} envs of one robot"),
        ("scaling_threads", "{} threads"),
    ):
        rows += [(words.format(value), rate, "env-steps/s") for value, rate in result.get(key, {}).items()]
    head = [
        provenance.sentence(result["measured"]),
        f"{result['num_envs']} envs, seed {result['seed']}. {_ratios(result)}",
        "",
        "| what | rate | unit |",
        "|---|---|---|",
    ]
    return "\n".join(head + [row(*each) for each in rows])


def row(what: str, rate: float, unit: str = "env-steps/s") -> str:
    """A line of the table."""
    return f"| {what} | {rate:,.0f} | {unit} |"


def _ratios(result: Mapping[str, Any]) -> str:
    """A sentence that compares the physics with MuJoCo's."""
    p = result["physics"]
    others = {"ratio": "mujoco.rollout", "batch_ratio": "mujoco.batch", "warp_ratio": "MuJoCo Warp, both on the card"}
    ratios = [f"{p[key]:.1f} times {other}" for key, other in others.items() if p.get(key) is not None]
    lacks = ""
    if p["batch_ratio"] is None:
        lacks = f"; MuJoCo {result['mujoco']} has no mujoco.batch; 3.17 and newer have it"
    return f"Physics: {', '.join(ratios)} (medians of the rounds{lacks})."
