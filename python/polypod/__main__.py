"""The `polypod` command."""

import os
import sys
from collections.abc import MutableMapping

from polypod import interrupts, quick_start

_SPIN_COUNT = "1000"
"""Turns, some microseconds, that an idle thread of torch's OpenMP (libgomp) spins before it
sleeps."""


def spin_briefly(environ: MutableMapping[str, str]) -> None:
    """Has torch's idle threads leave the cores to others, unless the user has set how they wait.

    By default they spin for milliseconds. Simulator and learner take turns on the same cores, and
    where other programs compute too, threads that spin keep the one they wait for from its core.
    """
    if not environ.keys() & {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}:
        environ["GOMP_SPINCOUNT"] = _SPIN_COUNT


def main() -> int:
    """Runs the command line.

    Returns its exit code: 0, 2 for bad input, 1 for internal errors, 130 after Ctrl-C.
    """
    try:
        interrupts.watch()
        spin_briefly(os.environ)  # libgomp reads it when torch is imported
        quick_start.skip_compiler()
        from polypod import cli

        return cli.main(sys.argv[1:])
    except KeyboardInterrupt:
        return interrupts.ended()
    except Exception:
        if interrupts.happened():
            return interrupts.ended()
        raise


if __name__ == "__main__":
    sys.exit(main())
