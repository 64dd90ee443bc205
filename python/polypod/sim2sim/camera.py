"""A robot's depth camera in MuJoCo: rays against the ground alone, `mj_multiRay`.

Frames are held between updates and late by the mean of the task's `delay`. They have no noise, and
none is lost.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from polypod import rotations
from polypod.arrays import Array
from polypod.export.robot import RobotInterface
from polypod.mujoco_model.reference import Heights, ground_alone, mujoco


class DepthCamera:
    """The cameras of all envs of a robot."""

    def __init__(
        self,
        sensor: Mapping[str, Any],
        mount: Mapping[str, Any],
        heights: Heights | None,
        step_dt: float,
        num_envs: int,
    ) -> None:
        """Makes the ground and the rays.

        Args:
            sensor: `[sensors.ray_caster_camera]` of a task, with all defaults.
            mount: where the robot carries the camera.
            heights: of the ground; None: a plane at height 0.
            step_dt: control step, s.
            num_envs: number of cameras.
        """
        self.body: str | None = mount.get("body")
        """Link that carries the camera; None: the base."""
        self._most, self._least = float(sensor["max_distance"]), float(sensor["min_distance"])
        self._is_zero_beyond = sensor["depth_clipping_behavior"] == "zero"
        self._place = np.array(mount["pos"], dtype=np.float64)
        rot = np.array(mount["rot"], dtype=np.float64)
        self._axes = rotations.matrix(rot / np.linalg.norm(rot))
        directions = _directions(sensor["pattern_cfg"])
        self._lengths = np.linalg.norm(directions, axis=1)
        self._units = directions / self._lengths[:, None]
        self._is_along_ray = sensor["data_type"] == "distance_to_camera"
        self._reach = self._most * (1.0 if self._is_along_ray else float(self._lengths.max()))
        self._ground = _Window(heights, self._reach)
        self._period = max(1, round(sensor["update_period"] / step_dt))
        self._late = round(float(np.mean(sensor["delay"])) / step_dt)
        self._shown = np.zeros((num_envs, len(directions)))
        self._waiting: list[list[Array | None]] = [[] for _ in range(num_envs)]
        self._wait = np.zeros(num_envs, dtype=np.intp)

    @staticmethod
    def of(interface: RobotInterface, heights: Heights | None, step_dt: float, num_envs: int) -> "DepthCamera | None":
        """The camera of a robot in the policy's task; None where it has none."""
        sensor = interface.task.get("sensors", {}).get("ray_caster_camera")
        mount = interface.config.get("camera") or (sensor or {}).get("mount")
        return DepthCamera(sensor, mount, heights, step_dt, num_envs) if sensor and mount else None

    def images(self) -> Array:
        """Distances that the policy is shown, m, [envs, pixels]."""
        return self._shown.copy()

    def begin(self, env: int, position: Array, axes: Array) -> None:
        """Begins an episode with a frame from a link at `position`, m, whose axes are columns."""
        self._shown[env] = self.render(position, axes)
        self._waiting[env] = [None] * self._late
        # envs take their frames at different times
        self._wait[env] = 1 + env % self._period

    def advance(self, env: int, position: Array, axes: Array) -> None:
        """Lets a control step pass, after which the link is there."""
        is_due = self._wait[env] <= 1
        self._wait[env] = self._period if is_due else self._wait[env] - 1
        self._waiting[env].append(self.render(position, axes) if is_due else None)
        frame = self._waiting[env].pop(0)
        if frame is not None:
            self._shown[env] = frame

    def render(self, position: Array, axes: Array) -> Array:
        """Distances from a camera with this place and these axes, m, [pixels]."""
        eye, turned = position + axes @ self._place, self._units @ (axes @ self._axes).T
        found = self._ground.rays(eye, turned, self._reach + 1.0)
        seen = np.where(found < 0.0, np.inf, found)
        if not self._is_along_ray:
            seen = seen / self._lengths
        if self._is_zero_beyond:
            return np.where((seen >= self._least) & (seen < self._most), seen, 0.0)
        return np.clip(seen, self._least, self._most)


class _Window:
    """The ground around a place: MuJoCo's rays look at every cell of a height field."""

    def __init__(self, heights: Heights | None, reach: float) -> None:
        """Makes a field that holds what rays of this length, m, may meet."""
        self._mj = mujoco()
        self._heights = heights
        self._half = 0
        field = heights
        if heights is not None:
            self._half = math.ceil(reach / heights.cell) + 1
            window = np.full((2 * self._half + 1,) * 2, heights.heights.min(), dtype=np.float32)
            # the scale of all windows
            window[0, 0] = heights.heights.max()
            field = Heights(window, (0.0, 0.0), heights.cell)
        self._model = ground_alone(field)
        self._data = self._mj.MjData(self._model)
        self._mj.mj_forward(self._model, self._data)

    def rays(self, eye: Array, units: Array, cutoff: float) -> Array:
        """Distances along unit vectors from a place, m, [rays]; negative where there is nothing."""
        if self._heights is not None:
            eye = eye - self._fill(eye, self._heights)
        count = len(units)
        geoms, found = np.zeros(count, dtype=np.int32), np.zeros(count)
        optional = {"normal": None} if "normal:" in str(self._mj.mj_multiRay.__doc__) else {}
        self._mj.mj_multiRay(
            m=self._model,
            d=self._data,
            pnt=eye,
            vec=units.ravel(),
            geomgroup=None,
            flg_static=True,
            bodyexclude=-1,
            geomid=geoms,
            dist=found,
            nray=count,
            cutoff=cutoff,
            **optional,
        )
        return found

    def _fill(self, eye: Array, heights: Heights) -> Array:
        """Fills the field with the heights about a place; beyond the map its edge goes on.

        Returns the place of the field's first point, [3], m. The field itself stays where it is:
        MuJoCo has sorted the model by it.
        """
        middle = np.round((eye[:2] - heights.origin) / heights.cell).astype(np.intp)
        around = np.arange(-self._half, self._half + 1)
        last = np.array(heights.heights.shape) - 1
        i, j = (np.clip(middle[axis] + around, 0, last[axis]) for axis in (0, 1))
        lowest, rise = self._model.geom_pos[0, 2], self._model.hfield_size[0, 2]
        self._model.hfield_data[:] = ((heights.heights[np.ix_(i, j)].T - lowest) / rise).ravel()
        return np.append(heights.origin + (middle - self._half) * heights.cell, 0.0)


def _directions(pattern: Mapping[str, Any]) -> Array:
    """Directions of pixels from top to bottom, camera axes, 1 along its own, [pixels, 3]."""
    width, height = pattern["width"], pattern["height"]
    across = np.tan(0.5 * pattern["horizontal_fov"])
    angle = pattern.get("vertical_fov")
    down = across * height / width if angle is None else np.tan(0.5 * angle)
    y = across * (1.0 - (2.0 * np.arange(width) + 1.0) / width)
    z = down * (1.0 - (2.0 * np.arange(height) + 1.0) / height)
    return np.stack(np.broadcast_arrays(1.0, y[None, :], z[:, None]), axis=-1).reshape(-1, 3)
