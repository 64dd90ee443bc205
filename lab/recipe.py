"""Trains the stages of a recipe: `python -m lab.recipe lab/recipes/legged --out OUT`.

A recipe is a folder with a `plan.toml` and train configs. Each stage of the plan is a run of
`polypod train`, or a mean of the weights of others. It leaves `OUT/<stage>/model.pt` with its
`manifest.json`, and its output in `OUT/<stage>.log`. A stage whose model is there is not trained
again. So a recipe goes on where it ended, also on another machine.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import torch

from polypod import _core, bundled, simulated
from polypod.compat import tomllib
from polypod.runs import run_dir

LIBRARY = Path(__file__).parents[1] / "assets" / "robots"
TASK = "velocity_flat_any_legged_play"

DRAFTED = "--drafted"
"""With the arguments of `polypod bodies generate`: gains, poses and limits of the drawn bodies are
those that `polypod robot new` drafts."""
VARIATION = """[variation]                  # factors of `body_variation`
base_width = [0.92, 1.1]
hip_offset = [0.9, 1.1]
thigh_length = [0.92, 1.08]
shank_length = [0.92, 1.08]
base_mass = [0.85, 1.2]
hip_mass = [0.8, 1.25]
thigh_mass = [0.8, 1.25]
shank_mass = [0.8, 1.25]
stiffness = [0.8, 1.3]
damping = [0.8, 1.25]
"""
"""End of the configs of drafted drawn bodies."""
_MORE = "more_"
"""Prefix of tables that add to those of the stage which a stage is like."""
GRACE = 60.0
"""Seconds that a stage has to write its checkpoint, once it is told to end."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A training.

    In a plan, `like = "NAME"` takes over from an earlier stage what it does not say; tables
    `more_teachers` and `more_shares` add to that stage's, and the last entry of a robot counts. A
    table with `each = { KEY = "VALUE" }` is a stage for each of them: `{key}` and `{value}` stand
    for both.
    """

    name: str
    config: str = ""
    """A train config: a name, or a file of the recipe; of a mean none."""
    robots: tuple[str, ...] = ()
    """Names; `@group` stands for a group of the plan, `@drawn.0` for the bodies of the first line
    of `bodies`, and `drafted_NAME` for a robot of the library as `polypod robot new` drafts it."""
    iterations: int | None = None
    """None: the config's."""
    seed: int = 1
    init: str | None = None
    """A stage, or a bundled policy, whose networks it begins with; empty: from scratch."""
    teachers: Mapping[str, str] = field(default_factory=dict)
    """Stages or bundled policies by robots (as above, with commas between), of a distillation."""
    shares: Mapping[str, float] = field(default_factory=dict)
    """Shares of the envs by robots, where they are not 1."""
    changes: tuple[str, ...] = ()
    """As after `--set`."""
    workers: int = 1
    """Processes with a GPU each."""
    grown: bool = False
    """Whether `init` is a perceptron of other numbers or joints (`lab.grown`)."""
    without: tuple[str, ...] = ()
    """Robots that are left out, also as drafts."""
    mean: Mapping[str, float] = field(default_factory=dict)
    """In place of a training: shares of the weights of stages or bundled policies, which sum up to
    1. A negative share leads away from a policy."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Stages, and the drawn bodies that they train on."""

    folder: Path
    stages: tuple[Stage, ...]
    groups: Mapping[str, Sequence[str]]
    bodies: tuple[tuple[str, ...], ...]
    """Arguments of `polypod bodies generate`, after the folder."""
    drafts: tuple[str, ...] = ()
    """Robots of the library that `polypod robot new` drafts from their URDF."""
    locked: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Drafts that hold joints in their default pose: `NAME = { robot = "ROBOT", joints = [...] }`
    with a robot of `drafts`, or a drafted drawn body, and patterns of slots. A table `[[held]]`
    with `robots`, `suffix` and `joints` stands for one of each of these robots; those of a group
    are the group `GROUP_SUFFIX`."""

    def named(self, names: Iterable[str]) -> set[str]:
        """Robots, and drawn bodies as `@drawn.N`, that names and groups stand for."""
        found: set[str] = set()
        for name in names:
            is_group = name.startswith("@") and not name.startswith("@drawn.")
            found |= self.named(self.groups[name[1:]]) if is_group else {name}
        return found

    def robots(self, names: Sequence[str], out: Path, without: Sequence[str] = ()) -> list[str]:
        """Robots that names and groups stand for, except some and their drafts."""
        found: list[str] = []
        for name in names:
            if name.startswith("@drawn."):
                found += sorted(path.stem for path in (bodies_folder(out, name[7:]) / "configs/robots").glob("*.toml"))
            else:
                found += self.robots(self.groups[name[1:]], out) if name.startswith("@") else [name]
        left_out = {*without, *(f"drafted_{robot}" for robot in without)}
        return [robot for robot in found if robot not in left_out]


def bodies_folder(out: Path, number: int | str) -> Path:
    """Where drawn bodies lie."""
    return out / "bodies" / str(number)


def read(folder: Path) -> Recipe:
    """Reads a recipe."""
    with (folder / "plan.toml").open("rb") as file:
        plan = tomllib.load(file)
    bodies = tuple(tuple(arguments) for arguments in plan.get("bodies", []))

    tables: dict[str, dict[str, Any]] = {}
    for table in [stage for template in plan["stages"] for stage in _each(template)]:
        like = tables[table["like"]] if "like" in table else {}
        tables[table["name"]] = _merged(like, {key: value for key, value in table.items() if key != "like"})

    def stage(table: dict[str, Any]) -> Stage:
        lists = {key: tuple(table.get(key, ())) for key in ("robots", "without", "changes")}
        return Stage(**{**table, **lists})

    return Recipe(
        folder=folder,
        stages=tuple(stage(table) for table in tables.values()),
        groups={**plan.get("groups", {}), **_groups_of_held(plan)},
        bodies=bodies,
        drafts=tuple(plan.get("drafts", ())),
        locked={**plan.get("locked", {}), **_held(plan)},
    )


def _merged(like: Mapping[str, Any], table: Mapping[str, Any]) -> dict[str, Any]:
    """A stage's table over that of the stage which it is like."""
    more = {key: value for key, value in table.items() if key.startswith(_MORE)}
    merged = {**like, **{key: value for key, value in table.items() if key not in more}}
    for key, value in more.items():
        name = key.removeprefix(_MORE)
        merged[name] = {**merged.get(name, {}), **value}
    return merged


