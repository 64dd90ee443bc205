"""The physics of all robots held against MuJoCo, formulas and the other engine.

`python -m lab.accuracy` adds to `polypod accuracy` the solver's sweeps, the two engines and the
friction cone, and writes docs/accuracy.md and README.md.
"""
