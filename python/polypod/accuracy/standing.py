"""Contact under a robot: a drop from 0.3 m, the forces on standing feet, and rest on a slope."""

import dataclasses
import math

import numpy as np

import polypod
from polypod.accuracy.result import Result
from polypod.arrays import Array
from polypod.mujoco_model.reference import GRAVITY, Ground, Reference
from polypod.mujoco_model.robot import Robot, with_actuators

DROP_HEIGHT = 0.3
"""Height of the lowest foot above the ground, m."""
DROP_TIME = 3.0
"""Time from the drop to the measurement, s."""
DT = 0.005
"""Physics step of the tasks, s."""
FINE = 0.0005
"""MuJoCo's step by default, s."""
MUJOCO_COARSE = 0.0025
"""The largest step at which MuJoCo's contacts, as stiff as they are set, stay calm, s."""
CONVERGED = 0.0001
"""Step at which a landing on soft legs no longer depends on the step, s."""
FRICTION = 0.8
"""Friction coefficient of all contacts."""
UNREACHED = 1e4
"""Speed of a joint that no landing reaches, rad/s."""
SETTLE_TIME = 10.0
"""Time after which a robot that is set on its feet has stopped swaying, s."""
SLOPE_ANGLE = math.radians(20.0)
"""Angle of the slope, rad."""
SLOPE_FINE = 0.002
"""MuJoCo's step on the slope, s."""
REST_TIME = 10.0
"""During which nothing may creep, s."""
FIRM = 4.0
"""Factor on stiffness and damping that makes legs firm: on the gains that policies are trained
with, some robots land in a deep crouch, and fall over when they stand still on a slope of 20
degrees, in MuJoCo as well."""
STAND_TIME = 2.0
"""Time that a robot has to stand, s."""
CALM_TIME = 0.5
"""Time at the end in which the base must stay in place, s."""
CALM_SPEED = 0.1
"""Largest speed of the base at rest, m/s."""
LEAST_HEIGHT = 0.6
"""Lowest height of the base of a standing robot, as a share of its height before gravity acts."""
LEAST_UPRIGHT = math.cos(math.radians(30.0))
"""Cosine of the largest tilt of a robot that stands."""


@dataclasses.dataclass(frozen=True)
class Drop(Result):
    """Three seconds after a drop from 0.3 m, targets in the default pose.

    Both simulators at the same step.

    Joints have no speed limits here. A landing drives legs into them, and the impulse of a rigid
    limit between rigid contacts depends on how stiff the contacts are. Step responses compare the
    limits. polypod at 5 ms is the robot of the tasks, with its limits: within such a step a motor
    at its limit of effort brings light joints to 100 rad/s.
    """

    gains: float
    """Factor on the robot's stiffness and damping."""
    dt: float
    """Physics step of both simulators, s."""
    height: float
    """Height of the base in polypod, m."""
    mujoco_height: float
    """Height of the base in MuJoCo, m."""
    pitch: float
    """Pitch of the base in polypod, rad."""
    mujoco_pitch: float
    """Pitch of the base in MuJoCo, rad."""
    mujoco_coarse_height: float
    """MuJoCo's at 2.5 ms, m."""
    mujoco_coarse_pitch: float
    """MuJoCo's at 2.5 ms, rad."""
    coarse_height: float
    """polypod's at 5 ms, m."""
    coarse_pitch: float
    """polypod's at 5 ms, rad."""

    @property
    def case(self) -> str:
        """The robot and the factor on its gains."""
        return f"{self.robot}, {self.gains:g} times its gains"

    @property
    def height_error(self) -> float:
        """Against MuJoCo at the same step, m."""
        return abs(self.height - self.mujoco_height)

    @property
    def pitch_error(self) -> float:
        """Against MuJoCo at the same step, rad."""
        return abs(self.pitch - self.mujoco_pitch)

    @property
    def coarse_height_error(self) -> float:
        """Error of polypod's height at 5 ms, m."""
        return abs(self.coarse_height - self.mujoco_height)

    @property
    def coarse_pitch_error(self) -> float:
        """Error of polypod's pitch at 5 ms, rad."""
        return abs(self.coarse_pitch - self.mujoco_pitch)


