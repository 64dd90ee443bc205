"""polypod's physics held against MuJoCo's, on the same URDFs.

Each comparison returns a plain dataclass; the tests assert bounds on it and `polypod accuracy`
writes it into the documentation. It needs the `bench` extra.
"""

from polypod.accuracy.engines import Engine, Engines, compare_engines
from polypod.accuracy.friction import Slide, Slope, compare_slide, compare_slope
from polypod.accuracy.motion import StepResponse, compare_step_responses
from polypod.accuracy.reference import Ground, Reference
from polypod.accuracy.report import Report, measure
from polypod.accuracy.robot import Actuators, Robot, load, names
from polypod.accuracy.standing import (
    Drop,
    SlopeRest,
    Standing,
    compare_drop,
    compare_slope_rest,
    compare_standing,
)
from polypod.accuracy.statics import StaticsResult, compare_statics
from polypod.accuracy.sweeps import Sweeps, compare_sweeps

__all__ = [
    "Actuators",
    "Drop",
    "Engine",
    "Engines",
    "Ground",
    "Reference",
    "Report",
    "Robot",
    "Slide",
    "Slope",
    "SlopeRest",
    "Standing",
    "StaticsResult",
    "StepResponse",
    "Sweeps",
    "compare_drop",
    "compare_engines",
    "compare_slide",
    "compare_slope",
    "compare_slope_rest",
    "compare_standing",
    "compare_statics",
    "compare_step_responses",
    "compare_sweeps",
    "load",
    "measure",
    "names",
]
