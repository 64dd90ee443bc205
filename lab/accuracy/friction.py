"""The cone of friction: a block that is pushed over a plane, and blocks on slopes."""

import dataclasses
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import polypod
from polypod.arrays import Array
from polypod.mujoco_model.reference import GRAVITY, Ground, Reference

BLOCK = """<robot name="block">
  <!-- MuJoCo only -->
  <mujoco><compiler inertiafromgeom="false"/></mujoco>
  <link name="block">
    <inertial>
      <mass value="2"/>
      <inertia ixx="0.0083333333" ixy="0" ixz="0" iyy="0.0083333333" iyz="0" izz="0.0133333333"/>
    </inertial>
    <collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision>
  </link>
</robot>
"""
"""2 kg, 20 by 20 by 10 cm, a solid of uniform density."""
HALF_HEIGHT = 0.05
"""Half of the block's height, m."""
SLIDES = ((0.2, 1.0, 0.0), (0.5, 2.0, 0.0), (0.5, 2.0, 0.6), (0.8, 1.0, 0.0), (1.0, 3.0, math.pi / 4))
"""Friction, speed (m/s) and direction (rad) of the pushed blocks."""
SLOPES = ((0.3, 30.0), (0.5, 20.0), (0.5, 26.0), (0.5, 27.2), (0.8, 20.0), (0.8, 38.0), (0.8, 39.3), (0.8, 45.0))
"""Friction and angle (degrees) of the blocks on slopes; atan(0.5) is 26.57 and atan(0.8) 38.66
degrees."""


@dataclasses.dataclass(frozen=True)
class Slide:
    """How far a block slides that starts with `speed`; the formula is v^2 / (2 mu g)."""

    friction: float
    speed: float
    """Speed at which the block starts, m/s."""
    direction: float
    """Angle of the push against the world's x axis, rad: the cone is round."""
    dt: float
    """Physics step, s."""
    formula: float
    """Distance by the formula, m."""
    distance: float
    """Distance in polypod, m."""
    mujoco: float
    """Distance in MuJoCo, m."""
    sideways: float
    """polypod's excursion across the push, m."""

    @property
    def case(self) -> str:
        """Name of what was compared."""
        direction = math.degrees(self.direction)
        return f"block, friction {self.friction:g}, {self.speed:g} m/s, {direction:.0f} degrees"


@dataclasses.dataclass(frozen=True)
class Slope:
    """A block released on a slope for a second.

    It holds below atan(mu), else a = g (sin - mu cos).
    """

    friction: float
    angle: float
    """Angle of the slope, rad."""
    dt: float
    """Physics step, s."""
    acceleration: float
    """polypod's acceleration from the distance covered, m/s^2; 0 where the formula says that the
    block holds."""
    formula: float
    """Acceleration by the formula, m/s^2."""
    mujoco: float
    """MuJoCo's, m/s^2."""
    distance: float
    """Along the slope, polypod's, m."""

    @property
    def case(self) -> str:
        """Name of what was compared."""
        return f"block, friction {self.friction:g}, slope of {math.degrees(self.angle):g} degrees"


def compare_slide(friction: float, speed: float, *, direction: float = 0.0, dt: float = 0.001) -> Slide:
    """Pushes a block over a level plane."""
    start, velocity = _at_rest(), speed * np.array([math.cos(direction), math.sin(direction), 0.0])
    formula = speed**2 / (2.0 * friction * GRAVITY)
    seconds = 1.5 * speed / (friction * GRAVITY)
    ours = _polypod(start, velocity, seconds, dt, friction) - start[:3]
    theirs = _mujoco(start, velocity, seconds, dt, friction) - start[:3]
    along = velocity / speed
    return Slide(
        friction=friction,
        speed=speed,
        direction=direction,
        dt=dt,
        formula=formula,
        distance=float(ours @ along),
        mujoco=float(theirs @ along),
        sideways=float(np.hypot(*(ours - (ours @ along) * along)[:2])),
    )


def compare_slope(friction: float, angle: float, *, dt: float = 0.001) -> Slope:
    """Releases a block on a plane that falls by `angle` towards +x."""
    normal = (math.sin(angle), 0.0, math.cos(angle))
    downhill = np.array([math.cos(angle), 0.0, -math.sin(angle)])
    start = np.array([*(HALF_HEIGHT * np.array(normal)), math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0])
    seconds, at_rest = 1.0, np.zeros(3)
    ours = float((_polypod(start, at_rest, seconds, dt, friction, normal) - start[:3]) @ downhill)
    theirs = float((_mujoco(start, at_rest, seconds, dt, friction, normal) - start[:3]) @ downhill)
    return Slope(
        friction=friction,
        angle=angle,
        dt=dt,
        acceleration=2.0 * ours / seconds**2,
        formula=max(0.0, GRAVITY * (math.sin(angle) - friction * math.cos(angle))),
        mujoco=2.0 * theirs / seconds**2,
        distance=ours,
    )


def _at_rest() -> Array:
    return np.array([0.0, 0.0, HALF_HEIGHT, 1.0, 0.0, 0.0, 0.0])


def _polypod(
    start: Array, velocity: Array, seconds: float, dt: float, friction: float, normal: Sequence[float] = (0.0, 0.0, 1.0)
) -> Array:
    """Where the block is in the end, [3]."""
    with tempfile.TemporaryDirectory() as folder:
        urdf = Path(folder) / "block.urdf"
        urdf.write_text(BLOCK, encoding="utf-8")
        sim = polypod.Simulation(str(urdf), dt=dt, friction=friction, ground_normal=tuple(normal), threads=1)
    sim.set_state(start, np.concatenate([velocity, np.zeros(3)]))
    sim.step(n=round(seconds / dt))
    return np.array(sim.qpos[0, :3])


def _mujoco(
    start: Array,
    velocity: Array,
    seconds: float,
    dt: float,
    friction: float,
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Array:
    reference = Reference(BLOCK, dt=dt, ground=Ground(friction, normal))
    reference.set_state(start, np.concatenate([velocity, np.zeros(3)]))
    reference.step(n=round(seconds / dt))
    return reference.qpos[:3]
