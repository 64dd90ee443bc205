"""Both simulators over the same episodes: the same states, commands, falls and errors."""

import dataclasses
import functools
import json
import math
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, descriptions, rotations
from polypod.accuracy import reference
from polypod.accuracy import robot as accuracy_robot
from polypod.arrays import Array
from polypod.compat import tomllib
from polypod.evaluation import Policy, Walking, play_task, rising, undisturbed, walking
from polypod.evaluation.results import finite, succeeds
from polypod.evaluation.rollout import Commands as Drawn
from polypod.export import onnx_graph
from polypod.export.robot import RobotInterface, interfaces
from polypod.export.runtime import OnnxPolicy
from polypod.networks.policies import reset
from polypod.policy import load
from polypod.provenance import Measured, measured
from polypod.python_terms import Terms, TermSim
from polypod.runs.own_terms import terms_of_run
from polypod.sim2sim.commands import Commanded, Commands
from polypod.sim2sim.driven import Drive, FoldedPolicy
from polypod.sim2sim.own_terms import OwnTerms
from polypod.sim2sim.twin import Physics, Twin
from polypod.vector_env import simulator

MAX_STEPS = 50_000_000
"""Control steps of all envs together. Their commands are drawn ahead, 24 bytes each."""
DT_ON_TERRAIN = 0.002
"""MuJoCo's step on terrain where none is named, s: its own default. At 5 ms some robots are thrown
off steep faces."""
MARGIN = 30.0
"""Level ground beyond that of the task, m: an episode leads some robots off their terrain."""

Progress = Callable[[str, int, int], None]
"""Called with a robot, the control steps done and those to do."""
Watch = Callable[[str, str, Array], None]
"""Called after each control step with "polypod" or "mujoco", a robot, and its positions [envs, 7 +
joints]."""
Seen = Callable[[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_]], None]
"""Called with planar velocities [envs, 2], m/s, yaw rates [envs], rad/s, and who fell [envs]."""


_MINIMUM_SHARE = 0.5
"""Share of the termination `root_height_below_minimum`, where the task does not say."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of a comparison."""

    envs_per_robot: int = 32
    steps: int | None = None
    """Control steps per episode. None: a whole one, with the commands of walking at most 20 s of
    it."""
    seed: int = 0
    command: tuple[float, float, float] | None = None
    """Forward and left velocity, m/s, and yaw rate, rad/s, for all envs. None: see `commands`."""
    commands: Drawn = "walking"
    """"walking" for the schedule that walking is judged by, "task" for commands as the task draws
    them."""
    dt: float | None = None
    """MuJoCo's physics step, s. None: the task's, on terrain at most `DT_ON_TERRAIN`."""
    integrator: reference.Integrator = "implicitfast"
    friction: float | None = None
    """Friction of the ground in MuJoCo. None: the task's static one."""
    soft_contact: bool = False
    """See `Physics.soft_contact`."""
    overrides: tuple[str, ...] = ()
    """`key=value` changes to the task, on top of the run's own."""
    terms: Path | None = None
    """The Python file of terms that the run was begun with, which is run."""


@dataclasses.dataclass(frozen=True)
class Figures:
    """One robot in one simulator: means over its envs, each over the time until it fell."""

    error_vel_xy: float
    """m/s, between commanded and actual planar velocity of the base's centre of mass."""
    error_vel_yaw: float
    """Error of the yaw rate, rad/s."""
    fall_rate: float
    """Share of the episodes that failed: base or torso on the ground, and what else ends them in
    the task."""
    episode_length_s: float
    still_error_vel_xy: float = math.nan
    """m/s, of a robot that stands still; NaN in files of builds that did not write it."""
    still_error_vel_yaw: float = math.nan
    """rad/s, of a robot that stands still."""
    success_rate: float = math.nan
    """Share of the episodes without a fall in which the robot followed its commands, as of an
    evaluation; NaN in files of builds that did not write it."""
    walking: Walking | None = None
    """Figures of the definition of walking; None in files of builds that did not write them."""


