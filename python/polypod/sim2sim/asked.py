"""Tells by the task of its training what a policy is asked for."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from polypod import _core
from polypod.compat import tomllib
from polypod.evaluation import play_task
from polypod.motions.names import observes_motions, split
from polypod.policy import load

Asked = Literal["velocity", "rising", "motions"]


def of(checkpoint: Path, robots: Sequence[str] | None, overrides: Sequence[str]) -> Asked:
    """Tells what the policy of a checkpoint is asked for; velocities where nothing else is known.

    Args:
        checkpoint: a `model_<n>.pt` next to its manifest, or an ONNX file that says its task.
        robots: names or paths of configs; None: those that the policy was trained on.
        overrides: `key=value` changes to the task, on top of the run's own.
    """
    manifest = load(checkpoint, robots=robots).manifest
    play = play_task(manifest["task"])
    changes, _ = split([*manifest["overrides"], *overrides])
    if observes_motions(play, changes):
        return "motions"
    _, resolved = _core.explain_task(play, changes)
    task = tomllib.loads(resolved)
    if "base_velocity" in task["commands"]:
        return "velocity"
    rewards = [{term.get("term", name) for name, term in terms.items()} for terms in task["rewards"].values()]
    return "rising" if any({"upright", "torso_height"} <= terms for terms in rewards) else "velocity"