def _held(plan: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The drafts with joints held that tables `[[held]]` stand for."""
    found = {}
    for table in plan.get("held", []):
        for name in table["robots"]:
            for robot in plan["groups"][name[1:]] if name.startswith("@") else [name]:
                found[f"{robot}_{table['suffix']}"] = {"robot": robot, "joints": table["joints"]}
    return found


def _groups_of_held(plan: Mapping[str, Any]) -> dict[str, list[str]]:
    """The groups of drafts with joints held, one for each group that `[[held]]` names."""
    return {
        f"{name[1:]}_{table['suffix']}": [f"{robot}_{table['suffix']}" for robot in plan["groups"][name[1:]]]
        for table in plan.get("held", [])
        for name in table["robots"]
        if name.startswith("@")
    }


def _each(template: dict[str, Any]) -> list[dict[str, Any]]:
    """The tables that a table with `each` stands for; of another one itself."""
    rest = {key: value for key, value in template.items() if key != "each"}

    def filled(value: Any, names: Mapping[str, str]) -> Any:
        if isinstance(value, str):
            return value.replace("{key}", names["key"]).replace("{value}", names["value"])
        if isinstance(value, list):
            return [filled(item, names) for item in value]
        if isinstance(value, dict):
            return {filled(key, names): filled(item, names) for key, item in value.items()}
        return value

    if "each" not in template:
        return [rest]
    return [filled(rest, {"key": key, "value": value}) for key, value in template["each"].items()]


def command(recipe: Recipe, stage: Stage, out: Path, threads: int | None) -> list[str]:
    """The command line of a stage's training."""
    config = recipe.folder / stage.config

    def model(name: str) -> str:
        return model_of(recipe, name, out)

    def robots(names: Sequence[str]) -> list[str]:
        return recipe.robots(names, out, without=stage.without)

    start = [sys.executable, "-m", "polypod"]
    if stage.workers > 1:
        start = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={stage.workers}"]
        start += ["-m", "polypod"]
    words = [*start, "train", "--train-config", str(config) if config.is_file() else stage.config]
    words += ["--robots", ",".join(robots(stage.robots)), "--seed", str(stage.seed), "--logger", "none"]
    words += ["--log-dir", str(out / "runs" / stage.name)]
    if threads is not None:
        words += ["--threads", str(threads)]
    if stage.iterations is not None:
        words += ["--max-iterations", str(stage.iterations)]
    if stage.init:
        words += ["--init", str(grown_of(stage, out)) if stage.grown else model(stage.init)]
    for change in stage.changes:
        words += ["--set", change]
    for names, teacher in stage.teachers.items():
        for robot in robots(names.split(",")):
            words += ["--set", f'train.distillation.teachers.{robot}="{model(teacher)}"']
    for names, share in stage.shares.items():
        for robot in robots(names.split(",")):
            words += ["--set", f"env_shares.{robot}={share}"]
    return words


def grown_of(stage: Stage, out: Path) -> Path:
    """The checkpoint that a stage with `grown` begins with."""
    return out / f"{stage.name}_init.pt"


def grow(recipe: Recipe, stage: Stage, out: Path) -> None:
    """Writes the checkpoint that a stage with `grown` begins with."""
    words = [sys.executable, "-m", "lab.grown", model_of(recipe, str(stage.init), out), str(grown_of(stage, out))]
    words += ["--train-config", str(recipe.folder / stage.config)]
    words += ["--robots", ",".join(recipe.robots(stage.robots, out, without=stage.without))]
    subprocess.run(words, check=True, env=environment(recipe, out))


def model_of(recipe: Recipe, name: str, out: Path) -> str:
    """A stage's model; a bundled policy goes by its name."""
    return str(out / name / "model.pt") if name in {stage.name for stage in recipe.stages} else name


def mix(recipe: Recipe, stage: Stage, out: Path) -> str:
    """Makes a stage that is a mean of weights, with the manifest of the first; returns a line."""
    names = {name: model_of(recipe, name, out) for name in stage.mean}
    files = [bundled.checkpoint(name) if file == name else Path(file) for name, file in names.items()]
    states = [run_dir.load_checkpoint(file)["actor_state_dict"] for file in files]
    shares = list(stage.mean.values())
    weights = dict(states[0])
    for key, first in states[0].items():
        if first.is_floating_point():
            sum_of = sum(share * state[key].double() for share, state in zip(shares, states, strict=True))
            weights[key] = sum_of.to(torch.promote_types(first.dtype, torch.float32))
    (out / stage.name).mkdir(exist_ok=True)
    manifest = {**run_dir.read_manifest(files[0]), "checkpoints": {}}
    (out / stage.name / run_dir.MANIFEST).write_text(json.dumps(manifest), encoding="utf-8")
    kept = {"actor_state_dict": weights, "iter": 0, "infos": {}}
    run_dir.save_checkpoint(out / stage.name / "model.pt", lambda file: torch.save(kept, file))
    return f"{stage.name}: the mean of {', '.join(names)}"


def packages(recipe: Recipe) -> list[str]:
    """The folder of a recipe, and those of recipes whose train configs it uses, for their tasks."""
    configs = {recipe.folder / stage.config for stage in recipe.stages if stage.config.endswith(".toml")}
    others = {str(file.resolve().parent) for file in configs} - {str(recipe.folder.resolve())}
    return [str(recipe.folder), *sorted(others)]


def environment(recipe: Recipe, out: Path) -> dict[str, str]:
    """The environment of a stage, with drawn bodies, drafted robots and the tasks of the recipe."""
    made = [*(bodies_folder(out, number) for number in range(len(recipe.bodies))), out / "drafts"]
    folders = [*(str(folder) for folder in made if folder.is_dir()), *packages(recipe)]
    folders.append(os.environ.get("POLYPOD_PATH", ""))
    return {**os.environ, "POLYPOD_PATH": os.pathsep.join(folder for folder in folders if folder)}


def draw(recipe: Recipe, out: Path, stages: Sequence[Stage]) -> None:
    """Draws the bodies and drafts the robots that the stages name, if they are not there."""
    # `lab.grown` simulates the robots of the policy that it grows
    grown = [stage for stage in recipe.stages if stage.name in {of.init for of in stages if of.grown}]
    named = recipe.named([name for stage in [*stages, *grown] for name in stage.robots])
    locked = {name: variant for name, variant in recipe.locked.items() if name in named}
    whole = named | {variant["robot"] for variant in locked.values()}
    for number, arguments in enumerate(recipe.bodies):
        prefix = f"{arguments[arguments.index('--prefix') + 1]}_" if "--prefix" in arguments else ""
        if f"@drawn.{number}" not in named and not any(name.startswith(prefix) for name in whole):
            continue
        if not (folder := bodies_folder(out, number)).is_dir():
            words = [sys.executable, "-m", "polypod", "bodies", "generate", str(folder)]
            subprocess.run([*words, *without_drafted(arguments)], check=True, stdout=subprocess.DEVNULL)
            if DRAFTED in arguments:
                for config in sorted((folder / "configs" / "robots").glob("*.toml")):
                    draft_drawn(folder, config)
    for robot in recipe.drafts:
        if f"drafted_{robot}" not in named and robot not in whole:
            continue
        if not (config := out / "drafts" / "configs" / "robots" / f"drafted_{robot}.toml").is_file():
            config.parent.mkdir(parents=True, exist_ok=True)
            # a config names its URDF by the way to it, which must be there on another machine
            own = out / "drafts" / "assets" / "robots" / robot
            shutil.copytree(LIBRARY / robot, own, dirs_exist_ok=True)
            draft(own / "robot.urdf", config)
    for name, variant in locked.items():
        if not (config := out / "drafts" / "configs" / "robots" / f"{name}.toml").is_file():
            draft_held(whole_of(recipe, variant["robot"], out), config, variant["joints"])


def whole_of(recipe: Recipe, robot: str, out: Path) -> Path:
    """The config of a draft of the library, or of a drawn body."""
    if robot in recipe.drafts:
        return out / "drafts" / "configs" / "robots" / f"drafted_{robot}.toml"
    places = [
        bodies_folder(out, number) / "configs" / "robots" / f"{robot}.toml" for number in range(len(recipe.bodies))
    ]
    return next(place for place in places if place.is_file())


def draft_held(whole: Path, config: Path, patterns: Sequence[str]) -> None:
    """Drafts a robot whose joints are held where slots match, with ranges of `body_variation`."""
    urdf = (whole.parent / tomllib.loads(whole.read_text(encoding="utf-8"))["urdf"]).resolve()
    own = config.parents[2] / "assets" / "robots" / urdf.parent.name
    if not own.is_dir():
        shutil.copytree(urdf.parent, own)
    draft(own / "robot.urdf", config, held(whole, patterns))
    _vary(config, tomllib.loads(whole.read_text(encoding="utf-8"))["reward_set"])


def draft(urdf: Path, config: Path, locked: Sequence[str] = ()) -> None:
    """Writes the config that `polypod robot new` drafts; `locked` are `JOINT=POSITION`."""
    words = [sys.executable, "-m", "polypod", "robot", "new", str(urdf), "--name", config.stem, "--out", str(config)]
    words += ["--force", *(word for joint in locked for word in ("--lock", joint))]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)


