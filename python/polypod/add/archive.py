"""Zip files of strangers, unpacked within bounds."""

import stat
import zipfile
from pathlib import Path, PurePosixPath

from polypod import _core

MOST_FILES = 4096
"""Entries of an archive."""
MOST_BYTES = 1 << 30
"""Size of all files together, unpacked."""
_PIECE = 1 << 20


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
                place.parent.mkdir(parents=True, exist_ok=True)
                left = _copy(archive, opened, entry, place, left)
    except (zipfile.BadZipFile, zipfile.LargeZipFile, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        if isinstance(error, _core.PolypodError):
            raise
        text = " ".join(str(error).split())
        raise _refused(archive, f"it is no zip file that can be read: {text}", "unpack it yourself") from error


def _copy(archive: Path, opened: zipfile.ZipFile, entry: zipfile.ZipInfo, place: Path, left: int) -> int:
    """Unpacks one file; returns how many bytes may still come."""
    with opened.open(entry) as source, place.open("xb") as target:
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
