"""A robot held against MuJoCo's model of its file: `polypod accuracy`.

Each comparison returns a plain dataclass, and `bounds` says how large its figures may be. It needs
the `bench` extra. The laboratory (`lab.accuracy`) adds the solver, the engines and the friction
cone, and writes the documentation's tables.
"""

from polypod.accuracy.motion import StepResponse, compare_step_responses
from polypod.accuracy.report import Report, measure
from polypod.accuracy.standing import (
    Drop,
    SlopeRest,
    Standing,
    compare_drop,
    compare_slope_rest,
    compare_standing,
)
from polypod.accuracy.statics import StaticsResult, compare_statics

__all__ = [
    "Drop",
    "Report",
    "SlopeRest",
    "Standing",
    "StaticsResult",
    "StepResponse",
    "compare_drop",
    "compare_slope_rest",
    "compare_standing",
    "compare_statics",
    "compare_step_responses",
    "measure",
]
