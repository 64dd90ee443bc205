"""Step responses: one joint's target jumps, without ground."""

import dataclasses

import numpy as np

import polypod
from polypod.accuracy.reference import Integrator, Reference
from polypod.accuracy.robot import Array, Robot

AMPLITUDE = 0.1
"""Of the jump, rad: small enough for every actuator to stay within its limits."""
DURATION = 1.0
"""s."""
FINE, COARSE = 0.0005, 0.005
"""Physics steps, s."""
CONVERGED = 0.00025
"""Step of the reference, s."""


@dataclasses.dataclass(frozen=True)
class StepResponse:
    """Worst deviation of any joint at any time from the converged answer, rad, over the jumps of all joints.

    The base is fixed and gravity acts; the robot starts in its default pose at rest and one joint's target jumps by 0.1
    rad. The converged answer is MuJoCo's with RK4 at 0.25 ms.
    """

    robot: str
    fine: float
    """polypod at 0.5 ms."""
    coarse: float
    """polypod at 5 ms."""
    mujoco_fine: float
    """MuJoCo, `implicitfast`, at 0.5 ms."""
    mujoco_coarse: float
    """MuJoCo, `implicitfast`, at 5 ms."""
    joints_further: int
    """Joints whose jump polypod follows less closely than MuJoCo's `implicitfast`, both at 5 ms."""


def compare_step_responses(robot: Robot) -> StepResponse:
    """Compares the response to a jump of each joint's target."""
    targets = jumps(robot)
    converged = mujoco_tracks(robot, targets, CONVERGED, "RK4")

    def deviation(track: Array) -> Array:
        return np.abs(track - converged).max(axis=(1, 2))

    coarse = deviation(polypod_tracks(robot, targets, COARSE))
    mujoco_coarse = deviation(mujoco_tracks(robot, targets, COARSE, "implicitfast"))
    return StepResponse(
        robot=robot.name,
        fine=float(deviation(polypod_tracks(robot, targets, FINE)).max()),
        coarse=float(coarse.max()),
        mujoco_fine=float(deviation(mujoco_tracks(robot, targets, FINE, "implicitfast")).max()),
        mujoco_coarse=float(mujoco_coarse.max()),
        joints_further=int(np.sum(coarse > mujoco_coarse)),
    )


def jumps(robot: Robot) -> Array:
    """Targets [jumps, joints] in which one joint after the other is off its default position."""
    return robot.default_position + AMPLITUDE * np.eye(robot.num_joints)


def polypod_tracks(robot: Robot, targets: Array, dt: float, engine: str = "articulated") -> Array:
    """Joint positions [jumps, samples, joints] every 5 ms."""
    sim = polypod.Simulation(
        robot.name, len(targets), dt=dt, engine=engine, ground=None, fixed_base=True, self_collision=False, threads=1
    )
    sim.set_state(robot.default_position, np.zeros(robot.num_joints))
    track = []
    for _ in range(round(DURATION / COARSE)):
        sim.step(targets=targets, n=round(COARSE / dt))
        track.append(sim.qpos)
    return np.stack(track, axis=1)


def mujoco_tracks(robot: Robot, targets: Array, dt: float, integrator: Integrator) -> Array:
    """The same with MuJoCo."""
    reference = Reference.of(robot, dt=dt, integrator=integrator, fixed_base=True)
    tracks = []
    for target in targets:
        reference.set_state(robot.default_position)
        track = []
        for _ in range(round(DURATION / COARSE)):
            reference.step(target, round(COARSE / dt))
            track.append(reference.qpos)
        tracks.append(track)
    return np.array(tracks)
