"""The files of a robot: what `polypod deploy write` and `polypod deploy show` give."""

import json
from pathlib import Path

from polypod import _core
from polypod.deploy.check import open_file
from polypod.deploy.header import header_of
from polypod.files import write_bytes

ONBOARD = Path(__file__).parent / "onboard"
"""The loops, which need no polypod."""


def shown(path: Path) -> str:
    """The contract of a file, for reading. Raises ConfigError."""
    return json.dumps(json.loads(open_file(path).text), indent=2)


def write(path: Path, out: Path) -> list[Path]:
    """Writes a graph, its contract as JSON and as a C++ header, and the loops.

    Raises ConfigError.
    """
    file = open_file(path)
    written = {
        out / path.name: file.data,
        out / "contract.json": (json.dumps(json.loads(file.text), indent=2) + "\n").encode(),
        out / "contract.hpp": header_of(file.contract).encode(),
    }
    for source in sorted(ONBOARD.iterdir()):
        if source.suffix in (".py", ".hpp"):
            written[out / "onboard" / source.name] = source.read_bytes()
    try:
        for place, data in written.items():
            write_bytes(place, data)
    except OSError as error:
        raise _core.ConfigError(f"cannot write to {out}: {error.strerror}; choose another --out") from error
    return list(written)