@dataclasses.dataclass(frozen=True)
class Standing(Result):
    """Forces of the ground on the feet of a robot at rest in its default pose."""

    weight: float
    """Weight of the robot, N."""
    normal: Array
    """Normal force per foot, polypod's, N."""
    mujoco_normal: Array
    """Normal force per foot, MuJoCo's, N."""
    tangential: Array
    """Horizontal force per foot [feet, 2], polypod's, N."""
    mujoco_tangential: Array
    """Horizontal force per foot [feet, 2], MuJoCo's, N."""

    @property
    def normal_error(self) -> float:
        """Largest difference of a foot's normal force, relative to MuJoCo's on that foot."""
        return float((np.abs(self.normal - self.mujoco_normal) / self.mujoco_normal).max())

    @property
    def tangential_error(self) -> float:
        """Largest difference of a foot's horizontal force, over MuJoCo's normal force on it."""
        difference = np.linalg.norm(self.tangential - self.mujoco_tangential, axis=1)
        return float((difference / self.mujoco_normal).max())


@dataclasses.dataclass(frozen=True)
class SlopeRest(Result):
    """Distance that a robot's base moves in 10 s on a slope of 20 degrees, after it has settled."""

    uphill: str
    """Side of the robot that faces up the slope."""
    creep: float
    """Largest distance from where it was after settling, polypod's, m."""
    mujoco_creep: float
    """Largest distance from where it was after settling, MuJoCo's, m."""

    @property
    def case(self) -> str:
        """The robot and its side up the slope."""
        return f"{self.robot}, {self.uphill} uphill"


def compare_drop(robot: Robot, *, gains: float = 1.0) -> Drop:
    """Drops a robot on its own gains or on `gains` times these.

    Its joints have no limits of speed.
    """
    robot = robot.with_gains(gains).without_speed_limits()
    start = pose(robot, DROP_HEIGHT)
    dt = CONVERGED if gains < FIRM else FINE
    limited = zip(robot.actuators.groups, np.isinf(robot.actuators.no_load_speed), strict=True)
    lifted = {group: {"velocity_limit": UNREACHED} for group, by_speed in limited if by_speed}

    def mujoco_drop(dt: float) -> Array:
        mujoco = Reference.of(robot, dt=dt, ground=Ground(FRICTION), bounded=True)
        mujoco.set_state(start)
        mujoco.step(robot.default_position, round(DROP_TIME / dt))
        return mujoco.qpos

    def drop(config: str, dt: float) -> Array:
        sim = polypod.Simulation(config, dt=dt, friction=FRICTION, self_collision=False, threads=1)
        sim.set_state(start)
        hold(sim, robot, DROP_TIME)
        return np.array(sim.qpos[0])

    with with_actuators(robot, lifted) as config:
        fine = drop(config, dt)
    coarse, theirs, theirs_coarse = drop(robot.source, DT), mujoco_drop(dt), mujoco_drop(MUJOCO_COARSE)
    return Drop(
        robot=robot.name,
        gains=gains,
        dt=dt,
        height=fine[2],
        mujoco_height=theirs[2],
        pitch=pitch(fine),
        mujoco_pitch=pitch(theirs),
        mujoco_coarse_height=theirs_coarse[2],
        mujoco_coarse_pitch=pitch(theirs_coarse),
        coarse_height=coarse[2],
        coarse_pitch=pitch(coarse),
    )


def compare_standing(robot: Robot) -> Standing:
    """Sets a robot on its feet and lets it settle."""
    sim = on_its_feet(robot)
    hold(sim, robot, SETTLE_TIME)
    mujoco = Reference.of(robot, dt=FINE, ground=Ground(FRICTION), bounded=True)
    mujoco.set_state(pose(robot, 0.0))
    mujoco.step(robot.default_position, round(SETTLE_TIME / FINE))
    links = list(sim.link_names)
    ours, theirs = sim.contact_forces[0], mujoco.contact_forces(links)
    feet = np.flatnonzero(theirs[:, 2] > 0.0)
    return Standing(
        robot=robot.name,
        weight=sim.total_mass * GRAVITY,
        normal=ours[feet, 2],
        mujoco_normal=theirs[feet, 2],
        tangential=ours[feet, :2],
        mujoco_tangential=theirs[feet, :2],
    )


