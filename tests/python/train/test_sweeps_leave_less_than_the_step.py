"""The solver's usual sweeps are no worse than the physics step, which 0.5 ms shows."""

import pytest

from common import size, some
from lab.accuracy import sweeps
from lab.accuracy.bounds import exceeded
from lab.accuracy.sweeps import COUNTS, USUAL, compare_sweeps
from polypod.mujoco_model.robot import load, names


@pytest.fixture(autouse=True)
def converged(monkeypatch: pytest.MonkeyPatch) -> None:
    """The core tier takes half the sweeps of the converged solution.

    This changes `left` over `step` by 1.5 %.
    """
    monkeypatch.setattr(sweeps, "CONVERGED", size(sweeps.CONVERGED // 2, sweeps.CONVERGED))


CORE = ("anymal_b", "phantomx", "spot", "unitree_b2", "unitree_h1")
"""Robots of the core tier, those that leave most among them; the extended tier takes all."""


@pytest.mark.parametrize("name", some(names(), CORE))
def test_sweeps_leave_less_than_the_step(name: str) -> None:
    found = compare_sweeps(load(name))
    assert not exceeded(found)
    # a heavy trunk on light legs and flat feet, without a warm start
    assert (found.left[USUAL] < 0.7 * found.step) == (name != "unitree_h1")
    # and more of them converge
    left = [found.left[count] for count in COUNTS]
    assert left == sorted(left, reverse=True)
    assert left[-1] > 0.0
