"""How fast the simulator is, beside MuJoCo in the same run: `polypod bench`. It needs the `bench` extra."""

from polypod.bench.report import Options, measure, picture, table

__all__ = ["Options", "measure", "picture", "table"]
