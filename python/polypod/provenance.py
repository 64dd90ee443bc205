"""When, where and with which build something was measured."""

import os
import platform
import subprocess
from datetime import datetime, timezone
from pathlib import Path
from typing import TypedDict

from polypod import _core


class GitState(TypedDict):
    """State of the source tree that polypod is imported from."""

    commit: str
    dirty: bool
    """Whether tracked files differ from the commit."""


class Measured(TypedDict):
    """Origin of a measurement."""

    date: str
    """UTC, YYYY-MM-DD."""
    machine: str
    """Processor, number of cores and instruction set."""
    commit: str
    """First digits of the commit, with `+` where tracked files differ from it; the version of an
    installed package."""


def measured() -> Measured:
    """Returns today's date, this machine and this build."""
    state = git_state()
    commit = f"version {_core.__version__}" if state is None else state["commit"][:9] + "+" * state["dirty"]
    machine = f"{cpu()}, {os.cpu_count()} cores, {_core.info()['simd']}"
    return {"date": datetime.now(timezone.utc).strftime("%Y-%m-%d"), "machine": machine, "commit": commit}


def sentence(origin: Measured) -> str:
    """The line that stands with a table of measurements."""
    return f"Measured on {origin['date']}, {origin['machine']}, commit {origin['commit']}."


def cpu() -> str:
    """Name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def git_state() -> GitState | None:
    """Commit and cleanness of polypod's source tree; None for an installed package."""
    package = Path(_core.__file__ or __file__).parent

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(package), *arguments], capture_output=True, text=True, timeout=10)
        except (OSError, subprocess.SubprocessError):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    if not git("ls-files", "__init__.py"):
        return None
    commit, changes = git("rev-parse", "HEAD"), git("status", "--porcelain", "--untracked-files=no")
    return None if commit is None or changes is None else {"commit": commit, "dirty": bool(changes)}
