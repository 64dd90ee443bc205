"""Writes python/polypod/schemas/*.json, which editors and the page of all keys read.

A task's and a robot's keys are the fields of the structs that the parser reads, with their doc
comments. A train config's keys are the fields of `polypod.runs.schema`, those of motions and sweeps
the fields of structs that read them. Terms are those of tools/terms.py.

    python tools/schemas.py [--check]
"""

import ast
import dataclasses
import inspect
import json
import math
import re
import sys
import textwrap
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_origin

import msgspec
import terms as terms_of_rust

from polypod.motions import key_poses, options
from polypod.runs import config as train_config
from polypod.training import sweep

ROOT = Path(__file__).parents[1]
OUT = ROOT / "python" / "polypod" / "schemas"
DRAFT = "http://json-schema.org/draft-07/schema#"

Schema = dict[str, Any]

ITEM = re.compile(
    r"(?P<above>(?:^(?:///|#\[)[^\n]*\n)*)^(?:pub(?:\([^)]*\))? )?(?P<sort>struct|enum) (?P<name>\w+)"
    r"(?:<(?P<parameter>\w+)>)?[^;{(\n]*\{\n(?P<body>.*?)^\}",
    re.MULTILINE | re.DOTALL,
)
VARIANT = re.compile(
    r"^    (?P<name>[A-Z]\w*)(?:\((?P<inner>[\w<>]+)\)| \{\n(?P<fields>.*?)^    \}| \{\})?,$", re.MULTILINE | re.DOTALL
)
NUMBER = re.compile(r"const (\w+): [\w]+ = ([-\w.+]+);")
SIMPLE: dict[str, Schema] = {
    "bool": {"type": "boolean"},
    "String": {"type": "string"},
    "PathBuf": {"type": "string"},
    "f32": {"type": "number"},
    "f64": {"type": "number"},
    "u32": {"type": "integer", "minimum": 0},
    "u64": {"type": "integer", "minimum": 0},
    "usize": {"type": "integer", "minimum": 0},
    "Table": {"type": "object"},
}
BY_TERM = {
    "RewardConfig": "rewards",
    "EventConfig": "events",
    "CurriculumConfig": "curricula",
    "CommandConfig": "commands",
    "ObservationTerm": "observations",
    "TerminationConfig": "terminations",
}
"""Kinds of terms by the struct of the keys that all of them take."""
READ_AS = {"Draw": "UncheckedDraw"}
"""Structs that the parser reads in the place of others: they say what may be left out."""
READ_LATER = {
    "robot_overrides": "BTreeMap<String, RobotConfig>",
    "terminations": "BTreeMap<String, TerminationConfig>",
}
"""Types of tables that the parser reads after the file."""
EXTENDS: Schema = {
    "description": "Name or path of the config below, or a list of them, of which the later ones win.",
    "anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}],
}


@dataclasses.dataclass(frozen=True)
class Item:
    """A struct or an enum of the parser."""

    sort: str
    above: str
    body: str
    parameter: str | None = None
    """Name of the type that a generic struct leaves open."""

    def of(self, type_: str | None) -> "Item":
        """A generic struct with its open type filled in."""
        return Item(self.sort, self.above, re.sub(rf"(?<=: ){self.parameter}(?=,)", type_ or "", self.body))

    @property
    def description(self) -> str:
        """The doc comment."""
        return doc(self.above)


def doc(above: str) -> str:
    """The doc comment in the lines above an item or a field."""
    lines = (line.strip() for line in above.splitlines())
    text = " ".join(line[3:].strip() for line in lines if line.startswith("///"))
    return re.sub(r"\(see `\w+`\)", "", terms_of_rust.plain(text)).replace(" ,", ",").strip()


