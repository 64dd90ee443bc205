"""The solver's usual number of sweeps is no worse than the physics step itself, which 0.5 ms shows."""

import pytest

from common import size
from polypod.accuracy import sweeps
from polypod.accuracy.robot import load, names
from polypod.accuracy.sweeps import COUNTS, USUAL, compare_sweeps


@pytest.fixture(autouse=True)
def converged(monkeypatch: pytest.MonkeyPatch) -> None:
    """The core tier takes half the sweeps of the converged solution, which changes `left` over `step` by 1.5 %."""
    monkeypatch.setattr(sweeps, "CONVERGED", size(sweeps.CONVERGED // 2, sweeps.CONVERGED))


@pytest.mark.parametrize("name", names("velocity_flat"))
def test_sweeps_leave_less_than_the_step(name: str) -> None:
    found = compare_sweeps(load(name))
    assert found.left[USUAL] < 0.7 * found.step
    # and more of them converge
    assert found.left[COUNTS[0]] > found.left[COUNTS[1]] > found.left[COUNTS[2]] > 0.0
