"""`polypod terms`."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from polypod import _core
from polypod.commands.arguments import arg

Kind = Literal["rewards", "observations", "terminations", "events", "commands", "curricula", "metrics", "memories"]


@dataclasses.dataclass(frozen=True)
class Terms:
    """Say which terms a task may name, with their parameters, units and formulas.

    Keys that all terms of a kind take are in docs/task.md.
    """

    name: Annotated[str | None, tyro.conf.Positional, arg(metavar="NAME")] = None
    """Name of a term to describe in full. Default: one line for each term."""
    kind: Annotated[Kind | None, arg(metavar="KIND")] = None
    """Kind of terms to show: rewards, observations, terminations, events, commands, curricula,
    tracking; with --terms also metrics, memories."""
    terms: Annotated[Path | None, arg(metavar="FILE")] = None
    """Python file whose terms are shown in the place of the built-in ones. The file is run."""
    json: bool = False
    """Print JSON in place of tables."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        from polypod import term_list

        terms = term_list.read() if self.terms is None else _of_file(self.terms)
        of_kind = {kind: of for kind, of in terms.items() if self.kind in (None, kind)}
        found = {kind: {name: of[name] for name in of if self.name in (None, name)} for kind, of in of_kind.items()}
        if not any(found.values()):
            kinds = [self.kind] if self.kind is not None else list(terms)
            if self.name is None and self.terms is None:
                raise _core.ConfigError(f"--kind {self.kind}: no such terms are built in; name a file with --terms")
            if self.name is None:
                raise _core.ConfigError(f"--terms {self.terms} declares no {self.kind}; leave out --kind")
            begin = "" if self.terms is None else f"--terms {self.terms}: "
            raise _core.UnknownNameError(begin + term_list.unknown(self.name, kinds, of_kind))
        if self.json:
            print(json.dumps(found, indent=2))
            return 0
        for kind, entries in found.items():
            if self.name is None and entries:
                print(kind)
            for name, term in entries.items():
                print("\n".join(_whole(kind, name, term) if self.name is not None else [f"  {_line(name, term)}"]))
        return 0


def _of_file(path: Path) -> dict[str, dict[str, dict[str, Any]]]:
    """The terms of a Python file. Raises ConfigError."""
    from polypod.python_terms.file import load
    from polypod.python_terms.listing import listed

    return listed(load(path))


def _line(name: str, term: dict[str, Any]) -> str:
    parameters = [parameter["name"] for parameter in term["parameters"]]
    parameters += [f"{key}={value}" for key, value in term.get("declared", {}).items()]
    description = term["description"].rstrip(".")
    return f"{name:<32} {description}".rstrip() + (f" [{', '.join(parameters)}]" if parameters else "")


def _whole(kind: str, name: str, term: dict[str, Any]) -> list[str]:
    units = f" ({term['units']})" if term.get("units") else ""
    lines = [f"{name}{units}, one of {kind}: {term['description']}".removesuffix(": ")]
    lines += [f"  modes: {term['modes']}"] if "modes" in term else []
    lines += [f"  follows the command {command}" for command in term["commands"]]
    for parameter in term["parameters"]:
        unit = f", {parameter['unit']}" if parameter["unit"] else ""
        must = "; required" if parameter["required"] == "yes" else ""
        lines.append(f"  {parameter['name']}: {parameter['type']}{unit}{must}. {parameter['description']}")
    lines += [f"  {key} = {json.dumps(value)}" for key, value in term.get("declared", {}).items()]
    return [*lines, f"  {term['source']}"]
