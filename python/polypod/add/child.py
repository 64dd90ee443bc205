"""Files of strangers, read first in another process within bounds of time and memory."""

import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

MEMORY = 8 << 30
"""Bytes of address space that MuJoCo may take for a file."""
PATIENCE = 10
"""Times its computing time that a process may take: on a busy machine it waits for others."""
_MOST_ANSWER = 64 << 20


class UnansweredError(Exception):
    """The process was ended, or ended itself, without an answer; the text says how."""


def ask(
    script: str,
    request: object,
    seconds: float,
    *,
    folder: Path | None = None,
    environment: Mapping[str, str] | None = None,
) -> Any:
    """Runs a script of this package, which reads a request and answers, both as JSON.

    Args:
        script: the path of the script.
        request: goes to its standard input.
        seconds: computing time that it may take; it has to bound itself, with `bound`.
        folder: where it runs; None: in an empty folder that is removed at the end.
        environment: of the process; None: that of this one.

    Returns:
        The last line of its standard output.

    Raises:
        UnansweredError: for a process that takes longer, or ends without an answer.
    """
    with tempfile.TemporaryDirectory() as empty:
        try:
            done = subprocess.run(
                [sys.executable, "-I", script],
                input=json.dumps(request).encode(),
                capture_output=True,
                timeout=PATIENCE * seconds,
                check=False,
                env=environment,
                cwd=folder or empty,
            )
        except subprocess.TimeoutExpired:
            raise UnansweredError(f"takes more than {PATIENCE * seconds:g} s") from None
    if hasattr(signal, "SIGXCPU") and done.returncode == -signal.SIGXCPU:
        raise UnansweredError(f"takes more than {seconds:g} s of computing")
    if len(done.stdout) > _MOST_ANSWER:
        raise UnansweredError(f"makes more than {_MOST_ANSWER >> 20} MiB of it")
    try:
        return json.loads(done.stdout.splitlines()[-1])
    except (IndexError, ValueError):
        raise UnansweredError(f"ends at it (exit code {done.returncode})") from None


def bound(**most: int) -> None:
    """Bounds this process, where the system can: `as`, `cpu`, `fsize` and `core` of `setrlimit`."""
    try:
        import resource
    except ImportError:
        return
    for name, value in most.items():
        kind = getattr(resource, f"RLIMIT_{name.upper().strip('_')}", None)
        if kind is not None:
            _, hard = resource.getrlimit(kind)
            least = value if hard == resource.RLIM_INFINITY else min(value, hard)
            # at the hard limit of computing time a process ends without a word
            resource.setrlimit(kind, (least, hard if name == "cpu" else least))
