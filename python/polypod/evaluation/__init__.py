"""Evaluation of policies.

Full episodes, deterministic, in the task's Play variant or as randomised in training.
"""

from polypod.evaluation.checkpoints import command, evaluate_checkpoint, evaluate_checkpoints, gate_of_checkpoint
from polypod.evaluation.results import FOLLOWS, CommandResult, Evaluation, RobotResult, TileResult
from polypod.evaluation.rollout import ENVS_PER_ROBOT, evaluate, play_task, undisturbed
from polypod.evaluation.seeds import CONFIDENCE, Interval, Summary, summarize
from polypod.evaluation.walking import Walking, walks, why_not
from polypod.networks.policies import Policy, load_network, load_policy

__all__ = [
    "CONFIDENCE",
    "ENVS_PER_ROBOT",
    "FOLLOWS",
    "CommandResult",
    "Evaluation",
    "Interval",
    "Policy",
    "RobotResult",
    "Summary",
    "TileResult",
    "Walking",
    "command",
    "evaluate",
    "evaluate_checkpoint",
    "evaluate_checkpoints",
    "gate_of_checkpoint",
    "load_network",
    "load_policy",
    "play_task",
    "summarize",
    "undisturbed",
    "walks",
    "why_not",
]
