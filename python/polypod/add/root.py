"""URDFs by another root."""

from xml.etree import ElementTree

import numpy as np

from polypod import rotations


def rooted(urdf: str, base: str) -> str:
    """A URDF whose root is the link `base`.

    Fixed joints above it, of empty links, hang on it the other way round.

    MuJoCo's free joint is that of the root. A text whose root it is already stays as it is.
    """
    tree = ElementTree.fromstring(urdf)
    above = {_end(joint, "child"): joint for joint in tree.findall("joint")}
    link: str | None = base
    while (joint := above.get(link)) is not None:
        link, lower = _end(joint, "parent"), link
        joint.set("type", "fixed")
        for tag, name in (("parent", lower), ("child", link)):
            (end,) = joint.findall(tag)
            end.set("link", str(name))
        origin = joint.find("origin")
        if origin is not None:
            _turn_round(origin)
    return urdf if link == base else ElementTree.tostring(tree, encoding="unicode")


def _turn_round(origin: ElementTree.Element) -> None:
    """Replaces the pose of an `<origin>` by its inverse."""
    x, y, z = (float(number) for number in origin.get("xyz", "0 0 0").split())
    roll, pitch, yaw = (float(number) for number in origin.get("rpy", "0 0 0").split())
    back = rotations.matrix_of_angles(roll, pitch, yaw).T
    place = -back @ np.array([x, y, z])
    origin.set("xyz", " ".join(repr(float(number)) for number in place))
    origin.set("rpy", " ".join(repr(number) for number in rotations.angles(back)))


def _end(joint: ElementTree.Element, tag: str) -> str | None:
    end = joint.find(tag)
    return None if end is None else end.get("link")
