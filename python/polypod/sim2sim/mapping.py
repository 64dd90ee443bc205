"""Map from the joints of somebody else's model to those of polypod's robot.

Joints of the same name are the same joint. Others are found by geometry: both robots are trees of
lines in space. A joint's line has to lie where its counterpart's does once the joints before it
have the same poses. This also gives the sign of each joint and the angle between both zeros:

    polypod's angle = sign * the model's angle + offset

The trees are matched from the base outwards. For each pair of joints, offsets are tried that carry
the lines and the centres of mass further out onto each other. The cost of a match is the sum of
squared distances, in tenths of the robot's size, with smaller terms for ranges and links. A name
pairs two joints, and geometry has to agree with it. Two matches that cost about the same are an
error: nothing is guessed.

The base's frame is polypod's (x forward, z up) unless no joint lies where it should; then the 24
turns by right angles are tried.
"""

import dataclasses
import difflib
import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from polypod import _core, rotations
from polypod.arrays import Array
from polypod.compat import tomllib
from polypod.files import read_bytes
from polypod.mujoco_model.reference import mujoco
from polypod.sim2sim.skeleton import BASE, Skeleton, skeleton

GOOD = 0.6
"""Cost per joint of a match that needs no other frame of the base."""
BAD = 1.0
"""Cost per joint of a match that is none."""
MARGIN = 0.02
"""Two matches whose costs per joint differ by less are equally good."""
STEEPEST = 0.5
"""Cosine of the largest angle between two axes of one joint."""
NEAR = 0.35
"""Largest distance of two lines of one joint, in sizes of the robot; of joints that names pair
twice that."""
SAME = 1e-3
"""Offsets that differ by less are one, rad; the first one found is kept."""
ZERO = 1e-5
"""Offsets below this are zero, rad."""
DOUBT = 0.5
"""An offset has to make a match this much better than zero does, unless it makes it exact."""
EXACT = 1e-6
"""Cost per joint of a match with a model of the very same robot."""
CLEAR = 0.1
"""Cost per joint below which no other offset of a joint is tried."""
POSES = 5
"""Poses at which the kinematics are compared."""
_TENTH = 0.1
_MAX_MAP = 1 << 20
_KEPT = 3
"""Ways to match a pair of joints that are followed up."""
_SPREAD = 1.0
"""Ways that cost more than the best one by this are not followed up."""


@dataclasses.dataclass(frozen=True)
class Pair:
    """A joint of polypod's robot and its counterpart."""

    ours: str
    theirs: str
    how: str
    """`name`, `geometry` or `map`: what paired them."""
    sign: float
    """-1 where both count in opposite directions."""
    offset: float
    """polypod's angle where the model's is zero, rad or m."""
    apart: float = 0.0
    """Largest distance of both axes over the poses that were compared, m."""
    tilt: float = 0.0
    """Largest angle between both axes over them, rad."""


@dataclasses.dataclass(frozen=True)
class JointMap:
    """The whole map, in polypod's order of joints."""

    pairs: tuple[Pair, ...]
    turn: Array
    """Matrix that turns vectors of the model's base frame into polypod's, [3, 3]."""
    shift: Array
    """Polypod's position of the model's base frame, m, [3]: p = turn @ p' + shift."""
    frame_how: str
    """`equal`, `geometry` or `map`."""
    cost: float = 0.0
    """Cost of the match, per joint."""

    @property
    def is_equal(self) -> bool:
        """Whether both frames of the base are the same."""
        return self.frame_how == "equal"

    @property
    def signs(self) -> Array:
        """Sign of each joint in the model, [joints]."""
        return np.array([pair.sign for pair in self.pairs])

    @property
    def offsets(self) -> Array:
        """Offset of each joint in the model, rad or m, [joints]."""
        return np.array([pair.offset for pair in self.pairs])


