"""Judges robots that nobody prepared: `python -m lab.zero_shot FOLDER --checkpoint FILE`.

Every URDF of a folder is drafted as `polypod robot new` does it; a library of `polypod bodies
generate` is taken as it is. Each robot is judged by the definition of walking. A file that is
refused has a line with the reason. With several checkpoints the last lines compare them.
"""

import argparse
import collections
import dataclasses
import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from polypod import _core, runs
from polypod.evaluation import ENVS_PER_ROBOT, evaluate_checkpoint
from polypod.evaluation.results import finite
from polypod.evaluation.walking import Walking, walks, why_not
from polypod.files import write_text
from polypod.new_robot import new_robot, robot_name
from polypod.tables import Rows, console_of_output
from polypod.training.report import walking_cells

TASK = "velocity_flat_any_legged"


@dataclasses.dataclass(frozen=True)
class Robot:
    """A robot of a folder."""

    name: str
    source: str
    """Path of its config; empty where it is refused."""
    refused: str = ""
    stands: bool | None = None
    """Whether the draft stands by itself; None where nothing was drafted."""


def robots_of(folder: Path, drafts: Path) -> Iterator[Robot]:
    """Robots of the URDFs and the configs in a folder.

    Args:
        folder: holds `.urdf` or `.toml` files, or is a library with `configs/robots`.
        drafts: where configs of URDFs are written.
    """
    library = folder / "configs" / "robots"
    for config in sorted([*folder.glob("*.toml"), *library.glob("*.toml")]):
        yield Robot(config.stem, str(config))
    for urdf in sorted(folder.glob("*.urdf")):
        name = robot_name(urdf)
        try:
            new = new_robot(urdf, drafts / f"{name}.toml", force=True)
        except _core.PolypodError as error:
            yield Robot(name, "", refused=" ".join(str(error).split()))
        else:
            yield Robot(name, str(new.path), stands=new.standing.holds)


def measure(
    checkpoint: Path,
    robots: Sequence[Robot],
    *,
    task: str = TASK,
    num_envs: int = ENVS_PER_ROBOT,
    seed: int = 0,
    steps: int | None = None,
    threads: int | None = None,
) -> dict[str, dict[str, Any]]:
    """Figures of each robot under a checkpoint: `walking`, `distance`, `why` or `refused`.

    Robots go one by one, so that none that is refused takes the others with it.
    """
    found: dict[str, dict[str, Any]] = {}
    for robot in robots:
        if robot.refused:
            found[robot.name] = {"refused": robot.refused}
            continue
        try:
            result = evaluate_checkpoint(
                checkpoint, [robot.source], task=task, num_envs=num_envs, seed=seed, steps=steps, threads=threads
            )
        except _core.PolypodError as error:
            found[robot.name] = {"refused": " ".join(str(error).split())}
            continue
        (figures,) = (of.walking for of in result.robots.values() if of.walking is not None)
        distance = next(iter(result.distances.values()), None)
        found[robot.name] = {
            "walks": walks(figures),
            "why": why_not(figures),
            "walking": dataclasses.asdict(figures),
            "distance": None if distance is None else dataclasses.asdict(distance),
            "stands": robot.stands,
        }
    return found


def table(found: dict[str, dict[str, Any]]) -> Rows:
    """A line per robot."""
    rows = Rows("robot", "distance", *walking_cells(_NOTHING))
    for name, entry in found.items():
        if "refused" in entry:
            rows.add_row(name, *["-"] * (len(walking_cells(_NOTHING))), "refused")
            continue
        distance = entry["distance"]
        far = "-" if distance is None else f"{distance['distance']:.2f}"
        rows.add_row(name, far, *walking_cells(Walking.from_dict(finite(entry["walking"]))).values())
    return rows


_NOTHING = Walking(1, 20.0, (), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(prog="python -m lab.zero_shot", description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path, help="folders of URDFs or configs, or drawn libraries")
    parser.add_argument("--checkpoint", nargs="+", default=["legged"], help="files, runs or bundled policies")
    parser.add_argument("--task", default=TASK)
    parser.add_argument("--num-envs", type=int, default=ENVS_PER_ROBOT, help="number for each robot")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path, help="also write all figures")
    parser.add_argument("--drafts", type=Path, help="keep the drafted configs in this folder")
    options = parser.parse_args()
    console = console_of_output()
    result: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        drafts = options.drafts or Path(temporary)
        drafts.mkdir(parents=True, exist_ok=True)
        robots = [robot for folder in options.folders for robot in robots_of(folder, drafts)]
        counts = collections.Counter(robot.name for robot in robots)
        if several := [name for name, count in counts.items() if count > 1]:
            parser.error(f"several files name their robot {several[0]}; rename all but one")
        for name in options.checkpoint:
            found = measure(
                runs.resolve(Path(name)),
                robots,
                task=options.task,
                num_envs=options.num_envs,
                seed=options.seed,
                threads=options.threads,
            )
            result[name] = found
            console.print(name, markup=False)
            table(found).print(console)
            for robot, entry in found.items():
                if "refused" in entry:
                    console.print(f"  {robot}: {entry['refused']}", markup=False)
        for name, found in result.items():
            walking = sum(entry.get("walks", False) for entry in found.values())
            console.print(f"{name}: {walking} of {len(found)} walk", markup=False)
    if options.json is not None:
        write_text(options.json, json.dumps(finite(result), indent=1) + "\n")


if __name__ == "__main__":
    main()
