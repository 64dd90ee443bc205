"""Lists the terms that a file declares, in the form of `polypod.term_list.read`."""

import dataclasses
import inspect
from collections.abc import Iterator, Mapping
from typing import Any

from polypod.python_terms.declarations import Memory, Terms

KINDS = ("rewards", "observations", "terminations", "events", "commands", "curricula", "metrics", "memories")
"""Kinds of terms that a file may declare."""
_UNSAID = ("name", "function", "hooks", "units")
"""Fields of declarations that are said otherwise."""


def listed(terms: Terms) -> dict[str, dict[str, dict[str, Any]]]:
    """All terms by kind and name: what is said of built-in terms, and what their decorators say.

    `declared` holds what differs from the decorators' defaults.
    """
    return {kind: {name: _entry(terms, term) for name, term in getattr(terms, kind).items()} for kind in KINDS}


def _entry(terms: Terms, term: Any) -> dict[str, Any]:
    code = None if isinstance(term, Memory) else getattr(inspect.unwrap(term.function), "__code__", None)
    document = "" if isinstance(term, Memory) else inspect.getdoc(term.function) or ""
    return {
        "description": " ".join(document.split("\n\n", 1)[0].split()),
        "units": getattr(term, "units", ""),
        "parameters": [],
        "commands": [],
        "declared": dict(_declared(term)),
        "source": f"{terms.path}:{code.co_firstlineno}" if code is not None else str(terms.path),
    }


def _declared(term: Any) -> Iterator[tuple[str, Any]]:
    for field in dataclasses.fields(term):
        value = getattr(term, field.name)
        is_needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if field.name not in _UNSAID and (is_needed or value != field.default):
            yield field.name, list(value) if isinstance(value, tuple) else value
    hooks: Mapping[str, Any] = getattr(term, "hooks", {})
    if hooks:
        yield "hooks", sorted(hooks)
