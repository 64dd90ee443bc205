"""Sources of robots: a file, a folder, a zip file, or the name of a robot in another package."""

import contextlib
import dataclasses
import importlib
import importlib.util
import io
import os
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from polypod import _core
from polypod.add import archive
from polypod.files import read_bytes, real_path

SNIFFED = 1 << 16
"""Bytes in which the root element of a file stands."""
MOST_BYTES = 64 << 20
"""Largest URDF that is read."""
MOST_LICENSE = 1 << 20
DEEP = 6
"""Folders below the one that is searched."""
MOST_SEEN = 20_000
"""Files and folders that are looked through."""
ABOVE = 4
"""Folders above a file in which its licence is looked for."""
Kind = Literal["urdf", "xacro", "mjcf"]
_LICENSES = ("LICENSE*", "LICENCE*", "COPYING*", "License*", "license*")
_ENDINGS = (".urdf", ".xml", ".mjcf", ".xacro")
DESCRIPTIONS = (*_ENDINGS, ".zip")
"""Endings of files that describe a robot."""
_PACKAGES = ("robot_descriptions", "mujoco_menagerie")


@dataclasses.dataclass(frozen=True)
class Source:
    """A file that describes a robot."""

    kind: Kind
    file: Path
    origin: str
    """Text by which the user has named it."""
    license: str | None
    """The text of the licence next to it."""
    license_name: str | None = None
    """Licence that its package states."""
    arguments: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Arguments of a xacro file."""
    package_dirs: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    """ROS package -> folder."""
    within: Path | None = None
    """Folder of an unpacked archive, beyond which nothing is read; None: it is no archive."""


def is_description(name: str) -> bool:
    """Whether a text has the ending of a file that describes a robot."""
    return name.lower().endswith(DESCRIPTIONS)


@contextlib.contextmanager
def opened(source: str, inner: str | None = None) -> Iterator[Source]:
    """Finds the robot's file; what is unpacked for that is removed at the end of the block.

    Args:
        source: a file, a folder, a zip file, `robot_descriptions:NAME` or `mujoco_menagerie:NAME`.
        inner: the file within a folder or zip file, where several could be the robot.

    Raises:
        ConfigError: where there is no such file, or several could be meant.
    """
    origin, _, name = source.partition(":")
    if origin in _PACKAGES:
        if not re.fullmatch(r"[\w+.-]{1,100}", name, re.ASCII):
            raise _core.ConfigError(f"{source[:80]!r} names no robot; write {origin}:NAME")
        yield (_of_robot_descriptions if origin == "robot_descriptions" else _of_menagerie)(name, source)
        return
    if not source.strip() or "\0" in source:
        raise _core.ConfigError(f"{source!r} is no file; name a URDF, xacro or MJCF file, a zip file or a folder")
    path = Path(source)
    if _is_folder(path):
        yield _in_folder(path, source, inner)
    elif path.suffix.lower() == ".zip":
        _check_is_there(path)
        with tempfile.TemporaryDirectory(prefix="polypod-add-") as folder:
            place = real_path(folder)
            archive.unpack(path, place)
            try:
                found = _in_folder(place, source, inner)
                if found.kind == "mjcf":
                    archive.check_inside(place, source)
                yield dataclasses.replace(found, within=place)
            except _core.PolypodError as error:
                # names of files in the folder are those in the archive to the user
                text = str(error.args[0] if error.args else error)
                raise type(error)(text.replace(f"{place}{os.sep}", f"{source}/")) from error
    else:
        _check_is_there(path)
        if inner is not None:
            raise _core.ConfigError(f"--file {inner}: {path} is a file already; name a folder or a zip file")
        kind = _kind(path)
        if kind is None and _is_usd(path):
            raise _core.ConfigError(
                f"{path}: this is a USD file; export the robot as URDF or MJCF: Isaac Sim and USD tools can write them"
            )
        if kind is None:
            raise _core.ConfigError(
                f"{path}: it is neither a URDF nor a xacro, MJCF or zip file: its root element is not <robot> or "
                "<mujoco>; name the robot's file"
            )
        yield Source(kind, path, source, _license(path, None))


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:
        return False


def _check_is_there(path: Path) -> None:
    try:
        if path.is_file():
            return
    except OSError as error:
        raise _core.ConfigError(f"{str(path)[:200]}: {error.strerror}; name a robot's file") from error
    raise _core.ConfigError(
        f"{path}: there is no such file; name a URDF, xacro, MJCF or zip file, a folder, robot_descriptions:NAME or "
        "mujoco_menagerie:NAME"
    )


def _is_usd(path: Path) -> bool:
    """Whether a file is a scene of USD, by its first bytes or the ending of its name."""
    with path.open("rb") as file:
        head = file.read(8)
    return head.startswith((b"#usda", b"PXR-USDC")) or path.suffix.lower() in (".usd", ".usda", ".usdc", ".usdz")


def _kind(path: Path) -> Kind | None:
    """Kind of a file, by its root element."""
    name = path.name.lower()
    if name.endswith(".xacro"):
        return "xacro"
    if not name.endswith(_ENDINGS):
        return None
    with path.open("rb") as file:
        head = file.read(SNIFFED).decode("utf-8", errors="replace")
    head = re.sub(r"<!--.*?-->|<\?.*?\?>|<!DOCTYPE[^>]*>", "", head, flags=re.DOTALL).lstrip("\ufeff \t\r\n")
    root = re.match(r"<\s*([\w:.-]+)", head)
    kinds: dict[str, Kind] = {"robot": "urdf", "mujoco": "mjcf"}
    found = kinds.get(root[1]) if root else None
    if found is None and name.endswith(".urdf"):
        # the reader says what is wrong with it
        return "urdf"
    return found


def _files(folder: Path, origin: str) -> list[Path]:
    """Files of a folder and `DEEP` folders below, links to folders not followed.

    Raises ConfigError for too many.
    """
    found: list[Path] = []
    seen = 0
    for above, folders, names in os.walk(folder):
        seen += len(folders) + len(names)
        if seen > MOST_SEEN:
            raise _core.ConfigError(
                f"{origin}: it holds more than {MOST_SEEN} files; name the robot's file or its folder"
            )
        if len(Path(above).relative_to(folder).parts) >= DEEP:
            folders.clear()
        # hidden ones are no descriptions: those of a Mac in a zip file have the names of others
        folders[:] = [name for name in folders if not name.startswith(".") and name != "__MACOSX"]
        found += [Path(above) / name for name in names if name.lower().endswith(_ENDINGS) and name[0] != "."]
    return sorted(path for path in found if path.is_file())


def _in_folder(folder: Path, origin: str, inner: str | None) -> Source:
    """The robot's file in a folder. Raises ConfigError."""
    files = _files(folder, origin)
    if inner is not None:
        chosen = [path for path in files if path.relative_to(folder).as_posix() == inner]
        kind = _kind(chosen[0]) if chosen else None
        if kind is None:
            raise _core.ConfigError(
                f"{origin}: --file {inner}: there is no URDF, xacro or MJCF file of this name in it"
            )
        return Source(kind, chosen[0], origin, _license(chosen[0], folder))
    found = [(path, kind) for path in files if (kind := _kind(path)) is not None]
    for kinds in (("mjcf",), ("urdf",), ("xacro",)):
        own = [(path, kind) for path, kind in found if kind in kinds]
        parts = _included([path for path, _ in own])
        own = [(path, kind) for path, kind in own if path.name not in parts] or own
        robots = [(path, kind) for path, kind in own if "scene" not in path.stem.lower()] or own
        if len(robots) == 1:
            path, kind = robots[0]
            return Source(kind, path, origin, _license(path, folder))
        if robots:
            names = ", ".join(path.relative_to(folder).as_posix() for path, _ in robots[:8])
            more = f" and {len(robots) - 8} more" if len(robots) > 8 else ""
            raise _core.ConfigError(
                f"{origin}: {len(robots)} files could be the robot: {names}{more}; name one with --file"
            )
    raise _core.ConfigError(f"{origin}: no URDF, xacro or MJCF file is in it; name the folder that holds one")


