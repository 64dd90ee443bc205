"""Runs `polypod`, or a function, in forks of a process that has imported all it needs.

This saves seconds a run.

A hang, an abort or a `kill -9` reaches the fork alone. The process is a fresh one: a fork of the
tests' own would inherit what earlier tests have begun in it, such as torch's autograd.
"""

import contextlib
import dataclasses
import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_MODULES = ("evaluation", "export", "play.session", "sim2sim", "robustness", "training.session", "bench")
_LIBRARIES = ("mujoco", "onnx", "rsl_rl.runners", "torch.utils.tensorboard", "viser", "av", "tyro")

_MEMORY_UNIT = 1 if sys.platform == "darwin" else 1024
"""Bytes of the unit of a process's peak memory."""


@dataclasses.dataclass(frozen=True)
class Ended:
    """How a command ended.

    `code` is negative for a signal, that of SIGKILL where it took too long.
    """

    code: int
    output: str
    errors: str
    memory: int
    """Peak, bytes."""


class ForkServer:
    """The process, as the tests see it."""

    def __init__(self) -> None:
        """Starts it."""
        command = [sys.executable, __file__]
        pipe = subprocess.PIPE
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "300"}
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment)
        self._running: int | None = None

    def start(
        self,
        words: Iterable[str],
        folder: Path,
        seconds: float = 60.0,
        memory: int = 0,
        user: int | None = None,
        call: dict[str, Any] | None = None,
    ) -> int:
        """Starts `polypod` in `folder`, with bounds of time and memory, maybe as another user.

        With `call`, the function that it names runs in place of `polypod`. Returns the process.
        """
        if self._running is not None:  # a test failed before it ended
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._running, signal.SIGKILL)
            self._answer()
        self._folder = folder
        limits = {"folder": str(folder), "seconds": seconds, "memory": memory, "user": user}
        request = {"words": list(words), "call": call, **limits}
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        self._running = int(self._answer()["process"])
        return self._running

    def ended(self) -> Ended:
        """Waits for what was started last."""
        answer = self._answer()
        self._running = None
        said = [(self._folder / name).read_bytes().decode(errors="replace") for name in (".output", ".errors")]
        for name in (".output", ".errors"):
            (self._folder / name).unlink()
        return Ended(answer["code"], *said, answer["memory"])

    def run(self, *words: str, cwd: Path, seconds: float = 60.0, memory: int = 0, user: int | None = None) -> Ended:
        """Starts `polypod` and waits for it."""
        self.start(words, cwd, seconds, memory, user)
        return self.ended()

    def call(self, function: str, *, cwd: Path, seconds: float = 60.0, memory: int = 0, **arguments: Any) -> Ended:
        """Runs the function `module:name`, whose result is the exit code, and waits for it."""
        self.start((), cwd, seconds, memory, call={"function": function, "arguments": arguments})
        return self.ended()

    def close(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(timeout=60)

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        return dict(json.loads(self._process.stdout.readline()))


def _serve() -> None:
    for module in _MODULES:
        importlib.import_module(f"polypod.{module}")
    for module in _LIBRARIES:
        importlib.import_module(module)
    importlib.import_module("polypod.networks.onnx_session").runtime("the tests")
    for line in sys.stdin:
        request = json.loads(line)
        child = os.fork()
        if child == 0:
            try:
                _become_polypod(**request)
            finally:
                os._exit(70)
        print(json.dumps({"process": child}), flush=True)
        status, usage = _waited(child, request["seconds"])
        print(
            json.dumps({"code": os.waitstatus_to_exitcode(status), "memory": usage.ru_maxrss * _MEMORY_UNIT}),
            flush=True,
        )


def _become_polypod(
    words: list[str], folder: str, seconds: float, memory: int, user: int | None, call: dict[str, Any] | None = None
) -> None:
    import polypod.__main__

    os.setsid()
    os.chdir(folder)
    for name, number in ((os.devnull, 0), (".output", 1), (".errors", 2)):
        flags = os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC
        os.dup2(os.open(name, flags, 0o600), number)
    sys.stdin, sys.stdout, sys.stderr = open(0), open(1, "w"), open(2, "w")  # noqa: SIM115
    sys.argv = ["polypod", *words]
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if memory:
        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    if user is not None:
        os.setuid(user)
    try:
        code = _called(**call) if call else polypod.__main__.main()
    except SystemExit as left:
        code = left.code if isinstance(left.code, int) else 0
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)


def _called(function: str, arguments: dict[str, Any]) -> int:
    module, _, name = function.partition(":")
    try:
        return int(getattr(importlib.import_module(module), name)(**arguments))
    except Exception:
        traceback.print_exc()
        return 1


def _waited(child: int, seconds: float) -> tuple[int, resource.struct_rusage]:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found, status, usage = os.wait4(child, os.WNOHANG)
        if found:
            return status, usage
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    _, status, usage = os.wait4(child, 0)
    return status, usage


if __name__ == "__main__":
    _serve()
