"""`polypod schema`."""

import dataclasses
import json
from importlib import resources
from typing import Annotated, Any, Literal

import tyro

from polypod.commands.arguments import arg

Kind = Literal["task", "robot", "train", "tracking", "motion", "sweep"]


@dataclasses.dataclass(frozen=True)
class SchemaOf:
    """Print the JSON schema of a kind of TOML, with which editors complete and check it.

    `polypod schema task > task.schema.json` writes a file. `#:schema task.schema.json` as the first
    line of a TOML names it to editors that use Taplo.
    """

    kind: Annotated[Kind, tyro.conf.Positional, arg(metavar="KIND")]
    """task, robot, train, tracking (`--set motions.`), motion (key poses) or sweep."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        print(json.dumps(read(self.kind), indent=1, ensure_ascii=False))
        return 0


def read(kind: Kind) -> dict[str, Any]:
    """The schema of a kind of file."""
    file = resources.files("polypod") / "schemas" / f"{kind}.json"
    schema: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return schema
