"""The simulator: the compiled half of polypod.

Arrays are NumPy arrays that the simulator owns. They are allocated once, at construction, and
`step` and `reset` write into them; what is handed out is the array itself and never a copy, unless
a docstring says so. Rows are envs.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypedDict

import numpy as np
import numpy.typing as npt

__version__: str
EARTH_GRAVITY: float
"""m/s^2, of tasks and simulations that say nothing else."""
LEAST_BASE_MASS: float
"""Least mass that randomisation must leave of a base, kg."""

class PolypodError(Exception):
    """The root of every exception that polypod raises on purpose."""

class ConfigError(PolypodError, ValueError):
    """A configuration, an override or an argument that cannot be used.

    The message names it and the remedy.
    """

class RobotError(PolypodError, ValueError):
    """A robot description that cannot be simulated.

    The message names the file, the element and the remedy.
    """

class UnknownNameError(ConfigError, KeyError):
    """A task, robot or train config that does not exist; the message lists the nearest names."""

class TaskEntry(TypedDict):
    name: str
    aliases: list[str]
    file: str
    num_robots: int
    """0 for a file that names no robots and is only there to be extended."""
    robots: list[str]

class RobotEntry(TypedDict):
    name: str
    title: str
    needs_policy: str | None
    """Why it cannot stand in its default pose without a policy, as its config says."""

class TrainEntry(TypedDict):
    name: str
    file: str
    title: str
    """The comment in its first line."""

class TrainFile(TypedDict):
    """A training config as text."""

    text: str
    id: str
    """Tells the file from all others: its absolute path, or that of a built-in file within the
    repository."""
    folder: str | None
    """Folder in which relative paths begin; None for a built-in file."""

class RobotDraft(TypedDict):
    """A robot config as text."""

    name: str
    toml: str
    notes: list[str]
    """Assumptions that were made, one line each."""
    kind: str
    """`biped`, `humanoid`, `quadruped`, `hexapod` ..."""
    needs_policy: str | None
    """Why it cannot stand without a policy, where its geometry says so."""

class TerrainEntry(TypedDict):
    """The ground of a task, lengths in m."""

    task: str
    """Full name."""
    origin: tuple[float, float]
    """x and y of the first height, in the world, or about the origin of every env where obstacles
    stand in each."""
    cell: float
    """Distance of two heights."""
    heights: npt.NDArray[np.float32]
    """Heights of the ground as the articulated engine knows it, [x, y]."""
    vertices: npt.NDArray[np.float32]
    """Corners of the generated terrain, [n, 3]; none without."""
    triangles: npt.NDArray[np.uint32]
    """Vertices of each triangle, [m, 3]."""
    tiles: list[tuple[int, int, str, tuple[float, float]]]
    """Level (row), column, type and middle of each tile."""
    pits: list[tuple[tuple[float, float], tuple[float, float]]]
    """Rectangles of heightfields that reach below the plane: smallest and largest x and y, about
    the same origin."""

class LinkStates(TypedDict):
    """Links of the n envs of a robot, in the order that `VecSim.links` was asked for.

    Float32. Frames are those of the URDF, world axes.
    """

    pos: npt.NDArray[np.float32]
    """Origins relative to the env's origin on the ground, m, as `State.base_pos`, [n, links, 3]."""
    quat: npt.NDArray[np.float32]
    """Orientations, [n, links, 4]: w, x, y, z with w >= 0."""
    lin_vel: npt.NDArray[np.float32]
    """Velocities of the origins, m/s, [n, links, 3]."""
    ang_vel: npt.NDArray[np.float32]
    """Angular velocities, rad/s, [n, links, 3]."""
    contact_force: npt.NDArray[np.float32]
    """Net contact forces of the last physics step, N, [n, links, 3]."""

class Parameters(TypedDict):
    """Present parameters of the n envs of a robot, float32."""

    static_friction: npt.NDArray[np.float32]
    """Static friction between robot and ground, combined, [n]."""
    dynamic_friction: npt.NDArray[np.float32]
    """Dynamic friction between robot and ground, combined, [n]."""
    mass: npt.NDArray[np.float32]
    """Masses of the links in the order of `VecSim.link_names`, kg, [n, links]; the base is the
    first."""
    stiffness: npt.NDArray[np.float32]
    """Stiffness of the gains, N m/rad, [n, num_actions], canonical order; 0 for missing joints and
    for networks."""
    damping: npt.NDArray[np.float32]
    """Damping of the gains, N m s/rad, [n, num_actions], canonical order."""

class StateValues(TypedDict, total=False):
    """Arguments of `VecSim.set_state` by name."""

    base_pos: npt.ArrayLike
    base_quat: npt.ArrayLike
    base_lin_vel: npt.ArrayLike
    base_ang_vel: npt.ArrayLike
    joint_pos: npt.ArrayLike
    joint_vel: npt.ArrayLike

class CoreInfo(TypedDict):
    version: str
    simd: str
    threads: int