def held(config: Path, patterns: Sequence[str]) -> list[str]:
    """Joints of a config whose slots match, as `JOINT=POSITION` in the default pose."""
    (info,) = simulated.robots(_core.VecSim(TASK, 1, robots=[str(config)], threads=1)).values()
    return [
        f"{info['joint_names'][joint]}={info['default_pose'][joint]!r}"
        for slot, joint in zip(info["slots"], info["joint_of_slot"], strict=True)
        if any(fnmatchcase(slot, pattern) for pattern in patterns)
    ]


def without_drafted(arguments: Sequence[str]) -> list[str]:
    """Arguments of `polypod bodies generate`."""
    return [word for word in arguments if word != DRAFTED]


def draft_drawn(folder: Path, config: Path) -> None:
    """Gives a drawn body the config that `polypod robot new` drafts, with its reward set."""
    rewards = tomllib.loads(config.read_text(encoding="utf-8"))["reward_set"]
    draft(folder / "assets" / "robots" / config.stem / "robot.urdf", config)
    _vary(config, rewards)


def _vary(config: Path, rewards: str) -> None:
    """Gives a draft a reward set, and ranges of `body_variation` if it has none yet."""
    lines = config.read_text(encoding="utf-8").splitlines()
    own = [f'reward_set = "{rewards}"' if line.startswith("reward_set") else line for line in lines]
    ranges = [] if any(line.startswith("[variation]") for line in lines) else ["", VARIATION]
    config.write_text("\n".join([*own, *ranges]) + "\n", encoding="utf-8")


