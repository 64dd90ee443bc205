"""Paths of the files of a robot, by its name or the path of its config."""

import os
from pathlib import Path

from polypod.registration import PATH


def urdf_file(source: str, key: str) -> Path | None:
    """The URDF of a robot; None where it is built in.

    Args:
        source: name of the robot, or path of its config.
        key: `urdf` of its config: relative to the config, or to the folder that holds `configs/`
            and `assets/`.
    """
    folders = [Path(folder) for folder in os.environ.get(PATH, "").split(os.pathsep) if folder]
    if source.endswith(".toml"):
        config = Path(source).absolute()
        folders = [config.parent, *list(config.parents)[2:3], *folders]
    return next((folder / key for folder in folders if (folder / key).is_file()), None)
