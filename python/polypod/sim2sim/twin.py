"""Envs of polypod's own robot in MuJoCo, which compiles the robot's URDF.

See `polypod.mujoco_model.reference` for what is set, and `polypod.sim2sim.driven` for how it is
driven.

- The PD law is MuJoCo's position actuator with the robot's gains.
- Shapes touch the ground with the task's friction; the robot's own links pass through each other.
- Contacts are as stiff as the step allows, or MuJoCo's default ones (time constant 20 ms), by
  choice.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from polypod.arrays import Array
from polypod.mujoco_model.reference import Ground, Integrator, Reference
from polypod.mujoco_model.robot import Robot
from polypod.sim2sim.camera import DepthCamera
from polypod.sim2sim.driven import Drive, Driven, FoldedPolicy, Observed

__all__ = ["Drive", "Driven", "FoldedPolicy", "Observed", "Physics", "Twin"]


@dataclasses.dataclass(frozen=True)
class Physics:
    """Step, integrator and contacts of MuJoCo."""

    dt: float = 0.005
    """Physics step, s."""
    integrator: Integrator = "implicitfast"
    friction: float = 0.8
    """Friction of feet and links on the ground."""
    soft_contact: bool = False
    """MuJoCo's default contacts, in which feet sink in, in place of the stiffest ones that the step
    allows."""
    torsional_friction: float = 0.0
    """Torsional friction of feet and links on the ground, m; above 0 contacts have `condim` 4."""
    rolling_friction: float = 0.0
    """Rolling friction of feet and links on the ground, m; above 0 contacts have `condim` 6."""


class Twin(Driven):
    """`num_envs` robots of one kind, each in a separate world."""

    def __init__(self, robot: Robot, base_bodies: Sequence[str], physics: Physics, drive: Drive) -> None:
        """Compiles the model.

        Args:
            robot: URDF and actuators.
            base_bodies: links that must not touch the ground: those of base and torso, and what
                else ends episodes.
            physics: how MuJoCo steps.
            drive: the policy, and how it drives.
        """
        ground = Ground(
            physics.friction,
            soft=physics.soft_contact,
            heights=drive.heights,
            torsional_friction=physics.torsional_friction,
            rolling_friction=physics.rolling_friction,
        )
        options = {"dt": physics.dt, "integrator": physics.integrator, "ground": ground, "gravity": drive.gravity}
        reference = Reference.of(robot, **options)
        model = reference.model
        model.actuator_forcelimited[:] = 1
        names = [model.body(body).name for body in model.geom_bodyid]
        super().__init__(reference, robot, np.array([name in base_bodies for name in names]), physics.dt, drive)
        self._camera = DepthCamera.of(self.interface, self.heights, self.step_dt, self.num_envs)

    def reset(self, qpos: Array, qvel: Array) -> None:
        """Begins in these states, [envs, nq] and [envs, nv]."""
        super().reset(qpos, qvel)
        if self._camera is not None:
            for env in range(self.num_envs):
                self._camera.begin(env, *self._link_pose(env, self._camera.body))

    def step(self, commands: npt.NDArray[np.float32], active: npt.NDArray[np.bool_]) -> Observed:
        """One control step towards `commands` [envs, 3].

        Envs that are not `active` are left alone.
        """
        observed = super().step(commands, active)
        if self._camera is not None:
            for env in np.flatnonzero(active & np.isfinite(self.qpos).all(axis=1)).tolist():
                self._camera.advance(env, *self._link_pose(env, self._camera.body))
        return observed

    def sensors(self) -> dict[str, Array]:
        """Readings of the robot's sensors, named as the folded graph's inputs, [envs, size]."""
        found = super().sensors()
        return found if self._camera is None else found | {"image": self._camera.images()}

    def _link_pose(self, env: int, link: str | None) -> tuple[Array, Array]:
        """Position of a link's frame, m, and its axes as columns; None: of the base."""
        model, data = self.reference.model, self._data[env]
        # a step leaves the poses of the state before it
        self._mj.mj_kinematics(model, data)
        body = data.body(self.reference.root if link is None else link)
        return np.array(body.xpos), np.array(body.xmat).reshape(3, 3)
