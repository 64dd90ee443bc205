"""Adaptive sampling of the frames where episodes begin: segments that fail come more often.

As in BeyondMimic, a clip is cut into bins of about a second. Failures of a bin are counted and
smoothed over time; a kernel also counts a failure for the bins before it, since a fall begins
earlier; a uniform share remains.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod.arrays import Array
from polypod.motions.options import SamplingOptions
from polypod.python_terms import Memory
from polypod.python_terms.declarations import memory

Ids = npt.NDArray[np.int64]


class Bins:
    """Bins of all clips, for each robot."""

    def __init__(self, durations: Sequence[float], options: SamplingOptions, robots: int) -> None:
        """Cuts clips of these lengths, s."""
        self.options = options
        self.counts = np.array([max(1, round(duration / options.bin_s)) for duration in durations], dtype=np.int64)
        """Number of bins of each clip, [clips]."""
        self.first = np.cumsum(self.counts) - self.counts
        self.total = int(self.counts.sum())
        """Bins of a robot."""
        self.robots = robots
        # probability without failures: every second is equally likely
        self._uniform = np.repeat(np.asarray(durations, dtype=np.float64) / self.counts, self.counts)
        self._uniform /= self._uniform.sum()

    def memories(self) -> list[Memory]:
        """Arrays that snapshots hold: smoothed failures, and those since the last control step."""
        size = self.total * self.robots
        return [memory(name, size=size, dtype="float64", per_env=False) for name in ("motion_failed", "motion_failing")]

    def decay(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Adds the failures of a control step to their running mean."""
        alpha = self.options.alpha
        arrays["motion_failed"][:] = (1.0 - alpha) * arrays["motion_failed"] + alpha * arrays["motion_failing"]
        arrays["motion_failing"][:] = 0.0

    def count(self, arrays: Mapping[str, npt.NDArray[Any]], robot: int, clip: Ids, share: Array) -> None:
        """Counts failures of a robot at these shares of their clips."""
        np.add.at(arrays["motion_failing"], robot * self.total + self.bin_of(clip, share), 1.0)

    def bin_of(self, clip: Ids, share: Array) -> Ids:
        """Index of the bin of a robot."""
        inner = np.minimum((share * self.counts[clip]).astype(np.int64), self.counts[clip] - 1)
        found: Ids = self.first[clip] + inner
        return found

    def probabilities(self, arrays: Mapping[str, npt.NDArray[Any]], robot: int) -> Array:
        """Probabilities of a robot's bins, [bins]; they add up to one."""
        if not self.options.adaptive:
            return self._uniform.copy()
        failed = arrays["motion_failed"][robot * self.total : (robot + 1) * self.total]
        weights = failed + self.options.uniform_ratio * self._uniform
        kernel = self.options.kernel_lambda ** np.arange(self.options.kernel_size)
        kernel = kernel / kernel.sum()
        spread = np.zeros_like(weights)
        for begin, count in zip(self.first, self.counts, strict=True):
            own = weights[begin : begin + count]
            for ahead, factor in enumerate(kernel):
                # beyond a clip's end its last bin goes on
                at = np.minimum(np.arange(count) + ahead, count - 1)
                spread[begin : begin + count] += factor * own[at]
        likely: Array = spread / spread.sum()
        return likely

    def sample(self, arrays: Mapping[str, npt.NDArray[Any]], robot: int, drawn: Array) -> tuple[Ids, Array]:
        """Clips [n], and shares of them [n] at which to begin, of uniform numbers [n, 2]."""
        edges = np.cumsum(self.probabilities(arrays, robot))
        at = np.minimum(np.searchsorted(edges, drawn[:, 0] * edges[-1], side="right"), self.total - 1)
        clip = np.searchsorted(self.first, at, side="right") - 1
        return clip, (at - self.first[clip] + drawn[:, 1]) / self.counts[clip]

    def curves(self, arrays: Mapping[str, npt.NDArray[Any]], robot: int) -> dict[str, float]:
        """Entropy against the uniform distribution's, and the likeliest bin."""
        p = self.probabilities(arrays, robot)
        entropy = -float((p * np.log(np.maximum(p, 1e-12))).sum()) / max(float(np.log(len(p))), 1e-12)
        return {"entropy": entropy, "top1_prob": float(p.max()), "top1_bin": float(p.argmax()) / len(p)}