@dataclasses.dataclass(frozen=True)
class RobotComparison:
    """One robot in both simulators."""

    polypod: Figures
    mujoco: Figures
    is_whole: bool = True
    """Whether all of the definition of walking is asked. A command or a number of steps that was
    chosen asks what it holds."""

    @property
    def why_not(self) -> list[str]:
        """Criteria of walking that the robot misses in MuJoCo, with numbers; empty if none.

        Empty if it transfers.
        """
        found = self.mujoco.walking
        return ["not measured"] if found is None else list(walking.faults(found, self.is_whole).values())

    @property
    def transfers(self) -> bool:
        """Whether the robot walks in MuJoCo, by the definition of `polypod.evaluation.walking`."""
        return not self.why_not


@dataclasses.dataclass(frozen=True)
class Comparison:
    """All robots, and what they were measured on."""

    command: str
    """The command line that compares the same again."""
    task: str
    envs_per_robot: int
    seed: int
    duration_s: float
    mujoco_version: str
    physics: Physics
    robots: dict[str, RobotComparison]
    measured: Measured
    distances: dict[str, descriptions.Distance] = dataclasses.field(default_factory=dict)
    """How far the robots that the policy was not trained on are from its training bodies."""

    @property
    def transfers(self) -> bool:
        """Whether all robots do."""
        return all(robot.transfers for robot in self.robots.values())

    def as_dict(self) -> dict[str, Any]:
        """The same, for JSON."""
        robots = {
            name: {**dataclasses.asdict(robot), "transfers": robot.transfers, "why_not": robot.why_not}
            for name, robot in self.robots.items()
        }
        content: dict[str, Any] = finite({**dataclasses.asdict(self), "transfers": self.transfers, "robots": robots})
        return content


def compare(
    checkpoint: Path,
    robots: Sequence[str] | None = None,
    options: Options | None = None,
    progress: Progress = lambda robot, done, total: None,
    watch: Watch | None = None,
) -> Comparison:
    """Runs the policy of a checkpoint in both simulators.

    polypod draws the initial states of the task's Play variant; both simulators begin in them. The
    commands are those that walking is judged by, or drawn once as the task draws them; then a
    heading is held by the same controller from each simulator's own heading.

    Args:
        checkpoint: a `model_<n>.pt` next to its manifest, or an ONNX file that says its task.
        robots: names or paths of configs; None: those that the policy was trained on.
        options: see `Options`.
        progress: told how far the run is.
        watch: shown all states; None: nobody is.

    Raises:
        ConfigError: for a checkpoint, robot or option that cannot be used, for a task with
            obstacles, and where MuJoCo, ONNX or onnxruntime is missing.
    """
    options = options or Options()
    for name, count in (("num_envs", options.envs_per_robot), ("steps", options.steps)):
        if count is not None and count < 1:
            raise _core.ConfigError(f"{name} = {count} must be at least 1")
    for flag, value, least, most in (("--dt", options.dt, 1e-5, 0.1), ("--friction", options.friction, 0.0, 100.0)):
        if value is not None and not least <= value <= most:
            raise _core.ConfigError(f"{flag} {value} must be from {least:g} to {most:g}")
    if options.command is not None and not all(math.isfinite(value) for value in options.command):
        raise _core.ConfigError(f"--command {' '.join(map(str, options.command))} must be finite numbers")
    loaded = load(checkpoint, robots=robots)
    network, manifest = loaded.network, loaded.manifest
    sources = list(manifest["robot_sources"] if robots is None else robots)
    terms = terms_of_run(manifest, options.terms, str(checkpoint))
    known = interfaces({**manifest, "overrides": [*manifest["overrides"], *options.overrides]}, sources)
    episode = Episode(manifest, sources, options, terms)
    physics = episode.physics
    for name in known:
        check_steps(physics, episode.step_dt, name)
    when = measured()
    in_polypod = run_polypod(episode, loaded.runner(), progress, watch)
    results = {}
    for source, (name, interface) in zip(sources, known.items(), strict=True):
        model = onnx_graph.robot_model(network, interface, {})
        policy = OnnxPolicy(model.SerializeToString())
        theirs = _run_mujoco(episode, name, source, interface, policy, progress, watch)
        results[name] = RobotComparison(in_polypod[name], theirs, episode.is_whole)
    return Comparison(
        command=_command(checkpoint, robots, options),
        task=episode.sim.task_name,
        envs_per_robot=options.envs_per_robot,
        seed=options.seed,
        duration_s=episode.steps * episode.step_dt,
        mujoco_version=reference.version(),
        physics=physics,
        robots=results,
        measured=when,
        distances=descriptions.distances(manifest, sources, str(checkpoint)),
    )


