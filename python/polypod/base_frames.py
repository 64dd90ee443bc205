"""Base frames of URDFs that are not x forward and z up in the middle, as CAD programs write them.

In such a frame legs lie to one side of the body, and pitch is roll: the joints of a robot get the
roles of others, or none. An empty root above the base, with the right axes, mends that:
`src/robot/base.rs` takes the frame whose axes fit the joints. A frame to one side of the middle
plane is moved.
"""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from polypod import _core
from polypod.arrays import Array
from polypod.urdf_elements import mass_of

ROOT = "x_forward_z_up"
"""Name of the link that is put above the root."""
TURNING = ("revolute", "continuous")
ADVANTAGE = 1.1
"""Share of the joints that turn about the axis to the left, at least, over that of the next axis:
hips, knees, ankles and elbows do."""
ASIDE = 0.03
"""Least distance of a foot from the middle plane, m."""
STRETCHED = 0.6
"""A limb whose end is as far from its first joint, as a share of its length, is stretched."""
SAME_REACH = 0.8
"""Two limbs at least reach as far down, as a share of the farther one's reach: a pair of legs."""
CLEARLY = 2.0
"""Legs reach as many times farther in another direction than along -z."""
LEAST_SHARE = 0.5
"""Humanoids have about as many joints that turn about the axis up as about the one forward; joints
of quadrupeds turn about the latter alone."""
OFF = 0.01
"""A base frame is in the middle plane up to this distance, m."""
SAME = 0.005
"""Coordinates of mirror images differ at most by this, m."""
MOST_ENDS = 1000
"""Most links without another below them that are compared."""
ENDLESS = 1e9
"""No joint is as far from another, m."""
BENT = 0.2
"""Knees that a stance bends to the rear by this angle do not bend forwards, rad."""
TOES = 0.005
"""The centre of mass of a foot lies at least this far from its ankle, on the side of the toes,
m."""
SIX = 6
"""Number of legs around a body, of which the middle ones point to its sides."""
UPRIGHT = 0.7
"""Least component of an axis along z of a joint that yaws."""
IN_THE_MIDDLE = 0.15
"""Largest distance of the end of a middle leg from the plane through the middle of all, over their
largest distance from it."""
Y_FORWARD = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""The axes of a frame whose x is the y of another, in the columns."""
FARTHEST = 20.0
"""A joint as far from its robot's root, m, is given in millimetres."""


def put_upright(robot: ElementTree.Element) -> str | None:
    """Puts an empty root with the right axes above that of a URDF whose joints pitch about x or z.

    Returns:
        A line that says what was assumed; None where the axes are right or unknown.
    """
    if (lying := _lying(robot)) is None:
        return None
    found, up, sign = lying
    root = next(str(link) for link in found.frames)
    turn = found.upright(up, sign).T
    ElementTree.SubElement(robot, "link", {"name": ROOT})
    joint = ElementTree.SubElement(robot, "joint", {"name": f"{ROOT}_joint", "type": "fixed"})
    ElementTree.SubElement(joint, "origin", {"xyz": "0 0 0", "rpy": " ".join(repr(angle) for angle in _angles(turn))})
    ElementTree.SubElement(joint, "parent", {"link": ROOT})
    ElementTree.SubElement(joint, "child", {"link": root})
    return found.assumption(root, up, sign)


def upright_axes(robot: ElementTree.Element) -> Array | None:
    """The axes of the upright frame in that of the base, in the columns.

    They are those that `put_upright` or `turn_upright` assume; None where neither changes anything.
    """
    if _with_legs_ahead(robot) is not None:
        return Y_FORWARD
    if (standing := _standing(robot)) is not None:
        _, found, up, sign = standing
        return found.upright(up, sign)
    if (lying := _lying(robot)) is None:
        return None
    found, up, sign = lying
    return found.upright(up, sign)


def turn_upright(robot: ElementTree.Element) -> str | None:
    """Turns the base's frame of a URDF whose joints pitch about y, and whose feet are not below.

    The joints fit such a frame as well as one with z up, so the feet alone tell: legs are stretched
    in the direction down, at zero. Six legs around a body also tell by their feet which way is
    forward: the middle ones point to the sides.

    Returns:
        A line that says what was assumed; None where the axes are right or unknown.
    """
    if (ahead := _with_legs_ahead(robot)) is not None:
        _turn(robot, ahead, Y_FORWARD)
        problem = "the middle ones of its six legs point along x, so y is taken for forward"
        return f'link "{ahead.get("name")}": {problem}; let its frame have x forward and z up'
    if (standing := _standing(robot)) is None:
        return None
    link, found, up, sign = standing
    _turn(robot, link, found.upright(up, sign))
    return found.assumption(str(link.get("name")), up, sign)