def _included(files: list[Path]) -> set[str]:
    """Names of the files that others of them include, but for scenes that include a robot."""
    names = set()
    for path in files:
        if "scene" not in path.stem.lower():
            with contextlib.suppress(OSError, _core.ConfigError):
                text = read_bytes(path, MOST_BYTES).decode("utf-8", errors="replace")
                names |= {Path(name).name for name in re.findall(r"include[^>]*\bfile(?:name)?=[\"']([^\"']+)", text)}
    return names


def including(file: Path) -> list[Path]:
    """Files next to one that include it."""
    found = []
    for path in sorted(file.absolute().parent.glob("*.xml"))[:MOST_SEEN]:
        with contextlib.suppress(OSError, _core.ConfigError):
            text = read_bytes(path, MOST_BYTES).decode("utf-8", errors="replace")
            if re.search(rf"<include[^>]*\bfile=[\"']{re.escape(file.name)}[\"']", text):
                found.append(path)
    return found


def _license(file: Path, folder: Path | None) -> str | None:
    """Text of the licence next to a file or above it, within `folder` if there is one."""
    above = file.absolute().parent
    for _ in range(ABOVE):
        for pattern in _LICENSES:
            for path in sorted(above.glob(pattern)):
                if path.is_file():
                    with contextlib.suppress(OSError, UnicodeDecodeError, _core.ConfigError):
                        return read_bytes(path, MOST_LICENSE).decode("utf-8")
        is_end = above.name in ("site-packages", "dist-packages") or (above / ".git").exists()
        if is_end or above == above.parent or (folder is not None and above == folder.absolute()):
            break
        above = above.parent
    return None


