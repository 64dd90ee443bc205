"""`polypod show`."""

import dataclasses
import json
from typing import Annotated, Any, Literal

import tyro

from polypod import _core
from polypod.commands.arguments import Overrides, arg
from polypod.compat import tomllib

Kind = Literal["task", "robot", "train"]


@dataclasses.dataclass(frozen=True)
class Show:
    """Show a task, a robot or a train config with all its values, and where each comes from."""

    name: Annotated[str, tyro.conf.Positional, arg(metavar="NAME")]
    """Name, alias or path of a task, a robot or a train config."""
    kind: Annotated[Kind | None, arg(metavar="KIND")] = None
    """task, robot or train. Default: the first of them that has the name."""
    set: Overrides = ()
    """Changes of a task or a train config. May be repeated."""
    only: Annotated[str | None, arg(metavar="KEY")] = None
    """Begin of the keys whose values are shown, such as events.push_robot."""
    json: bool = False
    """Print JSON in place of lines."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        kind = self.kind or kind_of(self.name)
        found = explained(kind, self.name, list(self.set))
        if self.only is not None:
            keys = self.only.split(".")
            found = [value for value in found if value.key.split(".")[: len(keys)] == keys]
            if not found:
                raise _core.ConfigError(f"--only {self.only}: {self.name} has no such key; leave it out to see all")
        if self.json:
            print(json.dumps([dataclasses.asdict(value) for value in found], indent=2))
            return 0
        texts = [f"{value.key} = {_toml(value.value)}" for value in found]
        width = min(max(map(len, texts)), 60)
        print(f"{kind} {self.name}")
        for text, value in zip(texts, found, strict=True):
            print(f"{text:<{width}}  # {value.origin}")
        return 0


def explained(kind: Kind, name: str, overrides: list[str]) -> list[Any]:
    """The values of a config with their origins. Raises ConfigError."""
    from polypod import origins

    if kind == "train":
        from polypod.runs import config

        # `polypod train` writes train. before its keys
        changes = [text.removeprefix("train.") for text in overrides]
        return origins.values(config.layers(name), config.load(name, changes).as_dict(), changes)
    if kind == "robot" and overrides:
        raise _core.ConfigError(
            f"--set changes tasks and train configs; a task changes {name} by robot_overrides.{name}.<key>=<value>"
        )
    texts, resolved = _core.explain_robot(name) if kind == "robot" else _core.explain_task(name, overrides)
    return origins.values([(file, tomllib.loads(text)) for file, text in texts], tomllib.loads(resolved), overrides)


def kind_of(name: str) -> Kind:
    """The kind of config that has a name. Raises UnknownNameError."""
    if any(entry["name"] == name for entry in _core.robots()):
        return "robot"
    if any(entry["name"] == name for entry in _core.train_configs()):
        return "train"
    try:
        _core.explain_task(name)
    except _core.UnknownNameError as error:
        if not name.endswith(".toml"):
            raise _core.UnknownNameError(f"{name[:80]} is no task, robot or train config; see polypod list") from error
        raise
    except _core.ConfigError as error:
        if not name.endswith(".toml"):
            raise
        raise _core.ConfigError(f"{error}; of another kind of file, say --kind robot or --kind train") from error
    return "task"


def _toml(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(inner)}" for key, inner in value.items()) + "}"
    if value is None:
        return "null"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else str(value)
