"""A robot and MuJoCo's model of its MJCF file: the tables of what `polypod add` compares."""

import dataclasses

import numpy as np

from polypod.accuracy.result import Result
from polypod.add import judge
from polypod.mujoco_model.robot import Robot


@dataclasses.dataclass(frozen=True)
class FileResult(Result):
    """Differences from MuJoCo's model of the file at random states, in one precision."""

    dtype: str
    errors: judge.Errors

    def worst(self) -> float:
        """The largest of the errors."""
        return self.errors.worst()


def compare_file(robot: Robot) -> list[FileResult]:
    """Compares masses, limits, dynamics and one step in both precisions.

    Nothing for a robot without an MJCF file.
    """
    if robot.origin is None:
        return []
    made, described = robot.origin.made, robot.origin.described
    described = dataclasses.replace(described, held={**described.held, **robot.locked_joints})
    speeds = np.minimum(robot.actuators.speed_limit, robot.actuators.no_load_speed)
    limits = speeds[np.isfinite(speeds)].tolist()
    return [
        FileResult(
            robot.name,
            dtype,
            judge.compare(
                robot.source,
                described,
                made.model,
                made.base,
                dtype=dtype,
                speed_limits=limits,
                narrowed=robot.narrowed,
            ),
        )
        for dtype in judge.BOUNDS
    ]
