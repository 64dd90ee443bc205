"""Speed of the simulator, compared with MuJoCo in the same run: `polypod bench`.

Needs the `bench` extra.
"""

from polypod.bench.report import Options, measure, picture, table

__all__ = ["Options", "measure", "picture", "table"]
