"""A watch over what a test's process starts and writes."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polypod

_STARTS = ("os.system", "os.exec", "os.posix_spawn", "os.fork", "os.forkpty", "subprocess.Popen", "socket.connect")
"""Events of Python's audit hooks that start a process or leave the machine."""

_seen: list[str] = []
_watching = False


_GIT = ["git", "-C", str(Path(polypod.__file__).parent)]
"""How polypod asks for the commit that it is, whatever the files say that it reads."""


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "subprocess.Popen" and list(arguments[1])[:3] == _GIT:
        return
    if _watching and (event in _STARTS or (event == "open" and _writes(*arguments))):
        _seen.append(f"{event} {arguments!r}")


def _writes(path: object, mode: str | None, flags: int) -> bool:
    if not isinstance(path, str) or path.endswith("/.lock") or path.startswith(("/dev/", "/proc/")):
        return False
    if "__pycache__" in path:
        return False
    return bool(mode and set(mode) & set("wax+")) or bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))


sys.addaudithook(_hook)


@contextlib.contextmanager
def nothing_started() -> Iterator[None]:
    """Fails when a process is started or a file opened for writing meanwhile."""
    global _watching
    _seen.clear()
    _watching = True
    try:
        yield
    finally:
        _watching = False
    assert not _seen