def turn_round(robot: ElementTree.Element, draft: Mapping[str, Any]) -> str | None:
    """Turns the base's frame of a body on two legs that looks along its -x.

    Knees that bend to the rear alone and feet that point there tell it.

    Args:
        robot: the tree of a URDF.
        draft: the config that was drafted for it.

    Returns:
        A line that says what was assumed; None where the frame is right or unknown.
    """
    link, (frames, _) = _base(robot), _zero_pose(robot)
    roles, pose = draft["joint_roles"], draft["default_pose"]
    ankles = [joint for joint in robot.findall("joint") if joint.get("name") in _pair(roles, "ANKLE_PITCH")]
    bends = all(angle < -BENT for angle in _pair(pose, "KNEE"))
    if link is None or link.get("name") not in frames or ROOT in frames or len(ankles) != 2 or not bends:
        return None
    toes = frames[link.get("name")][0][:, 0]
    if not all(_foot(robot, frames, ankle) @ toes < -TOES for ankle in ankles):
        return None
    _turn(robot, link, np.diag([-1.0, -1.0, 1.0]))
    problem = "its knees bend to the rear and its feet point there, so -x is taken for forward"
    return f'link "{link.get("name")}": {problem}; let its frame have x forward'


def _pair(values: Mapping[str, Any], role: str) -> list[Any]:
    return [values[slot] for side in "LR" if (slot := f"{side}_{role}") in values]


def _foot(
    robot: ElementTree.Element, frames: Mapping[str | None, tuple[Array, Array]], ankle: ElementTree.Element
) -> Array:
    """From an ankle to the centre of mass of all that it moves, at zero, in the root's frame, m."""
    below: dict[str | None, list[str | None]] = {}
    for joint in robot.findall("joint"):
        below.setdefault(_parent(joint), []).append(_child(joint))
    names = [_child(ankle)]
    for name in names:
        names += below.get(name, [])
    moment, mass = np.zeros(3), 0.0
    for link in robot.findall("link"):
        if link.get("name") in names:
            turn, place = frames[link.get("name")]
            own = mass_of(link)
            moment = moment + own * (place + turn @ _pose(link.find("inertial/origin"))[1])
            mass += own
    centre: Array = moment / mass if mass > 0.0 else frames[_child(ankle)][1]
    return centre - frames[_child(ankle)][1]


def _lying(robot: ElementTree.Element) -> "tuple[_Axes, int, float] | None":
    """The axes of a robot whose joints pitch about x or z, and the axis that is up."""
    found = _Axes.of(robot)
    if found is None or ROOT in found.frames or found.lateral == 1 or not len(found.limbs):
        return None
    _, up, sign = found.down()
    return found, up, sign


def _standing(robot: ElementTree.Element) -> "tuple[ElementTree.Element, _Axes, int, float] | None":
    """The base of a robot whose legs do not point along its -z, and the axis that is up."""
    link = _base(robot)
    found = None if link is None else _Axes.of(robot, link.get("name"))
    if link is None or found is None or found.lateral != 1:
        return None
    stretched = found.limbs[np.linalg.norm(found.limbs, axis=1) >= STRETCHED * found.lengths]
    if len(stretched) < 2:
        return None
    found = dataclasses.replace(found, limbs=stretched)
    reach, up, sign = found.down()
    pair = np.sort(-sign * stretched[:, up])[-2:]
    if (up, sign) == (2, 1.0) or pair[0] < SAME_REACH * reach or reach < CLEARLY * -float(stretched[:, 2].min()):
        return None
    if up == 0 and found.shares[2] < LEAST_SHARE * found.shares[0]:
        # abduction turns about the axis forward, and about none that is up
        return None
    return link, found, up, sign


def _with_legs_ahead(robot: ElementTree.Element) -> ElementTree.Element | None:
    """The base of a robot with six legs that yaw first, the middle ones of which point along x."""
    link, (frames, joints) = _base(robot), _zero_pose(robot)
    if link is None or link.get("name") not in frames:
        return None
    turn, place = frames[link.get("name")]
    yaws = {_child(joint) for joint in joints if abs((turn.T @ frames[_child(joint)][0] @ _axis(joint))[2]) > UPRIGHT}
    turning = {_child(joint) for joint in joints}
    ends: dict[str | None, Array] = {}
    for chain in _chains(robot, frames):
        first = next((name for name in reversed(chain) if name in turning), None)
        if first in yaws:
            reach = turn.T @ (frames[chain[0]][1] - place)
            if first not in ends or np.linalg.norm(reach[:2]) > np.linalg.norm(ends[first][:2]):
                ends[first] = reach
    if len(ends) != SIX:
        return None
    places = np.array([end[:2] for end in ends.values()])
    apart = np.abs(places - places.mean(axis=0))
    in_the_middle = (apart <= IN_THE_MIDDLE * apart.max()).sum(axis=0)
    # two legs lie in the plane between left and right, and none in the one between front and back
    return link if tuple(in_the_middle) == (0, 2) else None


