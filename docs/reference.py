"""The page of all keys of tasks, robots and train configs, from python/polypod/schemas/*.json."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

SCHEMAS = Path(__file__).resolve().parent.parent / "python" / "polypod" / "schemas"
PREFIX = "#/definitions/"
KINDS = {
    "rewards": "Terms of rewards",
    "observations": "Terms of observations",
    "terminations": "Terms of terminations",
    "events": "Terms of events",
    "curricula": "Terms of curricula",
    "commands": "Kinds of commands",
}
TITLES = {"task": "Tasks", "robot": "Robots", "train": "Train configs"}
TITLES |= {"tracking": "Tracking tasks", "motion": "Drawn motions", "sweep": "Sweeps"}
INTRODUCTION = """# Keys of configs

All keys that a task, a robot and a train config may have, with their values. `polypod schema task`
prints them for editors, `polypod terms NAME` says all of a term, and `polypod show NAME` says what
a config has. A file with `extends` says only what differs; one without says all that has no
default.
"""

Schema = dict[str, Any]


def page() -> str:
    """The page, as Markdown."""
    found = {kind: json.loads((SCHEMAS / f"{kind}.json").read_text(encoding="utf-8")) for kind in TITLES}
    of_robots = {"RobotConfig", *found["robot"]["definitions"]}
    lines = [INTRODUCTION]
    for kind, title in TITLES.items():
        definitions = found[kind].get("definitions", {})
        writer = Writer(definitions)
        lines += [f"## {title}\n", found[kind]["description"] + "\n", *writer.rows(found[kind]["properties"])]
        for name, schema in definitions.items():
            shapes = [schema, *schema.get("anyOf", [])]
            is_table = any("properties" in shape for shape in shapes)
            # a task changes robots, whose keys are said once
            if "." in name or not is_table or (kind == "task" and name in of_robots):
                continue
            lines += [f"### {name.removesuffix('Config')}\n", schema["description"] + "\n"]
            for shape in shapes:
                lines += writer.rows(own(shape))
        lines += writer.terms()
    return "\n".join(lines)


def own(schema: Schema) -> dict[str, Schema]:
    """Keys of a table, without entries by the names of terms."""
    return {
        key: value
        for key, value in schema.get("properties", {}).items()
        if not any(place.partition(".")[0] in KINDS for place in references(value))
    }


def references(schema: Schema) -> Iterator[str]:
    """Names of the definitions that a schema is."""
    if "$ref" in schema:
        yield schema["$ref"].removeprefix(PREFIX)
    for word in ("allOf", "anyOf"):
        for inner in schema.get(word, []):
            yield from references(inner)


class Writer:
    """Writes tables of the keys of a schema."""

    def __init__(self, definitions: dict[str, Schema]) -> None:
        """With the definitions that the schema refers to."""
        self.definitions = definitions

    def terms(self) -> Iterator[str]:
        """Tables of the built-in terms."""
        for kind, title in KINDS.items():
            names = [key for key in self.definitions if key.startswith(f"{kind}.") and not key.endswith(".whole")]
            if names:
                yield f"### {title}\n"
            for name in sorted(names):
                schema = self.definitions[name]
                yield f"#### `{name.partition('.')[2]}`\n\n{schema['description']}\n"
                yield from self.rows(schema["properties"])

    def rows(self, properties: dict[str, Schema]) -> Iterator[str]:
        """A table of keys."""
        if not properties:
            return
        yield "| key | value | meaning |\n|---|---|---|"
        for key, schema in properties.items():
            yield from self.row(key, schema)
        yield ""

    def row(self, key: str, schema: Schema) -> Iterator[str]:
        """The row of a key, and those of the keys below it."""
        meaning = schema.get("description", "").replace("|", "\\|").replace("<", "&lt;")
        yield f"| `{key}` | {self.value(schema)} | {meaning} |"
        for inner, below in own(schema).items():
            yield from self.row(f"{key}.{inner}", below)

    def value(self, schema: Schema) -> str:
        """The values of a key, in words."""
        if "enum" in schema or "const" in schema:
            names = schema.get("enum", [schema.get("const")])
            return ", ".join(f"`{json.dumps(name)}`" for name in names)
        if "type" not in schema:
            some = [self.named(place) for place in references(schema)]
            others = [self.value(other) for other in schema.get("anyOf", []) if "type" in other]
            return " or ".join(dict.fromkeys([*others, *some]))
        words = {"integer": "whole number", "boolean": "true or false", "string": "text", "object": "table"}
        text = words.get(schema["type"], schema["type"])
        if schema["type"] == "array":
            is_fixed = "minItems" in schema and schema.get("maxItems") == schema["minItems"]
            return (f"{schema['minItems']} x " if is_fixed else "list of ") + self.value(schema["items"])
        inner = schema.get("additionalProperties")
        if isinstance(inner, dict) and inner:
            return f"table of {self.value(inner)}"
        if "minimum" in schema and "maximum" in schema:
            return f"{text}, {schema['minimum']:,} to {schema['maximum']:,}"
        if "exclusiveMinimum" in schema:
            end = f" to {schema['maximum']:,}" if "maximum" in schema else ""
            return f"{text}, above {schema['exclusiveMinimum']:,}{end}"
        return f"{text}, {schema['minimum']:,} or above" if "minimum" in schema else text

    def named(self, place: str) -> str:
        """A link to a table, or the values of a definition that is none."""
        name = place.partition(".")[0].removesuffix("Config")
        found = self.definitions[place]
        if "enum" in found:
            return self.value(found)
        return f"[{name}](#{'robots' if name == 'Robot' else name.lower()})"
