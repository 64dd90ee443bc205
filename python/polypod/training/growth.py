"""Perceptrons that begin with those of another training, for other numbers and joints.

Columns of the first layer follow their numbers: observation term, place and slot. Rows of the last
layer follow their slots. Weights of new numbers are 0, and new joints begin still, so that the
others move as before. Checkpoint and manifest are enough: the robots of the training need not be on
this machine.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from polypod import _core, simulated
from polypod.arrays import Floats
from polypod.networks.transfer import (
    MOMENTS,
    Number,
    emptied,
    has_actions_for,
    numbers_of,
    numbers_of_run,
    perceptron_for,
    with_joints,
)
from polypod.runs import config, run_dir
from polypod.runs.schema import TrainConfig

SAMPLES = 512
"""Envs whose numbers give the means of new ones."""
LEAST_STD = 0.25
"""Least deviation of the actions that a grown policy explores with."""
FLOOR = 0.02
"""Added to the deviations of numbers of new terms, many of which are 0 after a reset."""
ACTIONS = "last_action"


def grow(checkpoint: Path, sim: _core.VecSim, robots: Sequence[str], train_config: TrainConfig) -> dict[str, Any]:
    """The networks of a checkpoint for another training.

    Actions are in units of a robot's action scale. They keep their size in rad where the
    checkpoint's robots share a scale and the new ones, too, and else their number. A manifest
    without `robot_info` counts as of the new scale.

    Args:
        checkpoint: of a perceptron, next to its manifest.
        sim: task and robots of the new training, with `SAMPLES` envs; it is reset.
        robots: names of these robots, or paths of their configs.
        train_config: of the new training, for the observation groups of its networks.

    Returns:
        The state of a checkpoint: the actor, and the critic if the checkpoint has one.

    Raises:
        ConfigError: for a broken file, and for networks that are no perceptrons of their task.
    """
    state, manifest = run_dir.load_checkpoint(checkpoint), run_dir.read_manifest(checkpoint)
    trained = config.parse(manifest["train_config"], f"{checkpoint.parent / run_dir.MANIFEST}: train_config")
    ratio = _ratio(manifest.get("robot_info", {}), simulated.robots(sim))
    sim.reset()
    grown: dict[str, Any] = {}
    for network in ("actor", "critic"):
        if (weights := state.get(f"{network}_state_dict")) is None:
            continue
        groups: list[str] = getattr(train_config.obs_groups, network)
        known = numbers_of_run(manifest, getattr(trained.obs_groups, network), robots)
        wanted = numbers_of(sim, groups)
        old = {key: value.float() if value.is_floating_point() else value for key, value in weights.items()}
        moved = None if known is None else perceptron_for(old, known, emptied(old, len(wanted)), wanted)
        slots = manifest["canonical_joint_names"]
        if known is None or moved is None or (network == "actor" and not has_actions_for(moved, slots)):
            raise _core.ConfigError(
                f"{checkpoint}: its {network} is no perceptron of the observation of {manifest['task']}; "
                "copy the checkpoint and its manifest again, or use another one"
            )
        seen = np.concatenate([np.asarray(sim.observation_of(group)) for group in groups], axis=1)
        _fit_moments(moved, known, wanted, seen, ratio)
        if network == "actor":
            moved = with_joints(moved, slots, sim.canonical_joint_names, ratio, LEAST_STD)
        grown[f"{network}_state_dict"] = moved
    return {**grown, "iter": 0, "infos": {}}


def _ratio(old: Mapping[str, Any], new: Mapping[str, Any]) -> float:
    """How many times larger the action scale was; 1 where robots have several scales."""
    scales = [{info["action_scale"] for info in infos.values() if "action_scale" in info} for infos in (old, new)]
    if any(len(of) != 1 for of in scales):
        return 1.0
    (before,), (after,) = scales
    return float(before) / float(after)


def _fit_moments(
    moved: dict[str, torch.Tensor], known: Sequence[Number], wanted: Sequence[Number], seen: Floats, ratio: float
) -> None:
    """Moments of last actions in the new unit, and of new numbers.

    New numbers have their mean over the bodies of the training, and the deviation of their term's
    known numbers. A perceptron without moments has none to fit.
    """
    if not moved.keys() & MOMENTS.keys():
        return
    old = set(known)
    actions = [column for column, number in enumerate(wanted) if number in old and number[1] == ACTIONS]
    mean, std, var = (moved[f"obs_normalizer.{key}"][0] for key in ("_mean", "_std", "_var"))
    for moments, power in ((mean, 1), (std, 1), (var, 2)):
        moments[actions] *= ratio**power
    of_terms: dict[tuple[str, str], list[int]] = {}
    for column, number in enumerate(wanted):
        if number in old:
            of_terms.setdefault(number[:2], []).append(column)
    for column, number in enumerate(wanted):
        if number in old:
            continue
        like = of_terms.get(number[:2])
        deviation = float(seen[:, column].std()) + FLOOR if like is None else float(std[like].mean())
        mean[column], std[column], var[column] = float(seen[:, column].mean()), deviation, deviation**2