# Other packages


def _package(name: str, origin: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise _core.ConfigError(f"{origin} needs the package {name.replace('_', '-')}: pip install {name}") from error


def _of_robot_descriptions(name: str, origin: str) -> Source:
    top = _package("robot_descriptions", origin)
    spellings = [name, f"{name}_description", f"{name}_mj_description"]
    module = next((each for each in spellings if importlib.util.find_spec(f"robot_descriptions.{each}")), None)
    if module is None or not module.endswith("_description"):
        raise _core.ConfigError(
            f"{origin}: robot_descriptions {_version(top)} has no robot of this name; see its README"
        )
    try:
        # a clone of the robot's repository, whose progress is no line of this command
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            description = importlib.import_module(f"robot_descriptions.{module}")
    except Exception as error:
        raise _unreachable(origin, error) from error
    place: tuple[Kind, str] | None = None
    for attribute, kind in (("MJCF_PATH", "mjcf"), ("URDF_PATH", "urdf"), ("XACRO_PATH", "xacro")):
        if place is None and hasattr(description, attribute):
            place = (kind, getattr(description, attribute))  # type: ignore[assignment]
    if place is None:
        raise _core.ConfigError(f"{origin}: it has neither a URDF nor an MJCF file; name another robot")
    package_path = Path(getattr(description, "PACKAGE_PATH", "."))
    folders = {package_path.name: package_path}
    folders |= {key: Path(folder) for key, folder in getattr(description, "XACRO_PACKAGE_PATHS", {}).items()}
    entries = importlib.import_module("robot_descriptions._descriptions").DESCRIPTIONS
    stated = getattr(entries.get(module), "license_spdx", None)
    arguments = {key: str(value) for key, value in getattr(description, "XACRO_ARGS", {}).items()}
    file = Path(place[1])
    return Source(place[0], file, origin, _license(file, None), stated, arguments, folders)


def _of_menagerie(name: str, origin: str) -> Source:
    menagerie = _package("mujoco_menagerie", origin)
    try:
        robot = menagerie.get(name)
    except Exception as error:
        raise _core.ConfigError(f"{origin}: {' '.join(str(error).split())}; see `mujoco-menagerie names`") from error
    try:
        folder = Path(robot.path(progress=None))
    except Exception as error:
        raise _unreachable(origin, error) from error
    entry: Any = robot.entry(robot.default_scene or robot.default_model)
    file = folder / entry.file
    return Source("mjcf", file, origin, _license(file, folder), robot.license)


def _unreachable(origin: str, error: Exception) -> _core.ConfigError:
    text = " ".join(str(error).split())[:300]
    return _core.ConfigError(
        f"{origin}: its package downloads it on first use, and that fails: {text or type(error).__name__}; connect to "
        "the network, or name a file or folder"
    )


def _version(module: Any) -> str:
    return str(getattr(module, "__version__", ""))
