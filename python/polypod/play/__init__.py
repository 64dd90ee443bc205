"""Watching a policy: in the browser, as a recording, or as a film that needs no display.

`polypod play` is its command; it needs the `play` extra.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from polypod.play.camera import Camera
    from polypod.play.film import Film
    from polypod.play.player import Player
    from polypod.play.raster import picture, render
    from polypod.play.scene import Frame, RobotFrame, Scene
    from polypod.play.viewer import Viewer

__all__ = ["Camera", "Film", "Frame", "Player", "RobotFrame", "Scene", "Viewer", "picture", "render"]
_MODULES = {
    "Camera": "camera",
    "Film": "film",
    "Frame": "scene",
    "Player": "player",
    "RobotFrame": "scene",
    "Scene": "scene",
    "Viewer": "viewer",
    "picture": "raster",
    "render": "raster",
}


def __getattr__(name: str) -> Any:
    """Imports what is asked for: pictures do without torch, which policies need."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