def snake(name: str) -> str:
    """A variant as a config writes it."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


class Parser:
    """Schemas of the structs in src/config."""

    def __init__(self) -> None:
        """Reads the sources."""
        paths = [*sorted((ROOT / "src" / "config").glob("*.rs")), ROOT / "src" / "robot" / "roles.rs"]
        text = "\n".join(path.read_text() for path in paths)
        self.items = {
            item["name"]: Item(item["sort"], item["above"], item["body"], item["parameter"])
            for item in ITEM.finditer(text)
        }
        # a termination has no keys but its term's
        self.items["TerminationConfig"] = Item("struct", "/// Parameters of a termination.", "")
        everything = text + (ROOT / "src" / "bounds.rs").read_text()
        self.numbers = {name: number.replace("_", "") for name, number in NUMBER.findall(everything)}
        self.bounds = {
            name: (self.number(least), self.number(most))
            for name, least, most, _ in terms_of_rust.QUANTITY.findall(everything)
        }
        self.terms = terms_of_rust.reference()
        self.defs: dict[str, Schema] = {}

    def number(self, text: str) -> float:
        """A literal or a constant."""
        return math.pi if text.endswith("::PI") else float(self.numbers.get(text, text))

    def ref(self, name: str, whole: bool) -> Schema:
        """A reference to the schema of an item, of which a layer may give a part."""
        key = f"{name}.whole" if whole else name
        if key not in self.defs:
            self.defs[key] = {}
            self.defs[key] = self.schema_of(name, whole)
        return {"$ref": f"#/definitions/{key}"}

    def schema_of(self, name: str, whole: bool) -> Schema:
        """The schema of a struct or an enum."""
        item = self.items[name]
        if name == "CommandsConfig":
            return self.commands(item, whole)
        if name == "ObservationsConfig":
            return self.observations(item, whole)
        if name in BY_TERM:
            return self.entry(name, item, whole)
        if item.sort == "enum":
            return self.enum(item, {}, [], whole)
        properties, required = self.properties(item, whole)
        if name in READ_AS:
            _, required = self.properties(self.items[READ_AS[name]], whole)
        flat = [found for found, above in fields(item.body) if "flatten" in above]
        if flat:
            return self.enum(self.items[flat[0][2]], properties, required, whole)
        return table(item.description, properties, required if whole else [])

    def properties(self, item: Item, whole: bool) -> tuple[dict[str, Schema], list[str]]:
        """Keys of a struct, and those that it must have."""
        properties, required = {}, []
        all_default = re.search(r"serde\([^)]*\bdefault\b", item.above) is not None
        for found, above in fields(item.body):
            if "flatten" in above or "serde(skip)" in above:
                continue
            kind = READ_LATER.get(found[1], found[2])
            # a task overrides parts of a robot, also where it is on top of none
            properties[found[1]] = self.field(kind, above, whole and found[1] != "robot_overrides")
            if not (all_default or re.search(r"\bdefault\b", attributes(above)) or found[2].startswith("Option<")):
                required.append(found[1])
        return properties, required

    def field(self, kind: str, above: str, whole: bool) -> Schema:
        """The schema of a field."""
        schema = self.bounded(
            self.kind(kind.removeprefix("Option<").removesuffix(">") if "Option<" in kind else kind, whole), above
        )
        description = {"description": doc(above)}
        # draft 7 ignores what stands next to a reference
        return {**description, "allOf": [schema]} if "$ref" in schema else {**description, **schema}

    def kind(self, kind: str, whole: bool) -> Schema:
        """The schema of a type."""
        if kind in SIMPLE:
            return dict(SIMPLE[kind])
        if found := re.fullmatch(r"\[(\w+); (\d)\]", kind):
            return {
                "type": "array",
                "items": self.kind(found[1], whole),
                "minItems": int(found[2]),
                "maxItems": int(found[2]),
            }
        if found := re.fullmatch(r"Vec<(.+)>", kind):
            items = {"type": "array", "items": self.kind(found[1], True)}
            if not self.is_table(found[1]) or whole:
                return items
            # a layer changes the elements that it names
            return {"anyOf": [items, {"type": "object", "additionalProperties": self.kind(found[1], False)}]}
        if found := re.fullmatch(r"BTreeMap<String, (.+)>", kind):
            if found[1].startswith("BTreeMap<String, RewardConfig"):
                return {"type": "object", "additionalProperties": self.by_term("RewardConfig", whole)}
            if found[1] in BY_TERM:
                return self.by_term(found[1], whole)
            return {"type": "object", "additionalProperties": self.kind(found[1], whole)}
        return self.ref(kind, whole)

    def is_table(self, kind: str) -> bool:
        """Whether a type is a table with fixed keys."""
        item = self.items.get(kind)
        return item is not None and (item.sort == "struct" or "serde(tag" in item.above)

    def bounded(self, schema: Schema, above: str) -> Schema:
        """With the bounds that the field's reader checks."""
        found = re.search(r"values::(\w+)(?:::<(\w+))?", attributes(above))
        if found is None or found[1] == "is_zero":
            return schema
        if found[2] in self.bounds:
            bounds = self.bounds[found[2]]
        elif found[1] == "count_up_to":
            bounds = (1, int(self.number(found[2])))
        else:
            most = self.number("MAX_COMMAND")
            bounds = {
                "fraction": (0, 1),
                "at_least_one": (1, math.inf),
                "physics_step": (self.number("MIN_DT"), self.number("MAX_DT")),
                "command_range": (-most, most),
                "optional_command_range": (-most, most),
                "env_shares": (1, 1000),
                "step_range": (0, int(self.number("MAX_DELAY"))),
            }.get(found[1], (-math.inf, math.inf))
        keys = {key: value for key, value in zip(("minimum", "maximum"), bounds, strict=True) if math.isfinite(value)}
        for inner in ("items", "additionalProperties"):
            if inner in schema:
                return {**schema, inner: {**schema[inner], **keys}}
        return {**schema, **keys}

    def enum(self, item: Item, properties: dict[str, Schema], required: list[str], whole: bool) -> Schema:
        """Names, or tables that a key tells apart."""
        tag = re.search(r'tag = "(\w+)"', item.above)
        variants = list(VARIANT.finditer(re.sub(r"#\[serde\(skip\)\]\n +\w+,", "", item.body)))
        if tag is None:
            return {"description": item.description, "enum": [snake(found["name"]) for found in variants]}
        tables = []
        for found in variants:
            body = textwrap.dedent(re.sub(r"^    ", "", found["fields"] or "", flags=re.MULTILINE))
            inner = self.inner(found["inner"]) if found["inner"] else Item("struct", "", textwrap.indent(body, "    "))
            own, needed = self.properties(inner, whole)
            above = item.body[: item.body.index(found[0])]
            name = {"description": doc(last_comment(above)), "const": snake(found["name"])}
            keys = {tag[1]: name, **properties, **own}
            tables.append(table(name["description"], keys, [tag[1], *required, *needed] if whole else []))
        return {"description": item.description, "anyOf": tables}

    def inner(self, kind: str) -> Item:
        """The struct of a variant, which may be generic."""
        name, _, type_ = kind.removesuffix(">").partition("<")
        return self.items[name].of(type_) if type_ else self.items[name]

    def commands(self, item: Item, whole: bool) -> Schema:
        """The commands of a task."""
        velocity = {"description": "A velocity of the base.", "allOf": [self.ref("VelocityCommandConfig", whole)]}
        others = self.by_term("CommandConfig", whole)
        others["properties"]["base_velocity"] = velocity
        return {"description": item.description, **others}

    def observations(self, item: Item, whole: bool) -> Schema:
        """The groups of observations."""
        group = self.kind("Vec<ObservationTerm>", whole)
        properties, _ = self.properties(item, whole)
        found: Schema = {
            "description": item.description,
            "type": "object",
            "properties": {**properties, "policy": {"description": properties["policy"]["description"], **group}},
            "additionalProperties": group,
        }
        return {**found, "required": ["policy"]} if whole else found

    def by_term(self, name: str, whole: bool) -> Schema:
        """Entries by the names of terms; other names are aliases, Python's or plugins' terms."""
        kind = BY_TERM[name]
        entries = {
            term: {"description": found["description"], **self.of_term(name, term, whole)}
            for term, found in self.terms[kind].items()
            if (name, term) != ("CommandConfig", "base_velocity")
        }
        return {"type": "object", "properties": entries, "additionalProperties": self.ref(name, whole)}

    def of_term(self, name: str, term: str, whole: bool) -> Schema:
        """An entry whose key is a term's name: that term, or the one that `term` names."""
        own = {"$ref": f"#/definitions/{self.term_def(name, term, whole)}"}
        if "term" not in self.properties(self.items[name], whole)[0]:
            return {"allOf": [own]}
        return {"anyOf": [own, {"allOf": [{"required": ["term"]}, self.ref(name, whole)]}]}

    def term_def(self, name: str, term: str, whole: bool) -> str:
        """The key of the schema of a built-in term."""
        key = f"{BY_TERM[name]}.{term}{'.whole' if whole else ''}"
        if key not in self.defs:
            item, found = self.items[name], self.terms[BY_TERM[name]][term]
            properties, required = self.properties(item, whole)
            for parameter in found["parameters"]:
                properties[parameter["name"]] = parameter_schema(parameter)
                required += [parameter["name"]] if parameter["required"] == "yes" else []
            if "term" in properties:
                properties["term"] = {**properties["term"], "const": term}
            if "modes" in found:
                properties["mode"] = {"description": "When it happens.", "enum": found["modes"].split(", ")}
            self.defs[key] = table(found["description"], properties, required if whole else [])
        return key

    def entry(self, name: str, item: Item, whole: bool) -> Schema:
        """An entry whose key is no built-in term's name: `term` may name one."""
        properties, required = self.properties(item, whole)
        found = {**table(item.description, properties, required if whole else []), "additionalProperties": True}
        if "term" not in properties:
            return found
        conditions = [
            {
                "if": {"properties": {"term": {"const": term}}, "required": ["term"]},
                "then": {"$ref": f"#/definitions/{self.term_def(name, term, whole)}"},
            }
            for term in self.terms[BY_TERM[name]]
        ]
        return {**found, "allOf": conditions}

    def document(self, name: str, title: str) -> Schema:
        """The schema of a file."""
        self.defs = {}
        part = self.schema_of(name, False)
        self.ref(name, True)
        whole = self.defs[f"{name}.whole"]
        # a file on top of none says all
        return {
            "$schema": DRAFT,
            "title": title,
            "description": part["description"],
            "type": "object",
            "properties": {"extends": EXTENDS, **part["properties"]},
            "additionalProperties": False,
            "if": {"not": {"required": ["extends"]}},
            "then": {"$ref": f"#/definitions/{name}.whole"},
            "definitions": {**self.defs, f"{name}.whole": {**whole, "additionalProperties": True}},
        }


