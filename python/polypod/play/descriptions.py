"""The makers' meshes of robots."""

from polypod.play.looks import Look
from polypod.play.mesh import Array


def check() -> None:
    """Raises ConfigError where a package is missing."""


def looks(robot: str, links: list[str], rest: Array) -> list[Look]:
    """Looks."""
    raise NotImplementedError
