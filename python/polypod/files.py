"""Files that a command reads, up to a size, and writes.

They are written whole or not at all, and never in place of what is not a regular file.
"""

import contextlib
import errno
import io
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from polypod import _core

ENDLESS = 64 << 20
"""Bytes that are read of what is not a regular file, at most."""
_PIECE = 1 << 20
"""Bytes that are asked for at once of what has no size."""
_PROCESS = re.compile(r"/dev/(stdin|stdout|stderr|fd/\d+)|/proc/[^/]+/fd/\d+")
"""Names of what this process has open already, maybe a file that the shell also writes to."""
_TEMPORARY = re.compile(r"\..+\.[^.]{8}\.tmp")
"""Names of the files that `write_bytes` fills before it puts them in their place."""


def read_bytes(path: Path, limit: int) -> bytes:
    """Reads at most `limit` bytes of a file.

    At most `ENDLESS` of a device or a pipe, which need not end.

    Memory is taken for what is there, not for what may be: a regular file is read at once, anything
    else, or a file that grows meanwhile, piece by piece.

    Raises:
        OSError: where it cannot be read.
        ConfigError: where there are more.
    """
    with path.open("rb") as file:
        state = os.fstat(file.fileno())
        if not stat.S_ISREG(state.st_mode):
            limit = min(limit, ENDLESS)
            size = _PIECE
        else:
            size = state.st_size
        pieces = []
        left = 0 if state.st_size > limit else limit + 1
        # one byte more than a file has tells whether it ends there
        while left > 0 and (piece := file.read(min(left, max(size, 1) + 1))):
            pieces.append(piece)
            left -= len(piece)
            size = _PIECE
        data = pieces[0] if len(pieces) == 1 else b"".join(pieces)
    if max(len(data), state.st_size) > limit:
        raise _core.ConfigError(
            f"{path} has more than {limit >> 20} MiB, too many for what it should be; choose another file"
        )
    return data


def real_path(path: str | os.PathLike[str]) -> Path:
    """The absolute path without symbolic links.

    Unlike `Path.resolve` it raises nothing at links in a circle.
    """
    return Path(os.path.realpath(path))


def relative_path(file: Path, folder: Path) -> str:
    """The way from a folder to a file, with forward slashes; whole where no way leads there."""
    try:
        return Path(os.path.relpath(file, real_path(folder))).as_posix()
    except ValueError:  # another drive
        return file.as_posix()


def write_text(path: Path, text: str) -> None:
    """Writes a text in UTF-8. Errors are those of `write_bytes`."""
    write_bytes(path, text.encode())


def write_filled(path: Path, fill: Callable[[BinaryIO], Any]) -> None:
    """Writes what `fill` puts into a file in memory.

    Errors are those of `write_bytes`, and those of `fill`.
    """
    buffer = io.BytesIO()
    fill(buffer)
    write_bytes(path, buffer.getbuffer())


def write_bytes(path: Path, data: "bytes | memoryview") -> None:
    """Writes a file whole or not at all, in place of nothing or of a regular file.

    Folders are made.

    A symbolic link stays and its target is written. Pipes and devices are written to and stay what
    they are.

    Raises:
        OSError: where it cannot be written.
    """
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "a name holds no zero byte")
    if _PROCESS.fullmatch(str(path)) or _is_special(path):
        with path.open("ab") as file:
            file.write(data)
        return
    target = Path(os.path.realpath(path))
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name[:100]}.", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        Path(name).chmod(_mode(target))
        Path(name).replace(target)
    finally:
        Path(name).unlink(missing_ok=True)
    _sync_folder(target.parent)


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A temporary folder to write into.

    It takes the place of `path` at the end of the block, whole or not at all.

    Files go over those of a folder that is there and not empty, each whole or not at all.

    Raises:
        OSError: where it cannot be written.
    """
    target = real_path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name[:100]}.", suffix=".tmp"))
    try:
        yield folder
        if target.is_dir() and any(target.iterdir()):
            for file in sorted(found for found in folder.rglob("*") if found.is_file()):
                place = target / file.relative_to(folder)
                place.parent.mkdir(parents=True, exist_ok=True)
                file.replace(place)
        else:
            mask = os.umask(0)
            os.umask(mask)
            folder.chmod(0o777 & ~mask)
            if target.is_dir():
                target.rmdir()
            folder.replace(target)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    _sync_folder(target.parent)


def remove_stale(folder: Path) -> None:
    """Removes what writers that were killed left in a folder where nobody else writes now."""
    for path in folder.glob(".*.tmp"):
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


def _is_special(path: Path) -> bool:
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return False
    return not stat.S_ISREG(mode)


def _mode(target: Path) -> int:
    """The permissions of an existing file; for a new one, the process' default."""
    try:
        return stat.S_IMODE(target.stat().st_mode)
    except FileNotFoundError:
        mask = os.umask(0)
        os.umask(mask)
        return 0o666 & ~mask


def _sync_folder(folder: Path) -> None:
    """Has the disk take note of new names, where folders can be opened."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