class Peers(Protocol):
    """Connects the workers of a training, which all call the same in the same order."""

    def gather(self, mine: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Returns `mine` of all workers, in their order. All have one length."""

    def exchange(self, mine: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Sends each worker its piece of `mine`.

        Returns the pieces from all workers, in their order.

        `mine` has a piece of one length for each worker, in their order.
        """

class Learner:
    """Proximal policy optimisation of two networks on the threads of a `VecSim`, in float32.

    A network is a perceptron or a network of joints like `polypod.networks:UrmaModel`. It computes
    the same as rsl_rl's PPO. The result depends on its options, its networks' numbers, the seed of
    the simulation and the iteration alone: not on the number of threads and not on the instruction
    set. Its networks begin with zeros: see `set_network`.
    """

    def __init__(
        self, sim: VecSim, options: str, peers: Peers | None = None, worker: int = 0, workers: int = 1
    ) -> None:
        """Makes a learner for the envs, robots and observations of `sim`.

        With `peers` it is one of several workers that learn together, each with the envs of its
        `share_of_worker`. All of them come to the same networks, bit for bit those of one learner
        with all envs. Arrays [num_envs] have a row for each env of `sim`.

        Args:
            sim: the simulation.
            options: JSON, see `polypod.runs.config.TrainConfig.native_options`.
            peers: connects the workers; what it raises is raised by `collect` and `update`.
            worker: number of this worker.
            workers: how many there are.

        Raises:
            ValueError: for options that cannot be read.
            ConfigError: for options that are out of range or name no columns of a task with several
                observation groups, more workers than blocks of envs, and the simulation of another
                share.
        """

    def collect(
        self, sim: VecSim, iteration: int, clip_actions: float | None = None
    ) -> list[tuple[int, int, float, float]]:
        """Simulates an iteration's steps with the policy and noise, and estimates the advantages.

        The interpreter's lock is free meanwhile.

        Args:
            sim: the simulation that the learner was made for.
            iteration: its number, which the noise depends on.
            clip_actions: greatest magnitude of the actions that the robots act with; the samples
                hold the actions as they were drawn. None: no limit.

        Returns:
            Step of the iteration, number of the env among those of all workers, return, and length
                in control steps of each episode that ended, by steps and envs.

        Raises:
            ConfigError: for another simulation, for a limit that is not above 0, and for actions
                that a diverged policy gives.
        """

    def begin(self, iteration: int) -> None:
        """Begins the samples of an iteration that its caller collects step by step.

        `act`, a step of the simulation and `record` follow for each step, then `finish`: together
        they are `collect`, bit for bit, with the caller's work between the steps.
        """

    def act(self, sim: VecSim) -> npt.NDArray[np.float32]:
        """Draws the actions [num_envs, num_actions] of the next step for the observations of `sim`.

        Raises ConfigError for another simulation, and ValueError out of turn.
        """

    def record(
        self,
        rewards: npt.NDArray[np.float32],
        terminated: npt.NDArray[np.bool_],
        truncated: npt.NDArray[np.bool_],
    ) -> None:
        """Stores the outcome of the step, [num_envs] each. Raises ValueError out of turn."""

    def finish(self, sim: VecSim) -> list[tuple[int, int, float, float]]:
        """Estimates the advantages of the iteration; returns what `collect` does.

        Raises ConfigError for another simulation, and ValueError where steps are left.
        """

    def use_card(self) -> str:
        """Computes the coming updates on the first NVIDIA card, with the bits of the CPU.

        Returns:
            The name of the card.

        Raises:
            ConfigError: without a card, its driver or NVRTC, for networks of joints, and for one of
                several workers. The CPU goes on with the updates.
        """

    def take_card_failure(self) -> str | None:
        """Why the card was given up, if it was; says it once.

        The CPU made the last update again, with the same bits, and makes the coming ones.
        """

    def set_goals(self, entropy_coef: float, desired_kl: float | None) -> None:
        """Changes what the coming updates aim at.

        Args:
            entropy_coef: weight of the entropy.
            desired_kl: divergence that the learning rate is adapted to; None: the learning rate
                stays.

        Raises:
            ValueError: for numbers that are not finite, and a divergence that is not above 0.
        """

    def update(self, sim: VecSim, learning_rate: float) -> dict[str, float]:
        """Learns from the steps, and takes their observations into the networks' statistics.

        Returns:
            The mean losses `value`, `surrogate` and `entropy`, and the `learning_rate` to go on
            with.

        Raises:
            ConfigError: for another simulation, and where a loss is not finite.
        """

    def network(
        self, name: str
    ) -> tuple[list[npt.NDArray[np.float32]], list[npt.NDArray[np.float32]], list[npt.NDArray[np.float32]], int]:
        """Returns the numbers of the network `actor` or `critic`, as copies.

        Returns:
            Weights, Adam's mean of the gradients, Adam's mean of their squares, and Adam's steps.
            Each list is in the order of torch's parameters: the deviations of the actions (of a
            perceptron that is the actor), then weight [outputs, inputs] and bias [outputs] of each
            layer; flat.
        """

    def action_std(self) -> npt.NDArray[np.float32]:
        """Returns the deviations that the actions are drawn with, [num_actions]: at least 1e-6.

        A network of joints gives the deviations of the last actions of all envs: one for each joint
        that a robot has.
        """

    def set_network(
        self,
        name: str,
        weights: Sequence[npt.NDArray[np.float32]],
        first: Sequence[npt.NDArray[np.float32]],
        second: Sequence[npt.NDArray[np.float32]],
        steps: int,
    ) -> None:
        """Takes over what `network` gives.

        Raises:
            ConfigError: for other sizes, a deviation or a mean of squares below 0, and a number
                that is not finite, which change nothing.
        """

    def normalizer(
        self, name: str, index: int = 0
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], int] | None:
        """Returns mean, variance and number of the samples of one of a network's statistics.

        Args:
            name: of the network.
            index: 0 for what a perceptron reads. A network of joints has four: of what joints do,
                of the numbers that describe them, of the logarithms of these, and of what belongs
                to no joint.

        Returns:
            Arrays with one number for each that is normalised, or None where there are no such
            statistics.
        """

    def set_normalizer(
        self, name: str, mean: npt.NDArray[np.float32], variance: npt.NDArray[np.float32], count: int, index: int = 0
    ) -> None:
        """Takes over what `normalizer` gives.

        Raises ConfigError for other sizes and numbers that it never gives.
        """

    def reward_scale(self) -> tuple[npt.NDArray[np.float32], list[npt.NDArray[np.float64]]] | None:
        """Returns the discounted returns, and each robot's statistics of them.

        Returns [num_envs], and count, mean and variance [robots].

        None where rewards are not scaled.
        """

    def set_reward_scale(
        self,
        returns: npt.NDArray[np.float32],
        count: npt.NDArray[np.float64],
        mean: npt.NDArray[np.float64],
        variance: npt.NDArray[np.float64],
    ) -> None:
        """Takes over what `reward_scale` gives. Raises ConfigError as `set_normalizer`."""

    def episodes(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Returns the reward sums and control steps of the present episodes, [num_envs] each."""

    def set_episodes(self, rewards: npt.NDArray[np.float32], lengths: npt.NDArray[np.float32]) -> None:
        """Takes over what `episodes` gives. Raises ConfigError as `set_normalizer`."""

    def rollout(self, sim: VecSim, into: dict[str, npt.NDArray[Any]] | None = None) -> dict[str, npt.NDArray[Any]]:
        """Returns the samples of the iteration as flat arrays by steps, envs and numbers.

        float32: `observations`, `actions`, `means`, `rewards` (as they came), `log_probs`,
        `values`, `returns`, `advantages` (brought to one scale). uint8: `ends` (0 none, 1
        terminated, 2 time-out). uint32: `places`, the number of each sample in its block of envs;
        `order`, the samples, step * num_envs + env, as the mini-batches take them; and
        `batch_sizes`, how many each takes.

        Args:
            sim: the simulation that the learner was made for.
            into: arrays to write into, such as views of memory that a GPU reads; those that are not
                there are made.

        Raises:
            ConfigError: for another simulation, and for arrays of other sizes.
            TypeError: for arrays of another kind.
        """

class VecSim:
    """Many independent envs, one robot each, stepped together.

    Envs of one robot are contiguous: robot r of R gets floor(num_envs / R) envs, the first
    (num_envs mod R) robots one more. An env's trajectory depends on the seed, its robot, its place
    in that robot's block, its configuration, its actions and what was set in it alone.

    Arrays that are handed out are guarded against writing (`flags.writeable` is False): views of
    the simulator's memory and copies of its state. To change the simulation, call `set_state`,
    `set_command` and the like; to change an array, `copy` it.
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
        dump_dir: str | os.PathLike[str] | None = None,
        share: tuple[int, int] | None = None,
        slots: Sequence[str] = (),
    ) -> None:
        """Builds the envs and resets them, so that `observation` is valid at once.

        Args:
            task: name or alias of a task, see `tasks`.
            num_envs: number of envs, at least one per robot.
            robots: names of the robots, see `robots`; None: those of the task.
            seed: of every random stream.
            threads: worker threads, 1 to 1024; None: one per core.
            overrides: `key=value` pairs, the key dotted as in the task's file, the value in TOML
                syntax.
            autoreset: "same_step", "next_step" or "disabled".
            dump_dir: see `set_dump_dir`.
            share: envs [start, end) of `num_envs` that are simulated here; None: all. They are, bit
                for bit, these rows of the whole batch.
            slots: names of actions that the batch has on top of its robots' own.

        Raises:
            ConfigError: for an unknown task, robot, slot, key or autoreset mode, and for a value
                out of range.
            RobotError: for a robot description that cannot be simulated.
        """

    num_envs: int
    """Number of envs that are simulated here."""
    total_num_envs: int
    """Number of envs of all shares."""
    share: tuple[int, int]
    """Robots of the batch that this process simulates, of all robots."""
    simd: str
    """Instruction set of the physics."""
    num_obs: int
    """Width of the policy's observation."""
    num_actions: int
    """Width of an action: the number of slots that any of the robots has."""
    max_episode_length: int
    """Control steps until an episode is truncated."""
    step_dt: float
    """Seconds between control steps."""
    gravity: tuple[float, float, float]
    """Gravity of the task, m/s^2, world axes."""
    robots: list[str]
    """Names of the robots, in the order of their blocks of envs."""
    canonical_joint_names: list[str]
    """Names of the action's columns: limb and role, such as LF_HAA, L_HIP_YAW or TORSO_YAW."""
    feet_names: list[str]
    """Names of the legs whose feet are columns of `state`."""
    action_mask: npt.NDArray[np.bool_]
    """Mask of the actions, [num_envs, num_actions]: True where an env's robot has a joint. A
    copy."""
    is_padded: bool
    """Whether some robots lack some of the action's columns, also robots whose envs are another
    worker's."""
    task_name: str
    """Full name of the task."""
    experiment_name: str
    """Name of the directory that runs of the task lie in."""
    threads: int
    """Worker threads."""
    seed: int
    """Seed of every random stream."""
    observation_layout: list[tuple[str, int]]
    """(term, size) of the policy's observation, in order."""
    observation_groups: dict[str, tuple[int, int]]
    """Half-open range of the columns of each observation group in a row of all groups.

    The group `policy` comes first; a task names the others in its `[observations]`.
    """

    def observation_terms(self, group: str = "policy") -> str:
        """Terms of an observation group, in order, as JSON: a list of objects.

        - `term`, `size`: name and number of numbers, those that the term remembers included.
        - `history_length`: control steps that it remembers, the present one included; the oldest
          numbers come first.
        - `kind`: scalar, odd, vector, pseudovector, planar_velocity, per_joint, per_foot, scan or
          body: how the numbers are mirrored.
        - `units`, `description`: what they say.
        - `source`: what the term is computed from on a robot: measured (given as it is),
          robot_constant (known of the robot), center_of_mass_velocity, base_angular_velocity,
          projected_gravity, velocity_command, joint_position, joint_position_minus_default,
          joint_velocity, last_action or height_scan.
        - `inputs`: what a robot's sensors have to give for it, as inputs of a folded graph.
        - `magnitude`: typical magnitude of the numbers, in `units`.
        - `blocks`: for the kind body, what consecutive numbers belong to: a list of {per, count}.
          `per` is body, length (a distance between front and hind legs), width (between left and
          right legs), role (all numbers of the first role, then those of the next) or joint (the
          first number of all joints, then the next number of all joints).
        - `offset`, `clip`, `scale`: what the task subtracts from the source, the limits of the
          result, and its factor.

        Raises:
            UnknownNameError: for a group that the task does not have.
        """

    def observation_mirror(self, robot: str, group: str = "policy") -> list[tuple[int, float]]:
        """Mirror image of an observation group, left and right exchanged: (index, sign) per number.

        Raises:
            UnknownNameError: for a robot that the run does not have, and for a group that the task
                does not have.
        """

    def action_mirror(self, robot: str) -> list[tuple[int, float]]:
        """Mirror image of an action: (column, sign) of each of its [num_actions] numbers.

        Columns that it lacks stay.

        Raises:
            UnknownNameError: for a robot that the run does not have.
        """

    def observation_mask(self, robot: str, group: str = "policy") -> list[bool]:
        """Mask of the numbers that the robot has, [size of the group].

        Numbers of joints that it lacks are 0.

        Raises:
            UnknownNameError: for a robot that the run does not have, or an unknown observation
                group.
        """

    def observation_shares(self, group: str = "policy") -> list[float]:
        """Share of the envs, of all workers, whose robot has each number, [size of the group].

        Raises:
            UnknownNameError: for an unknown observation group.
        """

    def env_ids(self, robot: str) -> tuple[int, int]:
        """The half-open range [start, stop) of the envs that hold `robot`.

        Raises UnknownNameError.
        """

    def joint_map(self, robot: str) -> list[tuple[str, int]]:
        """Name and index of each slot's joint, in the order of the robot's slots.

        The index counts in the robot's own joint order.
        """

    def robot_info(self) -> str:
        """JSON of numbers per robot.

        Mass (kg), joint names, default pose (rad), action scale (rad), gains, limits, ...

        A limit that a joint lacks is null in `lower`, `upper` and `effort_limit`. `slots`,
        `columns`, `joint_of_slot` and `slot_signs` say of each of the robot's slots its name, its
        column of the action, its joint, and whether the joint turns as the slot does (1) or the
        other way round (-1). Where a task drives some joints alone, these are theirs, and
        `held_joints` lists the others.
        """

    def command_ranges(self) -> dict[str, dict[str, list[float]]]:
        """Command ranges per robot: the task's, within the robot's own limits.

        {robot: {lin_vel_x: [low, high], lin_vel_y: [low, high], ang_vel_z: [low, high]}}: forward
        and left speed, m/s, and yaw rate, rad/s, base frame.
        """

    def network_torques(
        self,
        robot: str,
        error: npt.NDArray[np.float32],
        velocity: npt.NDArray[np.float32],
        memory: npt.NDArray[np.float32] | None = None,
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Steps the robot's actuator networks once: torques, and the networks' new memory.

        Args:
            robot: its name.
            error: [n, joints], target less position of the robot's own joints, rad.
            velocity: [n, joints], rad/s.
            memory: [n, remembered], what the call before gave; None: zero, as after a reset.

        Returns:
            Torques [n, joints], N m, before the actuators' limits, zero for joints without a
            network; and the memory.

        Raises:
            ConfigError: for a robot that takes no part.
            TypeError: for another dtype than float32.
            ValueError: for other shapes.
        """

    def robot_shapes(self) -> str:
        """JSON per robot: links, the base's centre of mass (m), contact bodies with their shapes.

        {robot: {links, base_com, bodies: [{name, link, group, shapes: [{shape, ..., position,
        quaternion}]}]}}: sizes in m; `link` is an index into `links`, and a shape's pose is in that
        link's frame.
        """

    def qpos(self, robot: str) -> npt.NDArray[np.float64]:
        """Positions of the n envs of `env_ids(robot)`, as `Simulation.qpos`, [n, 7 + joints].

        A copy.

        The base's position is relative to the env's origin; joints are in the robot's own order.
        """

    def qvel(self, robot: str) -> npt.NDArray[np.float64]:
        """Velocities of these envs, as in `Simulation.qvel`, [n, 6 + joints]. A copy."""

    def link_pose(self, robot: str) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Positions and quaternions (w, x, y, z) of the links' URDF frames.

        Returns copies: [n, links, 3], m, and [n, links, 4].
        """

    def link_names(self, robot: str) -> list[str]:
        """Links of a robot in the order of `link_pose`, as in the URDF.

        Links fixed to another are part of it.
        """

    def contact_body_names(self, robot: str) -> list[str]:
        """Contact bodies of a robot in the order of `contact_forces`.

        They are links of the URDF, also those fixed to others.
        """

    def contact_forces(self, robot: str) -> npt.NDArray[np.float64]:
        """Net force on each contact body in the last physics step, N, world axes, [n, bodies, 3].

        A copy.
        """

    def resolved_config(self) -> str:
        """TOML: the task and its robots after defaults and overrides."""

    def config_hash(self) -> str:
        """A hash of everything that decides what the simulation does, the seed left out."""

    def reset(
        self,
        seed: int | None = None,
        mask: npt.NDArray[np.bool_] | None = None,
        state: StateValues | None = None,
    ) -> None:
        """Begins new episodes.

        Args:
            seed: restarts the random streams; None: they go on.
            mask: bool [num_envs], the envs to reset; None: all.
            state: arguments of `set_state` with a row per env of the mask; what is absent is as the
                reset draws it.
        """

    def set_state(
        self,
        env_ids: npt.ArrayLike | None = None,
        *,
        base_pos: npt.ArrayLike | None = None,
        base_quat: npt.ArrayLike | None = None,
        base_lin_vel: npt.ArrayLike | None = None,
        base_ang_vel: npt.ArrayLike | None = None,
        joint_pos: npt.ArrayLike | None = None,
        joint_vel: npt.ArrayLike | None = None,
    ) -> None:
        """Sets the state of some envs in the middle of their episodes.

        Order, units and frames are those of `polypod.State`: what it gives can be set again. Absent
        arguments leave the state as it is. Each argument is an array [n, width] with a row for each
        of `env_ids`, or one row for all of them.

        Sensors, feet, links and the observation are computed for the new state as after a reset:
        accelerations, efforts, contact forces and times are 0, a history is filled with the new
        numbers, and the solver and actuator networks start without memory. Commands, actions and
        the length of the episode stay. Nothing lifts a robot out of the ground, and a joint up to
        0.1 rad beyond its limit is taken as it is: the next steps push both back.

        Args:
            env_ids: rows of the envs, e.g. [0, 3] or `np.flatnonzero(mask)`; None: all.
            base_pos: [n, 3], position relative to the env's origin on the ground, m.
            base_quat: [n, 4], orientation w, x, y, z, of length one within 0.001.
            base_lin_vel: [n, 3], velocity of the base's centre of mass, base axes, m/s.
            base_ang_vel: [n, 3], angular velocity, base axes, rad/s.
            joint_pos: [n, num_actions], rad; columns of missing joints do nothing.
            joint_vel: [n, num_actions], rad/s.

        Raises:
            TypeError: for arguments that are no numbers, and for a mask in the place of env ids.
            ValueError: for another shape.
            ConfigError: for a number that is not finite or so large that the state counts as
                broken, another quaternion, a joint further beyond its limit, an env that does not
                exist, is there twice or whose state has broken. Nothing has changed then.
        """

    def set_friction(
        self,
        static_friction: npt.ArrayLike,
        dynamic_friction: npt.ArrayLike | None = None,
        env_ids: npt.ArrayLike | None = None,
    ) -> None:
        """Sets the friction coefficients of robots; the ground's are combined with them.

        As in Isaac Lab, what this, `set_mass` and `set_gains` set holds through resets, until it is
        set again. An event of the task that draws the same number at a reset starts from it, and a
        reset with a seed draws all numbers from the beginning. Snapshots hold it.

        Args:
            static_friction: [n], a number for each of `env_ids`, or one for all.
            dynamic_friction: the same; None: the static one.
            env_ids: rows of the envs; None: all.

        Raises:
            ValueError: for another shape.
            ConfigError: for a coefficient that is negative or not finite, and for no such env.
        """

    def set_mass(self, mass: npt.ArrayLike, link: str | None = None, env_ids: npt.ArrayLike | None = None) -> None:
        """Sets the mass of a link; its inertia about the centre of mass is scaled along.

        It holds as `set_friction` says. A payload: `sim.parameters(robot)["mass"][:, 0] + 3.0`.

        Args:
            mass: kg, [n], a number for each of `env_ids`, or one for all.
            link: its name, see `link_names`; None: the base of each robot.
            env_ids: rows of the envs; None: all.

        Raises:
            ValueError: for another shape.
            UnknownNameError: for a link that one of these robots does not have.
            ConfigError: for a mass that is not positive and finite, and for no such env.
        """

    def set_gains(
        self,
        stiffness: npt.ArrayLike | None = None,
        damping: npt.ArrayLike | None = None,
        env_ids: npt.ArrayLike | None = None,
    ) -> None:
        """Sets gains of the actuators; they hold as `set_friction` says.

        Args:
            stiffness: N m/rad, [n, num_actions] in canonical order, one row for all of `env_ids`,
                or one number; columns of missing joints do nothing. None: as it is.
            damping: N m s/rad, the same.
            env_ids: rows of the envs; None: all.

        Raises:
            ValueError: for another shape.
            ConfigError: for a gain that is negative or not finite, for no such env, and for robots
                whose actuators are networks.
        """

    def parameters(self, robot: str) -> Parameters:
        """Present friction, masses and gains of the n envs of `env_ids(robot)`.

        Raises UnknownNameError.
        """

    def apply_force(
        self,
        force: npt.ArrayLike,
        torque: npt.ArrayLike | None = None,
        *,
        link: str | None = None,
        env_ids: npt.ArrayLike | None = None,
        frame: str = "world",
        point: npt.ArrayLike | None = None,
        steps: int | None = None,
        duration_s: float | None = None,
    ) -> None:
        """Lets a force and a torque act on a link in the next control step, or in several.

        They are zero afterwards. A later call for the same link of an env takes the place of this
        one, forces on different links add up, and a reset ends them. Snapshots hold them.

        Args:
            force: N, [n, 3] with a row for each of `env_ids`, or [3].
            torque: N m, the same; None: none.
            link: its name, see `link_names`; None: the base of each robot.
            env_ids: rows of the envs; None: all.
            frame: "world": force and torque keep their directions in the world; "link": they are in
                the axes of the link's URDF frame and turn with it.
            point: where the force acts, in the link's URDF frame, m, [n, 3] or [3]; None: at the
                link's centre of mass.
            steps: control steps; None: one.
            duration_s: a time in the place of `steps`, rounded up to control steps.

        Raises:
            ValueError: for another shape or frame, and for a time that is not positive.
            UnknownNameError: for a link that one of these robots does not have.
            ConfigError: for a number that is not finite, no step, and no such env.
        """

    def links(self, robot: str, names: Sequence[str] | None = None) -> LinkStates:
        """Poses, velocities and contact forces of links in the n envs of `env_ids(robot)`.

        Computed now, of each env's body as it was randomised; a broken state gives zeros.

        Args:
            robot: its name.
            names: names of links, in the order of the result; None: all, as `link_names` gives
                them. A few links take less time than all.

        Raises:
            UnknownNameError: for a robot that is not here, and a link that it does not have.
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
        """Observations, [num_envs, num_obs].

        Two buffers alternate: this one stays as it is until the step after the next one.
        """

    def observation_of(self, group: str) -> npt.NDArray[np.float32]:
        """An observation group, [num_envs, n]: a view as stable as `observation`.

        Raises:
            UnknownNameError: for a group that the task does not have.
        """

    @property
    def reward(self) -> npt.NDArray[np.float32]:
        """Rewards of the last step, already multiplied by `step_dt`, [num_envs]."""

    @property
    def terminated(self) -> npt.NDArray[np.bool_]:
        """Whether the episode ended in a terminal state (a fall), [num_envs]."""

    @property
    def truncated(self) -> npt.NDArray[np.bool_]:
        """Whether the episode ended by its time limit, [num_envs]."""

    @property
    def final_obs(self) -> npt.NDArray[np.float32]:
        """Last observations of the episodes that ended in this step, [num_envs, num_obs].

        Valid in the rows of `final_mask`.
        """

    def final_obs_of(self, group: str) -> npt.NDArray[np.float32]:
        """Last observations of a group, [num_envs, n], as `final_obs`. Raises UnknownNameError."""

    @property
    def final_mask(self) -> npt.NDArray[np.bool_]:
        """Whether the env's episode ended and the env was reset in the last step, [num_envs]."""

    def state(self, field: str) -> npt.NDArray[np.float32]:
        """One quantity of every robot, float32 [num_envs, n], gathered now: a copy for reading.

        The fields are the properties of `polypod.State`, which says what they hold. A broken state
        is gathered as zeros.

        Raises:
            ValueError: for a field that does not exist.
        """

    def terminate(self, mask: npt.NDArray[np.bool_]) -> None:
        """Ends the episodes of the envs in the mask, bool [num_envs], as failed in the last step.

        `terminated`, `truncated` and the log count them as if a termination of the task had;
        `reset` them next.

        Raises:
            ConfigError: with any autoreset but "disabled".
        """

    def truncate(self, mask: npt.NDArray[np.bool_]) -> None:
        """Ends the episodes of the envs in the mask, bool [num_envs], as out of time.

        As `terminate`; an episode that failed in the last step stays failed.

        Raises:
            ConfigError: with any autoreset but "disabled".
        """

    def env_origins(self) -> npt.NDArray[np.float64]:
        """Origins of the envs in the world, m, [num_envs, 3]; a copy.

        Zeros where each env has separate ground.

        Their x and y are what positions of `qpos` and `link_pose` are relative to; z is the height
        of the ground there (those positions count from the world's zero). A reset may move an env
        to another tile.
        """

    def terrain(self) -> TerrainEntry | None:
        """The ground of the sim's task and overrides, as `_core.terrain` gives it, or None.

        None stands for a plane.
        """

    def terrain_tiles(self) -> tuple[npt.NDArray[np.int64], list[str]]:
        """Level and type of the tile of each env, [num_envs].

        Zeros and an empty list without generated terrain.
        """

    @property
    def episode_length(self) -> npt.NDArray[np.int64]:
        """Control steps of the current episodes so far, [num_envs]. A copy."""

    def set_episode_length(self, episode_length: npt.NDArray[np.int64]) -> None:
        """Sets the control steps so far, int64 [num_envs]; learners spread the resets with it."""

    @property
    def command(self) -> npt.NDArray[np.float32]:
        """Commanded velocity in the base frame, [num_envs, 3]: x, y (m/s), yaw rate (rad/s)."""

    def command_columns(self) -> dict[str, list[str]]:
        """Names of the numbers of each command of the task, by the command's name."""

    def command_of(self, name: str) -> npt.NDArray[np.float32]:
        """Present numbers of a command of the task, [num_envs, columns]. A copy.

        `command_columns` names them; `command_specs` has their units.
        """

    def set_command(
        self,
        command: npt.NDArray[np.float32] | None,
        env_ids: npt.ArrayLike | None = None,
        *,
        name: str = "base_velocity",
    ) -> None:
        """Pins a command of the task to float32 [n, columns]: it is not drawn again.

        A velocity has 3 columns, and no heading controller turns it; a command that runs with time,
        such as the clock of a gait, runs on. None releases it. `env_ids` are the rows of the n
        envs; None: all.
        """

    def observe_external(self, values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_] | None = None) -> None:
        """Writes the observation terms that the task declares as `external`.

        Called once after each step, and after a reset with its mask; `step` refuses to go on
        without. Noise, limits, factor and history are the task's.

        Args:
            values: float32 [num_envs, n], the present numbers of these terms side by side, in the
                order of the groups.
            mask: bool [num_envs], the envs to observe; None: all.

        Raises:
            TypeError: for another dtype.
            ValueError: for another shape.
            ConfigError: for a number that is not finite.
        """

    def set_reward_weight(self, robot: str, term: str, weight: float) -> None:
        """Sets the weight of a reward term of the robot's set from the next step on.

        Snapshots do not hold it. Raises UnknownNameError for another robot, and ConfigError for
        another term, for a weight out of range, and where the task's curriculum sets the weight.
        """

    def reward_weights(self, robot: str) -> dict[str, float]:
        """Weights of the reward terms of the robot's set. Raises UnknownNameError."""

    def set_command_ranges(
        self,
        robot: str,
        *,
        lin_vel_x: Sequence[float] | None = None,
        lin_vel_y: Sequence[float] | None = None,
        ang_vel_z: Sequence[float] | None = None,
    ) -> None:
        """Sets ranges [lower, upper] of the robot's velocity commands, m/s and rad/s.

        Commands that are sampled later lie in them. None leaves a range as it is. Snapshots do not
        hold them. Raises UnknownNameError for another robot, and ConfigError for a range that is
        none, or where stages of the task's curriculum set the ranges.
        """

    def set_terrain_levels(self, levels: npt.NDArray[np.int64]) -> None:
        """Moves envs to levels of the terrain, int64 [num_envs]; a negative one leaves an env.

        Reset the envs that are moved before the next step.

        Raises:
            TypeError: for another dtype.
            ValueError: for another shape.
            ConfigError: for a level that the terrain lacks, and for a task without levels.
        """

    def push(self, velocity: npt.NDArray[np.float32]) -> None:
        """Adds a velocity to the base of each robot, as a push does.

        Observations follow with the next step.

        Args:
            velocity: float32 [num_envs, 3], world axes, m/s; zeros leave a robot alone.

        Raises:
            TypeError: for another dtype.
            ValueError: for another shape.
            ConfigError: for a number that is not finite or beyond 100 m/s.
        """

    def reward_terms(self, robot: str) -> list[str]:
        """Names of the reward terms of the robot's set, in order. Raises UnknownNameError."""

    def reward_sums(self, robot: str) -> npt.NDArray[np.float32]:
        """Weighted reward terms of the n envs of `env_ids(robot)`, [n, terms].

        Sums over the episode so far; a copy.

        The change of their sum in a step is `reward`. Raises UnknownNameError.
        """

    def height_scan(self) -> npt.NDArray[np.float32]:
        """Points on the ground that the height scanners' rays hit, world, m, [num_envs, rays, 3].

        A copy.

        There are no rays where the task has no height scanner.
        """

    def log(self) -> dict[str, float]:
        """Means over the episodes that ended since the last call, per robot and term.

        Empty when none ended.
        """

    def episode_stats(self, clear: bool = True) -> dict[str, dict[str, float]]:
        """Statistics of each robot over the episodes that ended since they were last cleared.

        Keys: episodes, falls, fall_rate, episode_length_s (s), error_vel_xy (m/s), error_vel_yaw
        (rad/s), command_xy (m/s), command_yaw (rad/s), reward_per_s. The command's means are the
        errors of standing still.
        """

    def take_logs(self) -> bytes:
        """Takes the data of `log` and `episode_stats`, for `add_logs` of another share."""

    def add_logs(self, data: bytes) -> None:
        """Adds what `take_logs` gave: `log` and `episode_stats` are of the episodes of both.

        Raises ConfigError for any other bytes.
        """

    def stay_on_device(self, stay: bool) -> None:
        """Whether the state of all envs may stay on the card between control steps.

        With the engine `cuda` and a task of which all parts have a form there, the card then makes
        the whole control step, with the same bits. It does so from the third step in a row on
        between which nobody reads or changes states; a look at them brings them back. By default it
        may. An env that reads states in each step is as fast without.
        """

    @property
    def steps_on_device(self) -> int:
        """Number of control steps that the card has made alone, see `stay_on_device`."""

    def lacks_on_device(self) -> str | None:
        """Why the card does not make whole control steps: one thing that has no form there.

        None if nothing is in the way, see `stay_on_device`.
        """

    @property
    def choice_of_engine(self) -> str | None:
        """Choice of the engine `auto` between the CPU and the card, with the times of both.

        None with another engine, and while both are being timed.
        """

    def device_arrays(self) -> dict[str, DeviceArray] | None:
        """The arrays of all envs in the card's memory, for `step_device`, without a copy.

        `actions` [num_envs, num_actions], which the next step reads; what it leaves: `observation`
        [num_envs, n], the columns of all groups as `observation_groups` has them, `final_obs` with
        the same columns, `reward`, `terminated` and `truncated` [num_envs], `command` [num_envs,
        3]. They stay where they are, and each step overwrites them.

        None where the card does not make whole control steps: `lacks_on_device` says why. The state
        of all envs goes to the card.

        Raises ConfigError where the card fails.
        """

    def step_device(self, stream: int = 0) -> None:
        """Begins a control step with the actions in `device_arrays`, and does not wait for it.

        The step follows the work that the CUDA stream has by now, and precedes what it gets later:
        with torch's `current_stream().cuda_stream` kernels before the call may write the actions,
        and kernels after it may read the outcome. `observation`, `reward` and the other arrays of
        NumPy, states and snapshots wait for the steps when they are read; `log` counts all of them.
        Where the host has to take part, for example for forces of `apply_force`, it does.

        Args:
            stream: handle of a CUDA stream of this process; 0: the default stream.

        Raises:
            ConfigError: where there are no arrays; as `step`, where actions that are refused raise
                it some steps later: their env has acted with zeros instead.
        """

    def set_dump_dir(self, dump_dir: str | os.PathLike[str] | None) -> None:
        """Sets the directory of dumps: one file for the first broken state of each robot.

        None switches dumps off.

        A state breaks when it becomes non-finite or runs away; its episode ends as `illegal_state`.
        A robot of which a state was dumped before is left out. A dump that cannot be written stops
        nothing.

        Raises:
            ConfigError: for a path with a zero byte.
        """

    def snapshot(self, env_ids: npt.ArrayLike | None = None) -> bytes:
        """The whole state, random streams and current observations included.

        With `env_ids`, rows of envs, theirs alone, without the statistics of episodes. Raises
        ConfigError for no such env.
        """

    def restore(self, data: bytes, env_ids: npt.ArrayLike | None = None) -> None:
        """Returns to a `snapshot` of an equal configuration, this share's or that of a larger one.

        A snapshot of some envs restores these. With `env_ids` only these envs of the snapshot are
        restored. All other envs, the seed and the statistics then stay as they are.

        Raises ConfigError for any other bytes, and for an env that they do not hold.
        """