@dataclasses.dataclass(frozen=True)
class Given:
    """Content of a map file."""

    base: str | None = None
    """Body of the model."""
    joints: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """The model's joint by polypod's."""
    signs: Mapping[str, float] = dataclasses.field(default_factory=dict)
    offsets: Mapping[str, float] = dataclasses.field(default_factory=dict)
    quaternion: tuple[float, float, float, float] | None = None
    """Turn of the model's base frame in polypod's: w, x, y, z."""
    position: tuple[float, float, float] | None = None
    """Place of the model's base frame in polypod's, m."""

    @classmethod
    def read(cls, path: Path) -> "Given":
        """Reads a map file. Raises ConfigError."""
        try:
            content = tomllib.loads(read_bytes(path, _MAX_MAP).decode())
        except OSError as error:
            raise _core.ConfigError(f"--map {path} cannot be read: {error.strerror}; name a TOML file") from error
        except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
            raise _core.ConfigError(f"--map {path} is no TOML: {str(error).splitlines()[0]}") from error
        known = ("base", "base_position", "base_quaternion", "joints")
        for key in content:
            if key not in known:
                raise _core.ConfigError(f"--map {path}: there is no key {key[:80]!r}; keys: {', '.join(known)}")
        joints, signs, offsets = {}, {}, {}
        entries = content.get("joints", {})
        if not isinstance(entries, dict):
            raise _core.ConfigError(f"--map {path}: joints must be a table of names")
        for name, entry in entries.items():
            entry = {"joint": entry} if isinstance(entry, str) else entry
            if not isinstance(entry, dict) or not isinstance(entry.get("joint"), str):
                raise _core.ConfigError(f"--map {path}: joints.{name} must name a joint of the model")
            if unknown := [key for key in entry if key not in ("joint", "sign", "offset")]:
                raise _core.ConfigError(
                    f"--map {path}: joints.{name} has no key {unknown[0][:80]!r}; keys: joint, sign, offset"
                )
            joints[name] = entry["joint"]
            if "sign" in entry:
                if entry["sign"] not in (1, -1, 1.0, -1.0) or isinstance(entry["sign"], bool):
                    raise _core.ConfigError(f"--map {path}: joints.{name}.sign must be 1 or -1")
                signs[name] = float(entry["sign"])
            if "offset" in entry:
                offsets[name] = _numbers(path, f"joints.{name}.offset", [entry["offset"]], 1)[0]
        base = content.get("base")
        if base is not None and not isinstance(base, str):
            raise _core.ConfigError(f"--map {path}: base must name a body of the model")
        turn, place = content.get("base_quaternion"), content.get("base_position")
        quaternion = None if turn is None else _numbers(path, "base_quaternion", turn, 4)
        if quaternion is not None:
            length = float(np.linalg.norm(quaternion))
            if not 0.5 < length < 2.0:
                raise _core.ConfigError(f"--map {path}: base_quaternion must have length 1: w, x, y, z")
            quaternion = tuple(number / length for number in quaternion)
        return cls(
            base=base,
            joints=joints,
            signs=signs,
            offsets=offsets,
            quaternion=None if quaternion is None else (quaternion[0], quaternion[1], quaternion[2], quaternion[3]),
            position=None if place is None else _three(_numbers(path, "base_position", place, 3)),
        )


def _numbers(path: Path, key: str, values: Any, count: int) -> tuple[float, ...]:
    is_number = isinstance(values, list) and all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in values
    )
    if not is_number or len(values) != count or not np.isfinite(np.array(values, dtype=np.float64)).all():
        raise _core.ConfigError(f"--map {path}: {key} must be {count} finite number{'s' if count > 1 else ''}")
    return tuple(float(value) for value in values)


def _three(values: tuple[float, ...]) -> tuple[float, float, float]:
    return values[0], values[1], values[2]


@dataclasses.dataclass(frozen=True)
class Found:
    """A joint of polypod's in a match."""

    theirs: int
    sign: float
    offset: float


@dataclasses.dataclass(frozen=True)
class Match:
    """Joints of both robots, and what sets them apart."""

    cost: float
    joints: Mapping[int, Found]

    def differs(self, other: "Match") -> bool:
        """Whether the other one pairs other joints, or counts a joint in the other direction."""
        return any(
            found.theirs != other.joints[joint].theirs or found.sign != other.joints[joint].sign
            for joint, found in self.joints.items()
        )


