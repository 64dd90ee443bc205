"""Error that the solver's sweeps leave, compared with the error of the physics step."""

import dataclasses
import inspect

import numpy as np

import polypod
from polypod.accuracy.result import Result
from polypod.accuracy.standing import DT, FRICTION
from polypod.arrays import Array
from polypod.mujoco_model.robot import Robot

FINE = 0.0005
"""The step that the physics step is held against, s."""
CONTROL = 0.02
"""How long a target is held, and how far the comparison goes, s."""
USUAL: int = inspect.signature(polypod.Simulation).parameters["solver_iterations"].default
"""Sweeps by default."""
MANY = 8 * USUAL
"""Sweeps with which the slowest robot converges."""
COUNTS = (USUAL // 2, USUAL, 2 * USUAL, MANY)
"""Sweeps that are compared."""
CONVERGED = 256
"""Sweeps that they are held against."""
AMPLITUDE = 0.5
"""Targets are uniformly within this of the default position, rad."""
ENVS = 1024
"""Robots that move at a time: few of them make most of the error."""
SETTLE, MOMENTS, EVERY = 20, 10, 4
"""Control steps before the first moment; moments that are compared; control steps from one to the
next."""


@dataclasses.dataclass(frozen=True)
class Sweeps(Result):
    """Error of the base's velocity after 20 ms of random targets, m/s.

    Root mean square over robots and moments.
    """

    left: dict[int, float]
    """Error of each number of sweeps, compared with 256 sweeps."""
    step: float
    """Error of the step: 5 ms compared with 0.5 ms, both with 256 sweeps."""


def compare_sweeps(robot: Robot, *, seed: int = 0) -> Sweeps:
    """Compares a robot under random targets: it kicks on the ground, falls and lies there."""
    rng = np.random.default_rng(seed)
    moving = _simulation(robot, DT, USUAL)
    others = {count: _simulation(robot, DT, count) for count in (*COUNTS, CONVERGED)}
    fine = _simulation(robot, FINE, CONVERGED)
    left: dict[int, list[Array]] = {count: [] for count in COUNTS}
    step: list[Array] = []
    for moment in range(SETTLE + MOMENTS * EVERY):
        targets = robot.default_position + rng.uniform(-AMPLITUDE, AMPLITUDE, (ENVS, robot.num_joints))
        if moment >= SETTLE and moment % EVERY == 0:
            qpos, qvel = moving.qpos, moving.qvel
            converged = _base_velocity(others[CONVERGED], qpos, qvel, targets)
            for count, errors in left.items():
                errors.append(_base_velocity(others[count], qpos, qvel, targets) - converged)
            step.append(converged - _base_velocity(fine, qpos, qvel, targets))
        moving.step(targets=targets, n=round(CONTROL / DT))
    return Sweeps(robot.name, {count: _rms(errors) for count, errors in left.items()}, _rms(step))


def _simulation(robot: Robot, dt: float, sweeps: int) -> polypod.Simulation:
    return polypod.Simulation(robot.source, ENVS, dt=dt, friction=FRICTION, solver_iterations=sweeps, threads=1)


def _base_velocity(sim: polypod.Simulation, qpos: Array, qvel: Array, targets: Array) -> Array:
    """Linear velocities [envs, 3] of the bases after a control step from a state."""
    sim.set_state(qpos, qvel)
    sim.step(targets=targets, n=round(CONTROL / sim.dt))
    return sim.qvel[:, :3]


def _rms(errors: list[Array]) -> float:
    return float(np.sqrt((np.array(errors) ** 2).sum(axis=-1).mean()))
