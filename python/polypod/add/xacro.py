"""Xacro files, expanded in a separate process; see `polypod.add.xacro_child` for its guards."""

import sys
from collections.abc import Mapping
from pathlib import Path

from polypod import _core
from polypod.add import child, xacro_child
from polypod.extras import package
from polypod.files import real_path


def expand(
    file: Path, package_dirs: Mapping[str, Path], arguments: Mapping[str, str], within: Path | None = None
) -> str:
    """The URDF's text of a xacro file.

    Args:
        file: the xacro file. It may include files of its package and of those of `package_dirs`.
        package_dirs: ROS package -> folder.
        arguments: its `<xacro:arg>` by name.
        within: folder of an archive, beyond which no folder is the package's; None: there is none.

    Raises:
        ConfigError: where the package `xacro` is missing, and for what it or its guards refuse.
    """
    package("xacro", "expanding a xacro file", "add")
    package("yaml", "expanding a xacro file", "add")
    place = real_path(file)
    above = [folder for folder in place.parents if within is None or folder.is_relative_to(within)]
    own = next((folder for folder in above if (folder / "package.xml").is_file()), above[min(1, len(above) - 1)])
    roots = [own, *(real_path(folder) for folder in package_dirs.values())]
    request = {
        "file": str(place),
        "roots": [str(root) for root in roots],
        "packages": {own.name: str(own)} | {name: str(real_path(folder)) for name, folder in package_dirs.items()},
        "arguments": dict(arguments),
        "path": sys.path,
    }
    try:
        answer = child.ask(xacro_child.__file__, request, xacro_child.SECONDS, folder=place.parent, environment={})
    except child.UnansweredError as error:
        answer = {"error": f"its process {error}: memory and time are bounded"}
    if "text" not in answer:
        text = " ".join(str(answer["error"]).split())
        raise _core.ConfigError(
            f"{file}: xacro does not expand it: {text}; correct the file, or expand it yourself and add the URDF"
        )
    return str(answer["text"])
