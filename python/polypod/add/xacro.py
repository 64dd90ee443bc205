"""Xacro files, expanded in a separate process; see `polypod.add.xacro_child` for its guards."""

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from polypod import _core
from polypod.add import xacro_child
from polypod.extras import package
from polypod.files import real_path

SECONDS = 120
"""A file that takes longer is refused, s."""
MOST_BYTES = 64 << 20
"""Size of an expanded file."""


def expand(file: Path, package_dirs: Mapping[str, Path], arguments: Mapping[str, str]) -> str:
    """The URDF's text of a xacro file.

    Args:
        file: the xacro file. It may include files of its package and of those of `package_dirs`.
        package_dirs: ROS package -> folder.
        arguments: its `<xacro:arg>` by name.

    Raises:
        ConfigError: where the package `xacro` is missing, and for what it or its guards refuse.
    """
    package("xacro", "expanding a xacro file", "add")
    package("yaml", "expanding a xacro file", "add")
    place = real_path(file)
    own = next(
        (above for above in place.parents if (above / "package.xml").is_file()),
        place.parents[min(1, len(place.parents) - 1)],
    )
    roots = [own, *(real_path(folder) for folder in package_dirs.values())]
    request = {
        "file": str(place),
        "roots": [str(root) for root in roots],
        "packages": {own.name: str(own)} | {name: str(real_path(folder)) for name, folder in package_dirs.items()},
        "arguments": dict(arguments),
        "path": sys.path,
    }
    try:
        done = subprocess.run(
            [sys.executable, "-I", str(Path(xacro_child.__file__))],
            input=json.dumps(request).encode(),
            capture_output=True,
            timeout=SECONDS,
            check=False,
            env={},
            cwd=place.parent,
        )
    except subprocess.TimeoutExpired:
        raise _core.ConfigError(
            f"{file}: xacro takes more than {SECONDS} s; expand it yourself, and add the URDF"
        ) from None
    try:
        answer = (
            json.loads(done.stdout) if len(done.stdout) <= MOST_BYTES else {"error": "the expanded file is too large"}
        )
    except ValueError:
        answer = {"error": f"its process ended with {done.returncode}: memory and time are bounded"}
    if "text" not in answer:
        text = " ".join(str(answer["error"]).split())
        raise _core.ConfigError(
            f"{file}: xacro does not expand it: {text}; correct the file, or expand it yourself and add the URDF"
        )
    return str(answer["text"])
