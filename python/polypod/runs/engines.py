"""Engines of a run's simulator, by the changes of its task."""

from collections.abc import Sequence

ENGINE = "physics.engine="
ON_THE_CPU = f"{ENGINE}articulated"
_OF_A_CARD = (f"{ENGINE}cuda", f"{ENGINE}auto")
SAME_BITS = (ON_THE_CPU, *_OF_A_CARD)
"""Engines that go on with each other's runs: nothing but the time depends on them."""


def on_the_cpu(changes: Sequence[str]) -> list[str]:
    """`key=value` pairs of a task, with the CPU in place of a card.

    The CPU has the same bits, and steps a few hundred envs sooner.
    """
    engines = [change for change in changes if change.startswith(ENGINE)]
    if not engines or engines[-1] not in _OF_A_CARD:
        return list(changes)
    return [*(change for change in changes if change not in engines), ON_THE_CPU]
