"""Watching a policy: in the browser, as a recording, or as a film that needs no display.

`polypod play` is its command; it needs the `play` extra.
"""

from polypod.play.camera import Camera
from polypod.play.film import Film
from polypod.play.player import Frame, Player, RobotFrame
from polypod.play.raster import picture, render
from polypod.play.viewer import Viewer

__all__ = ["Camera", "Film", "Frame", "Player", "RobotFrame", "Viewer", "picture", "render"]