def _command(checkpoint: Path, robots: Sequence[str] | None, options: Options) -> str:
    given: dict[str, Any] = {
        "--checkpoint": checkpoint,
        "--robots": ",".join(robots) if robots is not None else None,
        "--num-envs": options.envs_per_robot,
        "--steps": options.steps,
        "--commands": options.commands if options.commands != Options.commands else None,
        "--seed": options.seed,
        "--dt": options.dt,
        "--integrator": options.integrator if options.integrator != Options.integrator else None,
        "--friction": options.friction,
    }
    words = ["polypod", "sim2sim"]
    words += [word for flag, value in given.items() if value is not None for word in (flag, str(value))]
    if options.command is not None:
        words += ["--command", *map(str, options.command)]
    if options.soft_contact:
        words.append("--soft-contact")
    if options.terms is not None:
        words += ["--terms", str(options.terms)]
    words += [word for change in options.overrides for word in ("--set", change)]
    return shlex.join(words)


@dataclasses.dataclass(frozen=True)
class Ends:
    """Conditions that end an episode of a robot in its task."""

    groups: frozenset[str]
    """Groups of bodies that must not touch the ground."""
    least_height: float
    """Least height of the base, m."""
    most_tilt: float
    """Largest tilt of the base, rad."""


class Episode:
    """Initial states and commands, the same for both simulators."""

    def __init__(
        self, manifest: dict[str, Any], sources: list[str], options: Options, terms: Terms | None = None
    ) -> None:
        """Draws the initial states and the commands; `terms` are the run's. Raises ConfigError."""
        name, trained = play_task(manifest["task"]), manifest["overrides"]
        self._begin: Callable[[], _core.VecSim] = functools.partial(
            simulator,
            terms,
            name,
            options.envs_per_robot * len(sources),
            play=True,
            robots=sources,
            seed=options.seed,
            overrides=[*trained, *undisturbed(name, trained), *options.overrides],
            autoreset="disabled",
            slots=manifest["canonical_joint_names"],
        )
        self.sim = self._begin()
        self.envs_per_robot = options.envs_per_robot
        self.step_dt = self.sim.step_dt
        is_scheduled = options.command is None and options.commands == "walking"
        self.is_whole = is_scheduled and options.steps is None
        longest = walking.episode_steps(self.step_dt) if is_scheduled else self.sim.max_episode_length
        self.steps = min(options.steps or longest, self.sim.max_episode_length)
        if self.steps * self.sim.num_envs > MAX_STEPS:
            raise _core.ConfigError(
                f"{self.sim.num_envs} envs of {self.steps} control steps are more than {MAX_STEPS:,} steps; "
                "choose smaller --steps or --num-envs"
            )
        self.seed = options.seed
        task = tomllib.loads(self.sim.resolved_config())["task"]
        if "base_velocity" not in task["commands"]:
            given = ", ".join(task["commands"]) or "no command"
            raise _core.ConfigError(
                f"{self.sim.task_name}: commands: the task gives {given}; sim2sim compares velocity commands "
                "(`base_velocity`)"
            )
        if task["scene"].get("obstacles"):
            raise _core.ConfigError(
                f"{self.sim.task_name}: scene.obstacles: MuJoCo is given the task's ground and gravity; compare in a "
                "task without obstacles"
            )
        self.terminations: dict[str, dict[str, Any]] = task["terminations"]
        self.heights = heights(self.sim)
        # a pose's height is the world's already
        self.places = self.sim.env_origins() * [1.0, 1.0, 0.0]
        self.task_dt: float = task["sim"]["dt"]
        friction = _combined_friction(task) if options.friction is None else options.friction
        dt = options.dt or (self.task_dt if self.heights is None else min(self.task_dt, DT_ON_TERRAIN))
        self.physics = Physics(dt, options.integrator, friction, options.soft_contact, **_spin_friction(task))
        if options.command is not None:
            self.schedule = walking.Schedule.constant(options.command, self.sim.num_envs, self.steps)
            self.commands = Commands.of(self.schedule)
        elif is_scheduled:
            self.schedule = walking.schedule_of(self.sim, self.steps, options.seed)
            self.commands = Commands.of(self.schedule)
        else:
            self.schedule = walking.Schedule.elsewhere(self.sim.num_envs, self.steps)
            self.commands = Commands.draw(
                task["commands"]["base_velocity"], _ranges(self.sim), self.steps, self.step_dt, options.seed
            )
        self.start = {name: (self.sim.qpos(name), self.sim.qvel(name)) for name in self.sim.robots}
        self.outlines: dict[str, Any] = json.loads(self.sim.robot_shapes())

    def own_terms(self, name: str) -> OwnTerms | None:
        """Terms in Python of one robot in MuJoCo, at the beginning of the episode; None: none."""
        sim = self._begin() if isinstance(self.sim, TermSim) else None
        return OwnTerms(sim, name) if isinstance(sim, TermSim) else None

    def commands_of(self, name: str) -> Commands:
        """The commands of one robot's envs."""
        envs = slice(*self.sim.env_ids(name))
        fields = ("linear", "heading", "turning", "holds_heading", "standing", "turn_range")
        return dataclasses.replace(self.commands, **{key: getattr(self.commands, key)[:, envs] for key in fields})

    def figures(self, name: str, record: walking.Record, envs: slice) -> Figures:
        """One robot's figures of the envs of a record."""
        asked = walking.kinds_of(self.sim.command_ranges()[name]) if self.is_whole else None
        found = record.walking(envs, asked)
        return Figures(
            error_vel_xy=found.error_vel_xy,
            error_vel_yaw=found.error_vel_yaw,
            fall_rate=found.fall_rate,
            episode_length_s=float(record.steps[envs].mean() * self.step_dt),
            still_error_vel_xy=found.still_error_vel_xy,
            still_error_vel_yaw=found.still_error_vel_yaw,
            success_rate=float(succeeds(record.sums(envs)).mean()),
            walking=found,
        )

    def ends(self, name: str, interface: RobotInterface) -> "Ends":
        """Conditions that end an episode of one robot."""
        ends = self.terminations
        groups = {"base", "torso", *ends.get("illegal_contact", {}).get("bodies", ())}
        lowest = ends.get("root_height_below_minimum")
        least_height = -np.inf
        if lowest is not None:
            share = lowest.get("minimum_share", _MINIMUM_SHARE)
            least_height = lowest.get("minimum_height", rising.least_height(share, interface.info))
        return Ends(frozenset(groups), least_height, ends.get("bad_orientation", {}).get("limit_angle", np.pi))

    def delays(self, robot: accuracy_robot.Robot) -> Array:
        """Delays [envs, joints] in physics steps, one draw per env and group of actuators."""
        random = np.random.default_rng((self.seed, 1))
        delays = np.zeros((self.envs_per_robot, robot.num_joints))
        groups = np.array(robot.actuators.groups)
        for group in dict.fromkeys(robot.actuators.groups):
            joints = np.flatnonzero(groups == group)
            fewest, most = robot.actuators.delay[joints[0]]
            delays[:, joints] = random.integers(fewest, most, size=(self.envs_per_robot, 1), endpoint=True)
        return delays