def fields(body: str) -> Iterator[tuple[re.Match[str], str]]:
    """Fields of a struct, each with the lines above it."""
    at = 0
    for found in terms_of_rust.FIELD.finditer(body):
        yield found, body[at : found.start()]
        at = found.end()


def attributes(above: str) -> str:
    """The attributes above a field, without its comment."""
    return "\n".join(line for line in above.splitlines() if not line.strip().startswith("//"))


def last_comment(above: str) -> str:
    """The doc comment at the end of a text."""
    kept: list[str] = []
    for line in reversed(above.rstrip().splitlines()):
        if not line.strip().startswith(("///", "#[")):
            break
        kept.append(line)
    return "\n".join(reversed(kept))


def table(description: str, properties: dict[str, Schema], required: list[str]) -> Schema:
    """The schema of a table with these keys and no others."""
    found: Schema = {"description": description, "type": "object", "properties": properties}
    return {**found, **({"required": required} if required else {}), "additionalProperties": False}


def parameter_schema(parameter: dict[str, str]) -> Schema:
    """The schema of a term's parameter."""
    unit = f" Unit: {parameter['unit']}." if parameter["unit"] else ""
    return {"description": parameter["description"] + unit, **words_schema(parameter["type"])}


def words_schema(words: str) -> Schema:
    """The schema of a type in the words of `polypod terms`."""
    number = {"type": "number"}
    if words.startswith("list of "):
        return {"type": "array", "items": words_schema(words.removeprefix("list of "))}
    if words.startswith("table of "):
        keys = words.removeprefix("table of ").split(", ")
        return {"type": "object", "properties": {key: {} for key in keys}, "additionalProperties": False}
    simple = {
        "number": number,
        "whole number": {"type": "integer", "minimum": 0},
        "true or false": {"type": "boolean"},
        "text": {"type": "string"},
        "[low, high]": {"type": "array", "items": number, "minItems": 2, "maxItems": 2},
        "[x, y, z]": {"type": "array", "items": number, "minItems": 3, "maxItems": 3},
    }
    return simple[words] if words in simple else {"enum": words.split(" or ")}


