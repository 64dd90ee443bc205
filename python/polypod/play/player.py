"""A policy in the simulator, frame by frame."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, descriptions, rotations, simulated
from polypod.arrays import Array
from polypod.evaluation import play_task, undisturbed
from polypod.networks.policies import Policy, reset
from polypod.policy import load
from polypod.render.scene import Scene
from polypod.runs.own_terms import terms_of_run
from polypod.vector_env import simulator

SPACING = 1.2
"""Distance between robots that walk side by side, m."""
_ALIGNED = ("x", "y", "yaw")


@dataclasses.dataclass
class Tally:
    """Figures of a robot so far, over all its envs."""

    steps: int = 0
    falls: int = 0
    error_vel_xy: float = 0.0
    """Mean error of the horizontal velocity, m/s."""
    error_vel_yaw: float = 0.0
    """Mean error of the yaw rate, rad/s."""
    still_error_vel_xy: float = 0.0
    """m/s, mean planar velocity error of a robot that stands still."""
    still_error_vel_yaw: float = 0.0
    """rad/s, mean yaw rate error of a robot that stands still."""


class Player(Scene):
    """Steps a policy in the Play variant of its task, all robots side by side."""

    def __init__(
        self,
        checkpoint: Path,
        robots: Sequence[str] | None = None,
        command: npt.ArrayLike | None = None,
        *,
        task: str | None = None,
        envs_per_robot: int = 1,
        seed: int = 0,
        threads: int | None = None,
        overrides: Sequence[str] = (),
        terms: Path | None = None,
    ) -> None:
        """Loads the policy and begins the first episodes.

        Args:
            checkpoint: a `model_<n>.pt` next to its manifest, or an ONNX file, see
                `polypod.policy`.
            robots: names or paths of configs; None: those that the policy was trained on.
            command: forward and left velocity, m/s, and yaw rate, rad/s. The robots then begin side
                by side, looking along x. None: as the task draws it.
            task: name or alias of the task; None: that of the training.
            envs_per_robot: envs of each robot.
            seed: of every random stream.
            threads: of the simulator; None: one per core.
            overrides: `key=value` changes to the task, on top of the training's own.
            terms: the file of terms in Python that the run was begun with.

        Raises:
            ConfigError: for a checkpoint, robot, task or override that cannot be used.
        """
        policy = load(checkpoint, task, robots)
        self._policy: Policy = policy.runner()
        manifest = policy.manifest
        sources = list(manifest["robot_sources"] if robots is None else robots)
        name = play_task(task or manifest["task"])
        of_run = terms_of_run(manifest, terms, str(checkpoint))
        changes = [*manifest["overrides"], *undisturbed(name, manifest["overrides"]), *overrides]
        arguments: dict[str, Any] = {"robots": sources, "seed": seed, "threads": threads}
        arguments["slots"] = manifest["canonical_joint_names"]
        sim = simulator(of_run, name, envs_per_robot * len(sources), play=True, overrides=changes, **arguments)
        defaults = _defaults(simulated.config(sim)["task"], aligned=command is not None)
        if defaults:
            changes = [*defaults, *changes]
            sim = simulator(of_run, name, envs_per_robot * len(sources), play=True, overrides=changes, **arguments)
        if sim.num_obs != manifest["policy"]["num_obs"]:
            raise _core.ConfigError(
                f"the policy takes observations of {manifest['policy']['num_obs']} numbers, and {sim.task_name} "
                f"gives {sim.num_obs}; play it in its own task, {manifest['task']}"
            )
        super().__init__(sim, SPACING if command is not None else None)
        shapes = simulated.shapes(sim)
        self._com = {robot: np.array(shapes[robot]["base_com"]) for robot in sim.robots}
        self.distances = descriptions.distances(manifest, sources, str(policy.file))
        """Distances of the robots that the policy was not trained on from its training bodies."""
        self.tallies = {robot: Tally() for robot in sim.robots}
        self.policy_robots: list[str] = list(manifest["robot_sources"])
        """Names or paths of the robots that the policy was made for."""
        self.sources = sources
        """Names or paths of the robots, in the order of `sim.robots`."""
        self._commanded: npt.ArrayLike | None = None
        self._slots: Array | None = None
        self._gone = np.zeros(2)
        self.ranges = _ranges(self.config)
        """Smallest and largest commands that the task draws, [3, 2]: forward, left, m/s, and yaw
        rate, rad/s."""
        self.has_velocity = "base_velocity" in self.config["commands"]
        """Whether the task gives a velocity command."""
        if command is not None:
            self.command(command)
            self.sim.reset()

    def command(self, command: npt.ArrayLike | None) -> None:
        """Sets the command of all robots: forward and left velocity, m/s, and yaw rate, rad/s.

        None lets the task draw commands again.
        """
        self._commanded = command
        if command is None:
            self.sim.set_command(None)
        else:
            self.sim.set_command(np.tile(np.asarray(command, dtype=np.float32), (self.sim.num_envs, 1)))

    def use(self, policy: Policy) -> None:
        """Takes another policy for the same observations.

        Begins new episodes as this player's first ones began.
        """
        self._policy = policy
        self.sim.reset(self.sim.seed)
        if self._commanded is not None:
            self.command(self._commanded)
            self.sim.reset()
        reset(self._policy, np.ones(self.sim.num_envs, dtype=np.bool_))

    def push(self, velocity: npt.ArrayLike, env: int | None = None) -> None:
        """Adds a velocity [3] to the base of a robot or, with None, of all, world axes, m/s."""
        added = np.zeros((self.sim.num_envs, 3), dtype=np.float32)
        added[slice(None) if env is None else env] = np.asarray(velocity, dtype=np.float32)
        self.sim.push(added)

    def reset(self) -> None:
        """Begins new episodes."""
        self.sim.reset()
        reset(self._policy, np.ones(self.sim.num_envs, dtype=np.bool_))
        if self._slots is not None:
            self.places, self._gone = self._slots.copy(), np.zeros(2)

    def stand(self, columns: int) -> None:
        """Draws robots in rows of this length.

        A robot that restarts does so in its place among the others.

        Useful only where each env has a separate flat world (`alone`).
        """
        self._slots = self.formation(columns)
        self.places, self._gone = self._slots.copy(), np.zeros(2)

    def rest(self, robot: str) -> tuple[Array, Array]:
        """Positions and quaternions of a robot's links with all joints at zero, base axes.

        Returns [links, 3], m, and [links, 4].
        """
        source = self.sources[self.sim.robots.index(robot)]
        sim = _core.Simulation(source, ground=None, fixed_base=True, threads=1)
        sim.set_state(qpos=np.zeros(sim.nq))
        position, quaternion = sim.link_pose()
        return position[0], quaternion[0]

    def _stay_together(self, began: npt.NDArray[np.bool_]) -> None:
        """Draws robots that have just restarted in their places of a group that has gone on."""
        if self._slots is None:
            return
        base = self.sim.state("base_pos")[:, :2].astype(np.float64)
        if began.any():
            others = ~began
            gone = self._gone
            if others.any():
                gone = (base + self.places[:, :2] - self._slots[:, :2])[others].mean(axis=0)
            # frames that were shown keep the places that they have
            self.places = self.places.copy()
            self.places[began, :2] = self._slots[began, :2] + gone
        self._gone = (base + self.places[:, :2] - self._slots[:, :2]).mean(axis=0)

    def step(self) -> None:
        """One control step."""
        self.sim.step(self._policy(self.sim.observation))
        self.time += self.step_dt
        wanted, began = self.sim.command, self.sim.final_mask
        if began.any():
            reset(self._policy, began)
        self._stay_together(began)
        for robot, tally in self.tallies.items():
            first, last = self.sim.env_ids(robot)
            tally.falls += int(self.sim.terminated[first:last].sum())
            # an env that has just been reset shows its next episode already
            rows = np.flatnonzero(~began[first:last])
            if not len(rows):
                continue
            velocity, rate = self._base_velocity(robot)
            command = wanted[first:last][rows]
            tally.steps += len(rows)
            error = np.linalg.norm(command[:, :2] - velocity[rows, :2], axis=1)
            turn = np.abs(command[:, 2] - rate[rows, 2])
            tally.error_vel_xy += float((error - tally.error_vel_xy).sum()) / tally.steps
            tally.error_vel_yaw += float((turn - tally.error_vel_yaw).sum()) / tally.steps
            still_xy, still_yaw = np.linalg.norm(command[:, :2], axis=1), np.abs(command[:, 2])
            tally.still_error_vel_xy += float((still_xy - tally.still_error_vel_xy).sum()) / tally.steps
            tally.still_error_vel_yaw += float((still_yaw - tally.still_error_vel_yaw).sum()) / tally.steps

    def _base_velocity(self, robot: str) -> tuple[Array, Array]:
        """Velocity of the base's centre of mass and angular velocity, base axes, [envs, 3]."""
        qpos, qvel = self.sim.qpos(robot), self.sim.qvel(robot)
        velocity = np.stack([rotations.matrix(q[3:7]).T @ v[:3] for q, v in zip(qpos, qvel, strict=True)])
        return velocity + np.cross(qvel[:, 3:6], self._com[robot]), qvel[:, 3:6]


def _ranges(task: dict[str, Any]) -> Array:
    ranges = task["commands"].get("base_velocity")
    keys = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
    # a task without a velocity command asks for none
    return np.array([ranges[key] if ranges else [0.0, 0.0] for key in keys], dtype=np.float64)


def aligned_starts(task: dict[str, Any]) -> list[str]:
    """Changes to a task with which robots begin at their envs' origins, looking along x."""
    start = task.get("events", {}).get("reset_base", {})
    return [f"events.reset_base.{key}=[0.0, 0.0]" for key in _ALIGNED if key in start]


def _defaults(task: dict[str, Any], *, aligned: bool) -> list[str]:
    """Default changes of a player: aligned starts, and a separate tile for each robot."""
    changes = aligned_starts(task) if aligned else []
    if "terrain" in task["scene"]:
        changes.append('scene.terrain.columns="contiguous"')
    return changes
