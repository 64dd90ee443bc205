"""Rates that are measured in turn, so that a machine that slows down slows all of them."""

import time
from collections.abc import Callable, Mapping, Sequence
from statistics import median

Sample = Callable[[], int]
"""Does some work and returns how much, in the unit of the rate."""


def rates(samples: Mapping[str, Sample], seconds: float, rounds: int) -> dict[str, list[float]]:
    """Rates of each sample, one per round.

    Args:
        samples: by name; each is called once before anything is timed.
        seconds: least time for which a round repeats a sample.
        rounds: number of turns.

    Returns:
        Work per second.
    """
    measured: dict[str, list[float]] = {name: [] for name in samples}
    for sample in samples.values():
        sample()
    for _ in range(rounds):
        for name, sample in samples.items():
            work, start = 0, time.perf_counter()
            while True:
                work += sample()
                elapsed = time.perf_counter() - start
                if elapsed >= seconds:
                    break
            measured[name].append(work / elapsed)
    return measured


def medians(measured: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """The middle rate of each."""
    return {name: median(rates) for name, rates in measured.items()}
