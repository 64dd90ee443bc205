"""The built-in terms with their parameters: `polypod terms`.

The file is read from the sources of the terms by tools/terms.py.
"""

import difflib
import json
from collections.abc import Collection, Mapping, Sequence
from importlib import resources
from typing import Any


def read() -> dict[str, dict[str, dict[str, Any]]]:
    """All terms by kind and name."""
    text = resources.files("polypod").joinpath("builtin_terms.json").read_text(encoding="utf-8")
    terms: dict[str, dict[str, dict[str, Any]]] = json.loads(text)
    return terms


def unknown(name: str, kinds: Sequence[str], terms: Mapping[str, Collection[str]] | None = None) -> str:
    """Message about a name that no term of these kinds has.

    `terms` are those that exist, by kind; None: the built-in ones.
    """
    terms = read() if terms is None else terms
    known = [term for kind in kinds for term in terms.get(kind, ())]
    near = difflib.get_close_matches(name, known, n=1)
    remedy = f"did you mean {near[0]!r}?" if near else "polypod terms lists them"
    return f"there is no term {name[:80]!r} of {' or '.join(kinds)}; {remedy}"
