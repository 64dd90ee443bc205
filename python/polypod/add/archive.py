"""Zip files of strangers, unpacked within bounds."""

import html
import itertools
import os
import re
import stat
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from polypod import _core

MOST_FILES = 4096
"""Entries of an archive."""
MOST_BYTES = 1 << 30
"""Size of all files together, unpacked."""
MOST_NAMES = 1_000_000
"""Places of files that an MJCF file may name."""
_PIECE = 1 << 20
_NAMED = re.compile(rb"""\b(file\w*|meshdir|texturedir|assetdir)\s*=\s*(?:"([^"]*)"|'([^']*)')""")
"""Attributes of MJCF that name a file, or a folder of files."""


def unpack(archive: Path, folder: Path) -> None:
    """Unpacks the regular files of a zip file into a folder.

    Names stay below the folder. The sizes that count are those of what is unpacked, not what the
    archive states.

    Raises:
        ConfigError: for what is no zip file, is encrypted or damaged, for links and names that lead
            elsewhere, and for more than `MOST_FILES` files or `MOST_BYTES`.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            entries = [entry for entry in opened.infolist() if not entry.is_dir()]
            if len(entries) > MOST_FILES:
                raise _refused(archive, f"it has {len(entries)} files, more than {MOST_FILES}", "unpack what you need")
            left = MOST_BYTES
            for entry in entries:
                place = folder.joinpath(*_parts(archive, entry))
                left = _copy(archive, opened, entry, place, left)
    except (zipfile.BadZipFile, zipfile.LargeZipFile, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        if isinstance(error, _core.PolypodError):
            raise
        text = " ".join(str(error).split())
        raise _refused(archive, f"it is no zip file that can be read: {text}", "unpack it yourself") from error


def _copy(archive: Path, opened: zipfile.ZipFile, entry: zipfile.ZipInfo, place: Path, left: int) -> int:
    """Unpacks one file; returns how many bytes may still come."""
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        target = place.open("xb")
    except OSError as error:
        # two entries of one name, a file in the place of a folder, a name that no file may have
        problem = f"{entry.filename[:80]!r} cannot be unpacked: {error.strerror}"
        raise _refused(archive, problem, "unpack what you need") from error
    with target, opened.open(entry) as source:
        while piece := source.read(_PIECE):
            left -= len(piece)
            if left < 0:
                raise _refused(archive, f"its files take more than {MOST_BYTES >> 20} MiB", "unpack what you need")
            target.write(piece)
    return left


def _parts(archive: Path, entry: zipfile.ZipInfo) -> tuple[str, ...]:
    name = entry.filename
    parts = PurePosixPath(name).parts
    leads_away = name.startswith("/") or "\\" in name or ":" in name or "\0" in name or ".." in parts or not parts
    if leads_away or stat.S_ISLNK(entry.external_attr >> 16):
        raise _refused(archive, f"{name!r} is a link or leads out of the archive", "unpack what you need")
    return parts


def _refused(archive: Path, problem: str, remedy: str) -> _core.ConfigError:
    return _core.ConfigError(f"{archive}: {problem}; {remedy}, and name the folder")


def check_inside(folder: Path, archive: str) -> None:
    """Raises ConfigError where an MJCF file of an archive names a file outside of it.

    MuJoCo reads any file that is named: by its place from the file that names it, or from one that
    includes that one, and from the folders of meshes and textures.

    Args:
        folder: the folder that the archive is unpacked in, without links above it.
        archive: the archive's name.
    """
    bases, folders = {folder}, {""}
    names: set[str] = set()
    for file in _texts(folder):
        bases.add(file.parent)
        for key, *values in _NAMED.findall(file.read_bytes()):
            value = html.unescape(b"".join(values).decode("utf-8", errors="replace")).replace("\\", "/")
            (names if key.startswith(b"file") else folders).add(value)
    leading = {name for name in names | folders if _may_lead_out(name)}
    if len(bases) * (len(folders & leading) * len(names) + len(folders) * len(names & leading)) > MOST_NAMES:
        raise _refused(Path(archive), f"its files name more than {MOST_NAMES} places", "unpack what you need")
    pairs = itertools.chain(
        itertools.product(folders & leading, names), itertools.product(folders - leading, names & leading)
    )
    for (above, name), base in itertools.product(pairs, bases):
        place = Path(os.path.normpath(base / above / name))
        if not place.is_relative_to(folder) and place.exists():
            raise _refused(Path(archive), f"{name[:200]!r} in it leads out of the archive", "unpack what you need")


def _may_lead_out(name: str) -> bool:
    return name.startswith("/") or ".." in name.split("/")


def _texts(folder: Path) -> Iterator[Path]:
    """Files that may be XML: a zero byte comes after the first `<`, if there is one."""
    for above, _, names in os.walk(folder):
        for file in (Path(above) / name for name in names):
            data = file.read_bytes()
            first = data.find(b"<")
            if first >= 0 and data.find(b"\0", 0, first) < 0:
                yield file
