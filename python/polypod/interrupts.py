"""Ctrl-C in the command line: one line and exit code 130, whatever a library does with it."""

import signal
import sys
import threading
from types import FrameType

EXIT_CODE = 130

_seen: list[int] = []


def watch() -> None:
    """Remembers each Ctrl-C from now on, and forgets earlier ones.

    It raises KeyboardInterrupt as before.

    Where interrupts are ignored, they stay so.
    """
    _seen.clear()
    if (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    ):
        signal.signal(signal.SIGINT, _remember)


def happened() -> bool:
    """Whether Ctrl-C was pressed since `watch`."""
    return bool(_seen)


def ended() -> int:
    """Says that Ctrl-C ended the command, and returns its exit code."""
    print("polypod: interrupted", file=sys.stderr)
    return EXIT_CODE


def _remember(number: int, frame: FrameType | None) -> None:
    _seen.append(number)
    signal.default_int_handler(number, frame)
