"""Step responses: one joint's target jumps, without ground."""

import dataclasses

import numpy as np

import polypod
from polypod.accuracy.result import Result
from polypod.arrays import Array
from polypod.mujoco_model.reference import GRAVITY, Integrator, Reference
from polypod.mujoco_model.robot import Robot

AMPLITUDE = 0.1
"""Size of the jump of a joint's target, rad."""
HELD = 0.5
"""Share of the gains' stiffness that gravity has to leave, in every direction, for a pose to count
as held."""
DURATION = 1.0
"""Length of a response, s."""
FINE, COARSE = 0.0005, 0.005
"""Physics steps, s."""
CONVERGED = 0.00025
"""Step of the reference, s."""


@dataclasses.dataclass(frozen=True)
class StepResponse(Result):
    """Worst deviation from the converged answer over all joints, times and jumps, rad.

    The base is fixed; the robot starts in its default pose at rest and one joint's target jumps by
    0.1 rad. The converged answer is MuJoCo's with RK4 at 0.25 ms. Both have the limits of effort,
    speed and position.
    """

    gravity: bool
    """Whether gravity acts: where the gains hold the robot up. Elsewhere it topples like a pendulum
    on its head."""
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


@dataclasses.dataclass(frozen=True)
class Jumps:
    """Targets of a robot, and its answers at ever smaller steps."""

    targets: Array
    """Joint targets, rad, [jumps, joints]: one joint after the other is off its default
    position."""
    gravity: bool
    """Whether gravity acts."""
    converged: Array
    """Joint positions [jumps, samples, joints] every 5 ms, rad."""

    def deviation(self, track: Array) -> Array:
        """Deviation of a track from the converged one, rad."""
        return track - self.converged


def converged_jumps(robot: Robot) -> Jumps:
    """The jumps of all joints, converged in MuJoCo."""
    targets, gravity = jumps(robot), holds_its_pose(robot)
    return Jumps(targets, gravity, mujoco_tracks(robot, targets, CONVERGED, "RK4", gravity=gravity))


def compare_step_responses(robot: Robot, reference: Jumps | None = None) -> StepResponse:
    """Compares the response to a jump of each joint's target.

    `reference`: of `converged_jumps`, if it is there.
    """
    reference = reference or converged_jumps(robot)
    targets, gravity = reference.targets, reference.gravity

    def worst(track: Array) -> Array:
        """Largest deviation of each jump, rad."""
        return np.abs(reference.deviation(track)).max(axis=(1, 2))

    coarse = worst(polypod_tracks(robot, targets, COARSE, gravity=gravity))
    mujoco_coarse = worst(mujoco_tracks(robot, targets, COARSE, "implicitfast", gravity=gravity))
    return StepResponse(
        robot=robot.name,
        gravity=gravity,
        fine=float(worst(polypod_tracks(robot, targets, FINE, gravity=gravity)).max()),
        coarse=float(coarse.max()),
        mujoco_fine=float(worst(mujoco_tracks(robot, targets, FINE, "implicitfast", gravity=gravity)).max()),
        mujoco_coarse=float(mujoco_coarse.max()),
        joints_further=int(np.sum(coarse > mujoco_coarse)),
    )


def holds_its_pose(robot: Robot) -> bool:
    """Whether the gains hold the default pose on a fixed base against gravity."""
    reference = Reference.of(robot, dt=FINE, fixed_base=True)
    joints, change = robot.num_joints, 1e-5

    def gravity(position: Array) -> Array:
        reference.set_state(position)
        return reference.bias_force()

    slope = np.empty((joints, joints))
    for joint, step in enumerate(change * np.eye(joints)):
        above, below = (gravity(robot.default_position + sign * step) for sign in (1.0, -1.0))
        slope[joint] = (above - below) / (2.0 * change)
    left = (1.0 - HELD) * np.diag(robot.actuators.stiffness) + 0.5 * (slope + slope.T)
    return bool(np.linalg.eigvalsh(left).min() > 0.0)


def jumps(robot: Robot) -> Array:
    """Targets [jumps, joints] in which one joint after the other is off its default position."""
    return robot.default_position + AMPLITUDE * np.eye(robot.num_joints)


def polypod_tracks(
    robot: Robot, targets: Array, dt: float, engine: str = "articulated", *, gravity: bool = True
) -> Array:
    """Joint positions [jumps, samples, joints] every 5 ms."""
    sim = polypod.Simulation(
        robot.source,
        len(targets),
        dt=dt,
        engine=engine,
        ground=None,
        gravity=_acceleration(gravity),
        fixed_base=True,
        self_collision=False,
        threads=1,
    )
    sim.set_state(robot.default_position, np.zeros(robot.num_joints))
    track = []
    for _ in range(round(DURATION / COARSE)):
        sim.step(targets=targets, n=round(COARSE / dt))
        track.append(sim.qpos)
    return np.stack(track, axis=1)


def mujoco_tracks(robot: Robot, targets: Array, dt: float, integrator: Integrator, *, gravity: bool = True) -> Array:
    """Joint positions in MuJoCo, as `polypod_tracks`."""
    reference = Reference.of(
        robot, dt=dt, integrator=integrator, fixed_base=True, gravity=_acceleration(gravity), bounded=True
    )
    tracks = []
    for target in targets:
        reference.set_state(robot.default_position)
        track = []
        for _ in range(round(DURATION / COARSE)):
            reference.step(target, round(COARSE / dt))
            track.append(reference.qpos)
        tracks.append(track)
    return np.array(tracks)


def _acceleration(gravity: bool) -> tuple[float, float, float]:
    return (0.0, 0.0, -GRAVITY if gravity else 0.0)
