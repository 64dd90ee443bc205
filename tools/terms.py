"""Writes python/polypod/builtin_terms.json: all built-in terms, from the files that declare them.

A term's description is the doc comment of its function, or the comment above a registration with a
closure. Its parameters are the fields of the struct that the parser reads, with their doc comments.

    python tools/terms.py [--check]
"""

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from generated import ROOT, main

from polypod import _core
from polypod.motions.options import TERMS as TRACKING

OUT = ROOT / "python" / "polypod" / "builtin_terms.json"
KINDS = {
    "reward": "rewards",
    "reward_for": "rewards",
    "observation": "observations",
    "observation_of": "observations",
    "joint_observation": "observations",
    "foot_observation": "observations",
    "sensor_observation": "observations",
    "termination": "terminations",
    "body_event": "events",
    "reset_event": "events",
    "interval_event": "events",
    "curriculum": "curricula",
    "command": "commands",
    "velocity_command": "commands",
}
"""Kinds of terms by the method of the registry."""
MODES = {"body_event": "startup, reset", "reset_event": "reset", "interval_event": "interval"}
"""Modes of an event by the method that registers it."""
ELSEWHERE = {"base_velocity": "VelocityCommandConfig"}
"""Parameters of terms whose registration names no struct."""

REGISTRATION = re.compile(r"^ +registry\s*\.(\w+)\(\s*(\"\w+\"|[A-Z_]+),", re.MULTILINE)
STRUCT = re.compile(r"^(?:pub(?:\([^)]*\))? )?struct (\w+)[^;{(]*\{\n(.*?)^\}", re.MULTILINE | re.DOTALL)
FIELD = re.compile(r"^    (?:pub(?:\([^)]*\))? )?(?:r#)?(\w+): (.+),$", re.MULTILINE)
CONSTANT = re.compile(r"const (\w+): &str = \"(\w+)\";")
QUANTITY = re.compile(r"^    (\w+): (.+) => (.+), \"(.*)\";$", re.MULTILINE)
LISTS = {"[f32; 2]": "[low, high]", "[f64; 2]": "[low, high]", "[u32; 2]": "[low, high]"}
TYPES = {"f32": "number", "f64": "number", "u32": "whole number", "u64": "whole number", "usize": "whole number"}
WORDS = {"Angle": "number"}
TYPES |= {"bool": "true or false", "String": "text", "[f32; 3]": "[x, y, z]", "[f64; 3]": "[x, y, z]"}


def sources() -> dict[Path, str]:
    """The Rust files in which terms and their parameters stand."""
    paths = [path for folder in ("systems", "src/config") for path in (ROOT / folder).rglob("*.rs")]
    return {path: path.read_text() for path in [*paths, ROOT / "src" / "robot" / "roles.rs"]}


def plain(text: str) -> str:
    """A comment without links."""
    text = re.sub(r"\[(`[^`]*`)\]\([^)]*\)", r"\1", text)
    return re.sub(r"\[(`[^`]*`)\]", r"\1", text)