@dataclasses.dataclass(frozen=True)
class Rigid:
    """A motion of space: p -> turn @ p + shift."""

    turn: Array
    shift: Array

    def point(self, point: Array) -> Array:
        """A point, moved."""
        moved: Array = self.turn @ point + self.shift
        return moved

    def then_turned(self, about: Array, axis: Array, angle: float) -> "Rigid":
        """This motion, then a turn about a line."""
        if angle == 0.0:
            return self
        turn = rotations.matrix_about(axis, angle)
        return Rigid(turn @ self.turn, turn @ (self.shift - about) + about)

    def then_moved(self, by: Array) -> "Rigid":
        """This motion, then a shift."""
        return Rigid(self.turn, self.shift + by) if np.any(by != 0.0) else self


class _Matcher:
    """Matches the trees for one frame of the base."""

    def __init__(self, ours: Skeleton, theirs: Skeleton, paired: Mapping[int, int], given: Given) -> None:
        self.ours, self.theirs, self.paired = ours, theirs, paired
        self._taken = set(paired.values())
        self._signs = {i: given.signs[name] for i, name in enumerate(ours.names) if name in given.signs}
        self._offsets = {i: given.offsets[name] for i, name in enumerate(ours.names) if name in given.offsets}
        self._near = NEAR * ours.size
        self._unit = _TENTH * ours.size
        self._below = {joint: self._descendants(ours, joint) for joint in (BASE, *range(len(ours.names)))}
        self._beyond = {joint: self._descendants(theirs, joint) for joint in (BASE, *range(len(theirs.names)))}
        self._spare = len(theirs.names) - len(ours.names)

    @staticmethod
    def _descendants(of: Skeleton, joint: int) -> list[int]:
        found = of.children(joint)
        for child in found:
            found.extend(of.children(child))
        return found

    def matches(self, frame: Rigid) -> list[Match]:
        """The best ways to match the whole trees, the best first."""
        return self._around(BASE, BASE, frame, 4.0 * BAD * max(1, len(self.ours.names)))

    def _expanded(self, theirs: int) -> list[int]:
        """Joints of the model that may be next after one: joints in between have no counterpart."""
        found = dict.fromkeys(self.theirs.children(theirs), 0)
        open_ = list(found)
        for joint in open_:
            if joint not in self._taken and found[joint] < self._spare:
                new = self.theirs.children(joint)
                found.update(dict.fromkeys(new, found[joint] + 1))
                open_.extend(new)
        return open_

    def _around(self, ours: int, theirs: int, motion: Rigid, limit: float) -> list[Match]:
        """Matches of all that hangs on a pair of clusters that cost less than `limit`."""
        children = self.ours.children(ours)
        if not children:
            return [Match(0.0, {})]
        options = self._expanded(theirs)
        found: dict[int, dict[int, list[Match]]] = {}
        for child in children:
            found[child] = {}
            for option in options:
                if child in self.paired:
                    if self.paired[child] != option:
                        continue
                elif option in self._taken:
                    continue
                if not 0 <= len(self._beyond[option]) - len(self._below[child]) <= self._spare:
                    continue
                ways = self._pair(child, option, motion, limit)
                if ways:
                    found[child][option] = ways
            if not found[child]:
                return []
        return self._joined(children, found)

    def _joined(self, children: list[int], found: Mapping[int, Mapping[int, list[Match]]]) -> list[Match]:
        """Every choice of different joints for the children, the best few."""
        best: list[Match] = []

        def extend(index: int, used: frozenset[int], cost: float, joints: dict[int, Found]) -> None:
            if len(best) == _KEPT and cost >= best[-1].cost:
                return
            if index == len(children):
                best.append(Match(cost, joints))
                best.sort(key=lambda match: match.cost)
                del best[_KEPT:]
                return
            options = found[children[index]]
            for option in sorted(options, key=lambda option: options[option][0].cost):
                if used & {option, *self._beyond[option]}:
                    continue
                for way in options[option]:
                    mine = {joint.theirs for joint in way.joints.values()}
                    extend(index + 1, used | mine, cost + way.cost, joints | dict(way.joints))

        extend(0, frozenset(), 0.0, {})
        return best

    def _pair(self, ours: int, theirs: int, motion: Rigid, limit: float) -> list[Match]:
        """Matches of a pair of joints and of all that hangs on them that cost less than `limit`."""
        if self.ours.slides[ours] != self.theirs.slides[theirs]:
            return []
        axis, turned = self.ours.axes[ours], motion.turn @ self.theirs.axes[theirs]
        cosine = float(axis @ turned)
        if abs(cosine) < STEEPEST:
            return []
        sign = 1.0 if cosine > 0.0 else -1.0
        if self._signs.get(ours, sign) != sign:
            return []
        gap = self.ours.anchors[ours] - motion.point(self.theirs.anchors[theirs])
        along = float(gap @ axis)
        across = gap - along * axis
        distance = float(np.linalg.norm(across))
        if distance > self._near * (2.0 if ours in self.paired else 1.0):
            return []
        cost = (distance / self._unit) ** 2 + 0.2 * (along / self._unit) ** 2
        cost += 20.0 * (1.0 - abs(cosine))
        # later differences are measured from here, without those of the links before
        motion = motion.then_moved(across) if distance > 1e-12 else motion
        ways: list[Match] = []
        clear = CLEAR * (1 + len(self._below[ours]))
        for angle in self._angles(ours, theirs, motion, sign):
            local = cost + self._local(ours, theirs, motion, sign, angle)
            if local >= limit:
                continue
            joint = Found(theirs, sign, -angle if angle else 0.0)
            for rest in self._around(ours, theirs, self._moved(ours, motion, angle), limit - local):
                ways.append(Match(local + rest.cost, {ours: joint, **rest.joints}))
                limit = min(limit, local + rest.cost + _SPREAD)
            if ways and min(way.cost for way in ways) < clear:
                break
        ways.sort(key=lambda match: match.cost)
        return ways[:_KEPT]

    def _moved(self, ours: int, motion: Rigid, angle: float) -> Rigid:
        axis = self.ours.axes[ours]
        if self.ours.slides[ours]:
            return motion.then_moved(angle * axis)
        return motion.then_turned(self.ours.anchors[ours], axis, angle)

    def _local(self, ours: int, theirs: int, motion: Rigid, sign: float, angle: float) -> float:
        """Cost of a pair's links, ranges and offset."""
        cost = 1e-3 * (1.0 - np.cos(angle))
        moved = self._moved(ours, motion, angle)
        if self.ours.masses[ours] > 0.0 and self.theirs.masses[theirs] > 0.0:
            apart = self.ours.centers[ours] - moved.point(self.theirs.centers[theirs])
            cost += 0.2 * float(apart @ apart) / self._unit**2
        (low, high), range_ = self.ours.ranges[ours], sign * self.theirs.ranges[theirs] - angle
        least, most = min(range_), max(range_)
        if np.isfinite([low, high, least, most]).all() and max(high, most) > min(low, least):
            shared = max(0.0, min(high, most) - max(low, least)) / (max(high, most) - min(low, least))
            cost += 0.3 * (1.0 - shared)
        return float(cost)

    def _angles(self, ours: int, theirs: int, motion: Rigid, sign: float) -> list[float]:
        """Turns about the joint that bring what hangs on both together, the likeliest first."""
        if ours in self._offsets:
            return [-self._offsets[ours]]
        axis, anchor = self.ours.axes[ours], self.ours.anchors[ours]
        if self.ours.slides[ours]:
            return self._slides(ours, theirs, motion)
        found = [0.0]

        def across(vector: Array) -> Array:
            flat: Array = vector - float(vector @ axis) * axis
            return flat

        def turn(of: Array, to: Array, least: float) -> None:
            of, to = across(of), across(to)
            if min(np.linalg.norm(of), np.linalg.norm(to)) > least:
                found.append(float(np.arctan2(axis @ np.cross(of, to), of @ to)))

        least = 0.05 * self.ours.size
        if self.ours.masses[ours] > 0.0 and self.theirs.masses[theirs] > 0.0:
            mine, other = self.ours.centers[ours], motion.point(self.theirs.centers[theirs])
            turn(other - anchor, mine - anchor, 0.02 * self.ours.size)
        for child, option in itertools.product(self.ours.children(ours), self._expanded(theirs)):
            if self.paired.get(child, option) != option:
                continue
            mine, other = self.ours.axes[child], motion.turn @ self.theirs.axes[option]
            for way in (other, -other):
                turn(way, mine, 0.3)
            turn(motion.point(self.theirs.anchors[option]) - anchor, self.ours.anchors[child] - anchor, least)
        distinct: list[float] = []
        for angle in found:
            angle = 0.0 if abs(angle) < ZERO else angle
            if all(abs(np.angle(np.exp(1j * (angle - other)))) > SAME for other in distinct):
                distinct.append(angle)
        return self._likely(ours, theirs, motion, sign, distinct)

    def _slides(self, ours: int, theirs: int, motion: Rigid) -> list[float]:
        axis, found = self.ours.axes[ours], [0.0]
        if self.ours.masses[ours] > 0.0 and self.theirs.masses[theirs] > 0.0:
            gap = self.ours.centers[ours] - motion.point(self.theirs.centers[theirs])
            found.append(float(gap @ axis))
        return found

    def _likely(self, ours: int, theirs: int, motion: Rigid, sign: float, angles: list[float]) -> list[float]:
        """The few turns after which the next joints lie best."""
        scores = []
        for angle in angles:
            moved = self._moved(ours, motion, angle)
            score = self._local(ours, theirs, motion, sign, angle)
            for child in self.ours.children(ours):
                options = [
                    self._distance(child, option, moved)
                    for option in self._expanded(theirs)
                    if self.paired.get(child, option) == option
                ]
                score += min(options, default=np.inf)
            scores.append(score)
        least = min(scores)
        if least > EXACT * (1 + len(self.ours.children(ours))) and scores[0] - least < DOUBT:
            # links that differ a little give angles that differ a little
            return [
                0.0,
                *(
                    angle
                    for angle, score in zip(angles, scores, strict=True)
                    if abs(angle) > 1.0 and score < least + DOUBT
                ),
            ]
        order = np.argsort(scores, kind="stable")[:_KEPT]
        return [angles[index] for index in order if np.isfinite(scores[index])]

    def _distance(self, ours: int, theirs: int, motion: Rigid) -> float:
        axis = self.ours.axes[ours]
        gap = self.ours.anchors[ours] - motion.point(self.theirs.anchors[theirs])
        across = gap - float(gap @ axis) * axis
        cosine = abs(float(axis @ (motion.turn @ self.theirs.axes[theirs])))
        return float(across @ across + 0.2 * (gap @ axis) ** 2) / self._unit**2 + 20.0 * (1.0 - cosine)


