"""Limits of effort, position and speed in MuJoCo, as polypod has them.

- **Effort.** Each actuator's range follows from the state at the beginning of a step: effort
  limits, their tables over the joint angle, torque-speed lines of DC motors.
- **Position and speed.** MuJoCo's position limits are springs, and it has no limit of a joint's
  speed. polypod's are bounds of the velocity at the end of the step: not faster than the speed
  limit, and not past the position limit. Both become MuJoCo's own rows of joint limits.
  `mj_referenceConstraint` computes the acceleration that a row asks for from its spring; here it is
  replaced by the one that leads to the bound. MuJoCo then solves them together with contacts and
  dry friction.

MuJoCo computes the rows within its steps of `RK4`. Where a joint is near a limit, such a step is
made as ten of `implicitfast`: the motion has a kink at the bound, which a method of fourth order
follows no better.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod.arrays import Array
from polypod.mujoco_model.robot import Actuators

SPARE_SPEED = 20.0
"""Speed that a joint may gain in a step without passing its position limit unnoticed, rad/s or
m/s."""
SPARE_ACCELERATION = 1000.0
"""Largest acceleration of a joint by motors and gravity, rad/s^2 or m/s^2. A contact may give it
more."""
SUBSTEPS = 10
"""Steps of `implicitfast` in place of one of `RK4`."""
EVERYWHERE = 1e9
"""Distance from a position limit at which its row takes part at any position, rad or m."""
HARD = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Impedance of the rows: they give way by 1e-4 of what they hold."""


class Limits:
    """Steps of one model within the limits of its joints and actuators."""

    def __init__(self, mj: Any, model: Any, actuators: Actuators, joints: Sequence[int]) -> None:
        """Prepares a model; `joints` are its ids of the actuators' joints."""
        self._mj, self._model, self._actuators = mj, model, actuators
        self._joints = np.array(joints, dtype=np.intp)
        self._q, self._v = model.jnt_qposadr[self._joints], model.jnt_dofadr[self._joints]
        model.actuator_forcelimited[:] = 1
        self._may_touch = bool((model.geom_contype != 0).any())
        # joints without end have rows for their speed
        endless = self._joints[model.jnt_limited[self._joints] == 0]
        model.jnt_range[endless] = [-EVERYWHERE, EVERYWHERE]
        model.jnt_limited[self._joints] = 1
        model.jnt_solimp[self._joints] = HARD
        self._range = model.jnt_range[self._joints]
        self._speed_limit = np.full(model.njnt, np.inf)
        self._speed_limit[self._joints] = actuators.speed_limit

    def step(self, data: Any) -> None:
        """One physics step towards the targets in `data.ctrl`."""
        options, mj = self._model.opt, self._mj
        if options.integrator != mj.mjtIntegrator.mjINT_RK4:
            self._first_order_step(data)
        elif self._near(data).any():
            integrator, step = options.integrator, options.timestep
            options.integrator, options.timestep = mj.mjtIntegrator.mjINT_IMPLICITFAST, step / SUBSTEPS
            for _ in range(SUBSTEPS):
                self._first_order_step(data)
            options.integrator, options.timestep = integrator, step
        else:
            mj.mj_step(self._model, data)

    def _near(self, data: Any) -> npt.NDArray[np.bool_]:
        """Whether joints may reach a limit in this step.

        Sets the ranges of effort and the rows that take part.
        """
        model = self._model
        position, velocity = data.qpos[self._q], data.qvel[self._v]
        model.actuator_forcerange[:] = self._actuators.effort_range(position, velocity)
        speed, limit = np.abs(velocity), self._actuators.speed_limit
        gain = math.inf if self._may_touch else model.opt.timestep * SPARE_ACCELERATION
        fast = np.isfinite(limit) & (speed + gain > limit)
        margin = 2.0 * model.opt.timestep * (speed + SPARE_SPEED)
        model.jnt_margin[self._joints] = np.where(fast, EVERYWHERE, margin)
        near: npt.NDArray[np.bool_] = fast | (position - margin < self._range[:, 0])
        near |= self._range[:, 1] < position + margin
        return near

    def _first_order_step(self, data: Any) -> None:
        near = self._near(data).any()
        self._mj.mj_step1(self._model, data)
        if near:
            self._bound(data)
        self._mj.mj_step2(self._model, data)

    def _bound(self, data: Any) -> None:
        """Sets the accelerations that the rows of joint limits ask for."""
        model, step = self._model, self._model.opt.timestep
        rows = np.flatnonzero(data.efc_type == self._mj.mjtConstraint.mjCNSTR_LIMIT_JOINT)
        joints = data.efc_id[rows]
        # the row's coordinate is the distance from the limit
        least = -np.minimum(data.efc_pos[rows] / step, self._speed_limit[joints])
        change = least - data.efc_vel[rows]
        # `implicitfast` multiplies accelerations by M / (M + step D) after the constraints are
        # solved
        dofs = model.jnt_dofadr[joints]
        units = np.zeros((len(rows), model.nv))
        units[np.arange(len(rows)), dofs] = 1.0
        response = np.zeros_like(units)
        self._mj.mj_solveM(model, data, response, units)
        inverse = response[np.arange(len(rows)), dofs]
        data.efc_aref[rows] = (1.0 + step * inverse * self._implicit_damping(data)[dofs]) * change / step

    def _implicit_damping(self, data: Any) -> Array:
        """Damping of each degree of freedom, N m s/rad.

        The joint's and the actuator's, without the latter where the effort is at a limit.
        """
        model, actuators = self._model, self._actuators
        wanted = actuators.stiffness * (data.ctrl - data.qpos[self._q]) - actuators.damping * data.qvel[self._v]
        least, most = model.actuator_forcerange.T
        damping = np.array(model.dof_damping)
        damping[self._v] += np.where((least < wanted) & (wanted < most), actuators.damping, 0.0)
        return damping
