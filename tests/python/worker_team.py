"""Runs `polypod` as several workers: forks of a process that has imported all it needs.

torchrun takes seconds.
"""

import contextlib
import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from fork_server import _become_polypod, _waited


class WorkerTeam:
    """The process that forks, as the tests see it."""

    def __init__(self) -> None:
        """Starts it."""
        pipe = subprocess.PIPE
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "300"}
        self._running: list[int] = []
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=pipe, stdout=pipe, text=True, env=environment
        )

    def start(
        self, count: int, words: tuple[str, ...], folder: Path, own: dict[int, dict[str, Any]] | None = None
    ) -> list[int]:
        """Starts `polypod` with `words` as `count` workers in folders of `folder`.

        Returns their processes.

        `own` are further `words` of some workers, and what else is in their `environment`.
        """
        for process in self._running:  # a test failed before they ended
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        if self._running:
            self._answer()
        self.folders = [folder / f"worker_{index}" for index in range(count)]
        for path in self.folders:
            path.mkdir(exist_ok=True)
        request = {"words": words, "folders": list(map(str, self.folders)), "own": own or {}}
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        self._running = self._answer()
        return self._running

    def ended(self) -> list[tuple[int, str]]:
        """Waits for all workers; returns exit code and standard error of each."""
        codes = self._answer()
        self._running = []
        return [
            (code, (folder / ".errors").read_text(errors="replace"))
            for code, folder in zip(codes, self.folders, strict=True)
        ]

    def run(self, count: int, *words: str, folder: Path, own: Any = None) -> list[tuple[int, str]]:
        """Starts the workers and waits for them."""
        self.start(count, words, folder, own)
        return self.ended()

    def close(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(timeout=60)

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())


def _serve() -> None:
    import rsl_rl.runners  # noqa: F401

    import polypod.training.session  # noqa: F401

    for line in sys.stdin:
        request = json.loads(line)
        folders, own = request["folders"], request["own"]
        port = _free_port()
        children = []
        for index, folder in enumerate(folders):
            child = os.fork()
            if child == 0:
                mine = own.get(str(index), {})
                ranks = {
                    "RANK": index,
                    "LOCAL_RANK": index,
                    "WORLD_SIZE": len(folders),
                    "LOCAL_WORLD_SIZE": len(folders),
                }
                place = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
                for name, value in {**ranks, **place, **mine.get("environment", {})}.items():
                    os.environ[name] = str(value)
                try:
                    _become_polypod([*request["words"], *mine.get("words", [])], folder, 60.0, 0, None)
                finally:
                    os._exit(70)
            children.append(child)
        print(json.dumps(children), flush=True)
        end = time.monotonic() + 60.0
        statuses = [_waited(child, max(0.1, end - time.monotonic()))[0] for child in children]
        print(json.dumps([os.waitstatus_to_exitcode(status) for status in statuses]), flush=True)


def _free_port() -> int:
    """A port below those that the system gives to callers that ask for any.

    gloo and the neighbouring tests ask for any.
    """
    for port in random.sample(range(20_000, 32_000), 100):
        with contextlib.closing(socket.socket()) as probe:
            if probe.connect_ex(("127.0.0.1", port)):
                return port
    raise OSError("no port is free")


if __name__ == "__main__":
    _serve()
