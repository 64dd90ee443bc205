"""Reads what trainings and evaluations left in a folder, or in a folder packed as `.tar.xz`.

<folder>/<group>/<run>/
    manifest.json          of the training
    events.out.tfevents*   its curves, if they are to be drawn
    *.json                 evaluations: `polypod eval --json`
<folder>/**/*.json         comparisons with MuJoCo: `polypod sim2sim --json`

The runs of a group must be comparable: the same recipe with other seeds, or with one robot left out
after the other. The files, not their names, say what a policy was trained on.
"""

import dataclasses
import json
import tarfile
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from polypod import _core
from polypod.arrays import Array
from polypod.evaluation import Evaluation
from polypod.extras import package
from polypod.files import read_bytes
from polypod.runs.run_dir import MANIFEST

MAX_BYTES = 64 << 20
"""Largest size of a file of figures, bytes."""


@dataclasses.dataclass(frozen=True)
class Curve:
    """One scalar over a training."""

    iterations: Array
    """Finished iterations, beginning with 1."""
    values: Array


@dataclasses.dataclass(frozen=True)
class Run:
    """One training and what was measured of it."""

    group: str
    name: str
    manifest: dict[str, Any] | None
    evaluations: dict[str, Evaluation]
    """Evaluations by the name of the file, without its ending."""
    curves: dict[str, Curve]
    """Curves by TensorBoard's tag."""
    minutes: float
    """Wall-clock time between the first and the last record of the curves; NaN without curves."""

    @property
    def robots(self) -> list[str]:
        """Names of the robots of the training."""
        if self.manifest is not None:
            return list(self.manifest["robots"])
        origins = [each.checkpoint for each in self.evaluations.values() if each.checkpoint is not None]
        return list(origins[0]["robots"]) if origins else []

    @property
    def seed(self) -> int | None:
        """Seed of the training."""
        return None if self.manifest is None else self.manifest["seed"]

    @property
    def iterations(self) -> float:
        """Iterations that it was trained for; NaN if unknown.

        Read from its curves, else from the evaluated checkpoint.
        """
        ends = [float(curve.iterations[-1]) for curve in self.curves.values()]
        ends = ends or [float(e.checkpoint["iteration"]) for e in self.evaluations.values() if e.checkpoint]
        return max(ends, default=float("nan"))

    @property
    def samples_per_iteration(self) -> int:
        """Control steps of all envs together. Raises ConfigError without a manifest."""
        if self.manifest is None:
            raise _core.ConfigError(f"{self.group}/{self.name} has curves but no {MANIFEST}; copy that of the run too")
        return int(self.manifest["num_envs"] * self.manifest["train_config"]["run"]["num_steps_per_env"])


@dataclasses.dataclass(frozen=True)
class Results:
    """A folder's content."""

    runs: list[Run]
    """Runs in the order of their groups' names and their own."""
    sim2sim: list[dict[str, Any]]
    skipped: list[Path]
    """JSON files of another kind, relative to the folder."""

    @property
    def groups(self) -> dict[str, list[Run]]:
        """The runs of each group."""
        found: dict[str, list[Run]] = {}
        for run in self.runs:
            found.setdefault(run.group, []).append(run)
        return found


def read(source: Path) -> Results:
    """Reads a folder or an archive of one.

    Raises:
        ConfigError: for an empty one, and for a file that is broken or of another version.
    """
    if source.is_file():
        with tempfile.TemporaryDirectory() as folder:
            try:
                with tarfile.open(source, "r:xz") as archive:
                    archive.extractall(folder, filter="data")
            except (tarfile.TarError, OSError) as error:
                raise _core.ConfigError(f"cannot unpack {source}: {error}; pack a folder with tar -cJf") from error
            return _read(Path(folder), source)
    if not source.is_dir():
        raise _core.ConfigError(f"{source} is no folder and no .tar.xz; pass a folder with one per group and run")
    return _read(source, source)


def _read(folder: Path, source: Path) -> Results:
    results = Results([], [], [])
    directories = sorted(
        {file.parent for pattern in ("*.json", "events.out.tfevents*") for file in folder.rglob(pattern)}
    )
    for directory in directories:
        _read_directory(folder, directory, results)
    if not results.runs and not results.sim2sim:
        raise _core.ConfigError(f"{source} holds neither evaluations nor curves: polypod eval --json writes the former")
    return results


