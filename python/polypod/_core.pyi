"""The simulator: the compiled half of polypod.

Arrays are NumPy arrays that the simulator owns. They are allocated once, at construction, and `step` and `reset` write
into them; what is handed out is the array itself and never a copy, unless a docstring says so. Rows are envs.
"""

import os
from collections.abc import Mapping, Sequence
from typing import TypedDict

import numpy as np
import numpy.typing as npt

__version__: str

class PolypodError(Exception):
    """The root of every exception that polypod raises on purpose."""

class ConfigError(PolypodError, ValueError):
    """A configuration, an override or an argument that cannot be used; the message names it and the remedy."""

class RobotError(PolypodError, ValueError):
    """A robot description that cannot be simulated; the message names the file, the element and the remedy."""

class UnknownNameError(ConfigError, KeyError):
    """A task, robot or train config that does not exist; the message lists the nearest names."""

class TaskEntry(TypedDict):
    name: str
    aliases: list[str]
    file: str

class RobotEntry(TypedDict):
    name: str
    title: str

class CoreInfo(TypedDict):
    version: str
    simd: str
    threads: int

class VecSim:
    """Many independent envs, one robot each, stepped together on the CPU.

    Envs of one robot are contiguous: robot r of R gets floor(num_envs / R) envs, the first (num_envs mod R) robots one
    more. Env i's trajectory depends on the seed, i, its configuration and its actions alone.
    """

    def __init__(
        self,
        task: str,
        num_envs: int,
        robots: list[str] | None = None,
        seed: int = 0,
        threads: int | None = None,
        overrides: Sequence[str] = (),
        autoreset: str = "same_step",
    ) -> None:
        """Builds the envs and resets them, so that `observation` is valid at once.

        Args:
            task: name or alias of a task, see `tasks`.
            num_envs: number of envs, at least one per robot.
            robots: names of the robots, see `robots`; None: those of the task.
            seed: of every random stream.
            threads: worker threads; None: one per core.
            overrides: `key=value` pairs, the key dotted as in the task's file, the value in TOML syntax.
            autoreset: "same_step", "next_step" or "disabled".

        Raises:
            ConfigError: for an unknown task, robot, key or autoreset mode, and for a value out of range.
            RobotError: for a robot description that cannot be simulated.
        """

    num_envs: int
    num_obs: int
    """Width of an observation."""
    num_actions: int
    """Width of an action: the number of canonical joints."""
    max_episode_length: int
    """Control steps until an episode is truncated."""
    step_dt: float
    """Seconds between control steps."""
    robots: list[str]
    """Names of the robots, in the order of their blocks of envs."""
    canonical_joint_names: list[str]
    """Names of the action's slots."""
    task_name: str
    experiment_name: str
    threads: int
    seed: int
    observation_layout: list[tuple[str, int]]
    """(term, size) of the observation, in order."""

    def env_ids(self, robot: str) -> tuple[int, int]:
        """The half-open range [start, stop) of the envs that hold `robot`. Raises UnknownNameError."""

    def joint_map(self, robot: str) -> list[tuple[str, int]]:
        """Per canonical slot: the name of the robot's joint and its index in the robot's own joint order."""

    def robot_info(self) -> str:
        """JSON: per robot its mass (kg), joint names, default pose (rad), action scale (rad), gains, limits, ..."""

    def resolved_config(self) -> str:
        """TOML: the task and its robots after defaults and overrides."""

    def config_hash(self) -> str:
        """A hash of everything that decides what the simulation does, the seed left out."""

    def reset(self, seed: int | None = None, mask: npt.NDArray[np.bool_] | None = None) -> None:
        """Begins new episodes.

        Args:
            seed: restarts the random streams; None: they go on.
            mask: bool [num_envs], the envs to reset; None: all.
        """

    def step(self, actions: npt.NDArray[np.float32]) -> None:
        """Advances every env by one control step, without holding the interpreter's lock.

        Args:
            actions: float32, C-contiguous [num_envs, num_actions], before scale and offset.

        Raises:
            TypeError: for another dtype.
            ValueError: for another shape, and for a NaN or an infinity; the message names the env.
        """

    @property
    def observation(self) -> npt.NDArray[np.float32]:
        """[num_envs, num_obs]. Two buffers alternate: this one stays as it is until the step after the next one."""

    @property
    def reward(self) -> npt.NDArray[np.float32]:
        """[num_envs], of the last step, already multiplied by `step_dt`."""

    @property
    def terminated(self) -> npt.NDArray[np.bool_]:
        """[num_envs], the episode ended in a terminal state (a fall)."""

    @property
    def truncated(self) -> npt.NDArray[np.bool_]:
        """[num_envs], the episode ended by its time limit."""

    @property
    def final_obs(self) -> npt.NDArray[np.float32]:
        """[num_envs, num_obs], the last observation of the episodes that ended in this step: rows of `final_mask`."""

    @property
    def final_mask(self) -> npt.NDArray[np.bool_]:
        """[num_envs], the envs whose episode ended in the last step and that have been reset in it."""

    @property
    def episode_length(self) -> npt.NDArray[np.int64]:
        """[num_envs], control steps of the current episodes so far. A copy."""

    def set_episode_length(self, episode_length: npt.NDArray[np.int64]) -> None:
        """Sets the control steps so far, int64 [num_envs]; learners spread the resets with it."""

    @property
    def command(self) -> npt.NDArray[np.float32]:
        """[num_envs, 3], commanded velocity in the base frame: x, y (m/s), yaw rate (rad/s)."""

    def set_command(self, command: npt.NDArray[np.float32] | None) -> None:
        """Pins the commands to float32 [num_envs, 3]: no resampling, no heading controller. None releases them."""

    def log(self) -> dict[str, float]:
        """Means over the episodes that ended since the last call, per robot and term; empty when none ended."""

    def episode_stats(self, clear: bool = True) -> dict[str, dict[str, float]]:
        """Per robot, over the episodes that ended since the statistics were last cleared.

        Keys: episodes, falls, fall_rate, episode_length_s (s), error_vel_xy (m/s), error_vel_yaw (rad/s), command_xy
        (m/s), command_yaw (rad/s), reward_per_s. The command's means are the errors of standing still.
        """

    def snapshot(self) -> bytes:
        """The whole state, random streams and current observations included."""

    def restore(self, data: bytes) -> None:
        """Returns to a `snapshot` of an equal configuration. Raises ConfigError for any other bytes."""

def tasks() -> list[TaskEntry]:
    """The tasks that ship with polypod."""

def robots() -> list[RobotEntry]:
    """The robots that ship with polypod."""

def train_config(name: str) -> str:
    """The text of `configs/train/<name>.toml`. Raises UnknownNameError."""

def robot_urdf(name: str) -> str:
    """The text of a robot's URDF. Raises UnknownNameError."""

def check(path: str | os.PathLike[str], package_dirs: Mapping[str, str | os.PathLike[str]]) -> str:
    """What the URDF file at `path` is read as: links, joints, contact bodies, legs, and every warning.

    `package_dirs` names the folder of each ROS package in `package://` names. Raises RobotError.
    """

def info() -> CoreInfo:
    """The version, the instruction set in use and the number of threads."""