def compare_slope_rest(robot: Robot, uphill: str = "front") -> SlopeRest:
    """Sets a robot with firm legs on a slope.

    `uphill` is the side of it that looks up: "front" or "left".
    """
    robot = robot.with_gains(FIRM)
    axis = np.array([0.0, -1.0, 0.0]) if uphill == "front" else np.array([1.0, 0.0, 0.0])
    normal = _rotate(axis, np.array([0.0, 0.0, 1.0]))
    start = pose(robot, 0.0)
    start[:3] = start[2] * normal
    start[3:7] = [math.cos(SLOPE_ANGLE / 2), *(math.sin(SLOPE_ANGLE / 2) * axis)]
    x, y, z = (float(component) for component in normal)
    sim = polypod.Simulation(
        robot.source, dt=DT, friction=FRICTION, ground_normal=(x, y, z), self_collision=False, threads=1
    )
    sim.set_state(start)
    mujoco = Reference.of(robot, dt=SLOPE_FINE, ground=Ground(FRICTION, (x, y, z)), bounded=True)
    mujoco.set_state(start)
    hold(sim, robot, SETTLE_TIME)
    mujoco.step(robot.default_position, round(SETTLE_TIME / SLOPE_FINE))
    ours, theirs = sim.qpos[0, :3], mujoco.qpos[:3]
    creep = mujoco_creep = 0.0
    every = 0.1
    for _ in range(round(REST_TIME / every)):
        hold(sim, robot, every)
        mujoco.step(robot.default_position, round(every / SLOPE_FINE))
        creep = max(creep, float(np.linalg.norm(sim.qpos[0, :3] - ours)))
        mujoco_creep = max(mujoco_creep, float(np.linalg.norm(mujoco.qpos[:3] - theirs)))
    return SlopeRest(robot.name, uphill, creep, mujoco_creep)


def stands(robot: Robot, dt: float = DT, engine: str = "articulated") -> bool:
    """Whether a robot that is set on its feet is still on them after 2 s at this step, and calm."""
    sim = on_its_feet(robot, dt, engine)
    hold(sim, robot, STAND_TIME - CALM_TIME)
    before = sim.qpos[0, :3]
    hold(sim, robot, CALM_TIME)
    qpos, upright = sim.qpos[0], _upright(sim.qpos[0])
    if not np.isfinite(qpos).all():
        return False
    calm = float(np.linalg.norm(qpos[:3] - before)) < CALM_SPEED * CALM_TIME
    slow = float(np.linalg.norm(sim.qvel[0, :3])) < CALM_SPEED
    return calm and slow and qpos[2] > LEAST_HEIGHT * robot.base_height and upright > LEAST_UPRIGHT


def on_its_feet(
    robot: Robot, dt: float = DT, engine: str = "articulated", *, num_envs: int = 1, source: str | None = None
) -> polypod.Simulation:
    """Robots on their feet in the default pose; `source`: a config in the place of the robot's."""
    sim = polypod.Simulation(
        source or robot.source, num_envs, dt=dt, engine=engine, friction=FRICTION, self_collision=False, threads=1
    )
    sim.set_state(pose(robot, 0.0))
    return sim


def hold(sim: polypod.Simulation, robot: Robot, seconds: float) -> None:
    """Holds the default pose."""
    kp, kd = robot.actuators.stiffness, robot.actuators.damping
    sim.step(targets=robot.default_position, kp=kp, kd=kd, n=round(seconds / sim.dt))


def pose(robot: Robot, above: float) -> Array:
    """State in the default pose, level, with the lowest foot `above` the ground."""
    return np.array([0.0, 0.0, robot.base_height + above, 1.0, 0.0, 0.0, 0.0, *robot.default_position])


def _rotate(axis: Array, vector: Array) -> Array:
    """Turns `vector` about the unit vector `axis`, perpendicular to it, by the slope's angle."""
    return math.cos(SLOPE_ANGLE) * vector + math.sin(SLOPE_ANGLE) * np.cross(axis, vector)


def pitch(qpos: Array) -> float:
    """Pitch of the base, rad."""
    w, x, y, z = qpos[3:7]
    return math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))


def _upright(qpos: Array) -> float:
    """The z component of the base's z axis."""
    _, x, y, _ = qpos[3:7]
    return float(1.0 - 2.0 * (x * x + y * y))
