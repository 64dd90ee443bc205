"""How well a policy tracks motions: errors of the key links, clip by clip."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from polypod import _core
from polypod.arrays import Array
from polypod.evaluation.rollout import play_task, undisturbed
from polypod.motions import library
from polypod.motions.body import body_of
from polypod.motions.reference import Reference, errors
from polypod.networks.policies import Policy, reset
from polypod.python_terms import TermSim, Terms
from polypod.runs.own_terms import terms_of_run
from polypod.vector_env import simulator

LINK_BOUND = 0.1
"""Largest distance of a key link from the reference that counts as following, m."""
BASE_BOUND = 10.0
"""Largest angle of the base from the reference that counts as following, degrees."""
SHARE = 0.95
"""Share of an episode's control steps at which both must hold."""
NOISE = 0.2
"""Share of the training's noise with which episodes begin."""
MAX_STEPS = 10_000_000


@dataclasses.dataclass(frozen=True)
class ClipResult:
    """One robot in one clip."""

    episodes: int
    followed: float
    """Share of the episodes that last to the clip's end and hold both bounds."""
    failed: float
    """Share of the episodes that a termination ends."""
    base_m: tuple[float, float]
    """Distance of the base, m: mean and 95th percentile over control steps."""
    base_deg: tuple[float, float]
    """Angle of the base, degrees."""
    links_m: dict[str, tuple[float, float]]
    """Distance of each key link, m, with the reference moved to the base's place and heading."""


def measure(
    policy: Policy,
    task: str,
    robots: Sequence[str],
    terms: Terms,
    *,
    episodes: int = 16,
    seed: int = 0,
    threads: int | None = None,
    overrides: Sequence[str] = (),
    trained: Sequence[str] = (),
    slots: Sequence[str] = (),
) -> dict[str, dict[str, ClipResult]]:
    """Tracks each clip from its start, by robot and clip.

    Args:
        policy: see `Policy`.
        task: name or alias of the task.
        robots: names or paths of configs.
        terms: those of the run.
        episodes: of each robot and clip.
        seed: of the noise with which they begin.
        threads: of the simulator; None: one per core.
        overrides: `key=value` changes, on top of all others.
        trained: `key=value` changes of the training.
        slots: names of the policy's actions.

    Raises:
        ConfigError: for a run that tracks no motions, and for too many control steps.
    """
    if terms.options is None:
        raise _core.ConfigError("the run tracks no motions by the terms of tracking tasks; measure it with polypod eval")
    name = play_task(task)
    changes = [*trained, *undisturbed(name, trained), f"motions.reset.play_noise={NOISE}", *overrides]
    clips = list(terms.options["clips"])
    for change in overrides:
        if change.startswith("motions.clips="):
            raise _core.ConfigError(f"--set {change}: name the clips with --clips")
    longest = max(library.duration(clip) for clip in clips)
    changes.append(f"sim.episode_length_s={max(longest + 1.0, 10.0)}")
    if not 1 <= episodes <= 10_000:
        raise _core.ConfigError(f"episodes = {episodes} must be from 1 to 10000")
    sim = simulator(
        terms,
        name,
        episodes * len(clips) * len(robots),
        play=True,
        robots=list(robots),
        seed=seed,
        threads=threads,
        overrides=changes,
        autoreset="disabled",
        slots=list(slots),
    )
    if not isinstance(sim, TermSim):
        raise _core.ConfigError(f"{sim.task_name} tracks no motions")
    frames = sim.memory("motion_frame")[:, 0]
    clip_of = sim.memory("motion_clip")[:, 0].copy()
    references = {
        robot: Reference.of(body_of(robot), library.clips_of(clips, body_of(robot).source), sim.step_dt)
        for robot in sim.robots
    }
    running = np.ones(sim.num_envs, dtype=np.bool_)
    failed = np.zeros(sim.num_envs, dtype=np.bool_)
    seen: dict[str, list[tuple[Array, Array, Array, Array]]] = {robot: [] for robot in sim.robots}
    reset(policy)
    for _ in range(int(round(longest / sim.step_dt))):
        sim.step(policy(sim.observation))
        for robot, reference in references.items():
            rows = slice(*sim.env_ids(robot))
            links = sim.links(robot)
            parts = [links[key].astype(np.float64) for key in ("pos", "quat", "lin_vel", "ang_vel")]
            found = errors(reference, frames[rows], *parts)
            at = np.flatnonzero(running[rows])
            distance = np.linalg.norm(found.link_pos, axis=-1)
            base = np.linalg.norm(found.anchor_pos, axis=-1)
            seen[robot].append((at, distance[at], base[at], np.degrees(found.anchor_ori[at])))
        failed |= running & sim.terminated
        running &= ~(sim.terminated | sim.truncated)
        if not running.any():
            break
    results: dict[str, dict[str, ClipResult]] = {}
    for robot, reference in references.items():
        rows = slice(*sim.env_ids(robot))
        results[robot] = _results(reference, clip_of[rows], failed[rows], seen[robot])
    return results


def _results(reference: Reference, clip: Array, failed: Array, seen: list[tuple[Array, ...]]) -> dict[str, ClipResult]:
    env = np.concatenate([part[0] for part in seen]).astype(np.int64)
    links, base, turn = (np.concatenate([part[i] for part in seen]) for i in (1, 2, 3))
    holds = (links <= LINK_BOUND).all(axis=1) & (turn <= BASE_BOUND)
    steps = np.bincount(env, minlength=len(clip))
    share = np.bincount(env, weights=holds, minlength=len(clip)) / np.maximum(steps, 1)
    followed = (share >= SHARE) & ~failed.astype(np.bool_)
    results = {}
    for index, name in enumerate(reference.names):
        mine = np.flatnonzero(clip == index)
        at = np.isin(env, mine)
        if not at.any():
            continue
        results[name] = ClipResult(
            episodes=len(mine),
            followed=float(followed[mine].mean()),
            failed=float(failed[mine].mean()),
            base_m=_figures(base[at]),
            base_deg=_figures(turn[at]),
            links_m={link: _figures(links[at, i]) for i, link in enumerate(reference.body.key_links)},
        )
    return results


def _figures(values: Array) -> tuple[float, float]:
    """Mean and 95th percentile."""
    return float(values.mean()), float(np.quantile(values, 0.95))


def measure_checkpoint(
    checkpoint: Path, robots: Sequence[str] | None = None, clips: Sequence[str] | None = None, **arguments: Any
) -> dict[str, dict[str, ClipResult]]:
    """`measure` for a checkpoint or an ONNX file, whose manifest names task, robots and options.

    `clips` take the place of the run's.
    """
    from polypod.policy import load  # it builds on this package

    policy = load(checkpoint, None, robots)
    manifest = policy.manifest
    terms = terms_of_run(manifest, None, str(checkpoint))
    if terms is None or terms.options is None:
        raise _core.ConfigError(f"{checkpoint} was trained in a task that tracks no motions; use polypod eval")
    if clips is not None:
        terms = dataclasses.replace(terms, options={**terms.options, "clips": list(clips)})
    return measure(
        policy.runner(),
        manifest["task"],
        manifest["robot_sources"] if robots is None else robots,
        terms,
        trained=manifest["overrides"],
        slots=manifest["canonical_joint_names"],
        **arguments,
    )
