"""Speed of the simulator, compared with MuJoCo in the same run: `polypod bench`.

It needs the `bench` extra. `lab.speed` measures what the documentation shows besides.
"""

from polypod.bench.report import Options, measure, table

__all__ = ["Options", "measure", "table"]
