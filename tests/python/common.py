"""Names that the tests share."""

TASK = "Velocity-Flat-HeteroQuadruped-v0"

SHORT = ("sim.episode_length_s=0.4",)
"""Episodes of 20 control steps: time-outs within a quick test."""
