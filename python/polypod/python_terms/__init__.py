"""Terms of a task that are written in Python: declarations, their file, the simulator with them.

`polypod.terms` is the module that users import, with all names that a file of terms needs. The
names here are those that trainings and envs need.
"""

from polypod.python_terms.declarations import Declared, Memory, Terms
from polypod.python_terms.file import load
from polypod.python_terms.sim import TermSim

__all__ = ["Declared", "Memory", "TermSim", "Terms", "load"]