def train_schema() -> Schema:
    """The schema of a train config."""
    bounds = {(section, key): (least, most) for section, key, least, most in train_config.NUMBERS}
    sections = {}
    for section, type_ in train_config.SECTIONS.items():
        documented = attribute_docs(type_)
        properties = {}
        for field in dataclasses.fields(type_):
            schema = python_schema(field.type)
            if (section, field.name) in bounds:
                least, most = bounds[section, field.name]
                schema = {**schema, "minimum": least, "maximum": most}
            if field.name in train_config.CHOICES:
                schema = {"enum": list(train_config.CHOICES[field.name])}
            default = "" if field.default in (dataclasses.MISSING, None) else f" Default: {json.dumps(field.default)}."
            if field.default_factory is not dataclasses.MISSING:
                default = f" Default: {json.dumps(field.default_factory())}."
            properties[field.name] = {"description": documented.get(field.name, "") + default, **schema}
        sections[section] = table(inspect.getdoc(type_).split(": ", 1)[1].replace("\n", " "), properties, [])
    return {
        "$schema": DRAFT,
        "title": "polypod train config",
        "description": "What is trained, and how.",
        "type": "object",
        "properties": {"extends": EXTENDS, **sections},
        "additionalProperties": False,
    }


def struct_schema(type_: type[msgspec.Struct], title: str) -> Schema:
    """The schema of a file that is read as a struct."""
    (_,), found = msgspec.json.schema_components([type_], ref_template="#/definitions/{name}")
    for name, schema in found.items():
        schema.pop("title")
        documented = attribute_docs(getattr(sys.modules[type_.__module__], name))
        for key, value in schema["properties"].items():
            # a default of the parser says nothing where it stands for an absent key
            value = {inner: of for inner, of in value.items() if inner != "default" or of not in ([], None, {})}
            default = f" Default: {json.dumps(value.pop('default'))}." if "default" in value else ""
            if schema_of_some := [of for of in value.get("anyOf", []) if of != {"type": "null"}]:
                # an absent key stands for null, which TOML lacks
                value = schema_of_some[0] if key not in schema.get("required", ()) else value
            if "$ref" in value:
                value = {"allOf": [value]}
            schema["properties"][key] = {"description": documented[key] + default, **value}
    whole = found.pop(type_.__name__)
    return {"$schema": DRAFT, "title": title, **whole, "definitions": found}


