"""Numbers of a robot that lie outside drawn bodies: a policy trained on these has not seen them.

The numbers are those of the observation term `joint_descriptors` in units of the body, joint by
joint, of front and hind legs apart. Left and right limbs are one, mirrored. A robot is compared
with drawn bodies of its class.
"""

import dataclasses
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from polypod import _core, bodies, simulated

TASK = "velocity_flat_any_legged_play"
NUMBERS = (
    *("position x", "position y", "position z", "axis x", "axis y", "axis z", "default", "lower", "upper", "effort"),
    *("speed", "stiffness", "damping", "armature", "friction", "inertia", "mass", "action scale", "size"),
)
"""Numbers of a joint, in the order of the term."""
MARGIN = 0.05
"""A number lies outside if it is beyond the drawn ones by more than this share of their range."""
DRAWN = 200
"""Bodies of each kind."""
MIRRORED = {"position y": -1.0, "axis x": -1.0, "axis z": -1.0}
"""Numbers that the mirror image of a left limb has with this sign."""
_ODD = (
    "HAA",
    "HIP_ROLL",
    "HIP_YAW",
    "ANKLE_ROLL",
    "ANKLE_YAW",
    "SHOULDER_ROLL",
    "SHOULDER_YAW",
    "WRIST_ROLL",
    "WRIST_YAW",
)
"""Roles whose angles change sign in a mirror."""
_OTHERS = ("biped", "humanoid", "hexapod")
"""Classes of which one kind is drawn."""

Numbers = dict[str, float]
"""Value by name, such as `front KFE effort`."""


@dataclasses.dataclass(frozen=True)
class Outside:
    """A number of a robot beyond those of the drawn bodies."""

    name: str
    value: float
    low: float
    high: float
    """Least and largest number of the drawn bodies; NaN where none of them has the joint."""

    def __str__(self) -> str:
        if np.isnan(self.low):
            return f"{self.name}: no drawn body has the joint"
        return f"{self.name} {self.value:.3g}, drawn {self.low:.3g} to {self.high:.3g}"


def describe(robots: Sequence[str]) -> dict[str, tuple[str, Numbers]]:
    """Class and numbers of robots, by name: names of the library or paths of configs."""
    found = {}
    for robot in robots:
        layout = 'observations.policy=[{term="joint_descriptors",units="body"}]'
        sim = _core.VecSim(TASK, 1, robots=[robot], overrides=[layout], threads=1)
        sim.reset()
        (info,) = simulated.robots(sim).values()
        rows = np.asarray(sim.observation[0]).reshape(len(NUMBERS), -1)
        found[sim.robots[0]] = (info["class"], _by_place(info["slots"], rows))
    return found


def _by_place(slots: Sequence[str], rows: npt.NDArray[np.float32]) -> Numbers:
    """Means over left and right."""
    sums: dict[str, list[float]] = {}
    for slot, numbers in zip(slots, rows.T, strict=True):
        place, _, role = slot.partition("_")
        end = {"F": "front ", "M": "middle ", "H": "hind "}.get(place[1:], "")
        is_right = place.startswith("R") and place != "ROLL"
        values = dict(zip(NUMBERS, map(float, numbers), strict=True))
        if is_right:
            values |= {name: sign * values[name] for name, sign in MIRRORED.items()}
            if role.startswith(_ODD):
                # the axis is that of the role: it stays, and the angles change
                values |= {name: -values[name] for name in ("axis x", "axis y", "axis z")}
                values["default"], values["lower"], values["upper"] = (
                    -values["default"],
                    -values["upper"],
                    -values["lower"],
                )
        for name, value in values.items():
            sums.setdefault(f"{end}{role} {name}", []).append(value)
    return {name: float(np.mean(values)) for name, values in sums.items()}


def drawn(kinds: Sequence[str], count: int = DRAWN, seed: int = 0, wide: bool = True) -> dict[str, list[Numbers]]:
    """Numbers of drawn bodies, by kind."""
    found: dict[str, list[Numbers]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind in kinds:
            library = Path(folder) / kind
            made = bodies.generate(library, count, seed, [kind], "c", wide=wide)
            paths = [str(library / "configs" / "robots" / f"{body.name}.toml") for body in made]
            found[kind] = [numbers for _, numbers in describe(paths).values()]
    return found


def outside(robots: Sequence[str], count: int = DRAWN, seed: int = 0, wide: bool = True) -> dict[str, list[Outside]]:
    """Numbers of each robot that lie outside the drawn bodies of its class and number of joints."""
    described = describe(robots)
    kinds = {name: _kind(kind, numbers) for name, (kind, numbers) in described.items()}
    known = drawn(sorted({kind for kind in kinds.values() if kind is not None}), count, seed, wide)
    result = {}
    for name, (_, numbers) in described.items():
        kind = kinds[name]
        result[name] = _compare(numbers, known[kind] if kind is not None else [])
    return result


def _kind(kind: str, numbers: Numbers) -> str | None:
    """Kind of `bodies.KINDS`; None for a class that is not drawn."""
    if kind.startswith("quadruped"):
        return "quadruped" if any("HAA" in name.split() for name in numbers) else "quadruped8"
    return kind if kind in _OTHERS else None


def _compare(numbers: Numbers, known: Sequence[Numbers]) -> list[Outside]:
    found, missing = [], set()
    for name, value in numbers.items():
        values = [body[name] for body in known if name in body]
        if not values:
            joint = name
            for number in NUMBERS:
                joint = joint.removesuffix(f" {number}")
            if joint not in missing:
                missing.add(joint)
                found.append(Outside(joint, value, float("nan"), float("nan")))
            continue
        low, high = min(values), max(values)
        beyond = MARGIN * max(high - low, 0.02)
        if not low - beyond <= value <= high + beyond:
            found.append(Outside(name, value, low, high))
    return found


def main(arguments: Sequence[str]) -> None:
    """Prints the numbers of robots, by name or path, that lie outside 200 wide bodies."""
    for name, numbers in outside(arguments).items():
        print(f"{name}: {len(numbers)} numbers outside")
        for number in numbers:
            print(f"  {number}")


if __name__ == "__main__":
    main(sys.argv[1:])
