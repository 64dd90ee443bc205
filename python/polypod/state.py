"""The state of every robot as dense arrays."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core

FloatArray = npt.NDArray[np.float32]


class State:
    """Present state of the robots, for terms in Python.

    Each property is a float32 array [num_envs, n], gathered when it is asked for: a copy, yours to
    keep, of the state after the last step or reset. It is guarded against writing, which would
    change nothing; `VecSim.set_state` sets states. Under same-step autoreset that is the new
    episode's state where one has ended; build the env with `autoreset="disabled"` to see the last
    state of an episode, as `polypod.terms.CustomTerms` does.

    Joints are in canonical order (`VectorEnv.canonical_joint_names`), feet in the order of
    `VectorEnv.feet_names` with x, y, z side by side: twelve joints and LF, LH, RF, RH for
    quadrupeds. Entries for missing joints and feet are 0, see `action_mask`. Base axes: x forward,
    y left, z up. After a reset all is computed for the new state; accelerations, efforts, contact
    forces and times, which belong to physics steps, are 0: none has been made. Rows whose state
    broke (`valid` is False) are zeros.
    """

    def __init__(self, sim: Callable[[], _core.VecSim]) -> None:
        """Reads from the simulator that `sim` gives."""
        self._sim = sim

    @property
    def base_pos(self) -> FloatArray:
        """Position of the base relative to the env's origin, m, [num_envs, 3].

        The origin lies on the ground (`VecSim.env_origins`): on terrain at the height of the tile's
        middle.
        """
        return self._sim().state("base_pos")

    @property
    def base_height(self) -> FloatArray:
        """Height of the base above the ground below it, m, [num_envs].

        Where the task has a height scanner: above the mean of the ground below its rays.
        """
        return self._sim().state("base_height")[:, 0]

    @property
    def base_quat(self) -> FloatArray:
        """Orientation of the base, [num_envs, 4]: w, x, y, z."""
        return self._sim().state("base_quat")

    @property
    def base_lin_vel(self) -> FloatArray:
        """Velocity of the base's centre of mass, base axes, m/s, [num_envs, 3]."""
        return self._sim().state("base_lin_vel")

    @property
    def base_ang_vel(self) -> FloatArray:
        """Angular velocity of the base, base axes, rad/s, [num_envs, 3]."""
        return self._sim().state("base_ang_vel")

    @property
    def projected_gravity(self) -> FloatArray:
        """Unit vector of gravity, base axes, [num_envs, 3]; zeros without gravity."""
        return self._sim().state("projected_gravity")

    @property
    def joint_pos(self) -> FloatArray:
        """Joint positions, rad, [num_envs, joints]."""
        return self._sim().state("joint_pos")

    @property
    def joint_vel(self) -> FloatArray:
        """Joint velocities, rad/s, [num_envs, joints]."""
        return self._sim().state("joint_vel")

    @property
    def joint_acc(self) -> FloatArray:
        """Joint accelerations over the last physics step, rad/s^2, [num_envs, joints]."""
        return self._sim().state("joint_acc")

    @property
    def joint_effort(self) -> FloatArray:
        """Efforts that the actuators applied in the last physics step, N m, [num_envs, joints]."""
        return self._sim().state("joint_effort")

    @property
    def default_joint_pos(self) -> FloatArray:
        """The default pose, rad, [num_envs, joints]."""
        return self._sim().state("default_joint_pos")

    @property
    def contact_forces(self) -> FloatArray:
        """Net contact force on each foot in the last step, world axes, N, [num_envs, 3 feet]."""
        return self._sim().state("contact_forces")

    @property
    def feet_pos(self) -> FloatArray:
        """Centre of each foot relative to the env's origin, m, [num_envs, 3 feet]."""
        return self._sim().state("feet_pos")

    @property
    def feet_height(self) -> FloatArray:
        """Height of each foot's centre above the ground below it, m, [num_envs, feet]."""
        return self._sim().state("feet_height")

    @property
    def feet_vel(self) -> FloatArray:
        """Velocities of the feet, world axes, m/s, [num_envs, 3 feet]."""
        return self._sim().state("feet_vel")

    @property
    def feet_air_time(self) -> FloatArray:
        """Time that each foot has been in the air, s, [num_envs, feet]; 0 in contact."""
        return self._sim().state("feet_air_time")

    @property
    def feet_contact_time(self) -> FloatArray:
        """Time that each foot has been in contact, s, [num_envs, feet]; 0 in the air."""
        return self._sim().state("feet_contact_time")

    @property
    def action_mask(self) -> npt.NDArray[np.bool_]:
        """Bool [num_envs, joints], True where an env's robot has a joint. It never changes."""
        return self._sim().action_mask

    @property
    def command(self) -> FloatArray:
        """Commanded velocity, base axes, [num_envs, 3]: x, y (m/s), yaw rate (rad/s)."""
        return self._sim().state("command")

    @property
    def last_action(self) -> FloatArray:
        """Action as the policy gave it, [num_envs, joints]."""
        return self._sim().state("last_action")

    @property
    def previous_action(self) -> FloatArray:
        """The action before the last one, [num_envs, joints]."""
        return self._sim().state("previous_action")

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Bool [num_envs], False where the state broke in the last step."""
        valid: npt.NDArray[Any] = self._sim().state("valid")[:, 0] > 0.0
        return valid

    @property
    def episode_length(self) -> npt.NDArray[np.int64]:
        """int64 [num_envs], control steps of the episodes so far."""
        return self._sim().episode_length