def named(ours: Sequence[str], theirs: Sequence[str]) -> dict[int, int]:
    """Joints that have the same name, but for case, punctuation and the word joint.

    Only where that is unique.
    """

    def plain(name: str) -> str:
        return re.sub(r"[^a-z0-9]|joint", "", name.lower())

    found: dict[int, int] = {}
    for form in (str, plain):
        mine, other = [form(name) for name in ours], [form(name) for name in theirs]
        for index, name in enumerate(mine):
            if index not in found and mine.count(name) == 1 and other.count(name) == 1:
                candidate = other.index(name)
                if candidate not in found.values():
                    found[index] = candidate
    return found


def find(
    ours: Skeleton,
    theirs: Skeleton,
    given: Given,
    file: str,
) -> JointMap:
    """Pairs the joints of two robots.

    Args:
        ours: polypod's robot with its joints at zero.
        theirs: the model with its joints at zero.
        given: content of a map file.
        file: of the model, for messages.

    Raises:
        ConfigError: where a joint has no counterpart or there are two ways to pair them.
    """
    paired, how = _paired(ours, theirs, given, file)
    matcher = _Matcher(ours, theirs, paired, given)
    frame, match, frame_how = _framed(matcher, ours, theirs, given, file)
    turn, shift = frame.turn, frame.shift
    pairs = tuple(
        Pair(
            ours=name,
            theirs=theirs.names[match.joints[index].theirs],
            how=how.get(index, "geometry"),
            sign=match.joints[index].sign,
            offset=match.joints[index].offset,
        )
        for index, name in enumerate(ours.names)
    )
    return JointMap(pairs, turn, shift, frame_how, match.cost / max(1, len(pairs)))


