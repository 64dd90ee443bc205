"""Perceptrons that go on with other numbers or joints: `init` and `grown` of a recipe's stage.

Columns of the first layer and rows of the last one follow their numbers and slots. New columns are
0, so that the policy begins with the actions that it had. New joints begin still.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from polypod import _core, simulated
from polypod.descriptions import for_one_env_each
from polypod.runs import config, run_dir
from polypod.training.transfer import Number, critic_for, numbers_of

LEAST_STD = 0.25
"""Least deviation of the actions that a grown policy explores with."""
SAMPLES = 512
"""Envs whose numbers give the mean and deviation of new ones."""
OF_ACTIONS = "last_action"


def simulation(manifest: Mapping[str, Any]) -> _core.VecSim:
    """One env of each robot of a policy's training."""
    robots = list(manifest["robot_sources"])
    changes = for_one_env_each(manifest["overrides"])
    return _core.VecSim(manifest["task"], len(robots), robots=robots, threads=1, overrides=changes)


def grow(checkpoint: Path, task: str, robots: Sequence[str], overrides: Sequence[str], out: Path) -> None:
    """Writes the actor of a checkpoint for the task and robots of another training.

    Args:
        checkpoint: of a perceptron, next to its manifest.
        task: of the training.
        robots: of the training.
        overrides: changes of the task.
        out: file of the new checkpoint, which has no critic.
    """
    state, manifest = run_dir.load_checkpoint(checkpoint), run_dir.read_manifest(checkpoint)
    old = state["actor_state_dict"]
    new = _core.VecSim(task, SAMPLES, robots=list(robots), threads=1, overrides=list(overrides), seed=1)
    before = simulation(manifest)
    last = max(key for key in old if key.startswith("mlp.") and key.endswith(".weight"))
    ratio = _scale(before) / _scale(new)
    known, wanted = numbers_of(before, ["policy"]), numbers_of(new, ["policy"])
    slots = {slot: row for row, slot in enumerate(before.canonical_joint_names)}
    actor = {key: value.clone() for key, value in old.items()}
    _scale_actions(actor, known, ratio)
    rows = [slots.get(slot, -1) for slot in new.canonical_joint_names]
    for key in (last, last.replace("weight", "bias")):
        actor[key] = _rows(actor[key] * ratio, rows, 0.0)
    std = _rows(old["distribution.std_param"] * ratio, rows, LEAST_STD)
    actor["distribution.std_param"] = std.clamp(min=LEAST_STD)
    template = {key: torch.zeros_like(value) for key, value in actor.items()}
    width = len(wanted)
    for key in ("mlp.0.weight", "obs_normalizer._mean", "obs_normalizer._var", "obs_normalizer._std"):
        template[key] = torch.zeros(template[key].shape[0], width)
    moved = critic_for(actor, known, template, wanted)
    assert moved is not None
    _fill_moments(moved, known, wanted, new)
    torch.save({"actor_state_dict": moved, "iter": 0, "infos": {}}, out)


def _scale(sim: _core.VecSim) -> float:
    """Action scale of the first robot, rad."""
    return next(iter(simulated.robots(sim).values()))["action_scale"]


def _scale_actions(actor: dict[str, torch.Tensor], known: Sequence[Number], ratio: float) -> None:
    """Moments of last actions in units of the new action scale."""
    columns = [column for column, (_, term, _, _) in enumerate(known) if term == OF_ACTIONS]
    for key, power in (("_mean", 1), ("_var", 2), ("_std", 1)):
        actor[f"obs_normalizer.{key}"][:, columns] *= ratio**power


def _rows(values: torch.Tensor, rows: Sequence[int], otherwise: float) -> torch.Tensor:
    """Rows in another order; -1 stands for a new one."""
    return torch.stack([values[row] if row >= 0 else torch.full_like(values[0], otherwise) for row in rows])


def _fill_moments(
    moved: dict[str, torch.Tensor], known: Sequence[Number], wanted: Sequence[Number], sim: _core.VecSim
) -> None:
    """Means and deviations of new numbers, over the bodies of the training."""
    sim.reset()
    seen = np.asarray(sim.observation)
    new = [column for column, number in enumerate(wanted) if number not in set(known)]
    mean, std = seen.mean(axis=0)[new], seen.std(axis=0)[new] + 0.02
    moved["obs_normalizer._mean"][0, new] = torch.from_numpy(mean)
    moved["obs_normalizer._std"][0, new] = torch.from_numpy(std)
    moved["obs_normalizer._var"][0, new] = torch.from_numpy(std**2)


def main() -> None:
    """`python -m lab.grown CHECKPOINT OUT --train-config FILE --robots NAMES`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--train-config", required=True)
    parser.add_argument("--robots", required=True)
    arguments = parser.parse_args()
    run = config.load(arguments.train_config).run
    grow(arguments.checkpoint, run.task, arguments.robots.split(","), run.task_changes, arguments.out)


if __name__ == "__main__":
    main()
