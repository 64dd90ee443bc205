"""The two engines side by side, on the same robots, at the same step."""

import dataclasses
import statistics
import time

import numpy as np

from polypod.accuracy import motion
from polypod.accuracy.result import Result
from polypod.accuracy.standing import DT, SETTLE_TIME, hold, on_its_feet, pitch, stands
from polypod.arrays import Array
from polypod.mujoco_model.reference import GRAVITY
from polypod.mujoco_model.robot import Robot, with_actuators

STEPS = (0.001, 0.002, 0.004, 0.005, 0.008, 0.01, 0.0125, 0.016, 0.02, 0.025, 0.04, 0.05, 0.1, 0.125, 0.25)
"""Physics steps that are tried, s."""
SPEED_ENVS = 64
"""Envs in which the speed is measured."""
SPEED_STEPS = {"articulated": 1000, "avian": 50}
"""Physics steps of a timing, and the engines."""
TIMINGS = 5
"""Number of timings; the median is reported."""


@dataclasses.dataclass(frozen=True)
class Engine:
    """One engine's figures of one robot; at 5 ms, but for `largest_step`."""

    engine: str
    """Name of the engine."""
    height: float
    """Height of the base, 10 s after the robot was set on its feet in the default pose, m."""
    pitch: float
    """Pitch of the base then, rad."""
    force: float
    """Sum of the vertical contact forces then, over the weight."""
    torque: Array
    """Torques of the actuators then, N m."""
    frictionless_torque: Array
    """Torques of the actuators then, without dry friction in the joints, N m."""
    response_max: float
    """Largest deviation of a joint from MuJoCo's converged answer to a jump of a target by 0.1 rad,
    in 1 s, rad."""
    response_rms: float
    """Root of the mean square of these deviations, over all jumps, joints and times, rad."""
    drift: float
    """Largest distance of a link's origin from where base pose and joint positions put it, in the
    10 s, m."""
    largest_step: float
    """Largest of `STEPS` at which the robot stands for 2 s, as at all smaller ones, s; 0: at
    none."""
    steps_per_second: float
    """Physics steps of an env in a second of one core's time, median of several timings."""


@dataclasses.dataclass(frozen=True)
class Engines(Result):
    """Both engines' figures of one robot."""

    articulated: Engine
    avian: Engine

    @property
    def torque_difference(self) -> float:
        """Largest difference of the engines' torques on the standing robot, over the largest one.

        A joint at rest may be held by any torque within its dry friction: what is compared are
        robots without it.
        """
        return _apart(self.articulated.frictionless_torque, self.avian.frictionless_torque)

    @property
    def torque_difference_with_friction(self) -> float:
        """Difference of the torques with dry friction in the joints, N m."""
        return _apart(self.articulated.torque, self.avian.torque)


def compare_engines(robot: Robot, reference: motion.Jumps | None = None) -> Engines:
    """Measures both engines; `reference`: of `motion.converged_jumps`, if it is there."""
    reference = reference or motion.converged_jumps(robot)

    def measured(engine: str) -> Engine:
        track = motion.polypod_tracks(robot, reference.targets, DT, engine, gravity=reference.gravity)
        return _measure(robot, engine, reference.deviation(track))

    return Engines(robot.name, *(measured(engine) for engine in SPEED_STEPS))


def _apart(torque: Array, other: Array) -> float:
    return float(np.abs(other - torque).max()) / float(np.abs(torque).max())


def _measure(robot: Robot, engine: str, deviation: Array) -> Engine:
    sim = on_its_feet(robot, DT, engine)
    drift, every = 0.0, 0.1
    for _ in range(round(SETTLE_TIME / every)):
        hold(sim, robot, every)
        drift = max(drift, float(sim.link_drift[0]))
    return Engine(
        engine=engine,
        height=float(sim.qpos[0, 2]),
        pitch=pitch(sim.qpos[0]),
        force=float(sim.contact_forces[0, :, 2].sum()) / (sim.total_mass * GRAVITY),
        torque=sim.joint_torque[0],
        frictionless_torque=frictionless_torque(robot, engine),
        response_max=float(np.abs(deviation).max()),
        response_rms=float(np.sqrt(np.mean(deviation**2))),
        drift=drift,
        largest_step=_largest_step(robot, engine),
        steps_per_second=_speed(robot, engine),
    )


def frictionless_torque(robot: Robot, engine: str) -> Array:
    """The actuators' torques on the robot as it stands after `SETTLE_TIME`, N m.

    Its joints have no dry friction.
    """
    with with_actuators(robot, {group: {"friction": 0.0} for group in robot.actuators.groups}) as config:
        sim = on_its_feet(robot, DT, engine, source=config)
        hold(sim, robot, SETTLE_TIME)
    return sim.joint_torque[0]


def _largest_step(robot: Robot, engine: str) -> float:
    largest = 0.0
    for dt in STEPS:
        if not stands(robot, dt, engine):
            break
        largest = dt
    return largest


def _speed(robot: Robot, engine: str) -> float:
    """Robots that hold their default pose; a first run warms caches up."""
    steps = SPEED_STEPS[engine]
    sim = on_its_feet(robot, DT, engine, num_envs=SPEED_ENVS)
    rates = []
    for _ in range(TIMINGS + 1):
        start = time.thread_time()
        hold(sim, robot, steps * DT)
        rates.append(SPEED_ENVS * steps / (time.thread_time() - start))
    return statistics.median(rates[1:])