def _read_directory(folder: Path, directory: Path, results: Results) -> None:
    manifest, evaluations = None, {}
    for file in sorted(directory.glob("*.json")):
        content = _load(file)
        if file.name == MANIFEST:
            manifest = content
        elif "mujoco_version" in content:
            results.sim2sim.append(content)
        elif "evaluations" in content:
            for index, entry in enumerate(content["evaluations"]):
                evaluations[f"{file.stem}_{index}"] = _evaluation(entry, file)
        elif {"task", "robots", "duration_s"} <= content.keys():
            evaluations[file.stem] = _evaluation(content, file)
        else:
            results.skipped.append(file.relative_to(folder))
    curves, minutes = _curves(directory)
    if not evaluations and not curves:
        return
    parts = directory.relative_to(folder).parts
    group = "/".join(parts[:-1]) or (parts[-1] if parts else folder.name)
    results.runs.append(Run(group, parts[-1] if parts else folder.name, manifest, evaluations, curves, minutes))


def _load(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_bytes(file, MAX_BYTES).decode())
    except _core.PolypodError:
        raise
    except (OSError, ValueError, RecursionError) as error:
        raise _core.ConfigError(f"cannot read {file}: {error}; write it again") from error
    if not isinstance(content, dict):
        raise _core.ConfigError(f"{file} holds no table; move it elsewhere")
    return content


def _evaluation(content: dict[str, Any], file: Path) -> Evaluation:
    try:
        return Evaluation.from_dict(content)
    except (KeyError, TypeError) as error:
        raise _core.ConfigError(
            f"{file} was written by another version of polypod eval ({error}); measure it again"
        ) from error


def _curves(directory: Path) -> tuple[dict[str, Curve], float]:
    """All scalars, and the minutes from the first to the last record."""
    if not any(directory.glob("events.out.tfevents*")):
        return {}, float("nan")
    module = package("tensorboard.backend.event_processing.event_accumulator", "reading curves", "train")
    events = module.EventAccumulator(str(directory), size_guidance={"scalars": 0})
    events.Reload()
    curves, times = {}, []
    for tag in events.Tags()["scalars"]:
        records = events.Scalars(tag)
        times += [records[0].wall_time, records[-1].wall_time]
        steps = np.array([record.step + 1 for record in records], dtype=np.float64)
        curves[tag] = Curve(steps, np.array([record.value for record in records], dtype=np.float64))
    return curves, (max(times) - min(times)) / 60.0 if times else float("nan")


def smoothed(curve: Curve, window: int) -> Curve:
    """The mean over each `window` iterations, of the records that there are of them."""
    sums = np.concatenate([[0.0], np.cumsum(curve.values)])
    ends = np.arange(1, len(curve.values) + 1)
    starts = np.searchsorted(curve.iterations, curve.iterations - window, side="right")
    return Curve(curve.iterations, (sums[ends] - sums[starts]) / (ends - starts))


def reached(curve: Curve, score: float) -> float:
    """The first iteration after which a curve is at most `score`; NaN if it never is."""
    below = np.flatnonzero(curve.values <= score)
    return float(curve.iterations[below[0]]) if len(below) else float("nan")


def final(curve: Curve) -> float:
    """The mean over the last tenth of a curve."""
    return float(curve.values[-max(len(curve.values) // 10, 1) :].mean())


def mean_curve(curves: Sequence[Curve], scales: Sequence[float]) -> tuple[Array, Array, Array, Array]:
    """Curves on one axis, up to the shortest one's end: places, mean, lowest and highest value.

    Args:
        curves: of one tag.
        scales: of each curve's iterations, samples per iteration, say.
    """
    axes = [curve.iterations * scale for curve, scale in zip(curves, scales, strict=True)]
    places = np.linspace(max(axis[0] for axis in axes), min(axis[-1] for axis in axes), 200)
    values = np.stack([np.interp(places, axis, curve.values) for axis, curve in zip(axes, curves, strict=True)])
    return places, values.mean(axis=0), values.min(axis=0), values.max(axis=0)
