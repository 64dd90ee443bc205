"""Reads elements of a URDF that may be missing."""

from collections.abc import Collection
from xml.etree import ElementTree


def link_at(joint: ElementTree.Element, end: str) -> str:
    """Name of the link at a joint's end, "parent" or "child"; empty where the joint names none."""
    found = joint.find(end)
    return "" if found is None else found.get("link", "")


def mass_of(link: ElementTree.Element) -> float:
    """Mass of a link, kg; 0 without one. Raises ValueError for text that is no number."""
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else float(mass.get("value", 0.0))


def and_more(links: Collection[str]) -> str:
    """Clause for a note on the first of some links: how many more there are."""
    more = len(links) - 1
    return f" (like {more} more link{'s' if more > 1 else ''})" if more else ""
