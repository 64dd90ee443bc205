"""The exported policy on the same robots in MuJoCo, compared with polypod under the same commands.

A policy that walks in a second simulator has not learned the first one's mistakes. `polypod
sim2sim` runs it; it needs the `export` and `bench` extras.
"""

from polypod.sim2sim.beginning import Options, heights
from polypod.sim2sim.commands import Commands
from polypod.sim2sim.run import Comparison, Figures, RobotComparison, compare
from polypod.sim2sim.twin import Physics, Twin

__all__ = [
    "Commands",
    "Comparison",
    "Figures",
    "Options",
    "Physics",
    "RobotComparison",
    "Twin",
    "compare",
    "heights",
]
