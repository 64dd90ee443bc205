"""`polypod add`: any description of a legged robot becomes a robot of a library.

`sources` finds the file, `compiling` has MuJoCo compile an MJCF file, `mjcf` writes it down as a
`description`, `kept` writes MuJoCo's model into one file, `urdf` copies a URDF, `toml` puts what
the file says of actuators into the draft, and `judge` compares the robot with MuJoCo's model.
"""

import contextlib
import dataclasses
import functools
import re
import time
from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from polypod import _core, base_frames, new_robot, simulated, urdf_copies
from polypod.add import compiling, description, judge, kept, mjcf, sources, turned, urdf
from polypod.add.compiling import Compiled
from polypod.add.description import Description
from polypod.add.toml import Slots, refined
from polypod.add.xacro import expand
from polypod.compat import tomllib
from polypod.files import new_folder, real_path, write_bytes, write_text
from polypod.text import plain
from polypod.vector_env import make

_LIMIT = re.compile(r"\[actuators\]: the URDF(.*?),? for ([^;]+); (.*) follow from (.*): write the motor's")
_LOST = re.compile(r"mesh \"[^\"]*\" is not found; the shape is left out")
LOW = 0.6
"""A keyframe with the hips lower than this share of a standing robot's lies or sits."""
_CHECK = re.compile(r"; `polypod check [^`]*` lists them")


@dataclasses.dataclass(frozen=True)
class Added:
    """A robot that was added."""

    new: new_robot.NewRobot
    """Config that was written, and how the robot stands."""
    origin: str
    notes: list[str]
    """Features that polypod cannot hold and their treatment, and assumptions."""
    errors: dict[str, judge.Errors]
    """Differences from MuJoCo's model of the file, by precision; empty where MuJoCo has none."""
    has_license: bool
    seconds: float


@dataclasses.dataclass(frozen=True)
class _Found:
    """A robot that is read and not written yet."""

    name: str
    urdf: str
    meshes: dict[str, bytes]
    notes: list[str]
    described: Description | None
    compiled: Compiled | None
    original: str
    """Text of a URDF as it was."""
    model: str | None = None
    """MuJoCo's model of an MJCF file, as one file."""
    missing: str | None = None
    """Collision meshes that are not found."""


