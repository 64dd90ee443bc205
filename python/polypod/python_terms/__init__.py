"""Terms of a task that are written in Python: declarations, their file, the simulator with them.

`polypod.terms` is the module that users import.
"""

from polypod.python_terms.declarations import (
    Command,
    Curriculum,
    Declared,
    Event,
    Memory,
    Metric,
    Observation,
    Reward,
    Termination,
    Terms,
    command,
    curriculum,
    event,
    memory,
    metric,
    observation,
    reward,
    termination,
)
from polypod.python_terms.env import TermEnv
from polypod.python_terms.file import load
from polypod.python_terms.random import EnvRandom
from polypod.python_terms.sim import TermSim, declared_in

__all__ = [
    "Command",
    "Curriculum",
    "Declared",
    "EnvRandom",
    "Event",
    "Memory",
    "Metric",
    "Observation",
    "Reward",
    "TermEnv",
    "TermSim",
    "Termination",
    "Terms",
    "command",
    "curriculum",
    "declared_in",
    "event",
    "load",
    "memory",
    "metric",
    "observation",
    "reward",
    "termination",
]