def compared(
    found: JointMap,
    ours: Skeleton,
    our_model: Any,
    theirs: Skeleton,
    model: Any,
    root: int,
    held: Mapping[int, float],
) -> JointMap:
    """The map with the angles between the joints' axes at `POSES` random poses in range.

    Args:
        found: the map.
        ours: polypod's robot.
        our_model: its model.
        theirs: the joints of the map in the other model.
        model: the other model.
        root: its base's body.
        held: positions of joints of the other model that are held.
    """
    random = np.random.default_rng(0)
    low, high = np.clip(ours.ranges, -0.5 * np.pi, 0.5 * np.pi).T
    apart, tilt = np.zeros(len(ours.names)), np.zeros(len(ours.names))
    our_root = int(np.flatnonzero(ours.clusters == BASE)[0])
    for _ in range(POSES):
        angles = random.uniform(low, high)
        mine = skeleton(our_model, our_root, ours.ids.tolist(), dict(zip(ours.ids.tolist(), angles, strict=True)))
        their_angles = found.signs * (angles - found.offsets)
        positions = dict(zip(theirs.ids.tolist(), their_angles, strict=True))
        other = skeleton(model, root, theirs.ids.tolist(), {**held, **positions})
        axes = found.signs[:, None] * (other.axes @ found.turn.T)
        gaps = mine.anchors - (other.anchors @ found.turn.T + found.shift)
        across = gaps - (gaps * mine.axes).sum(axis=1, keepdims=True) * mine.axes
        apart = np.maximum(apart, np.linalg.norm(across, axis=1))
        sine = np.linalg.norm(np.cross(mine.axes, axes), axis=1)
        tilt = np.maximum(tilt, np.arctan2(sine, (mine.axes * axes).sum(axis=1)))
    pairs = tuple(
        dataclasses.replace(pair, apart=float(a), tilt=float(t))
        for pair, a, t in zip(found.pairs, apart, tilt, strict=True)
    )
    return dataclasses.replace(found, pairs=pairs)


