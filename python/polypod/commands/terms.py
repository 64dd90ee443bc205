"""`polypod terms`."""

import dataclasses
import json
from typing import Annotated, Any, Literal

import tyro

from polypod import _core
from polypod.commands.arguments import arg

Kind = Literal["rewards", "observations", "terminations", "events", "commands", "curricula"]


@dataclasses.dataclass(frozen=True)
class Terms:
    """Say which terms a task may name, with their parameters, units and formulas.

    Keys that all terms of a kind take are in docs/task.md.
    """

    name: Annotated[str | None, tyro.conf.Positional, arg(metavar="NAME")] = None
    """Name of a term, of which all is said. Default: one line for each term."""
    kind: Annotated[Kind | None, arg(metavar="KIND")] = None
    """Terms of this kind alone: rewards, observations, terminations, events, commands or
    curricula."""
    json: bool = False
    """As JSON."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        from polypod import term_list

        terms = term_list.read()
        kinds = [self.kind] if self.kind is not None else list(terms)
        found = {
            kind: {name: term for name, term in terms[kind].items() if self.name in (None, name)} for kind in kinds
        }
        if not any(found.values()):
            raise _core.UnknownNameError(term_list.unknown(self.name or "", [*kinds]))
        if self.json:
            print(json.dumps(found, indent=2))
            return 0
        for kind, of_kind in found.items():
            if self.name is None:
                print(kind)
            for name, term in of_kind.items():
                print("\n".join(_whole(kind, name, term) if self.name is not None else [f"  {_line(name, term)}"]))
        return 0


def _line(name: str, term: dict[str, Any]) -> str:
    parameters = ", ".join(parameter["name"] for parameter in term["parameters"])
    return f"{name:<32} {term['description'].rstrip('.')}" + (f" [{parameters}]" if parameters else "")


def _whole(kind: str, name: str, term: dict[str, Any]) -> list[str]:
    units = f" ({term['units']})" if term.get("units") else ""
    lines = [f"{name}{units}, one of {kind}: {term['description']}"]
    lines += [f"  modes: {term['modes']}"] if "modes" in term else []
    lines += [f"  follows the command {command}" for command in term["commands"]]
    for parameter in term["parameters"]:
        unit = f", {parameter['unit']}" if parameter["unit"] else ""
        must = "; required" if parameter["required"] == "yes" else ""
        lines.append(f"  {parameter['name']}: {parameter['type']}{unit}{must}. {parameter['description']}")
    return [*lines, f"  {term['source']}"]
