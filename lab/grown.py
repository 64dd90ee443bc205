"""Perceptrons that go on with other numbers or joints: `init` and `grown` of a recipe's stage.

The critic is left out: a stage's new one learns from its start.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from polypod import _core
from polypod.runs import config
from polypod.training import growth


def grow(checkpoint: Path, train_config: str, robots: Sequence[str], out: Path) -> None:
    """Writes the actor of a checkpoint for the task and robots of another training.

    Args:
        checkpoint: of a perceptron, next to its manifest.
        train_config: name or path of the training's config.
        robots: of the training.
        out: file of the new checkpoint, which has no critic.
    """
    of_stage = config.load(train_config)
    sim = _core.VecSim(
        of_stage.run.task,
        growth.SAMPLES,
        robots=list(robots),
        threads=1,
        overrides=of_stage.run.task_changes,
        seed=1,
    )
    state = growth.grow(checkpoint, sim, robots, of_stage)
    state.pop("critic_state_dict", None)
    torch.save(state, out)


def main() -> None:
    """`python -m lab.grown CHECKPOINT OUT --train-config FILE --robots NAMES`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--train-config", required=True)
    parser.add_argument("--robots", required=True)
    arguments = parser.parse_args()
    grow(arguments.checkpoint, arguments.train_config, arguments.robots.split(","), arguments.out)


if __name__ == "__main__":
    main()
