"""Base frames of URDFs that are not x forward and z up in the middle, as CAD programs write them.

In such a frame legs lie to one side of the body, and pitch is roll: the joints of a robot get the
roles of others, or none. An empty root above the base, with the right axes, mends that:
`src/robot/base.rs` takes the frame whose axes fit the joints. A frame to one side of the middle
plane is moved.
"""

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from polypod import _core
from polypod.arrays import Array

ROOT = "x_forward_z_up"
"""Name of the link that is put above the root."""
TURNING = ("revolute", "continuous")
ADVANTAGE = 1.1
"""Share of the joints that turn about the axis to the left, at least, over that of the next axis:
hips, knees, ankles and elbows do."""
ASIDE = 0.03
"""Least distance of a foot from the middle plane, m."""
OFF = 0.01
"""A base frame is in the middle plane up to this distance, m."""
SAME = 0.005
"""Coordinates of mirror images differ at most by this, m."""
MOST_ENDS = 1000
"""Most links without another below them that are compared."""
ENDLESS = 1e9
"""No joint is as far from another, m."""
FARTHEST = 20.0
"""A joint as far from its robot's root, m, is given in millimetres."""


def put_upright(robot: ElementTree.Element) -> str | None:
    """Puts an empty root with the right axes above that of a URDF, where it lacks them.

    Returns:
        A line that says what was assumed; None where the axes are right or unknown.
    """
    frames, joints = _zero_pose(robot)
    axes = [frames[joint.find("child").get("link")][0] @ _axis(joint) for joint in joints]  # type: ignore[union-attr]
    if not axes or ROOT in frames:
        return None
    shares = np.square(axes).mean(axis=0)
    lateral = int(shares.argmax())
    if lateral == 1 or shares[lateral] < ADVANTAGE * np.sort(shares)[1]:
        return None
    parents = _ends(robot, "parent")
    ends = np.array([place for link, (_, place) in frames.items() if link not in parents])
    ends = ends[np.abs(ends[:, lateral]) > ASIDE]
    if not len(ends):
        return None
    across = [axis for axis in range(3) if axis != lateral]
    _, up, sign = max((float((-way * ends[:, axis]).max()), axis, way) for axis in across for way in (1.0, -1.0))
    (forward,) = (axis for axis in across if axis != up)
    x, z = np.eye(3)[forward], sign * np.eye(3)[up]
    turn = np.stack([x, np.cross(z, x), z])
    root = next(str(link) for link in frames)
    ElementTree.SubElement(robot, "link", {"name": ROOT})
    joint = ElementTree.SubElement(robot, "joint", {"name": f"{ROOT}_joint", "type": "fixed"})
    ElementTree.SubElement(joint, "origin", {"xyz": "0 0 0", "rpy": " ".join(repr(angle) for angle in _angles(turn))})
    ElementTree.SubElement(joint, "parent", {"link": ROOT})
    ElementTree.SubElement(joint, "child", {"link": root})
    names = "xyz"
    return (
        f'link "{root}": its joints pitch about {names[lateral]}, so {names[up] if sign > 0 else "-" + names[up]} is '
        f"taken for up and {names[forward]} for forward; let its frame have x forward and z up"
    )


def put_in_the_middle(robot: ElementTree.Element) -> str | None:
    """Moves the root frame of a URDF into the plane between left and right limbs.

    Returns:
        A line that says by how much; None where it is there, and for limbs without mirror images.
    """
    frames, _ = _zero_pose(robot)
    parents = _ends(robot, "parent")
    ends = np.array([place for link, (_, place) in frames.items() if link not in parents])
    if not 2 <= len(ends) <= MOST_ENDS:
        return None
    one, other = (ends[side] for side in np.triu_indices(len(ends), 1))
    apart = np.abs(one - other)
    are_images = (apart[:, [0, 2]].max(axis=1) <= SAME) & (apart[:, 1] > 2.0 * ASIDE)
    middles = np.sort(0.5 * (one + other)[are_images, 1])
    if not len(middles) or np.abs(middles).min() <= OFF:
        return None
    alike = np.searchsorted(middles, middles + SAME, "right") - np.searchsorted(middles, middles - SAME)
    middle = float(middles[alike.argmax()])
    root = next(str(link) for link in frames)
    (link,) = (link for link in robot.findall("link") if link.get("name") == root)
    if root != ROOT and link.find("inertial") is None:
        # the base is a link below, whose frame may be another
        return None
    below = [joint for joint in robot.findall("joint") if joint.find("parent").get("link") == root]  # type: ignore[union-attr]
    for part in [*link.findall("inertial"), *link.findall("visual"), *link.findall("collision"), *below]:
        origin = part.find("origin")
        if origin is None:
            origin = ElementTree.SubElement(part, "origin")
        place = _numbers(origin.get("xyz", "0 0 0")) - [0.0, middle, 0.0]
        origin.set("xyz", " ".join(repr(float(number)) for number in place))
    return f'link "{root}": its frame lies {-middle:.3f} m to the left of the middle plane; put it there'


