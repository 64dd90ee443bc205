"""Evaluating what trainings left."""

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from polypod.evaluation.policies import load_policy
from polypod.evaluation.results import Evaluation
from polypod.evaluation.rollout import evaluate
from polypod.training import run_dir


def evaluate_checkpoint(checkpoint: Path, robots: Sequence[str] | None = None, **arguments: Any) -> Evaluation:
    """`evaluate` for a checkpoint; task, robots and overrides come from its manifest unless given."""
    state, manifest = run_dir.load_checkpoint(checkpoint), run_dir.read_manifest(checkpoint)
    overrides = [*manifest["overrides"], *arguments.pop("overrides", ())]
    evaluation = evaluate(
        load_policy(state, manifest["policy"]),
        arguments.pop("task", None) or manifest["task"],
        manifest["robot_sources"] if robots is None else robots,
        overrides=overrides,
        **arguments,
    )
    origin = {
        "file": str(checkpoint),
        "sha256": hashlib.sha256(checkpoint.read_bytes()).hexdigest(),
        "iteration": state.get("iter"),
        "task": manifest["task"],
        "robots": manifest["robots"],
        "seed": manifest.get("seed"),
        "train_config": manifest.get("train_config"),
        "git": manifest.get("git"),
    }
    return dataclasses.replace(evaluation, checkpoint=origin)


def evaluate_checkpoints(checkpoints: Sequence[Path], **arguments: Any) -> list[Evaluation]:
    """`evaluate_checkpoint` for each, with the same arguments: the seeds of one training, say."""
    return [evaluate_checkpoint(checkpoint, **arguments) for checkpoint in checkpoints]