def _paired(ours: Skeleton, theirs: Skeleton, given: Given, file: str) -> tuple[dict[int, int], dict[int, str]]:
    """Joints that the map file or their names pair."""
    paired: dict[int, int] = {}
    how: dict[int, str] = {}
    for mine, other in given.joints.items():
        for name, known, what in ((mine, ours.names, "the robot"), (other, theirs.names, file)):
            if name not in known:
                near = difflib.get_close_matches(name, known, n=3)
                guess = f"did you mean {' or '.join(map(repr, near))}? " if near else ""
                raise _core.ConfigError(f"--map: {what} has no joint {name[:80]!r}; {guess}Joints: {', '.join(known)}")
        index = theirs.names.index(other)
        if index in paired.values():
            raise _core.ConfigError(f"--map: {other} is given to two joints; give it to one")
        paired[ours.names.index(mine)], how[ours.names.index(mine)] = index, "map"
    for index, candidate in named(ours.names, theirs.names).items():
        if index not in paired and candidate not in paired.values():
            paired[index], how[index] = candidate, "name"
    return paired, how


def _framed(matcher: _Matcher, ours: Skeleton, theirs: Skeleton, given: Given, file: str) -> tuple[Rigid, Match, str]:
    """The base's frame and the match in it."""
    count = max(1, len(ours.names))
    none = np.zeros(3)
    if given.quaternion is not None or given.position is not None:
        turn = np.eye(3) if given.quaternion is None else rotations.matrix(given.quaternion)
        frame = Rigid(turn, none if given.position is None else np.array(given.position))
        return frame, _only(matcher.matches(frame), ours, theirs, count, file), "map"
    equal = Rigid(np.eye(3), none)
    found = matcher.matches(equal)
    if found and found[0].cost < GOOD * count:
        return equal, _only(found, ours, theirs, count, file), "equal"
    tried = [(equal, match) for match in found]
    roots = [skeleton.anchors[skeleton.children(BASE)].mean(axis=0) for skeleton in (ours, theirs)]
    for turn in right_angles():
        frame = Rigid(turn, roots[0] - turn @ roots[1])
        tried += [(frame, match) for match in matcher.matches(frame)]
    if not tried:
        raise _core.ConfigError(_no_match(ours, theirs, matcher, file))
    tried.sort(key=lambda entry: entry[1].cost)
    frame, best = tried[0]
    # a frame that is turned has to explain what the same frame does not
    if best.cost > (BAD if frame is equal else GOOD) * count:
        raise _core.ConfigError(_no_match(ours, theirs, matcher, file))
    for other, match in tried[1:]:
        is_close = match.cost - best.cost < MARGIN * count
        if is_close and (best.differs(match) or not np.allclose(other.turn, frame.turn)):
            raise _core.ConfigError(_two_ways(ours, theirs, best, match, file))
    is_equal = np.allclose(frame.turn, np.eye(3)) and np.linalg.norm(frame.shift) < 1e-9
    return (equal if is_equal else frame), best, "equal" if is_equal else "geometry"


