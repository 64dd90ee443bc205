"""Envs of polypod's own robot in MuJoCo, which compiles the robot's URDF.

See `polypod.accuracy.reference` for what is set, and `polypod.sim2sim.driven` for how it is driven.

- The PD law is MuJoCo's position actuator with the robot's gains.
- Shapes touch the ground with the task's friction; the robot's own links pass through each other.
- Contacts are as stiff as the step allows, or MuJoCo's default ones (time constant 20 ms), by choice.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from polypod.accuracy.reference import GRAVITY, Ground, Heights, Integrator, Reference
from polypod.accuracy.robot import Robot
from polypod.export.robot import RobotInterface
from polypod.sim2sim.commands import Array
from polypod.sim2sim.driven import Driven, FoldedPolicy, NetworkTorques, Observed

__all__ = ["Driven", "FoldedPolicy", "Observed", "Physics", "Twin"]


@dataclasses.dataclass(frozen=True)
class Physics:
    """How MuJoCo steps."""

    dt: float = 0.005
    """Physics step, s."""
    integrator: Integrator = "implicitfast"
    friction: float = 0.8
    """Of feet and links on the ground."""
    soft_contact: bool = False
    """MuJoCo's default contacts, in which feet sink in, in place of the stiffest ones that the step allows."""
    torsional_friction: float = 0.0
    """Of feet and links on the ground, m; above 0 contacts have `condim` 4."""
    rolling_friction: float = 0.0
    """The same across the normal; above 0 contacts have `condim` 6."""


class Twin(Driven):
    """`num_envs` robots of one kind, each in a separate world."""

    def __init__(
        self,
        robot: Robot,
        interface: RobotInterface,
        policy: FoldedPolicy,
        base_bodies: Sequence[str],
        *,
        step_dt: float,
        physics_dt: float,
        physics: Physics,
        delays: Array,
        network_torques: NetworkTorques | None = None,
        heights: Heights | None = None,
        places: Array | None = None,
        gravity: tuple[float, float, float] = (0.0, 0.0, -GRAVITY),
        least_height: float = -np.inf,
        most_tilt: float = np.pi,
    ) -> None:
        """Compiles the model.

        Args:
            robot: URDF and actuators.
            interface: between policy and robot.
            policy: folded for the robot.
            base_bodies: links that must not touch the ground: those of base and torso, and what else ends episodes.
            step_dt: control step, s.
            physics_dt: the physics step that delays are counted in, s.
            physics: how MuJoCo steps.
            delays: [envs, joints], of the targets, in physics steps.
            network_torques: of the robot's actuator networks, one physics step of `physics_dt` after the other.
            heights: of the ground; None: a plane.
            places: [envs, 3], of the envs' origins on it, m; None: the world's origin.
            gravity: m/s^2, world axes.
            least_height: see `base_height`; one that is lower has fallen, m.
            most_tilt: of the base's z axis from the direction against gravity; one that is farther has fallen, rad.
        """
        ground = Ground(
            physics.friction,
            soft=physics.soft_contact,
            heights=heights,
            torsional_friction=physics.torsional_friction,
            rolling_friction=physics.rolling_friction,
        )
        options = {"dt": physics.dt, "integrator": physics.integrator, "ground": ground, "gravity": gravity}
        reference = Reference.of(robot, **options)
        model = reference.model
        model.actuator_forcelimited[:] = 1
        names = [model.body(body).name for body in model.geom_bodyid]
        super().__init__(
            reference,
            robot,
            interface,
            policy,
            np.array([name in base_bodies for name in names]),
            step_dt=step_dt,
            physics_dt=physics_dt,
            dt=physics.dt,
            delays=delays,
            network_torques=network_torques,
            heights=heights,
            places=places,
            gravity=gravity,
            least_height=least_height,
            most_tilt=most_tilt,
        )
