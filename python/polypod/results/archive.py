"""Folders of results as one compressed file, `.tar.xz`."""

import contextlib
import io
import lzma
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path

from polypod import _core
from polypod.files import read_bytes

MAX_COMPRESSED = 64 << 20
"""Bytes of an archive, at most."""
MAX_UNPACKED = 256 << 20
"""Bytes that an archive may unpack to. A few hundred runs with their curves take a tenth of it."""
MAX_MEMBERS = 100_000
_MAX_MEMORY = 256 << 20
"""Bytes that the decompressor may take. `xz -9` needs 65 MiB."""


@contextlib.contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """A temporary folder with the content of an archive.

    Files and folders alone are unpacked, inside the temporary folder, and no more than `MAX_UNPACKED` bytes.

    Raises:
        ConfigError: for a file that is no such archive, that is damaged or too large, or that holds anything else.
    """
    try:
        data = _decompressed(read_bytes(path, MAX_COMPRESSED), path)
    except OSError as error:
        raise _core.ConfigError(f"cannot read {path}: {error.strerror}") from error
    with tempfile.TemporaryDirectory(prefix="polypod-results-") as folder:
        try:
            _extract(data, Path(folder))
        except (tarfile.TarError, OSError, UnicodeError, ValueError) as error:
            raise _core.ConfigError(f"cannot unpack {path}: {error}; pack the folder again with tar -cJf") from error
        yield Path(folder)


def _decompressed(data: bytes, path: Path) -> bytes:
    try:
        decompressor = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MAX_MEMORY)
        content = decompressor.decompress(data, MAX_UNPACKED + 1)
    except lzma.LZMAError as error:
        raise _core.ConfigError(f"{path} is no .tar.xz: {error}; pass a folder, or pack one with tar -cJf") from error
    if len(content) > MAX_UNPACKED:
        raise _core.ConfigError(f"{path} unpacks to more than {MAX_UNPACKED >> 20} MiB; choose another file")
    if not decompressor.eof or decompressor.unused_data:
        raise _core.ConfigError(f"{path} is cut off or has something behind its end; copy it again")
    return content


def _extract(data: bytes, folder: Path) -> None:
    with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
        for count, member in enumerate(archive):
            if count >= MAX_MEMBERS:
                raise ValueError(f"it holds more than {MAX_MEMBERS} files")
            if not (member.isreg() or member.isdir()):
                raise ValueError(f"{member.name[:80]!r} is neither a file nor a folder")
            if member.issparse() or member.size > len(data):
                raise ValueError(f"{member.name[:80]!r} has more bytes than the archive")
            archive.extract(member, folder, filter="data")