def add(
    source: str,
    out: Path,
    *,
    file: str | None = None,
    root: str | None = None,
    name: str | None = None,
    package_dirs: Mapping[str, str] | None = None,
    arguments: Mapping[str, str] | None = None,
    feet: Mapping[str, str] | None = None,
    joint_roles: Mapping[str, str] | None = None,
    locked_joints: Mapping[str, float] | None = None,
    force: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> Added:
    """Adds a robot to a library of the user's.

    Args:
        source: a URDF, xacro, MJCF or zip file, a folder, `robot_descriptions:NAME` or
            `mujoco_menagerie:NAME`.
        out: the library's folder, with `configs/robots/` and `assets/robots/` in it; it is made if
            it is not there.
        file: the file within a folder or zip file, where several could be the robot.
        root: the body of an MJCF scene that is the robot's base, where several could be.
        name: the robot's name; None: the file's.
        package_dirs: ROS package -> folder, for `package://` names and xacro's `$(find)`.
        arguments: `<xacro:arg>` by name.
        feet: leg -> the link that is its foot, where geometry alone does not tell.
        joint_roles: slot -> joint, where geometry alone does not tell.
        locked_joints: joint -> position at which it is held, rad or m.
        force: write over a robot of this name that is there.
        progress: as in `polypod.new_robot.new_robot`.

    Raises:
        ConfigError: for a source that cannot be read, and where the robot is there already.
        RobotError: where it is no legged robot's, or holds what polypod cannot simulate.
    """
    began = time.perf_counter()
    folders = {package: real_path(folder) for package, folder in (package_dirs or {}).items()}
    with sources.opened(source, file) as found:
        read = _read(found, root, folders, arguments or {})
        given = identifier(name or read.name)
        config = out / "configs" / "robots" / f"{given}.toml"
        try:
            _check_name(given, config, force)
        except OSError as error:
            raise _unwritable(out, error) from error
        held = {**(read.described.held if read.described else {}), **(locked_joints or {})}
        try:
            with new_folder(out) as staged, _named_after(found.file, staged, given, read):
                made, notes, errors = _write(staged, given, read, found, held, feet or {}, joint_roles or {}, progress)
        except OSError as error:
            raise _unwritable(out, error) from error
        made = dataclasses.replace(made, path=config, notes=[])
        notes = [plain(note.replace(str(staged), str(out))) for note in notes]
        return Added(made, source, notes, errors, found.license is not None, time.perf_counter() - began)


@contextlib.contextmanager
def _named_after(file: Path, staged: Path, name: str, read: _Found) -> Iterator[None]:
    """Lets errors name the user's file in the place of the one that is being written.

    Errors of a robot without a foot's shape also name the meshes that are missing, and errors about
    its legs the joints that are locked.
    """
    try:
        yield
    except _core.PolypodError as error:
        text = str(error.args[0] if error.args else error)
        for written in (
            staged / "assets" / "robots" / name / "robot.urdf",
            staged / "configs" / "robots" / f"{name}.toml",
        ):
            text = text.replace(str(written), str(file))
        if read.missing is not None and "collision shape" in text:
            text = f"{text}; {read.missing}"
        if "collision shape" in text and (scenes := sources.including(file)):
            names = description.listed([scene.name for scene in scenes])
            text = f"{text}; {names} includes this file and may say what its geoms touch: add that file in its place"
        if "the legs are not one at each corner" in text:
            text = f"{text}; if they hang on the joints of a waist, lock these (--lock JOINT=POSITION)"
        if "legs were found" in text:
            text = "; ".join([text, *(note for note in read.notes if note.endswith(": locked"))])
        raise type(error)(text.replace("of robot new", "of polypod add")) from error


def _unwritable(out: Path, error: OSError) -> _core.ConfigError:
    return _core.ConfigError(f"cannot write {str(out)[:200]}: {error.strerror or error}; choose another --out")


def identifier(name: str) -> str:
    """Small letters, digits and underscores, as robots are named.

    Raises ConfigError where none is left.
    """
    words = "".join(letter if letter.isascii() and letter.isalnum() else " " for letter in name.lower()).split()
    if not words:
        raise _core.ConfigError(f"{name[:80]!r} has no letter or digit; pass a --name such as my_robot")
    return "_".join(words)[:100]


def _check_name(name: str, config: Path, force: bool) -> None:
    if config.exists() and not force:
        raise _core.ConfigError(f"{config} is there already; pass --force to write over it, or another --name or --out")
    with contextlib.suppress(_core.UnknownNameError):
        if _core.robot_urdf(name) and not config.exists():
            raise _core.ConfigError(f"there is a robot `{name}` already; pass another --name")


def _read(found: sources.Source, root: str | None, folders: Mapping[str, Path], arguments: Mapping[str, str]) -> _Found:
    if found.kind == "mjcf":
        compiling.check(found.file, root)
        return _of_mjcf(compiling.compiled(found.file, root))
    if root is not None:
        raise _core.ConfigError(
            f"--root {root}: {found.file.name} is a URDF, whose base is its root link; leave it out"
        )
    dirs = {**found.package_dirs, **folders}
    text = "" if found.kind == "xacro" else urdf.read(found.file)
    # many files with macros have the ending of a URDF
    if found.kind == "xacro" or re.search(r"<xacro:\w", text):
        text = expand(found.file, dirs, {**found.arguments, **arguments}, found.within)
    copy = urdf.copied(text, found.file, dirs, found.within)
    stem = found.file.name.partition(".")[0]
    return _Found(copy.name.strip() or stem, copy.text, copy.meshes, copy.notes, None, None, text, missing=copy.missing)


def _of_mjcf(made: Compiled) -> _Found:
    reader = mjcf.Reader(made)
    described = reader.description()
    model = kept.text(reader)
    notes = list(described.notes)
    if model is None:
        notes.append(f"MuJoCo's model of the file: {kept.NAME} left out: it cannot be written as one file")
    meshes = {f"{shape.mesh}.obj": description.obj(shape).encode() for link in described.links for shape in link.shapes}
    meshes.pop(".obj", None)
    return _Found(made.name, description.urdf(described), meshes, notes, described, made, "", model)


def _write(
    folder: Path,
    name: str,
    read: _Found,
    found: sources.Source,
    held: Mapping[str, float],
    feet: Mapping[str, str],
    roles: Mapping[str, str],
    progress: Callable[[str, int, int], None] | None,
) -> tuple[new_robot.NewRobot, list[str], dict[str, judge.Errors]]:
    """Writes a library of one robot, lets it stand and compares it."""
    assets = folder / "assets" / "robots" / name
    for mesh, data in read.meshes.items():
        write_bytes(assets / "meshes" / mesh, data)
    write_text(assets / "robot.urdf", read.urdf)
    drafts_of = functools.partial(_core.draft_robot, name=name, feet=feet, joint_roles=roles, locked_joints=held)
    if read.compiled is None:
        read = _upright(read, assets / "robot.urdf", drafts_of, keeps_up=bool(roles))
    else:
        read = _turned(read, read.compiled, assets, drafts_of, keeps_up=bool(roles))
    if read.model is not None:
        write_text(assets / kept.NAME, read.model)
    config = folder / "configs" / "robots" / f"{name}.toml"

    def stood(refine: Callable[[str], str] | None) -> new_robot.NewRobot:
        return new_robot.new_robot(
            assets / "robot.urdf",
            config,
            name,
            feet=feet,
            joint_roles=roles,
            locked_joints=held,
            force=True,
            urdf_key=f"assets/robots/{name}/robot.urdf",
            refine=refine,
            progress=progress,
        )

    described = read.described
    notes = list(read.notes)
    heights: list[float] = []
    made = stood(None if described is None else _refinement(config, described, found.origin, heights, posed=True))
    if described is not None and described.pose is not None:
        problem = None if made.pose_holds else "the robot does not stand in it"
        if problem is None and (height := _hip_height(config)) < LOW * heights[-1]:
            problem = f"its hips are {height:.2f} m high, and {heights[-1]:.2f} m where it stands"
        drafted = made if problem is None else stood(_refinement(config, described, found.origin, heights, posed=False))
        if problem is not None and drafted.pose_holds:
            made = drafted
            notes.append(f"the keyframe {described.pose}: {problem}: replaced by a pose that it stands in")
        elif problem is not None:
            made = stood(_refinement(config, described, found.origin, heights, posed=True))
    errors, reason = _judged(config, read)
    if reason is not None:
        notes.append(reason)
    _check(errors, found.file)
    if found.license is not None:
        write_text(assets / "LICENSE", found.license)
    write_text(assets / "SOURCE.md", _source(name, read, found, notes, errors))
    return made, [*notes, *_summed_up(made.notes)], errors


def _upright(read: _Found, file: Path, drafts_of: Callable[..., new_robot.Draft], *, keeps_up: bool) -> _Found:
    """A URDF whose base has x forward and z up in the middle, which is written to its file."""
    robot = urdf_copies.read(file)
    if robot is None:
        return read
    try:
        robot, *changes = new_robot.upright_of(file, robot, drafts_of, keeps_up=keeps_up)
        notes = [change for change in changes if change is not None]
        if not notes:
            return read
        original = ElementTree.fromstring(read.original)
        if notes[0] == changes[0]:
            (None if keeps_up else base_frames.turn_upright(original)) or base_frames.put_upright(original)
        base_frames.put_in_the_middle(original)
    except _core.PolypodError:
        raise
    except (ValueError, ElementTree.ParseError):
        # the reader of URDFs says what is wrong
        return read
    text = urdf_copies.text_of(robot, "with an upright base in the middle", file, file.parent, ())
    write_text(file, text)
    original_text = ElementTree.tostring(original, encoding="unicode")
    return dataclasses.replace(read, urdf=text, original=original_text, notes=[*read.notes, *notes])


def _turned(
    read: _Found, compiled: Compiled, assets: Path, drafts_of: Callable[..., new_robot.Draft], *, keeps_up: bool
) -> _Found:
    """An MJCF robot whose base has x forward and z up, which is written to its files."""
    file = assets / "robot.urdf"
    if (robot := urdf_copies.read(file)) is None or (axes := base_frames.upright_axes(robot)) is None:
        return read
    _, assumed, _ = new_robot.upright_of(file, robot, drafts_of, keeps_up=keeps_up)
    if assumed is None:
        return read
    found = _of_mjcf(turned.turned(compiled, axes))
    for mesh, data in found.meshes.items():
        write_bytes(assets / "meshes" / mesh, data)
    write_text(file, found.urdf)
    return dataclasses.replace(found, name=read.name, notes=[*found.notes, assumed.replace('link "', 'body "', 1)])


def _summed_up(notes: list[str]) -> list[str]:
    """Notes of a draft, without temporary paths.

    One note stands for all joints whose limits are missing or no motor's in the same way. Meshes
    that are not found are named already.
    """
    joints: dict[tuple[str, str], list[str]] = {}
    values: dict[tuple[str, str], list[str]] = {}
    kept = []
    for note in notes:
        found = _LIMIT.match(note)
        if found is None:
            kept += [] if _LOST.search(note) else [_CHECK.sub("", note)]
            continue
        problem, names, value, source = found.groups()
        joints.setdefault((problem, source), []).extend(names.split(", "))
        values.setdefault((problem, source), []).append(value)
    for (problem, source), names_of in joints.items():
        of_all = values[problem, source]
        follow = f"{of_all[0]} follow" if len(of_all) == 1 else "limits follow"
        kept.append(
            f"joint {description.listed(names_of)}: the file{problem}: {follow} from {source}; write the motor's"
        )
    return kept


def _info(config: Path) -> Mapping[str, Any]:
    env = make(new_robot.task_of(config), 1, robots=[str(config)], seed=0)
    try:
        (info,) = simulated.robots(env.sim).values()
        return info
    finally:
        env.close()


def _hip_height(config: Path) -> float:
    """Height of the hips above the soles in a config's pose, m."""
    info = _info(config)
    return float(info["base_height"] + info["hip_height"])


def _refinement(
    config: Path, described: Description, origin: str, heights: list[float], *, posed: bool
) -> Callable[[str], str]:
    """Returns the function that puts what the file says into a draft.

    It adds the height of the hips in the draft's own pose to `heights`.
    """

    def refine(draft: str) -> str:
        write_text(config, draft)
        info = _info(config)
        heights.append(float(info["base_height"] + info["hip_height"]))
        return refined(draft, described, Slots.of(info), origin, posed=posed and described.pose is not None)

    return refine


def _judged(config: Path, read: _Found) -> tuple[dict[str, judge.Errors], str | None]:
    """The comparison with MuJoCo in both precisions, or why there is none."""
    try:
        if read.described is not None and read.compiled is not None:
            model, base, described = read.compiled.model, read.compiled.base, read.described
        else:
            model, base, described = urdf.reference(read.original, judge.base_link(config), {})
    except _core.ConfigError as error:
        return {}, f"not compared with MuJoCo: {error}"
    held = _held(config)
    described = dataclasses.replace(described, held={**described.held, **held})
    return {dtype: judge.compare(config, described, model, base, dtype=dtype) for dtype in judge.BOUNDS}, None


def _held(config: Path) -> dict[str, float]:
    held: dict[str, float] = tomllib.loads(config.read_text(encoding="utf-8")).get("locked_joints", {})
    return held


def _check(errors: Mapping[str, judge.Errors], file: Path) -> None:
    """Raises ConfigError where a robot does not move as MuJoCo's model."""
    for dtype, each in errors.items():
        if not each.worst() <= judge.BOUNDS[dtype]:
            name, worst = max(dataclasses.asdict(each).items(), key=lambda item: item[1])
            raise _core.ConfigError(
                f"{file}: {name}: what is read of it differs from MuJoCo's model by {worst:.1e} in {dtype}, more than "
                f"{judge.BOUNDS[dtype]:g}; nothing is written. Please report the file"
            )


def _source(
    name: str, read: _Found, found: sources.Source, notes: list[str], errors: Mapping[str, judge.Errors]
) -> str:
    """The text of SOURCE.md."""
    licence = "see `LICENSE`" if found.license is not None else "no file with it was found next to the source"
    if found.license_name:
        licence = f"{found.license_name}, {licence}"
    reader = "polypod's URDF reader" if found.kind != "mjcf" else f"MuJoCo {metadata.version('mujoco')}"
    lines = [f"# {name}", "", "## Origin", "", f"- Source: `{found.origin}`, `{found.file.name}`"]
    lines += [f"- Licence: {licence}", f"- Read by {reader} and written by polypod {_core.__version__}", ""]
    lines += ["## Deviations", "", *[f"- {_escaped(note)}" for note in notes or ["none"]], ""]
    if read.described is not None:
        lines += _table(read.described)
    if read.model is not None:
        lines += [
            "## MuJoCo's model",
            "",
            f"`{kept.NAME}`: what MuJoCo compiles of the file, without what is only seen.",
        ]
        lines += ["`polypod accuracy` compares the robot with it; `polypod sim2sim --model` plays policies on it.", ""]
    if errors:
        lines += ["## How it was checked", "", "Largest relative difference from MuJoCo's model of the file:", ""]
        lines += ["| | " + " | ".join(errors) + " |", "|---|" + "---|" * len(errors)]
        for field in dataclasses.fields(judge.Errors):
            figures = (f"{getattr(each, field.name):.0e}" for each in errors.values())
            lines.append(f"| {field.name} | " + " | ".join(figures) + " |")
        lines.append("")
    return "\n".join(lines)


def _escaped(text: str) -> str:
    return " ".join(text.split()).replace("<", "&lt;").replace("|", "\\|")


def _table(described: Description) -> list[str]:
    """The joints as the file has them."""
    lines = ["## Joints of the file", ""]
    lines += [
        "| joint | range | kp | kd | effort | armature | damping | friction | spring |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for joint in described.joints:
        drive = joint.drive
        cells: list[Any] = [f"{joint.lower:.4g} to {joint.upper:.4g}"]
        cells += [None, None, None] if drive is None else [drive.stiffness, drive.damping, drive.effort]
        cells += [joint.armature, joint.damping, joint.friction, joint.stiffness]
        shown = ("" if cell is None else cell if isinstance(cell, str) else f"{cell:.6g}" for cell in cells)
        lines.append(f"| {_escaped(joint.name)} | " + " | ".join(shown) + " |")
    return [*lines, ""]