def _only(matches: list[Match], ours: Skeleton, theirs: Skeleton, count: int, file: str) -> Match:
    if not matches or matches[0].cost > BAD * count:
        raise _core.ConfigError(_no_match(ours, theirs, None, file))
    best = matches[0]
    for match in matches[1:]:
        if match.cost - best.cost < MARGIN * count / len(ours.names) and best.differs(match):
            raise _core.ConfigError(_two_ways(ours, theirs, best, match, file))
    return best


def _two_ways(ours: Skeleton, theirs: Skeleton, best: Match, other: Match, file: str) -> str:
    for index, found in best.joints.items():
        second = other.joints[index]
        if found.theirs != second.theirs:
            return (
                f"{file}: {ours.names[index]} may be {theirs.names[found.theirs]} or {theirs.names[second.theirs]}, "
                f'both fit; say which in a --map FILE with [joints] {ours.names[index]} = "..."'
            )
        if found.sign != second.sign:
            return (
                f"{file}: {theirs.names[found.theirs]} may turn like {ours.names[index]} or against it, both fit; say "
                f"which in a --map FILE with joints.{ours.names[index]}.sign"
            )
    return f"{file}: its base may stand in two ways, both fit; say which in a --map FILE with base_quaternion"


def _no_match(ours: Skeleton, theirs: Skeleton, matcher: _Matcher | None, file: str) -> str:
    missing = len(ours.names) - len(theirs.names)
    if missing > 0:
        return (
            f"{file}: the robot has {len(ours.names)} joints and the model {len(theirs.names)}: "
            f"{', '.join(theirs.names)}; name a model of this robot, or another --robot"
        )
    return (
        f"{file}: the joints of the model do not lie where the robot's do; name a model of this robot, another "
        f"--robot, or pair them in a --map FILE. Joints of the model: {', '.join(theirs.names)}"
    )


def right_angles() -> list[Array]:
    """The 24 turns that carry axes onto axes, [3, 3] each."""
    turns = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            for row, (column, sign) in enumerate(zip(order, signs, strict=True)):
                turn[row, column] = sign
            if np.linalg.det(turn) > 0.0:
                turns.append(turn)
    return turns


def quaternion_of(turn: Array) -> Array:
    """Quaternion [4], w, x, y, z, of a rotation matrix [3, 3]."""
    mj = mujoco()
    quaternion = np.zeros(4)
    mj.mju_mat2Quat(quaternion, np.ascontiguousarray(turn, dtype=np.float64).ravel())
    return quaternion


def times(a: Array, b: Array) -> Array:
    """Product of two quaternions, [4]."""
    product = np.zeros(4)
    mujoco().mju_mulQuat(product, np.ascontiguousarray(a), np.ascontiguousarray(b))
    return product
