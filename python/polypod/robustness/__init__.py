"""A fixed battery of conditions.

Friction, payload, worn motors, delays, pushes, wrong descriptions, sudden commands.

`polypod robustness` runs a policy through it, in polypod and in MuJoCo. The conditions are entries
of `conditions.CONDITIONS`; each says how it changes a robot in either simulator and what is allowed
in it.
"""

from polypod.robustness.conditions import CONDITIONS, Bound, Condition, chosen
from polypod.robustness.results import Battery, Cell, Row
from polypod.robustness.run import Options, measure

__all__ = ["CONDITIONS", "Battery", "Bound", "Cell", "Condition", "Options", "Row", "chosen", "measure"]
