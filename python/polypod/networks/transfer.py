"""Transfer of a perceptron to other bodies: columns of its first layer follow their numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from polypod import _core
from polypod.descriptions import for_one_env_each
from polypod.observation import terms_of

FIRST_LAYER = "mlp.0.weight"
MOMENTS = {"obs_normalizer._mean": 0.0, "obs_normalizer._var": 1.0, "obs_normalizer._std": 1.0}
"""Statistics of the observation, and what they are of a number that was never seen."""

STD = "distribution.std_param"
"""Deviations of the actions of a perceptron."""

Number = tuple[str, str, int, str]
"""A number of an observation: group, term, place within the term, and the slot or leg that it
belongs to."""


def numbers_of(sim: _core.VecSim, groups: Sequence[str], slots: Sequence[str] | None = None) -> list[Number]:
    """The numbers of observation groups side by side, in order.

    `slots` are those of another simulation of the same terms; None: the simulation's.
    """
    own = sim.canonical_joint_names
    owners_of = {"per_joint": (own, own if slots is None else slots), "per_foot": (sim.feet_names, sim.feet_names)}
    numbers: list[Number] = []
    for group in groups:
        for term in terms_of(sim, group):
            here, owners = owners_of.get(term.kind, ([], []))
            if not here or term.size % len(here):
                numbers += [(group, term.term, place, "") for place in range(term.size)]
                continue
            for row in range(term.size // len(here)):
                numbers += [(group, term.term, row, owner) for owner in owners]
    return numbers


def perceptron_for(
    old: Mapping[str, torch.Tensor], of: Sequence[Number], own: Mapping[str, torch.Tensor], wanted: Sequence[Number]
) -> dict[str, torch.Tensor] | None:
    """The state of a perceptron for other numbers; equal outputs where new ones are absent.

    Args:
        old: the perceptron's state.
        of: the numbers that it reads.
        own: the state of the new perceptron.
        wanted: the numbers that the new one reads.

    Returns:
        None where the two differ in more than the numbers that they read.
    """
    if old.keys() != own.keys() or FIRST_LAYER not in own:
        return None
    moved: dict[str, torch.Tensor] = {}
    place = {number: index for index, number in enumerate(of)}
    pairs = [(index, place[number]) for index, number in enumerate(wanted) if number in place]
    to, begin = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    for key, value in own.items():
        if key != FIRST_LAYER and key not in MOMENTS:
            if old[key].shape != value.shape:
                return None
            moved[key] = old[key]
            continue
        if old[key].shape[0] != value.shape[0] or old[key].shape[1] != len(of) or value.shape[1] != len(wanted):
            return None
        moved[key] = torch.full_like(value, MOMENTS.get(key, 0.0))
        moved[key][:, to] = old[key][:, begin].to(value.device)
    return moved


def numbers_of_run(
    manifest: Mapping[str, Any], groups: Sequence[str], stand_ins: Sequence[str] = ()
) -> list[Number] | None:
    """`numbers_of` for a manifest's training.

    Args:
        manifest: of the training.
        groups: observation groups.
        stand_ins: robots with as many legs, which are simulated where the training's robots are not
            on this machine.

    Returns:
        None where neither can be simulated in the training's task.
    """
    slots, sources = list(manifest["canonical_joint_names"]), list(manifest["robot_sources"])
    for robots in filter(None, (sources, list(stand_ins))):
        # changes of robots that are not here name nothing
        changes = manifest["overrides"] if robots == sources else of_observation(manifest["overrides"])
        try:
            sim = _core.VecSim(
                manifest["task"], len(robots), robots=robots, threads=1, overrides=for_one_env_each(changes)
            )
            return numbers_of(sim, groups, slots)
        except _core.PolypodError:
            continue
    return None


def of_observation(overrides: Sequence[str]) -> list[str]:
    """`key=value` pairs of a task that change its observation."""
    return [change for change in overrides if change.startswith("observations.")]


def emptied(state: Mapping[str, torch.Tensor], width: int) -> dict[str, torch.Tensor]:
    """Zeros of the shapes of a perceptron that reads `width` numbers."""
    return {
        key: torch.zeros(*value.shape[:-1], width) if key == FIRST_LAYER or key in MOMENTS else torch.zeros_like(value)
        for key, value in state.items()
    }


def with_joints(
    actor: Mapping[str, torch.Tensor],
    known: Sequence[str],
    wanted: Sequence[str],
    ratio: float = 1.0,
    least_std: float = 0.0,
) -> dict[str, torch.Tensor]:
    """An actor with the rows of other slots; the mean action of a new one is 0.

    Args:
        actor: its state.
        known: its slots.
        wanted: the new ones.
        ratio: factor of the actions that it has.
        least_std: deviation of new actions, and the least of all.
    """
    rows = {slot: row for row, slot in enumerate(known)}

    def of_slots(key: str, otherwise: float) -> torch.Tensor:
        values = actor[key] * ratio
        new = torch.full_like(values[0], otherwise)
        return torch.stack([values[rows[slot]] if slot in rows else new for slot in wanted])

    moved = {key: of_slots(key, 0.0) for key in _last_layer(actor)}
    return {**actor, **moved, STD: of_slots(STD, least_std).clamp(min=least_std)}


def has_actions_for(actor: Mapping[str, torch.Tensor], slots: Sequence[str]) -> bool:
    """Whether a perceptron has an action, and a deviation, for each slot."""
    return all(key in actor and len(actor[key]) == len(slots) for key in (*_last_layer(actor), STD))


def _last_layer(state: Mapping[str, torch.Tensor]) -> tuple[str, str]:
    """Keys of the weights and the bias of a perceptron's last layer."""
    last = max(int(key.split(".")[1]) for key in state if key.startswith("mlp."))
    return f"mlp.{last}.weight", f"mlp.{last}.bias"
