"""Errors of the key links of a policy that tracks motions, clip by clip."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.arrays import Array
from polypod.evaluation.rollout import play_task, undisturbed
from polypod.motions import library
from polypod.motions.body import body_of
from polypod.motions.options import parse
from polypod.motions.reference import Errors, Reference, errors_in
from polypod.networks.policies import Policy, reset
from polypod.python_terms import Terms, TermSim
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


@dataclasses.dataclass
class Seen:
    """All that was seen of one robot."""

    reference: Reference
    clip: npt.NDArray[np.int64]
    """Clip of each env, [envs]."""
    failed: npt.NDArray[np.bool_]
    running: npt.NDArray[np.bool_]
    parts: list[tuple[npt.NDArray[np.int64], Array, Array, Array]] = dataclasses.field(default_factory=list)

    def add(self, found: Errors, fell: npt.NDArray[np.bool_], over: npt.NDArray[np.bool_]) -> None:
        """Notes a control step of the envs that still run, and which of them it ends."""
        at: npt.NDArray[np.int64] = np.flatnonzero(self.running).astype(np.int64)
        distance = np.linalg.norm(found.link_pos[at], axis=-1)
        base = np.linalg.norm(found.anchor_pos[at], axis=-1)
        turn: Array = np.degrees(found.anchor_ori[at])
        self.parts.append((at, distance, base, turn))
        self.failed |= self.running & fell
        self.running &= ~(fell | over)


class Trial:
    """Episodes of a policy: each robot tracks each clip from its start."""

    def __init__(
        self,
        manifest: Mapping[str, Any],
        robots: Sequence[str],
        terms: Terms,
        *,
        episodes: int = 16,
        seed: int = 0,
        threads: int | None = None,
        overrides: Sequence[str] = (),
    ) -> None:
        """Begins the episodes.

        Args:
            manifest: of the run.
            robots: names or paths of configs.
            terms: those of the run.
            episodes: of each robot and clip.
            seed: of the noise with which they begin.
            threads: of the simulator; None: one per core.
            overrides: `key=value` changes, on top of the run's.

        Raises:
            ConfigError: for options that cannot be used.
        """
        if not 1 <= episodes <= 10_000:
            raise _core.ConfigError(f"episodes = {episodes} must be from 1 to 10000")
        for change in overrides:
            if change.startswith("motions.clips"):
                raise _core.ConfigError(f"--set {change}: name the motions with --clips")
        name, trained = play_task(manifest["task"]), manifest["overrides"]
        options = dict(terms.options or {})
        clips = list(options["clips"])
        longest = max(library.duration(clip) for clip in clips)
        length = f"sim.episode_length_s={longest + 1.0}"
        noise = f"motions.reset.play_noise={NOISE}"
        sim = simulator(
            terms,
            name,
            episodes * len(clips) * len(robots),
            play=True,
            robots=list(robots),
            seed=seed,
            threads=threads,
            overrides=[*trained, *undisturbed(name, trained), length, noise, *overrides],
            autoreset="disabled",
            slots=list(manifest["canonical_joint_names"]),
        )
        if not isinstance(sim, TermSim):
            raise _core.ConfigError(f"{sim.task_name} tracks no motions; use polypod eval")
        self.sim = sim
        self.options = parse(dict(sim.terms.options or {}), "motions")
        self.steps = round(longest / sim.step_dt)
        self.seen: dict[str, Seen] = {}
        self.sources = list(robots)
        for robot, source in zip(sim.robots, robots, strict=True):
            rows = slice(*sim.env_ids(robot))
            body = body_of(source)
            reference = Reference.of(body, library.clips_of(clips, body.source), sim.step_dt)
            count = rows.stop - rows.start
            clip = sim.view.memory["motion_clip"][rows, 0].copy()
            ends = np.zeros(count, dtype=np.bool_), np.ones(count, dtype=np.bool_)
            self.seen[robot] = Seen(reference, clip, *ends)

    @property
    def is_over(self) -> bool:
        """Whether all episodes have ended."""
        return not any(seen.running.any() for seen in self.seen.values())

    def run(self, policy: Policy) -> dict[str, dict[str, ClipResult]]:
        """Tracks the clips in polypod; by robot and clip."""
        sim = self.sim
        reset(policy)
        for _ in range(self.steps):
            sim.step(policy(sim.observation))
            for robot, seen in self.seen.items():
                rows = slice(*sim.env_ids(robot))
                found = errors_in(sim, robot, seen.reference, sim.view.memory["motion_frame"][rows, 0])
                seen.add(found, sim.terminated[rows], sim.truncated[rows])
            if self.is_over:
                break
        return self.results()

    def results(self) -> dict[str, dict[str, ClipResult]]:
        """Figures of the episodes so far, by robot and clip."""
        return {robot: _results(seen) for robot, seen in self.seen.items()}


def _results(seen: Seen) -> dict[str, ClipResult]:
    reference, clip, failed = seen.reference, seen.clip, seen.failed
    env = np.concatenate([part[0] for part in seen.parts])
    links, base, turn = (np.concatenate([part[i] for part in seen.parts]) for i in (1, 2, 3))
    holds = (links <= LINK_BOUND).all(axis=1) & (turn <= BASE_BOUND)
    steps = np.bincount(env, minlength=len(clip))
    share = np.bincount(env, weights=holds, minlength=len(clip)) / np.maximum(steps, 1)
    followed = (share >= SHARE) & ~failed
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


def follows(found: Mapping[str, Mapping[str, ClipResult]]) -> bool:
    """Whether all robots follow all motions in `SHARE` of their episodes."""
    return all(result.followed >= SHARE for clips in found.values() for result in clips.values())


def lines_of(found: Mapping[str, Mapping[str, ClipResult]]) -> list[str]:
    """Figures as a table for each robot."""
    lines = []
    for robot, clips in found.items():
        lines += [robot, "  motion      followed  failed  base m (95 %)   base deg (95 %)  worst link m (95 %)"]
        for name, result in clips.items():
            worst = max(result.links_m, key=lambda link: result.links_m[link][1])
            mean, high = result.links_m[worst]
            lines.append(
                f"  {name:<10} {result.followed:>8.0%} {result.failed:>7.0%}  {result.base_m[0]:.3f} "
                f"({result.base_m[1]:.3f})   {result.base_deg[0]:4.1f} ({result.base_deg[1]:4.1f})      "
                f"{mean:.3f} ({high:.3f}) {worst}"
            )
    return lines


def as_dict(found: Mapping[str, Mapping[str, ClipResult]]) -> dict[str, Any]:
    """Figures for JSON."""
    return {robot: {name: dataclasses.asdict(r) for name, r in clips.items()} for robot, clips in found.items()}


def _figures(values: Array) -> tuple[float, float]:
    """Mean and 95th percentile."""
    return float(values.mean()), float(np.quantile(values, 0.95))


def terms_of(manifest: Mapping[str, Any], name: str, clips: Sequence[str] | None) -> Terms:
    """The terms of a run, with other clips if they are named. Raises ConfigError."""
    terms = terms_of_run(manifest, None, name)
    if terms is None or terms.options is None:
        raise _core.ConfigError(f"{name} was trained in a task that tracks no motions; use polypod eval")
    if clips is None:
        return terms
    return dataclasses.replace(terms, options={**terms.options, "clips": list(clips)})


def measure_checkpoint(
    checkpoint: Path, robots: Sequence[str] | None = None, clips: Sequence[str] | None = None, **arguments: Any
) -> dict[str, dict[str, ClipResult]]:
    """Tracks motions with a checkpoint or an ONNX file, in polypod.

    Args:
        checkpoint: with a manifest that names task, robots and options.
        robots: names or paths; None: those of the run.
        clips: names or files; None: those of the run.
        **arguments: of `Trial`.
    """
    from polypod.policy import load  # it builds on this package

    policy = load(checkpoint, None, robots)
    manifest = policy.manifest
    sources = manifest["robot_sources"] if robots is None else robots
    return Trial(manifest, sources, terms_of(manifest, str(checkpoint), clips), **arguments).run(policy.runner())
