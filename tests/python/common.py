"""Names that the tests share."""

from pathlib import Path

TASK = "Velocity-Flat-HeteroQuadruped-v0"

SHORT = ("sim.episode_length_s=0.4",)
"""Episodes of 20 control steps: time-outs within a quick test."""

_POLICIES = Path(__file__).parents[2] / "assets" / "policies"
(FLAT_POLICY,) = (_POLICIES / "flat_universal").glob("model_*.pt")
(ROUGH_POLICY,) = (_POLICIES / "rough_universal").glob("model_*.pt")
"""The checkpoints that come along."""