def train(recipe: Recipe, stage: Stage, out: Path, ends_at: float | None, threads: int | None) -> str:
    """Trains a stage, until `ends_at` at most (`time.monotonic`); returns a line about it."""
    if (out / stage.name / "model.pt").is_file():
        return f"{stage.name}: is there"
    if stage.mean:
        return mix(recipe, stage, out)
    began = time.monotonic()
    if ends_at is not None and began > ends_at:
        return f"{stage.name}: no time left"
    if stage.grown:
        grow(recipe, stage, out)
    with (out / f"{stage.name}.log").open("w") as log:
        run = subprocess.Popen(
            command(recipe, stage, out, threads), stdout=log, stderr=subprocess.STDOUT, env=environment(recipe, out)
        )
        try:
            code = run.wait(None if ends_at is None else max(ends_at - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            run.send_signal(signal.SIGTERM)
            code = run.wait(GRACE)
    return f"{stage.name}: exit code {code}, {time.monotonic() - began:.0f} s, {keep(stage.name, out)}"


def keep(name: str, out: Path) -> str:
    """Puts the last checkpoint of a stage's run with its manifest where other stages find it."""
    try:
        model = run_dir.find_checkpoint(out / "runs" / name, "latest")
    except _core.ConfigError:
        return "no checkpoint"
    (out / name).mkdir(exist_ok=True)
    shutil.copy(model, out / name / "model.pt")
    shutil.copy(model.parent / run_dir.MANIFEST, out / name / run_dir.MANIFEST)
    return model.name


def main() -> None:
    """Trains the stages that are asked for, in the plan's order."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--stages", help="names, with commas between; all by default")
    parser.add_argument("--together", type=int, default=1, help="trainings at a time")
    parser.add_argument("--threads", type=int, help="threads of each training; all cores by default")
    parser.add_argument("--iterations", type=int, help="number for each stage, in place of the plan's")
    parser.add_argument("--seconds", type=float, help="after which trainings end, with a checkpoint")
    arguments = parser.parse_args()
    began = time.monotonic()
    recipe, out = read(arguments.recipe.resolve()), arguments.out.resolve()
    known = {stage.name: stage for stage in recipe.stages}
    if arguments.iterations is not None:
        known = {name: replace(stage, iterations=arguments.iterations) for name, stage in known.items()}
    names = list(known) if arguments.stages is None else arguments.stages.split(",")
    if unknown := [name for name in names if name not in known]:
        sys.exit(f"{arguments.recipe} has no stage {', '.join(unknown)}; it has {', '.join(known)}")
    out.mkdir(parents=True, exist_ok=True)
    draw(recipe, out, [known[name] for name in names])
    ends_at = None if arguments.seconds is None else began + arguments.seconds
    with ThreadPoolExecutor(arguments.together) as pool:
        for line in pool.map(lambda name: train(recipe, known[name], out, ends_at, arguments.threads), names):
            print(line, flush=True)


if __name__ == "__main__":
    main()