class DeviceArray:
    """An array in the memory of a card, row-major, see `VecSim.device_arrays`.

    `torch.from_dlpack`, `jax.dlpack.from_dlpack` and `cupy.from_dlpack` share its memory, and so
    does what knows the CUDA array interface, such as `torch.as_tensor`. The memory is freed when
    nobody holds it any more.
    """

    @property
    def shape(self) -> list[int]:
        """Sizes."""

    @property
    def dtype(self) -> str:
        """float32 or bool."""

    @property
    def address(self) -> int:
        """Address of the first number in the card's memory."""

    @property
    def __cuda_array_interface__(self) -> dict[str, Any]: ...
    def __dlpack_device__(self) -> tuple[int, int]: ...
    def __dlpack__(
        self,
        *,
        stream: int | None = None,
        max_version: tuple[int, int] | None = None,
        dl_device: tuple[int, int] | None = None,
        copy: bool | None = None,
    ) -> Any: ...

class Simulation:
    """Physics without a task: robots of one kind, any tree of links of a URDF, one per env.

    Generalised positions `qpos` are the base's position in the world (3, m), its quaternion (w, x,
    y, z) and the joints' positions (rad or m) in the order of `joint_names`; velocities `qvel` are
    the linear velocity of the base's origin in world axes (3, m/s), its angular velocity in base
    axes (3, rad/s) and the joints'. A fixed base has joints only.

    Arrays that are handed out are float64 copies. Arguments may be anything that NumPy makes an
    array of numbers of, with one row per env, or one row for all envs; where it says so one number
    for all joints. Every trajectory is the same, bit for bit, for any number of threads and envs
    and on any instruction set. A state that diverges holds NaN from then on, in its own env only.
    """

    def __init__(
        self,
        robot: str | os.PathLike[str],
        num_envs: int = 1,
        *,
        dt: float = 0.005,
        ground: str | None = "plane",
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
        engine: str = "articulated",
        fixed_base: bool = False,
        package_dirs: Mapping[str, str | os.PathLike[str]] = {},
        locked_joints: Mapping[str, float] = {},
        friction: npt.ArrayLike = 1.0,
        torsional_friction: float = 0.0,
        rolling_friction: float = 0.0,
        restitution: float = 0.0,
        armature: npt.ArrayLike | None = None,
        self_collision: bool | None = None,
        ground_normal: Sequence[float] = (0.0, 0.0, 1.0),
        solver_iterations: int = 4,
        avian_substeps: int = 8,
        threads: int | None = None,
        simd: str | None = None,
        dtype: str | type[np.floating] = "float32",
    ) -> None:
        """Loads the robot and puts one into each env, at rest in `default_qpos`.

        Args:
            robot: a robot of the library (with its gains, rotor inertias, springs, surfaces, effort
                limits, motors and default pose, without its delays), the path of a robot's `.toml`,
                or the path of a URDF (gains 0; effort limits, joint limits, damping and friction as
                in the URDF).
            num_envs: number of envs.
            dt: physics step, s.
            ground: "plane", through the world's origin, or None.
            gravity: world axes, m/s^2.
            engine: "articulated", or "avian": rigid bodies of Avian with joints between them
                (single precision, revolute joints).
            fixed_base: fix the base to the world, its frame upon the world's; it then feels no
                ground.
            package_dirs: folder of each package in `package://<package>/...` mesh names.
            locked_joints: position (rad or m) of each joint that is held: it becomes part of its
                parent link. Joints of a URDF that mimic others are held in any case, with a
                warning.
            friction: coefficient of robot and ground combined, or (static, dynamic); surfaces of a
                robot multiply it.
            torsional_friction: torque about a contact's normal per normal force, m; of ground
                contacts.
            rolling_friction: torque across a contact's normal per normal force, m; of ground
                contacts.
            restitution: coefficient of robot and ground combined, from 0 to 1.
            armature: reflected rotor inertia, kg m^2, one number or [num_joints]. None: the
                robot's, 0 for a URDF.
            self_collision: whether a robot's links collide with one another, but for those joined
                by a joint or touching in the default pose. None: as the robot's config says, no for
                a URDF.
            ground_normal: normal of the ground plane, of any length.
            solver_iterations: sweeps of the articulated engine's contact solver per physics step.
            avian_substeps: substeps of the engine "avian" per physics step.
            threads: 1 to 1024; None: all cores.
            simd: instruction set: "avx512", "avx2", "neon" or "portable". None: the fastest one, or
                the value of `POLYPOD_SIMD`. Without effect in float64.
            dtype: "float32", or "float64" for reference, which is slower.

        Raises:
            RobotError: for a URDF that cannot be simulated. Assumptions about what it leaves open
                are in `warnings` and, for the path of a URDF, are UserWarnings.
            UnknownNameError: for a robot that does not exist.
            ConfigError: for any other option.
        """

    @property
    def joint_names(self) -> list[str]:
        """Joints that move, as in the URDF, parents before children."""

    @property
    def link_names(self) -> list[str]:
        """Links, as in the URDF: the base, then what each joint moves.

        Links fixed to another are part of it.
        """

    @property
    def num_joints(self) -> int:
        """Number of joints that move."""
    @property
    def num_links(self) -> int:
        """Number of links, the base's included."""
    @property
    def num_envs(self) -> int:
        """Number of envs."""
    @property
    def nq(self) -> int:
        """Columns of `qpos`: 7 + joints, or joints for a fixed base."""

    @property
    def nv(self) -> int:
        """Columns of `qvel`: 6 + joints, or joints for a fixed base."""

    @property
    def total_mass(self) -> float:
        """Mass of a robot before any `set_mass`, kg."""

    @property
    def dt(self) -> float:
        """Physics step, s."""

    @property
    def time(self) -> float:
        """Simulated since construction, s."""

    @property
    def threads(self) -> int:
        """Worker threads."""
    @property
    def warnings(self) -> list[str]:
        """Assumptions made while reading the URDF.

        Each names the file, the element and the remedy.
        """

    @property
    def default_qpos(self) -> npt.NDArray[np.float64]:
        """The pose to begin with, [nq]: the robot's default pose.

        For a URDF zero, or the limit nearest to it.

        The base is level, with its lowest collision shape touching the ground; without ground it is
        at the origin.
        """

    @property
    def joint_range(self) -> npt.NDArray[np.float64]:
        """Lower and upper position limits, rad or m, [num_joints, 2].

        Infinite where there is none.
        """

    @property
    def effort_limit(self) -> npt.NDArray[np.float64]:
        """Largest effort at construction, N m or N, [num_joints]; infinite where there is no limit.

        Where it depends on the position, this is the largest one.
        """

    @property
    def qpos(self) -> npt.NDArray[np.float64]:
        """Positions of all envs, [num_envs, nq]."""

    @property
    def qvel(self) -> npt.NDArray[np.float64]:
        """Velocities of all envs, [num_envs, nv]."""

    @property
    def contact_forces(self) -> npt.NDArray[np.float64]:
        """Net contact force on each link in the last step, world, N, [num_envs, num_links, 3]."""

    @property
    def joint_torque(self) -> npt.NDArray[np.float64]:
        """Effort of the actuators in the last physics step, N m or N, [num_envs, num_joints]."""

    @property
    def link_drift(self) -> npt.NDArray[np.float64]:
        """Largest distance of a link's origin from its forward kinematics, m, [num_envs].

        Only under the engine "avian" do joints come apart; elsewhere it is zero.
        """

    def set_state(
        self,
        qpos: npt.ArrayLike | None = None,
        qvel: npt.ArrayLike | None = None,
        env_ids: npt.ArrayLike | None = None,
    ) -> None:
        """Sets positions, velocities or both; contact impulses are cleared, `time` goes on.

        Args:
            qpos: [nq] or [n, nq]; quaternions are normalised. None: as they are.
            qvel: [nv] or [n, nv]. None: as they are.
            env_ids: the n envs. None: all.

        Raises:
            ValueError: for another shape, a number that is not finite, a quaternion of zeros, an
                env that is none.
        """

    def step(
        self,
        *,
        torque: npt.ArrayLike | None = None,
        targets: npt.ArrayLike | None = None,
        kp: npt.ArrayLike | None = None,
        kd: npt.ArrayLike | None = None,
        effort_limit: npt.ArrayLike | None = None,
        implicit: bool | None = None,
        n: int = 1,
    ) -> None:
        """Advances every env by `n` physics steps, without holding the interpreter's lock.

        Arrays are a number, [num_joints] or [num_envs, num_joints].

        Args:
            torque: joint efforts, N m or N, applied as they are within the limits of effort and
                motor.
            targets: joint positions that the gains pull to, rad or m. With neither of both the
                joints are passive.
            kp: stiffness, N m/rad; kept for later steps.
            kd: damping, N m s/rad; kept for later steps.
            effort_limit: largest effort, N m or N, infinity for none; kept for later steps.
            implicit: True: the gains act on the end of each physics step, which is stable with any
                gains. False: on its beginning, as a motor controller at that rate would. None: as
                the robot's config says, else implicitly.
            n: number of steps, all with the same targets or torques.

        Raises:
            ValueError: for another shape, a number that is not finite, torque together with
                targets.
        """

    def link_pose(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Positions and quaternions of the links' URDF frames.

        Returns [num_envs, num_links, 3], m, and [num_envs, num_links, 4].

        In the world; quaternions are (w, x, y, z) with w >= 0. This and the following are computed
        in double precision from the present state.
        """

    def link_velocity(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Linear velocities of the links' origins, m/s, and angular velocities, rad/s.

        Both [num_envs, num_links, 3], world axes.
        """

    def mass_matrix(self) -> npt.NDArray[np.float64]:
        """Mass matrices, armature included, [num_envs, nv, nv]."""

    def bias_force(self) -> npt.NDArray[np.float64]:
        """Bias force `c` in `M qacc + c = force`, gravity included, [num_envs, nv]."""

    def forward_dynamics(self, torque: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Accelerations [num_envs, nv] without contacts, limits, damping and friction.

        Args:
            torque: [num_joints], [num_envs, num_joints], or generalised forces [nv], [num_envs,
                nv].
        """

    def inverse_dynamics(self, qacc: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Generalised forces [num_envs, nv] that cause accelerations [nv] or [num_envs, nv].

        No contacts.
        """

    def jacobian(self, link: str | int, point: Sequence[float] = (0.0, 0.0, 0.0)) -> npt.NDArray[np.float64]:
        """Jacobian of the point's linear and the link's angular velocity, [num_envs, 6, nv].

        Both in world axes.

        Args:
            link: name or index.
            point: in the link's URDF frame, m.
        """

    def ground_gap(self) -> npt.NDArray[np.float64]:
        """Distance of each link from the ground, m, negative inside it, [num_envs, num_links].

        Inf without shapes.
        """

    def energy(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Kinetic energy, armature included, and potential energy: [num_envs], J.

        The potential energy is zero at the world's origin.
        """

    def center_of_mass(self) -> npt.NDArray[np.float64]:
        """Centres of mass in the world, m, [num_envs, 3]."""

    def momentum(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Linear momentum, kg m/s, and angular momentum about the centre of mass, kg m^2/s.

        Both [num_envs, 3], world axes, without rotors.
        """

    def set_mass(self, link: str | int, mass: npt.ArrayLike, env_ids: npt.ArrayLike | None = None) -> None:
        """Sets a link's mass, kg: a number or [n].

        Its inertia is scaled along, as if the density had changed.
        """

    def set_com(self, link: str | int, com: npt.ArrayLike, env_ids: npt.ArrayLike | None = None) -> None:
        """Sets a link's centre of mass in its URDF frame, m: [3] or [n, 3]."""

    def set_inertia(self, link: str | int, inertia: npt.ArrayLike, env_ids: npt.ArrayLike | None = None) -> None:
        """Sets a link's inertia about its centre of mass in the axes of its URDF frame, kg m^2.

        Args:
            link: name or index.
            inertia: [3, 3] or [n, 3, 3], or xx, yy, zz, xy, xz, yz as [6] or [n, 6].
            env_ids: the n envs. None: all.
        """

    def set_friction(
        self, static: npt.ArrayLike, dynamic: npt.ArrayLike | None = None, env_ids: npt.ArrayLike | None = None
    ) -> None:
        """Sets friction coefficients, robot and ground combined: a number or [n].

        `dynamic` None: as `static`.
        """

    def set_gains(
        self,
        kp: npt.ArrayLike | None = None,
        kd: npt.ArrayLike | None = None,
        env_ids: npt.ArrayLike | None = None,
    ) -> None:
        """Sets stiffness, N m/rad, and damping, N m s/rad: a number, [num_joints], [n, num_joints].

        None: as it is.
        """

    def set_armature(self, armature: npt.ArrayLike, env_ids: npt.ArrayLike | None = None) -> None:
        """Sets reflected rotor inertias, kg m^2: a number, [num_joints] or [n, num_joints]."""

    def snapshot(self) -> bytes:
        """State, time, contact warm starts and every env's numbers.

        Stepping on from it repeats every bit.
        """

    def restore(self, data: bytes) -> None:
        """Returns to a `snapshot` of an equal simulation.

        Raises ConfigError for any other bytes.
        """

def tasks() -> list[TaskEntry]:
    """Tasks of `POLYPOD_PATH` and bundled ones, without those of `broken_configs`."""

def robots() -> list[RobotEntry]:
    """Robots of `POLYPOD_PATH` and bundled ones, without those of `broken_configs`."""

def broken_configs() -> list[str]:
    """Errors of configs that cannot be read, and that `tasks` and `robots` leave out.

    Using the name of such a config raises its error; all others work.
    """

def observation_specs() -> str:
    """JSON of all observation terms that a task may name.

    {name: {kind, units, description, source, ...}}.

    Keys and values are those of `VecSim.observation_terms`; what depends on a task is left out.
    """

def command_specs() -> str:
    """JSON of all kinds of commands that a task may name.

    {name: {columns, description}}: names of a command's numbers, and what they are.
    """

def train_config(name: str, above: Sequence[str | os.PathLike[str]] = ...) -> TrainFile:
    """The first `configs/train/<name>.toml` that is not among the files `above`, by their ids.

    Raises:
        UnknownNameError: for a name that no file has.
        ConfigError: for a file that cannot be read, and for a name that only files `above` have.
    """

def explain_task(name: str, overrides: Sequence[str] = ...) -> tuple[list[tuple[str, str]], str]:
    """The files of a task with what they say, and the task with all defaults, as TOML.

    The file that extends no other comes first. The last text has all layers, overrides and
    defaults.

    Raises:
        UnknownNameError: for a name that does not exist.
        ConfigError: for a config or an override that cannot be used.
    """

def explain_robot(name: str) -> tuple[list[tuple[str, str]], str]:
    """The files of a robot's config and the config, as `explain_task` gives a task.

    Raises as `explain_task`.
    """

def check_names(task: str | None = None, robots: Sequence[str] = ..., overrides: Sequence[str] = ...) -> None:
    """Reads the configs of a task and of robots, and the task's overrides, without a simulation.

    Raises:
        UnknownNameError: for a name that does not exist.
        ConfigError: for a config or an override that cannot be used.
    """

def play_task(task: str) -> str:
    """The name of a task's Play variant: without noise, pushes, randomisation and curriculum.

    It is the task of that name, where there is a file for it, or else one that is made by the same
    rule. A Play variant is its own.

    Args:
        task: name, alias or path of a task.

    Raises:
        UnknownNameError: for a name that does not exist.
        ConfigError: for a file that cannot be read.
    """

def training_task(task: str) -> str:
    """The name of the task that a Play variant belongs to; of any other task its own name.

    Raises:
        UnknownNameError: for a name that does not exist.
        ConfigError: for a file that cannot be read.
    """

def disturbances(task: str, overrides: Sequence[str] = ...) -> list[str]:
    """Keys of a task's enabled noise, pushes and randomisation.

    An example is `events.push_robot.enabled`.

    Each set to false, by an override, leaves a task that only draws how episodes begin and what is
    commanded. The list of a Play variant is empty.

    Raises:
        UnknownNameError: for a name that does not exist.
        ConfigError: for a config or an override that cannot be used.
    """

def task_robots(task: str, overrides: Sequence[str] = ...) -> list[str]:
    """Names or paths of a task's robots.

    Raises UnknownNameError and ConfigError as `disturbances`.
    """

def train_configs() -> list[TrainEntry]:
    """All training configs, by name.

    Raises ConfigError for a folder of `POLYPOD_PATH` that cannot be read.
    """

def with_overrides(config: str, overrides: Sequence[str]) -> str:
    """Writes overrides into a config, by the rules of `VecSim`'s.

    Args:
        config: tables as JSON, with every key that may be overridden.
        overrides: `key=value` pairs, the key dotted, the value in TOML syntax or a bare word.

    Returns:
        The changed tables as TOML.

    Raises:
        ConfigError: for a table or element that does not exist, and for a value that cannot be
            read.
    """

def robot_urdf(name: str) -> str:
    """The text of a robot's URDF. Raises UnknownNameError."""

def check(
    path: str | os.PathLike[str],
    package_dirs: Mapping[str, str | os.PathLike[str]] = ...,
    locked_joints: Mapping[str, float] = ...,
) -> str:
    """Description of a URDF file: links, joints, contact bodies, legs, and every warning.

    `package_dirs` names the folder of each ROS package in `package://` names, `locked_joints` the
    position (rad or m) of each joint that is held. Raises RobotError.
    """

def draft_robot(
    path: str | os.PathLike[str],
    *,
    name: str | None = ...,
    urdf: str | None = ...,
    package_dirs: Mapping[str, str | os.PathLike[str]] = ...,
    feet: Mapping[str, str] = ...,
    joint_roles: Mapping[str, str] = ...,
    locked_joints: Mapping[str, float] = ...,
    gain_factor: float = ...,
    balanced: bool = ...,
) -> RobotDraft:
    """Drafts a config for the robot of the URDF file at `path`: roles, pose, gains, ranges.

    Args:
        path: the URDF file.
        name: the robot's name; None: that of the URDF.
        urdf: text of the config under `urdf`; None: `path`.
        package_dirs: ROS package -> folder, for `package://` names.
        feet: leg (`LF`, `LH`, `RF`, `RH`; `L`, `R`) -> link that is its foot, where geometry alone
            does not tell.
        joint_roles: slot -> joint of the URDF, where geometry alone does not tell.
        locked_joints: joint -> position at which it is held, rad or m.
        gain_factor: multiplies the gains that follow from weight and leg length.
        balanced: whether two legs get gains on which a policy balances, as makers choose them, in
            the place of stiff ones, which show whether the pose is sound.

    Raises:
        RobotError: where the URDF cannot be read or is no legged robot's.
    """

def terrain(task: str, overrides: Sequence[str] = ...) -> TerrainEntry:
    """The ground of a task.

    Raises ConfigError where it is a plane, UnknownNameError for an unknown task.
    """

def slots_of_legs(joint_names: Sequence[str]) -> list[bool]:
    """Whether each of these slots is of a leg; False for a name that is no slot.

    A joint that slides on the left or the right (`L_SLIDE`) counts as a leg's.
    """

def share_of_worker(num_envs: int, worker: int, workers: int) -> tuple[int, int]:
    """The envs [start, end) of `num_envs` that a worker simulates: whole blocks of 16 or more.

    Raises ConfigError where there are fewer blocks than workers.
    """

def join_snapshots(parts: Sequence[bytes]) -> bytes:
    """Joins the snapshots of shares, in order.

    The result equals the snapshot of one simulation of all of them, byte for byte.

    Raises ConfigError for bytes that are none, and for shares that do not follow one another.
    """

def cuda() -> str:
    """Whether the engine `cuda` can be used on this machine, and why not: one line."""

def info() -> CoreInfo:
    """The version, the instruction set in use and the number of threads."""