@dataclasses.dataclass(frozen=True)
class _Axes:
    """Axes and limbs of a robot at zero, in the frame of its root or of another link."""

    frames: dict[str | None, tuple[Array, Array]]
    """Turn and place of each link, in the root's frame."""
    shares: Array
    """Mean square of the axes of turning joints along x, y and z."""
    lateral: int
    """The axis to the left."""
    limbs: Array
    """Distance from the first joint of each limb off the middle plane to its end, m."""
    lengths: Array
    """Lengths of the same limbs, over all joints, m."""

    @classmethod
    def of(cls, robot: ElementTree.Element, link: str | None = None) -> "_Axes | None":
        """The axes of a robot whose joints clearly turn about one axis most, in a link's frame."""
        frames, joints = _zero_pose(robot)
        if not joints or (link is not None and link not in frames):
            return None
        own = np.eye(3) if link is None else frames[link][0]
        axes = [frames[_child(joint)][0] @ _axis(joint) for joint in joints] @ own
        shares = np.square(axes).mean(axis=0)
        lateral = int(shares.argmax())
        if shares[lateral] < ADVANTAGE * np.sort(shares)[1]:
            return None
        turning = {_child(joint) for joint in joints}
        limbs, lengths = [], []
        for chain in _chains(robot, frames):
            places = np.array([frames[link][1] for link in chain]) @ own
            first = max((at for at, link in enumerate(chain) if link in turning), default=None)
            if first is not None and abs(places[0, lateral]) > ASIDE:
                limbs.append(places[0] - places[first])
                lengths.append(np.linalg.norm(np.diff(places[: first + 1], axis=0), axis=1).sum())
        return cls(frames, shares, lateral, np.array(limbs).reshape(-1, 3), np.array(lengths))

    def down(self) -> tuple[float, int, float]:
        """Distance that the limbs reach downwards, m, and the axis that is up with its sign."""
        across = [axis for axis in range(3) if axis != self.lateral]
        return max((float((-way * self.limbs[:, axis]).max()), axis, way) for axis in across for way in (1.0, -1.0))

    def upright(self, up: int, sign: float) -> Array:
        """The axes of the upright frame in that frame, in the columns."""
        x, z = np.eye(3)[self._forward(up)], sign * np.eye(3)[up]
        return np.stack([x, np.cross(z, x), z]).T

    def assumption(self, link: str, up: int, sign: float) -> str:
        lateral, above, forward = ("xyz"[axis] for axis in (self.lateral, up, self._forward(up)))
        above = above if sign > 0 else f"-{above}"
        return (
            f'link "{link}": its joints pitch about {lateral}, so {above} is taken for up and {forward} for forward; '
            "let its frame have x forward and z up"
        )

    def _forward(self, up: int) -> int:
        (forward,) = (axis for axis in range(3) if axis not in (self.lateral, up))
        return forward


def _base(robot: ElementTree.Element) -> ElementTree.Element | None:
    """The body's link: the root, or the first one with inertia on a chain of fixed joints below."""
    children = _ends(robot, "child")
    roots = [link for link in robot.findall("link") if link.get("name") not in children]
    links = {link.get("name"): link for link in robot.findall("link")}
    while len(roots) == 1 and roots[0].find("inertial") is None:
        below = [joint for joint in robot.findall("joint") if _parent(joint) == roots[0].get("name")]
        roots = [links[_child(joint)] for joint in below if joint.get("type") == "fixed"] if len(below) == 1 else []
    return roots[0] if len(roots) == 1 else None


def _turn(robot: ElementTree.Element, link: ElementTree.Element, turn: Array) -> None:
    """Turns the frame of a link, whose new axes are the columns; nothing in the world moves."""
    name = link.get("name")
    joints = robot.findall("joint")
    below = [joint for joint in joints if _parent(joint) == name]
    above = [joint for joint in joints if _child(joint) == name]
    parts = [*link.findall("inertial"), *link.findall("visual"), *link.findall("collision"), *below]
    for part, is_above in [*((part, False) for part in parts), *((joint, True) for joint in above)]:
        origin = part.find("origin")
        own, place = _pose(origin)
        if origin is None:
            origin = ElementTree.SubElement(part, "origin")
        own, place = (own @ turn, place) if is_above else (turn.T @ own, turn.T @ place)
        origin.set("xyz", " ".join(repr(float(number)) for number in place))
        origin.set("rpy", " ".join(repr(angle) for angle in _angles(own)))


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


def _chains(robot: ElementTree.Element, links: Iterable[str | None]) -> Iterator[list[str | None]]:
    """The links from each end of a tree to its root, the end first."""
    above, parents = {_child(joint): _parent(joint) for joint in robot.findall("joint")}, _ends(robot, "parent")
    for end in links:
        if end not in parents:
            chain = [end]
            while chain[-1] in above:
                chain.append(above[chain[-1]])
            yield chain


def _parent(joint: ElementTree.Element) -> str | None:
    return None if (end := joint.find("parent")) is None else end.get("link")


def _child(joint: ElementTree.Element) -> str | None:
    return None if (end := joint.find("child")) is None else end.get("link")


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