class Reader:
    """Finds terms and parameters in Rust sources."""

    def __init__(self) -> None:
        """Reads structs, enums, constants and quantities."""
        self.files = sources()
        everything = "\n".join(self.files.values())
        self.constants = dict(CONSTANT.findall(everything))
        self.units = {name: unit.strip() for name, _, _, unit in QUANTITY.findall(everything)}
        self.needs = self._commands(everything)

    def text(self, word: str) -> str:
        """A literal, or the value of a constant."""
        return word.strip('"') if word.startswith('"') else self.constants[word]

    def _commands(self, everything: str) -> dict[str, list[str]]:
        """Names of terms and of the commands that they follow."""
        found: dict[str, list[str]] = {}
        for loop in re.finditer(r"for term in \[(.*?)\] \{(.*?)\}", everything, re.DOTALL):
            for command in re.findall(r"needs_command\(term, (\w+)\)", loop[2]):
                for term in re.findall(r'"(\w+)"', loop[1]):
                    found.setdefault(term, []).append(self.text(command))
        for loop in re.finditer(r"for command in \[(.*?)\] \{(.*?)\}", everything, re.DOTALL):
            for term in re.findall(r'needs_command\("(\w+)", command\)', loop[2]):
                found.setdefault(term, []).extend(map(self.text, loop[1].split(", ")))
        for term, command in re.findall(r'needs_command\("(\w+)", ([A-Z_]+|"\w+")\)', everything):
            found.setdefault(term, []).append(self.text(command))
        return found

    def terms(self) -> Iterator[dict[str, Any]]:
        """All terms, in the order of their files."""
        for path, content in sorted(self.files.items()):
            for found in REGISTRATION.finditer(content):
                if (kind := KINDS.get(found[1])) is None:
                    continue
                name = self.text(found[2])
                call = content[found.start() : content.index(";\n", found.end())]
                yield {
                    "kind": kind,
                    "name": name,
                    **({"modes": MODES[found[1]]} if found[1] in MODES else {}),
                    "description": self.description(content, found.start(), call),
                    "parameters": self.parameters(name, content, call),
                    "commands": self.needs.get(name, []),
                    "source": str(path.relative_to(ROOT)),
                }

    def description(self, content: str, start: int, call: str) -> str:
        """Doc comment of the function, or the comment above a closure."""
        if not (is_closure := "|" in call):
            function = re.split(r",\s*", call.rstrip(")\n "))[-1]
            if (
                place := re.search(rf"^(?:pub(?:\([^)]*\))? )?fn {re.escape(function)}\b", content, re.MULTILINE)
            ) is None:
                return ""
            start = place.start()
        lines = []
        for line in reversed(content[:start].splitlines()):
            mark = "//" if is_closure else "///"
            text = line.strip()
            if text.startswith("#["):
                continue
            if not text.startswith(mark):
                break
            lines.append(text.removeprefix(mark).strip())
        return plain(" ".join(reversed(lines)))

    def parameters(self, name: str, content: str, call: str) -> list[dict[str, str]]:
        """Parameters of a term: the fields of the struct that its call or its functions name."""
        struct = ELSEWHERE.get(name) or self.struct_of(content, call)
        if struct in (None, "NoParams"):
            return []
        for text in (content, *self.files.values()):
            if read := re.search(rf'serde\(try_from = "(\w+)"\)\]\n(?:pub )?struct {struct}\b', text):
                struct = read[1]
            for found, body in STRUCT.findall(text):
                if found == struct:
                    return list(self.fields(text, body))
        raise SystemExit(f"{name}: there is no struct {struct}")

    def struct_of(self, content: str, call: str) -> str | None:
        """Name of the struct of parameters."""
        if found := re.search(r"\|(?:\w+: &?|)(\w+) ?(?:\{\})?,", call):
            if found[1] == "p":
                inner = re.search(r"let \w+: (\w+) = p;", content[content.index(call) :])
                return inner[1] if inner else None
            if found[1][0].isupper():
                return found[1]
        # the first one of two functions reads the parameters
        for function in re.findall(r"(?<!::)\b([a-z_0-9]+)(?=[,)]|$)", call):
            is_used = re.search(rf"^use .*\b{function}\b", content, re.MULTILINE)
            for text in self.files.values() if is_used else (content,):
                signature = re.search(rf"fn {function}(?:<[^>]*>)?\(\s*\w+: &?(\w+),", text)
                if signature and signature[1] not in (*TYPES, "RobotView"):
                    return signature[1]
        return None

    def fields(self, content: str, body: str) -> Iterator[dict[str, str]]:
        """Fields of a struct."""
        at = 0
        for found in FIELD.finditer(body):
            above, at = body[at : found.start()], found.end()
            if "flatten" in above:
                continue
            doc = " ".join(line.strip()[3:].strip() for line in above.splitlines() if line.strip().startswith("///"))
            quantity = re.search(r"values::\w+::<(\w+)", above)
            unit = self.units.get(quantity[1], "") if quantity else ""
            kind = found[2].removeprefix("Option<").removesuffix(">") if found[2].startswith("Option<") else found[2]
            name = renamed[1] if (renamed := re.search(r'rename = "(\w+)"', above)) else found[1]
            yield {
                "name": name,
                "type": self.type(content, kind),
                "unit": unit,
                "required": "no" if "serde(default" in above or found[2].startswith("Option<") else "yes",
                "description": plain(doc),
            }

    def type(self, content: str, kind: str) -> str:
        """A type in words."""
        if kind in LISTS:
            return LISTS[kind]
        if kind in TYPES:
            return TYPES[kind]
        if kind.startswith("Vec<"):
            return f"list of {self.type(content, kind[4:-1])}"
        for text in (content, *self.files.values()):
            if found := re.search(rf"enum {re.escape(kind)} \{{(.*?)\}}", text, re.DOTALL):
                # configs cannot name a variant that the parser skips
                shown = re.sub(r"#\[serde\(skip\)\]\n +\w+,", "", found[1])
                names = re.findall(r"^    (\w+),", shown, re.MULTILINE)
                return " or ".join(re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower() for name in names)
            for name, body in STRUCT.findall(text):
                if name == kind and kind not in WORDS:
                    return f"table of {', '.join(field['name'] for field in self.fields(text, body))}"
        return WORDS.get(kind, kind)


def reference() -> dict[str, Any]:
    """All terms by kind and name."""
    found: dict[str, Any] = {kind: {} for kind in sorted(set(KINDS.values()))}
    described = {"observations": json.loads(_core.observation_specs()), "commands": json.loads(_core.command_specs())}
    for term in Reader().terms():
        kind, name = term.pop("kind"), term.pop("name")
        if spec := described.get(kind, {}).get(name):
            term["description"] = spec["description"]
            term["units"] = spec.get("units", "")
        before = found[kind].get(name)
        if before is not None and "modes" in term:
            # one event of several modes
            before["modes"] += f", {term['modes']}"
            continue
        found[kind][name] = term
    found = {kind: dict(sorted(terms.items())) for kind, terms in found.items()}
    return {**found, "tracking": {name: tracking_term(*said) for name, said in TRACKING.items()}}


def tracking_term(sort: str, description: str) -> dict[str, Any]:
    """A term of tracking tasks, whose parameters are set by `--set motions.`."""
    more = {
        "reward": [("weight", "Factor of the term."), ("std", "Width of the bell curve, in the error's units.")],
        "termination": [("threshold", "Deviation beyond which the episode fails; null leaves it out.")],
        "observation": [],
    }
    parameters = [
        {"name": name, "type": "number", "unit": "", "required": "no", "description": text} for name, text in more[sort]
    ]
    words = f"{sort.capitalize()} of tasks that track motions. {description}"
    return {
        "description": words,
        "parameters": parameters,
        "commands": [],
        "source": "python/polypod/motions/tracking.py",
    }


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], __doc__, OUT, lambda: json.dumps(reference(), indent=1) + "\n"))
