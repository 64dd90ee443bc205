"""Random numbers of envs for terms in Python."""

import hashlib
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

_STEP = np.uint64(0x9E3779B97F4A7C15)
_FACTORS = (np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB))
_UNIT = np.float32(2.0**-24)
"""Spacing of the float32 numbers that are drawn from [0, 1)."""

Ids = npt.NDArray[np.int64]


class EnvRandom:
    """A stream of random numbers for each env.

    The numbers of an env depend on the seed, its robot, its place in that robot's envs, and how
    many were drawn for it before: not on the other envs. Checkpoints hold the streams. The
    generator is SplitMix64, with integer and float32 arithmetic alone: it gives the same bits on
    any machine.
    """

    def __init__(self, seed: int, blocks: Sequence[tuple[str, int, int]]) -> None:
        """Begins the streams.

        Args:
            seed: of the simulation.
            blocks: name, first env and end of each robot.
        """
        self._blocks = list(blocks)
        self.counters: npt.NDArray[np.uint64] = np.zeros(max(end for _, _, end in blocks), dtype=np.uint64)
        """uint64 [num_envs], how many numbers were drawn."""
        self.begin(seed)

    def begin(self, seed: int) -> None:
        """Begins the streams of a seed."""
        self.counters[:] = 0
        self._keys = np.zeros_like(self.counters)
        for robot, start, end in self._blocks:
            digest = hashlib.sha256(f"{seed}/{robot}".encode()).digest()
            places = np.arange(end - start, dtype=np.uint64)
            with np.errstate(over="ignore"):
                self._keys[start:end] = _mixed(np.uint64(int.from_bytes(digest[:8], "little")) + places * _STEP)

    def uniform(self, low: float, high: float, ids: Ids, size: int = 1) -> npt.NDArray[np.float32]:
        """Numbers in [low, high), float32 [len(ids), size]."""
        unit = (self._bits(ids, size) >> np.uint64(40)).astype(np.float32) * _UNIT
        return np.float32(low) + np.float32(high - low) * unit

    def integers(self, low: int, high: int, ids: Ids, size: int = 1) -> npt.NDArray[np.int64]:
        """Whole numbers from low to high, without high, int64 [len(ids), size]."""
        drawn = (self._bits(ids, size) >> np.uint64(32)) * np.uint64(high - low) >> np.uint64(32)
        return low + drawn.astype(np.int64)

    def _bits(self, ids: Ids, size: int) -> npt.NDArray[np.uint64]:
        """uint64 [len(ids), size]."""
        with np.errstate(over="ignore"):
            counters = self.counters[ids][:, np.newaxis] + np.arange(size, dtype=np.uint64)
            bits = _mixed(self._keys[ids][:, np.newaxis] + (counters + np.uint64(1)) * _STEP)
        self.counters[ids] += np.uint64(size)
        return bits


def _mixed(numbers: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """SplitMix64's output function."""
    numbers = (numbers ^ (numbers >> np.uint64(30))) * _FACTORS[0]
    numbers = (numbers ^ (numbers >> np.uint64(27))) * _FACTORS[1]
    return numbers ^ (numbers >> np.uint64(31))
