"""Evaluation of the checkpoints of trainings."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from polypod import _core, bundled, descriptions, text
from polypod.evaluation import gate
from polypod.evaluation.gate import Gate
from polypod.evaluation.results import Evaluation
from polypod.evaluation.rollout import evaluate, play_task
from polypod.provenance import measured
from polypod.runs.own_terms import terms_of_run


def evaluate_checkpoint(checkpoint: Path, robots: Sequence[str] | None = None, **arguments: Any) -> Evaluation:
    """`evaluate` for a checkpoint or an ONNX file.

    Task, robots and overrides come from its manifest unless given. The CPU steps what a card
    stepped in the training. `terms`, a path, is the file of terms in Python that a run was begun
    with; no manifest makes one run.
    """
    from polypod.policy import load  # it builds on this package

    task = arguments.pop("task", None)
    policy = load(checkpoint, task, robots)
    manifest = policy.manifest
    terms = terms_of_run(manifest, arguments.pop("terms", None), str(checkpoint))
    given = list(arguments.pop("overrides", ()))
    evaluation = evaluate(
        policy.runner(),
        task or manifest["task"],
        manifest["robot_sources"] if robots is None else robots,
        overrides=given,
        trained=manifest["overrides"],
        slots=manifest["canonical_joint_names"],
        terms=terms,
        **arguments,
    )
    origin = {
        "file": bundled.shown(checkpoint),
        "sha256": policy.sha256,
        "iteration": policy.iteration,
        "task": manifest["task"],
        "robots": manifest["robots"],
        "seed": manifest.get("seed"),
        "train_config": manifest.get("train_config"),
        "git": manifest.get("git"),
        "in_own_task": task is None or play_task(task) == play_task(manifest["task"]),
    }
    distances = {} if robots is None else descriptions.distances(manifest, robots, str(checkpoint))
    return dataclasses.replace(evaluation, checkpoint=origin, measured=measured(), distances=distances)


def gate_of_checkpoint(checkpoint: Path, robots: Sequence[str] | None = None, **arguments: Any) -> dict[str, Gate]:
    """`polypod.evaluation.gate.measure` for a checkpoint or an ONNX file.

    Files are read as in `evaluate_checkpoint`.
    """
    from polypod.policy import load  # it builds on this package

    task = arguments.pop("task", None)
    policy = load(checkpoint, task, robots)
    manifest = policy.manifest
    return gate.measure(
        policy.runner(),
        task or manifest["task"],
        manifest["robot_sources"] if robots is None else robots,
        trained=manifest["overrides"],
        slots=manifest["canonical_joint_names"],
        **arguments,
    )


def evaluate_checkpoints(checkpoints: Sequence[Path], **arguments: Any) -> list[Evaluation]:
    """`evaluate_checkpoint` for each, with the same arguments: the seeds of one training, say."""
    return [evaluate_checkpoint(checkpoint, **arguments) for checkpoint in checkpoints]


def command(evaluation: Evaluation) -> str:
    """The command line that measures the same again."""
    origin = evaluation.checkpoint or {}
    given = {
        "--checkpoint": origin.get("file", "FILE"),
        "--task": None if _is_in_own_task(evaluation) else evaluation.task,
        "--robots": None if origin.get("robots") == list(evaluation.robots) else list(evaluation.robots),
        "--num-envs": evaluation.num_envs,
        "--episodes": evaluation.episodes if evaluation.episodes > 1 else None,
        "--steps": evaluation.steps,
        "--seed": evaluation.seed,
        "--commands": "task" if evaluation.commands == "task" else None,
        "--grid": evaluation.grid and tuple(evaluation.grid),
        "--randomized": evaluation.randomized,
    }
    return text.command_line(("polypod", "eval"), given, {"--set": evaluation.overrides})


def _is_in_own_task(evaluation: Evaluation) -> bool:
    origin = evaluation.checkpoint or {}
    if "in_own_task" in origin:
        return bool(origin["in_own_task"])
    try:
        return play_task(origin.get("task", "")) == evaluation.task
    except _core.ConfigError:
        return False