def _ranges(sim: _core.VecSim) -> dict[str, Array]:
    """Ranges of the commands, each [2, envs]."""
    ranges = sim.command_ranges()
    envs = [(robot, stop - start) for robot in sim.robots for start, stop in [sim.env_ids(robot)]]
    return {
        key: np.concatenate([np.tile(np.array(ranges[robot][key])[:, None], count) for robot, count in envs], axis=1)
        for key in ("lin_vel_x", "lin_vel_y", "ang_vel_z")
    }


def heights(sim: _core.VecSim) -> reference.Heights | None:
    """The ground of a sim and `MARGIN` beyond it; None for a plane."""
    terrain = sim.terrain()
    if terrain is None:
        return None
    x, y = terrain["origin"]
    return reference.Heights(terrain["heights"], (x, y), terrain["cell"]).widened(MARGIN)


def run_polypod(
    episode: Episode, policy: Policy, progress: Progress, watch: Watch | None, seen: Seen | None = None
) -> dict[str, Figures]:
    """Runs an episode in polypod; figures by robot. `seen` is shown each control step."""
    sim = episode.sim
    commanded = Commanded(sim)
    reset(policy)
    record = walking.Record(episode.schedule, episode.step_dt)
    for step in range(episode.steps):
        heading = np.concatenate([rotations.heading(sim.qpos(name)[:, 3:7]) for name in sim.robots])
        commands = episode.commands.at(step, heading)
        observation = commanded.observation(commands)
        # the actions of a robot that lies on the ground are not judged, and may be beyond what a
        # step takes
        sim.step(np.where(record.active[:, None], policy(observation), np.float32(0.0)))
        record.add(sim.state("base_lin_vel")[:, :2], sim.state("base_ang_vel")[:, 2], sim.terminated, commands)
        if seen is not None:
            seen(sim.state("base_lin_vel")[:, :2], sim.state("base_ang_vel")[:, 2], sim.terminated)
        if watch is not None:
            for name in sim.robots:
                watch("polypod", name, sim.qpos(name))
        progress("polypod", step + 1, episode.steps)
    return {name: episode.figures(name, record, slice(*sim.env_ids(name))) for name in sim.robots}


