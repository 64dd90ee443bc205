"""Watching a policy: in the browser, as a recording, or as a film that needs no display.

`polypod play` is its command; it needs the `play` extra.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from polypod.play.player import Player
    from polypod.play.viewer import Viewer
    from polypod.render.camera import Camera
    from polypod.render.film import Film
    from polypod.render.raster import picture, render
    from polypod.render.scene import Frame, RobotFrame, Scene

__all__ = ["Camera", "Film", "Frame", "Player", "RobotFrame", "Scene", "Viewer", "picture", "render"]
_MODULES = {
    "Camera": "render.camera",
    "Film": "render.film",
    "Frame": "render.scene",
    "Player": "play.player",
    "RobotFrame": "render.scene",
    "Scene": "render.scene",
    "Viewer": "play.viewer",
    "picture": "render.raster",
    "render": "render.raster",
}


def __getattr__(name: str) -> Any:
    """Imports what is asked for: pictures do without torch, which policies need."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"polypod.{_MODULES[name]}"), name)
