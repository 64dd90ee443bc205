"""Randomly generated robots, as a library.

Quadrupeds, bipeds, humanoids and hexapods of drawn lengths.

Lengths, densities, stances and drives are drawn, and the rest follows from them. A body's mass
grows with the cube of its leg's length, and a link's share with the link's length. Gains, efforts
and speeds are shares of weight and leg length. The ranges of the lengths are about those of a
thousand published bodies (Velythyl/embodiment-scaling-laws, BSD-3-Clause); the robots of the
library lie within all ranges.
"""

from polypod.bodies.files import toml, urdf
from polypod.bodies.library import BY_DEFAULT, KINDS, TASK, draw, generate
from polypod.bodies.parts import Body

__all__ = ["BY_DEFAULT", "KINDS", "TASK", "Body", "draw", "generate", "toml", "urdf"]
