import dataclasses
@dataclasses.dataclass(frozen=True)
class Difference:
    item: str
def ranked(*a): return []
