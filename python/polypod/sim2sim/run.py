"""Both simulators over the same episodes: the same states, commands, falls and errors."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, descriptions, rotations, text
from polypod.arrays import Array
from polypod.evaluation import Policy, Walking, walking
from polypod.evaluation.results import succeeds
from polypod.export.robot import RobotInterface, interfaces
from polypod.export.runtime import OnnxPolicy
from polypod.mujoco_model import reference
from polypod.networks.policies import reset
from polypod.policy import load
from polypod.provenance import measured
from polypod.python_terms import Terms
from polypod.runs.own_terms import terms_of_run
from polypod.sim2sim.beginning import Beginning, Options, begun, check_steps
from polypod.sim2sim.commands import Commanded, Commands
from polypod.sim2sim.compared import Compared

Progress = Callable[[str, int, int], None]
"""Called with a robot, the control steps done and those to do."""
Watch = Callable[[str, str, Array], None]
"""Called after each control step with "polypod" or "mujoco", a robot, and its positions [envs, 7 +
joints]."""
Seen = Callable[[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_]], None]
"""Called with planar velocities [envs, 2], m/s, yaw rates [envs], rad/s, and who fell [envs]."""


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

    def why_not(self, is_whole: bool) -> list[str]:
        """Criteria of walking that the robot misses, with numbers; empty if it walks.

        `is_whole`: whether all of the definition of walking is asked.
        """
        if self.walking is None:
            return ["not measured"]
        return list(walking.faults(self.walking, is_whole).values())


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
        """Criteria of walking that the robot misses in MuJoCo, with numbers."""
        return self.mujoco.why_not(self.is_whole)

    @property
    def transfers(self) -> bool:
        """Whether the robot walks in MuJoCo, by the definition of `polypod.evaluation.walking`."""
        return not self.why_not


@dataclasses.dataclass(frozen=True)
class Comparison(Compared[RobotComparison]):
    """All robots that walk, and what they were measured on."""

    distances: dict[str, descriptions.Distance] = dataclasses.field(default_factory=dict)
    """Distances of the robots that the policy was not trained on from its training bodies."""

    def judged(self, robot: RobotComparison) -> dict[str, Any]:
        """Whether a robot walks in MuJoCo, and why not, for JSON."""
        return {**super().judged(robot), "why_not": robot.why_not}


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
    options.check()
    loaded = load(checkpoint, robots=robots)
    network, manifest = loaded.network, loaded.manifest
    sources = list(manifest["robot_sources"] if robots is None else robots)
    terms = terms_of_run(manifest, options.terms, str(checkpoint))
    known = interfaces({**manifest, "overrides": [*manifest["overrides"], *options.overrides]}, sources)
    episode = Episode(manifest, sources, options, terms)
    for name in known:
        check_steps(episode.physics, episode.step_dt, name)
    conditions = conditions_of(episode, checkpoint, robots, options)
    in_polypod = run_polypod(episode, loaded.runner(), progress, watch)
    results = {}
    for source, (name, interface) in zip(sources, known.items(), strict=True):
        policy = OnnxPolicy.of(network, interface)
        theirs = _run_mujoco(episode, name, source, interface, policy, progress, watch)
        results[name] = RobotComparison(in_polypod[name], theirs, episode.is_whole)
    distances = descriptions.distances(manifest, sources, str(checkpoint))
    return Comparison(**conditions, robots=results, finer=episode.finer, distances=distances)


def conditions_of(
    episode: Beginning, checkpoint: Path, robots: Sequence[str] | None, options: Options
) -> dict[str, Any]:
    """The fields of `Compared` that say what is measured, and today's date."""
    return {
        "command": command_line(checkpoint, robots, options),
        "task": episode.sim.task_name,
        "envs_per_robot": options.envs_per_robot,
        "seed": options.seed,
        "duration_s": episode.steps * episode.step_dt,
        "mujoco_version": reference.version(),
        "physics": episode.physics,
        "measured": measured(),
    }


def command_line(checkpoint: Path, robots: Sequence[str] | None, options: Options) -> str:
    """The command line that compares the same again."""
    given: dict[str, Any] = {
        "--checkpoint": checkpoint,
        "--robots": None if robots is None else list(robots),
        "--num-envs": options.envs_per_robot,
        "--steps": options.steps,
        "--commands": options.commands if options.commands != Options.commands else None,
        "--seed": options.seed,
        "--dt": options.dt,
        "--integrator": options.integrator if options.integrator != Options.integrator else None,
        "--friction": options.friction,
        "--command": options.command and tuple(options.command),
        "--soft-contact": options.soft_contact,
        "--terms": options.terms,
    }
    return text.command_line(("polypod", "sim2sim"), given, {"--set": options.overrides})


class Episode(Beginning):
    """Initial states and commands, the same for both simulators."""

    def __init__(
        self, manifest: dict[str, Any], sources: list[str], options: Options, terms: Terms | None = None
    ) -> None:
        """Draws the initial states and the commands; `terms` are the run's. Raises ConfigError."""
        super().__init__(manifest, sources, options, terms)
        is_scheduled = _is_scheduled(options)
        self.is_whole = is_scheduled and options.steps is None
        if "base_velocity" not in self.task["commands"]:
            given = ", ".join(self.task["commands"]) or "no command"
            raise _core.ConfigError(
                f"{self.sim.task_name}: commands: the task gives {given}; sim2sim compares velocity commands "
                "(`base_velocity`), getting up and tracking"
            )
        if options.command is not None:
            self.schedule = walking.Schedule.constant(options.command, self.sim.num_envs, self.steps)
            self.commands = Commands.of(self.schedule)
        elif is_scheduled:
            self.schedule = walking.schedule_of(self.sim, self.steps, options.seed)
            self.commands = Commands.of(self.schedule)
        else:
            self.schedule = walking.Schedule.elsewhere(self.sim.num_envs, self.steps)
            self.commands = Commands.draw(
                self.task["commands"]["base_velocity"], _ranges(self.sim), self.steps, self.step_dt, options.seed
            )

    def longest(self, options: Options) -> int:
        """Control steps of an episode where `options` do not say."""
        return walking.episode_steps(self.step_dt) if _is_scheduled(options) else self.sim.max_episode_length

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


def _is_scheduled(options: Options) -> bool:
    """Whether the commands are those that walking is judged by."""
    return options.command is None and options.commands == "walking"


def _ranges(sim: _core.VecSim) -> dict[str, Array]:
    """Ranges of the commands, each [2, envs]."""
    ranges = sim.command_ranges()
    envs = [(robot, stop - start) for robot in sim.robots for start, stop in [sim.env_ids(robot)]]
    return {
        key: np.concatenate([np.tile(np.array(ranges[robot][key])[:, None], count) for robot, count in envs], axis=1)
        for key in ("lin_vel_x", "lin_vel_y", "ang_vel_z")
    }


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


def _run_mujoco(
    episode: Episode,
    name: str,
    source: str,
    interface: RobotInterface,
    policy: OnnxPolicy,
    progress: Progress,
    watch: Watch | None,
) -> Figures:
    twin, step_by = begun(episode, name, source, interface, policy)
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
