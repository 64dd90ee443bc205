"""Cost of a batch of many kinds of bodies, compared with the same kinds one by one."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import polypod
from polypod import _core, provenance, simulated
from polypod.bench import sampling
from polypod.bench.report import Progress
from polypod.bench.steps import control_steps

TASK = "velocity_flat_legged"
KINDS = (
    "anymal_d",
    "anymal_b_kinova",
    "unitree_go2",
    "unitree_b1",
    "spot",
    "solo12",
    "box_quadruped",
    "unitree_h1",
    "unitree_g1",
    "cassie",
    "berkeley_humanoid",
    "booster_t1",
    "limx_tron1",
    "bolt",
    "phantomx",
    "unitree_a2",
)
"""Sixteen of two, four and six legs, with 6 to 29 joints."""
SECONDS, ROUNDS = 0.4, 5
"""Length of one timing, and number of timings of each batch."""


def measure(robots: Sequence[str], num_envs: int, threads: int | None, seed: int, progress: Progress) -> dict[str, Any]:
    """Rates of whole control steps in env-steps/s, all batches in turn in one process.

    Args:
        robots: names of at least two kinds.
        num_envs: of every batch, shared out evenly where it is mixed.
        threads: None: all cores.
        seed: of the simulation and the actions.
        progress: is told what comes next.

    Raises:
        ConfigError: for fewer than two kinds, or fewer envs than kinds.
        UnknownNameError: for an unknown robot.
    """
    if len(set(robots)) < 2 or num_envs < len(robots):
        raise _core.ConfigError("--robots takes two different robots or more, and --num-envs one env for each at least")
    threads = threads or os.cpu_count() or 1
    progress(f"control steps of {len(robots)} kinds together and one by one, {threads} threads")
    samples = {"mixed": control_steps(TASK, num_envs, threads, seed, robots=robots)}
    samples |= {robot: control_steps(TASK, num_envs, threads, seed, robots=[robot]) for robot in robots}
    rates = sampling.medians(sampling.rates(samples, SECONDS, ROUNDS))
    mixed = rates.pop("mixed")
    mean = len(rates) / sum(1.0 / rate for rate in rates.values())
    return {
        "measured": provenance.measured(),
        "task": TASK,
        "num_envs": num_envs,
        "threads": threads,
        "seed": seed,
        "joints": _joints(robots),
        "by_kind": rates,
        "one_by_one": mean,
        "mixed": mixed,
        "share": mixed / mean,
    }


def _joints(robots: Sequence[str]) -> dict[str, int]:
    env = polypod.make(TASK, num_envs=len(robots), robots=list(robots), seed=0, threads=1)
    try:
        return {robot: len(info["slots"]) for robot, info in simulated.robots(env.sim).items()}
    finally:
        env.close()


def table(result: Mapping[str, Any]) -> str:
    """The figures as Markdown.

    The mean is that of the costs: what a batch costs that has as many envs of each kind.
    """
    lines = [
        provenance.sentence(result["measured"]),
        f"{result['task']}, {result['num_envs']} envs, {result['threads']} threads, whole control steps, medians.",
        "",
        "| kind | joints | env-steps/s |",
        "|---|---|---|",
    ]
    lines += [f"| {kind} | {result['joints'][kind]} | {rate:,.0f} |" for kind, rate in result["by_kind"].items()]
    lines += [
        f"| mean of the kinds, one by one | | {result['one_by_one']:,.0f} |",
        f"| all kinds in one batch | | {result['mixed']:,.0f} ({result['share']:.0%}) |",
    ]
    return "\n".join(lines)