def is_taken(note: str) -> bool:
    """Whether a note of a draft says that the base has the axes of that root."""
    return note.startswith(f'link "{ROOT}"') and "its frame is the base's" in note


def check_units(urdf: Path, robot: ElementTree.Element) -> None:
    """Refuses a URDF in millimetres.

    Raises:
        RobotError: for a joint that lies further away than any robot is large.
    """
    frames, joints = _zero_pose(robot)
    for joint in joints:
        distance = float(np.linalg.norm(frames[joint.find("child").get("link")][1]))  # type: ignore[union-attr]
        if distance > FARTHEST:
            raise _core.RobotError(
                f'{urdf}: joint "{joint.get("name")}": it lies {distance:.4g} m from the root link at zero; a URDF has '
                "metres: if its lengths are millimetres, write a thousandth of them, and a millionth of the inertias"
            )


def _zero_pose(
    robot: ElementTree.Element,
) -> tuple[dict[str | None, tuple[Array, Array]], list[ElementTree.Element]]:
    """Turn and place of each link in the root's frame, at zero, and the joints that turn.

    Nothing, for numbers without a finite pose.
    """
    below: dict[str | None, list[ElementTree.Element]] = {}
    for joint in robot.findall("joint"):
        if joint.find("parent") is not None and joint.find("child") is not None:
            below.setdefault(joint.find("parent").get("link"), []).append(joint)  # type: ignore[union-attr]
    children = _ends(robot, "child")
    roots = [link.get("name") for link in robot.findall("link") if link.get("name") not in children]
    if len(roots) != 1:
        return {}, []
    frames: dict[str | None, tuple[Array, Array]] = {roots[0]: (np.eye(3), np.zeros(3))}
    joints: list[ElementTree.Element] = []
    waiting = list(roots)
    while waiting:
        parent = waiting.pop()
        turn, place = frames[parent]
        for joint in below.get(parent, []):
            link = joint.find("child").get("link")  # type: ignore[union-attr]
            if link in frames:
                return {}, []
            own, offset = _pose(joint.find("origin"))
            if not np.abs(offset).max() < ENDLESS:
                return {}, []
            frames[link] = turn @ own, place + turn @ offset
            waiting.append(link)
            if joint.get("type") in TURNING:
                joints.append(joint)
    return frames, joints


def _ends(robot: ElementTree.Element, end: str) -> set[str | None]:
    return {found.get("link") for joint in robot.findall("joint") if (found := joint.find(end)) is not None}


def _axis(joint: ElementTree.Element) -> Array:
    found = joint.find("axis")
    axis = _numbers("1 0 0" if found is None else found.get("xyz", "1 0 0"))
    return axis / max(float(np.linalg.norm(axis)), 1e-12)


def _pose(origin: ElementTree.Element | None) -> tuple[Array, Array]:
    if origin is None:
        return np.eye(3), np.zeros(3)
    (cr, cp, cy), (sr, sp, sy) = (part(_numbers(origin.get("rpy", "0 0 0"))) for part in (np.cos, np.sin))
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return np.array(rows), _numbers(origin.get("xyz", "0 0 0"))


def _numbers(text: str) -> Array:
    numbers = np.array([float(word) for word in text.split()])
    if numbers.shape != (3,):
        raise ValueError(f"{text!r} are not three numbers")
    return numbers


def _angles(turn: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a matrix."""
    pitch = math.asin(max(-1.0, min(1.0, -float(turn[2, 0]))))
    if abs(turn[2, 0]) > 1.0 - 1e-9:
        # roll and yaw turn about the same axis
        return math.atan2(-float(turn[1, 2]), float(turn[1, 1])), pitch, 0.0
    return (
        math.atan2(float(turn[2, 1]), float(turn[2, 2])),
        pitch,
        math.atan2(float(turn[1, 0]), float(turn[0, 0])),
    )