def tracking_schema() -> Schema:
    """The schema of the options of tracking tasks."""
    schema = struct_schema(options.Options, "polypod options of tracking tasks")
    for kind, word in (("rewards", "reward"), ("terminations", "termination")):
        of = schema["properties"][kind].pop("additionalProperties")
        terms = {name: text for name, (sort, text) in options.TERMS.items() if sort == word}
        names = {name: {"description": text, "allOf": [of]} for name, text in terms.items()}
        schema["properties"][kind] |= {"properties": names, "additionalProperties": False}
    # `--set` changes single options
    schema.pop("required")
    return schema


def attribute_docs(type_: type) -> dict[str, str]:
    """Descriptions of the fields of a dataclass or a struct: the strings below them."""
    found: dict[str, str] = {}
    is_struct = issubclass(type_, msgspec.Struct)
    read = [type_] if is_struct else [of for of in type_.__mro__ if dataclasses.is_dataclass(of)]
    for of in reversed(read):
        (node,) = ast.parse(textwrap.dedent(inspect.getsource(of))).body
        assert isinstance(node, ast.ClassDef)
        for field, below in zip(node.body, node.body[1:], strict=False):
            is_text = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and is_text:
                found[field.target.id] = " ".join(str(below.value.value).split())
    return found


def python_schema(kind: Any) -> Schema:
    """The schema of a type of a dataclass."""
    if isinstance(kind, types.UnionType):
        some = [python_schema(of) for of in get_args(kind) if of is not type(None)]
        return some[0] if len(some) == 1 else {"anyOf": some}
    if get_origin(kind) is list:
        return {"type": "array", "items": python_schema(get_args(kind)[0])}
    if get_origin(kind) is dict:
        return {"type": "object", "additionalProperties": python_schema(get_args(kind)[1])}
    return {"type": {bool: "boolean", int: "integer", float: "number", str: "string"}[kind]}


def schemas() -> dict[str, Schema]:
    """The schemas by kind of file."""
    parser = Parser()
    return {
        "task": parser.document("TaskConfig", "polypod task"),
        "robot": parser.document("RobotConfig", "polypod robot"),
        "train": train_schema(),
        "tracking": tracking_schema(),
        "motion": struct_schema(key_poses.Drawing, "polypod drawn motion"),
        "sweep": struct_schema(sweep.SweepFile, "polypod sweep"),
    }


def main(arguments: list[str]) -> int:
    """Writes the files, or with --check says whether they are the present ones."""
    if arguments not in ([], ["--check"]):
        print(__doc__, file=sys.stderr)
        return 2
    found = schemas()
    texts = {OUT / f"{kind}.json": json.dumps(schema, separators=(",", ":")) + "\n" for kind, schema in found.items()}
    OUT.mkdir(exist_ok=True)
    for path, text in texts.items():
        if not arguments:
            path.write_text(text)
        elif not path.is_file() or path.read_text() != text:
            print(f"{path.relative_to(ROOT)} is not what the sources say; run python tools/schemas.py", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