def twin_of(
    episode: Episode, name: str, source: str, interface: RobotInterface, policy: FoldedPolicy, late: int = 0
) -> Twin:
    """One robot of an episode in MuJoCo, before its first reset.

    `late` physics steps are added to its delays.
    """
    robot = accuracy_robot.of(episode.sim, name, source)
    ends = episode.ends(name, interface)
    bodies = [body["name"] for body in episode.outlines[name]["bodies"] if body["group"] in ends.groups]
    drive = Drive(
        interface,
        policy,
        step_dt=episode.step_dt,
        physics_dt=episode.task_dt,
        delays=episode.delays(robot) + late,
        network_torques=functools.partial(episode.sim.network_torques, name),
        heights=episode.heights,
        places=episode.places[slice(*episode.sim.env_ids(name))],
        gravity=episode.sim.gravity,
        least_height=ends.least_height,
        most_tilt=ends.most_tilt,
    )
    return Twin(robot, bodies, episode.physics, drive)


def _run_mujoco(
    episode: Episode,
    name: str,
    source: str,
    interface: RobotInterface,
    policy: OnnxPolicy,
    progress: Progress,
    watch: Watch | None,
) -> Figures:
    terms = episode.own_terms(name)
    twin = twin_of(episode, name, source, interface, policy if terms is None else terms.policy(policy))
    twin.reset(*episode.start[name])
    if terms is not None:
        terms.begin(twin)
    step_by = twin.step if terms is None else functools.partial(terms.step, twin)
    commands = episode.commands_of(name)
    envs = slice(*episode.sim.env_ids(name))
    record = walking.Record(episode.schedule.of_envs(envs), episode.step_dt)
    for step in range(episode.steps):
        wanted = commands.at(step, rotations.heading(twin.qpos[:, 3:7]))
        seen = step_by(wanted, record.active)
        record.add(seen.velocity, seen.yaw_rate, seen.fell, wanted)
        if watch is not None:
            watch("mujoco", name, twin.qpos)
        progress(name, step + 1, episode.steps)
    return episode.figures(name, record, slice(None))


def _combined_friction(task: dict[str, Any]) -> float:
    """Static friction of a robot's nominal surface on the ground."""
    ground, robot = task["scene"]["ground"], task["robot_material"]
    a, b = ground["static_friction"], robot["static_friction"]
    rules = {"multiply": a * b, "average": 0.5 * (a + b), "min": min(a, b), "max": max(a, b)}
    return float(rules[ground["friction_combine"]])


def _spin_friction(task: dict[str, Any]) -> dict[str, float]:
    """Coefficients of torsional and rolling friction between robot and ground, m.

    The larger ones of both surfaces.
    """
    surfaces = (task["scene"]["ground"], task["robot_material"])
    names = ("torsional_friction", "rolling_friction")
    return {name: max(float(surface.get(name, 0.0)) for surface in surfaces) for name in names}


def check_steps(physics: Physics, step_dt: float, name: str) -> None:
    """Raises ConfigError unless MuJoCo's steps make up the control steps of a robot."""
    if physics.dt <= 0.0 or abs(step_dt / physics.dt - round(step_dt / physics.dt)) > 1e-6:
        raise _core.ConfigError(f"dt = {physics.dt} s does not divide the control step of {step_dt} s ({name})")
