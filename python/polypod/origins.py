"""Origins of the values of a config: `polypod show`."""

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

DEFAULT = "default"
"""Origin of a value that no file sets."""
OVERRIDE = "--set"
"""Origin of a value that an override sets."""


@dataclasses.dataclass(frozen=True)
class Value:
    """A value of a resolved config."""

    key: str
    """Dotted; elements of lists by their name or term, else by their number."""
    value: Any
    origin: str
    """File that sets it, `OVERRIDE` or `DEFAULT`."""


@dataclasses.dataclass(frozen=True)
class _Step:
    """A key on the way to a value: a table's, or an element of a list by name and number."""

    name: str
    index: int | None = None

    def of(self, node: Any) -> tuple[bool, Any]:
        """Whether a table or a list has this element, and the element."""
        if isinstance(node, Mapping):
            for key in (self.name, str(self.index)):
                if key in node:
                    return True, node[key]
        if isinstance(node, list) and self.index is not None:
            for element in node:
                if _name(element) == self.name:
                    return True, element
            # an unnamed element is known by its number
            if self.name == str(self.index) and self.index < len(node):
                return True, node[self.index]
        return False, None


def values(
    layers: Sequence[tuple[str, Mapping[str, Any]]], resolved: Mapping[str, Any], overrides: Sequence[str] = ()
) -> list[Value]:
    """All values of a resolved config with their origins.

    Args:
        layers: files with what they say, the one that extends no other first.
        resolved: all layers, overrides and defaults in one table.
        overrides: `key=value` pairs that are in it.
    """
    changed = [re.split(r"[.\[\]]+", text.partition("=")[0].strip()) for text in overrides]
    return [
        Value(".".join(step.name for step in path), value, _origin(layers, changed, path))
        for path, value in _leaves(resolved, ())
    ]


def _leaves(node: Any, path: tuple[_Step, ...]) -> Iterator[tuple[tuple[_Step, ...], Any]]:
    """Values that are neither tables nor lists of tables."""
    if isinstance(node, Mapping) and node:
        for key, value in node.items():
            yield from _leaves(value, (*path, _Step(key)))
    elif isinstance(node, list) and node and all(isinstance(element, Mapping) for element in node):
        for index, element in enumerate(node):
            yield from _leaves(element, (*path, _Step(_name(element) or str(index), index)))
    else:
        yield path, node


def _name(element: Any) -> str | None:
    """Name of an element of a list: its key `name`, else `term`."""
    if not isinstance(element, Mapping):
        return None
    found = (element.get(key) for key in ("name", "term"))
    return next((text for text in found if isinstance(text, str)), None)


def _origin(
    layers: Sequence[tuple[str, Mapping[str, Any]]], changed: Sequence[Sequence[str]], path: Sequence[_Step]
) -> str:
    for keys in changed:
        if all(key in (step.name, str(step.index)) for key, step in zip(keys, path, strict=False)):
            return OVERRIDE
    for file, table in reversed(layers):
        node: Any = table
        # values of a list, or in place of a table, are this file's: those below it have no say
        is_whole = False
        for step in path:
            is_whole |= not isinstance(node, Mapping)
            is_there, node = step.of(node)
            if not is_there:
                break
        else:
            return file
        if is_whole:
            return DEFAULT
    return DEFAULT
