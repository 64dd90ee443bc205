"""Engines of a run's simulator, by the changes of its task."""

from collections.abc import Iterable

ENGINE = "physics.engine="
ON_THE_CPU = f"{ENGINE}articulated"
_OF_A_CARD = (f"{ENGINE}cuda", f"{ENGINE}auto")
SAME_BITS = (ON_THE_CPU, *_OF_A_CARD)
"""Engines that go on with each other's runs: nothing but the time depends on them."""


def on_the_cpu(changes: Iterable[str]) -> list[str]:
    """A `key=value` pair that moves a task with these changes from a card to the CPU.

    The CPU has the same bits, and steps a few hundred envs sooner. None where the task is on no
    card.
    """
    engines = [change for change in changes if change.startswith(ENGINE)]
    return [ON_THE_CPU] if engines and engines[-1] in _OF_A_CARD else []
