"""Terms of an observation as the simulator states them; no term is known by name here.

A term is stated once, where it is registered in Rust (`TermSpec`). `terms_of` reads those of a
simulation.
"""

import dataclasses
import functools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from polypod import _core


@dataclasses.dataclass(frozen=True, kw_only=True)
class Block:
    """Consecutive numbers of a term of the kind `body`."""

    per: str
    """Kind of owner: body, length, width, role or joint; see `VecSim.observation_terms`."""
    count: int
    """Number of values of the body, of one role or of one joint."""

    def size(self, roles: int, joints: int) -> int:
        """Returns the number of all its values."""
        return self.count * {"role": roles, "joint": joints}.get(self.per, 1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Treatment:
    """Operations on a term after it is measured, in this order."""

    offset: float = 0.0
    """Number that is subtracted."""
    clip: tuple[float, float] | None = None
    """Lower and upper limit; None: no limits."""
    scale: float = 1.0
    """Factor of the limited numbers."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Term:
    """One term of an observation.

    `VecSim.observation_terms` documents the values of `kind` and `source`.
    """

    term: str
    """Name of the term in the task's config."""
    size: int
    """Number of its values, history included."""
    history_length: int = 1
    """Control steps that it remembers, the present one included; the oldest come first."""
    kind: str = "scalar"
    units: str = ""
    description: str = ""
    source: str = "measured"
    """Name of the formula that computes the term on a robot."""
    inputs: tuple[str, ...] = ()
    """Inputs of the formula from the robot's sensors, in order."""
    magnitude: float = 1.0
    """Typical magnitude of its numbers, in `units`."""
    blocks: tuple[Block, ...] = ()
    """Owners of the values, for the kind `body`."""
    treatment: Treatment = Treatment()

    @property
    def width(self) -> int:
        """Number of values of one control step."""
        return self.size // self.history_length

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> "Term":
        """Reads an entry of `VecSim.observation_terms`, or the part that a manifest holds."""
        known = {field.name for field in dataclasses.fields(cls)} - {"inputs", "blocks", "treatment"}
        clip = entry.get("clip")
        return cls(
            **{key: value for key, value in entry.items() if key in known},
            inputs=tuple(entry.get("inputs", ())),
            blocks=tuple(Block(**block) for block in entry.get("blocks", ())),
            treatment=Treatment(
                offset=entry.get("offset", 0.0),
                clip=None if clip is None else (clip[0], clip[1]),
                scale=entry.get("scale", 1.0),
            ),
        )


Layout = Sequence[Mapping[str, Any] | tuple[str, int]]
"""Terms of an observation in order, as manifests of networks of joints hold them: `layout_of`
writes them. Manifests of earlier versions hold (term, size) alone."""


def terms_of(sim: _core.VecSim, group: str = "policy") -> tuple[Term, ...]:
    """Terms of an observation group of `sim`, in order."""
    return tuple(Term.read(entry) for entry in json.loads(sim.observation_terms(group)))


def placed(terms: Iterable[Term]) -> Iterator[tuple[Term, slice]]:
    """Terms with their columns of the observation."""
    start = 0
    for term in terms:
        yield term, slice(start, start + term.size)
        start += term.size


def columns_of(sim: _core.VecSim, source: str) -> tuple[slice, int]:
    """Columns of the term that is computed from `source`, and the number of new ones in a step."""
    for term, columns in placed(terms_of(sim)):
        if term.source == source:
            return columns, term.width
    raise _core.ConfigError(
        f"task {sim.task_name} observes no term that is computed from {source}; add one to observations.policy"
    )


def layout_of(terms: Sequence[Term]) -> list[dict[str, Any]]:
    """Layout of an observation for a network of joints, for its manifest."""
    return [
        {
            "term": term.term,
            "size": term.size,
            **({} if term.history_length == 1 else {"history_length": term.history_length}),
            "kind": term.kind,
            "magnitude": term.magnitude,
            "source": term.source,
            "blocks": [dataclasses.asdict(block) for block in term.blocks],
        }
        for term in terms
    ]


def read_layout(layout: Layout) -> list[Term]:
    """Terms of a layout.

    This version's terms complete those of which the layout has name and size alone.
    """
    return [
        Term.read(entry if isinstance(entry, Mapping) else {**_spec(entry[0]), "term": entry[0], "size": entry[1]})
        for entry in layout
    ]


def _spec(name: str) -> dict[str, Any]:
    specs: dict[str, dict[str, Any]] = _specs()
    return specs.get(name, {})


@functools.cache
def _specs() -> Any:
    return json.loads(_core.observation_specs())
