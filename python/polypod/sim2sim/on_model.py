"""The policy on a maker's MuJoCo model, compared with polypod under the same commands."""

import dataclasses
import functools
import hashlib
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from polypod import _core, rotations, simulated, text
from polypod.arrays import Array
from polypod.evaluation import Policy, walking
from polypod.evaluation.results import finite
from polypod.export.robot import RobotInterface, interfaces
from polypod.export.runtime import OnnxPolicy
from polypod.files import read_bytes
from polypod.mujoco_model import reference
from polypod.mujoco_model import robot as model_robot
from polypod.mujoco_model.reference import Reference
from polypod.policy import load
from polypod.provenance import Measured, measured
from polypod.sim2sim import beginning, differences, maker, mapping, mjcf, phases, run, told
from polypod.sim2sim.commands import Commands
from polypod.sim2sim.driven import FoldedPolicy
from polypod.sim2sim.maker import Actuation, Choices, Contacts, Maker, Model
from polypod.sim2sim.phases import PhaseFigures, PhaseRecord
from polypod.sim2sim.run import Episode, Figures
from polypod.sim2sim.skeleton import BASE
from polypod.sim2sim.twin import Twin

Watch = Callable[[str, Array], None]
"""Called after each control step with "polypod" or "model" and positions [envs, 7 + joints]."""

CLEAR = 1e-6
"""A robot is put this near to where its feet touch as polypod's do, m."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of a play."""

    episodes: int = 20
    commands: Literal["phases", "walking"] = "phases"
    phases: str = phases.DEFAULT
    """See `polypod.sim2sim.phases.parse`."""
    phase_s: float = 5.0
    """Length of a phase, s."""
    rounds: int = 1
    """Number of times that the phases come in an episode."""
    seed: int = 0
    actuators: Actuation = "model"
    contact: Contacts = "asis"
    dt: float | None = None
    """MuJoCo's physics step, s. None: the file's."""
    integrator: str | None = None
    """None: the file's."""
    friction: float | None = None
    """Sliding friction of all contacts of the model; None: the file's."""
    map: Path | None = None
    """See `polypod.sim2sim.mapping.Given.read`."""
    differences: bool = True
    """Whether to rank what sets the model apart from polypod's robot."""
    overrides: tuple[str, ...] = ()
    """`key=value` changes to the task, on top of the run's own."""

    def check(self) -> None:
        """Raises ConfigError for what cannot be run."""
        for flag, count, most in (("--num-envs", self.episodes, 100_000), ("--rounds", self.rounds, 1000)):
            if not 1 <= count <= most:
                raise _core.ConfigError(f"{flag} {count} must be from 1 to {most}")
        for name, value, least, upper in (
            ("--phase-s", self.phase_s, 0.1, 1000.0),
            ("--dt", self.dt, 1e-5, 0.1),
            ("--friction", self.friction, 0.0, 100.0),
        ):
            if value is not None and not least <= value <= upper:
                raise _core.ConfigError(f"{name} {value} must be from {least:g} to {upper:g}")
        phases.parse(self.phases)


@dataclasses.dataclass(frozen=True)
class Played:
    """Figures of the robot in one simulator."""

    figures: Figures
    phases: list[PhaseFigures]
    """Empty with the commands of walking."""


@dataclasses.dataclass(frozen=True)
class ModelComparison:
    """A policy on a model, and what that was measured on."""

    command: str
    """The command line that compares the same again."""
    model: dict[str, str]
    """Name of the file, and its SHA-256."""
    checkpoint: dict[str, str]
    """Name of the policy's file, and its SHA-256."""
    task: str
    robot: str
    source: str
    """Name of the robot in the library, or the path of its config."""
    episodes: int
    duration_s: float
    seed: int
    mujoco_version: str
    dt: float
    """MuJoCo's physics step, s."""
    integrator: str
    actuators: str
    contact: str
    notes: list[str]
    """Parts of the model that were added, left out or replaced."""
    base: str
    """The model's body that is the base."""
    base_frame: str
    """`equal`, or how its frame was found."""
    base_turn: list[list[float]]
    base_shift: list[float]
    """polypod's point is `base_turn @ p + base_shift` of the model's point p in the frames of the
    base, m."""
    joints: list[mapping.Pair]
    polypod: Played
    on_model: Played
    differences: list[differences.Difference]
    """The largest effect first."""
    is_whole: bool
    """Whether all of the definition of walking is asked."""
    measured: Measured

    @property
    def why_not(self) -> list[str]:
        """Clauses of the definition of walking that the robot misses on the model, with numbers."""
        return self.on_model.figures.why_not(self.is_whole)

    @property
    def transfers(self) -> bool:
        """Whether the robot on the model meets the clauses of walking that its commands hold."""
        return not self.why_not

    def as_dict(self) -> dict[str, Any]:
        """Returns the results for JSON."""
        content = {**dataclasses.asdict(self), "transfers": self.transfers, "why_not": self.why_not}
        found: dict[str, Any] = finite(content)
        return found


def load_model(path: Path, robot: model_robot.Robot, given: Path | None, choices: Choices) -> Model:
    """Checks and reads a file as a model of a robot. Raises ConfigError."""
    try:
        mjcf.check(path)
    except ValueError as error:
        raise _core.ConfigError(f"--model {path}: {mjcf.one_line(error)}") from error
    return compiled(path, robot, given, choices)


def compiled(path: Path, robot: model_robot.Robot, given: Path | None, choices: Choices) -> Model:
    """Reads a file that was checked before. Raises ConfigError."""
    named = mapping.Given() if given is None else mapping.Given.read(given)
    try:
        reading = mjcf.read(str(path))
    except ValueError as error:
        raise _core.ConfigError(f"--model {path}: {mjcf.one_line(error)}") from error
    return Model(reading, path.name, robot, named, choices)


def play(
    model_file: Path,
    checkpoint: Path,
    robot: str | None = None,
    options: Options | None = None,
    progress: run.Progress = lambda simulator, done, total: None,
    watch: Watch | None = None,
) -> ModelComparison:
    """Plays a policy on a model of its robot.

    Args:
        model_file: the MuJoCo file.
        checkpoint: a `model_<n>.pt` next to its manifest, or an ONNX file that says its task.
        robot: name or path of the config; None: the one of the policy's robots whose joints the
            model has.
        options: see `Options`.
        progress: told how far the run is.
        watch: shown all states; None: nobody is.

    Raises:
        ConfigError: for a file, checkpoint, robot or option that cannot be used.
    """
    options = options or Options()
    options.check()
    try:
        mjcf.check(model_file)
    except ValueError as error:
        raise _core.ConfigError(f"--model {model_file}: {mjcf.one_line(error)}") from error
    if robot is None:
        robot = guess(model_file, load(checkpoint).robots)
    stage = Stage(checkpoint, robot, options)
    model = compiled(
        model_file,
        stage.robot,
        options.map,
        Choices(options.actuators, options.contact, options.dt, options.integrator, options.friction),
    )
    beginning.check_steps(dataclasses.replace(stage.episode.physics, dt=model.dt), stage.episode.step_dt, stage.name)
    when = measured()
    ours = stage.in_polypod(progress, watch)
    theirs = stage.on(model, progress, watch)
    ranked = []
    if options.differences:
        alone = Stage(checkpoint, robot, dataclasses.replace(options, episodes=1))
        ranked = differences.ranked(
            functools.partial(alone.twin_of, alone.policy()),
            alone.episode.start[alone.name],
            (alone.maker_of(model), alone.start(model)),
            progress,
        )
    return ModelComparison(
        command=_command(model_file, checkpoint, robot, options),
        model={"file": str(model_file), "sha256": _digest(model_file)},
        checkpoint={"file": str(checkpoint), "sha256": stage.sha256},
        task=stage.episode.sim.task_name,
        robot=stage.name,
        source=robot,
        episodes=options.episodes,
        duration_s=stage.schedule.steps * stage.episode.step_dt,
        seed=options.seed,
        mujoco_version=reference.version(),
        dt=model.dt,
        integrator=model.integrator,
        actuators=options.actuators,
        contact=options.contact,
        notes=list(dict.fromkeys([*model.notes, *stage.told(model)])),
        base=model.root,
        base_frame=model.map.frame_how,
        base_turn=model.map.turn.tolist(),
        base_shift=model.map.shift.tolist(),
        joints=list(model.map.pairs),
        polypod=ours,
        on_model=theirs,
        differences=ranked,
        is_whole=stage.is_whole,
        measured=when,
    )


def robot_of(model_file: Path, robots: Sequence[str]) -> str:
    """Checks the file, and returns the robot that `guess` finds. Raises ConfigError."""
    try:
        mjcf.check(model_file)
    except ValueError as error:
        raise _core.ConfigError(f"--model {model_file}: {mjcf.one_line(error)}") from error
    return guess(model_file, robots)


def guess(model_file: Path, robots: Sequence[str]) -> str:
    """The robot whose joints have the names of the model's.

    Raises ConfigError where that is not one.

    Robots of one maker share their joints' names. The name of the file or its model, masses and
    geometry tell them apart.
    """
    try:
        spec = mjcf.read(str(model_file)).spec
        model = spec.compile()
    except Exception as error:
        raise _core.ConfigError(f"--model {model_file}: {mjcf.one_line(error)}") from error
    names = [model.joint(joint).name for joint in range(model.njnt)]
    sim = _core.VecSim(model_robot.TASK, len(robots), robots=list(robots), threads=1)
    infos = simulated.robots(sim)
    costs: dict[str, float] = {}
    for source, name in zip(robots, sim.robots, strict=True):
        joints = infos[name]["joint_names"]
        if len(mapping.named(joints, names)) < len(joints):
            continue
        try:
            found = Model(mjcf.read(str(model_file)), model_file.name, model_robot.of(sim, name, source))
        except _core.ConfigError:
            continue
        ratio = infos[name]["mass"] / max(float(found.model.body(found.root).subtreemass[0]), 1e-9)
        costs[source] = found.map.cost + float((np.log(ratio) / 0.1) ** 2)
    words = {
        word for text in (spec.modelname, model_file.stem) for word in re.split(r"[^a-z0-9]+", text.lower()) if word
    }
    called = [source for source in costs if Path(source).stem.lower().split("_")[-1] in words]
    if len(called) == 1:
        return called[0]
    best = sorted(costs, key=costs.__getitem__)
    if not best:
        raise _core.ConfigError(
            f"--model {model_file}: no robot of the policy has joints of these names; say which with --robot: "
            f"{', '.join(robots)}"
        )
    if len(best) > 1 and costs[best[1]] < 2.0 * costs[best[0]] + 1e-3:
        raise _core.ConfigError(f"--model {model_file}: it may be {best[0]} or {best[1]}; say which with --robot")
    return best[0]


class Stage:
    """A policy, its robot, and the commands of an episode."""

    def __init__(self, checkpoint: Path, robot: str, options: Options) -> None:
        """Draws the initial states as polypod does. Raises ConfigError."""
        loaded = load(checkpoint, robots=[robot])
        self.options = options
        self.sha256 = loaded.sha256
        self.runner: Policy = loaded.runner()
        manifest = loaded.manifest
        plan = phases.parse(options.phases)
        length = options.rounds * len(plan) * options.phase_s if options.commands == "phases" else walking.EPISODE_S
        overrides = (*options.overrides, f"sim.episode_length_s={length + 1.0}")
        known = interfaces({**manifest, "overrides": [*manifest["overrides"], *options.overrides]}, [robot])
        ((self.name, self.interface),) = known.items()
        self.episode = Episode(
            manifest,
            [robot],
            beginning.Options(envs_per_robot=options.episodes, seed=options.seed, overrides=overrides),
        )
        if self.episode.heights is not None:
            raise _core.ConfigError(
                f"{self.episode.sim.task_name} has generated terrain, and --model is played on the ground of its file; "
                "choose a policy of flat ground"
            )
        self.source = robot
        self.robot = model_robot.of(self.episode.sim, self.name, robot)
        self._network = loaded.network
        self.is_whole = options.commands == "walking"
        self.plan: tuple[phases.Phase, ...] | None = None
        if not self.is_whole:
            self.plan = plan
            self.episode.schedule = phases.schedule(
                plan, options.rounds, options.phase_s, options.episodes, self.episode.step_dt
            )
            self.episode.commands = Commands.of(self.episode.schedule)
            self.episode.steps = self.episode.schedule.steps
            self.episode.is_whole = False
        self.schedule = self.episode.schedule

    def policy(self, model: Model | None = None) -> OnnxPolicy:
        """The exported policy, which remembers nothing yet, told of polypod's robot or a model."""
        interface = self.interface if model is None else told.interface_on(model, self.interface)[0]
        return OnnxPolicy.of(self._network, interface)

    def told(self, model: Model) -> list[str]:
        """Lines for people about the model's gains that the policy is told."""
        line = told.interface_on(model, self.interface)[1]
        return [] if line is None else [line]

    def twin_of(self, policy: FoldedPolicy | None = None) -> Twin:
        """Polypod's robot in MuJoCo, before its first reset."""
        return beginning.twin_of(self.episode, self.name, self.source, self.interface, policy or self.policy())

    def _record(self) -> PhaseRecord | None:
        if self.plan is None:
            return None
        return PhaseRecord(self.plan, self.schedule, self.episode.step_dt, self.robot.joint_names)

    def in_polypod(self, progress: run.Progress, watch: Watch | None) -> Played:
        """Plays the policy in polypod."""
        by_phase = self._record()
        shown = None if watch is None else lambda simulator, robot, qpos: watch(simulator, qpos)
        seen = None if by_phase is None else by_phase.see
        figures = run.run_polypod(self.episode, self.runner, progress, shown, seen)[self.name]
        return Played(figures, [] if by_phase is None else by_phase.figures())

    def start(self, model: Model) -> tuple[Array, Array]:
        """Initial states of polypod, at heights at which the model's feet touch as polypod's do."""
        return started(model, self.robot, *self.episode.start[self.name])

    def maker_of(self, model: Model, policy: FoldedPolicy | None = None, late: int = 0) -> Maker:
        """The model with the policy, before its first reset.

        `late` physics steps are added to its delays.
        """
        ends = self.episode.ends(self.name, self.interface)
        outlines = self.episode.outlines[self.name]["bodies"]
        policy = policy or self.policy(model)
        return made(model, self.episode, self.robot, self.interface, ends, outlines, policy, late)

    def on(self, model: Model, progress: run.Progress, watch: Watch | None) -> Played:
        """Plays the policy on the model."""
        robots = self.maker_of(model)
        robots.reset(*self.start(model))
        commands = self.episode.commands
        record, by_phase = walking.Record(self.schedule, self.episode.step_dt), self._record()
        for step in range(self.schedule.steps):
            robots.saturated[:], robots.watched[:] = 0.0, 0.0
            seen = robots.step(commands.at(step, rotations.heading(robots.qpos[:, 3:7])), record.active)
            record.add(seen.velocity, seen.yaw_rate, seen.fell)
            if by_phase is not None:
                by_phase.add(seen.velocity, seen.yaw_rate, seen.fell, robots.saturated, robots.watched)
            if watch is not None:
                watch("model", robots.qpos)
            progress("model", step + 1, self.schedule.steps)
            if watch is None and not record.active.any():
                break
        figures = self.episode.figures(self.name, record, slice(None))
        return Played(figures, [] if by_phase is None else by_phase.figures())


def started(model: Model, robot: model_robot.Robot, qpos: Array, qvel: Array) -> tuple[Array, Array]:
    """Initial states [envs, nq] and [envs, nv] of the model.

    At their heights the model's feet touch as polypod's do.
    """
    qpos = qpos.copy()
    ours = Reference.of(robot, dt=0.005)
    shapes = np.flatnonzero(ours.model.geom_bodyid > 0)
    body, touch = model.model, (model.model.geom_contype | model.model.geom_conaffinity) != 0
    of_robot = np.flatnonzero((model.skeleton.clusters[body.geom_bodyid] >= BASE) & touch)
    for row in qpos:
        ours.set_state(row)
        gap = maker.lowest(ours.model, ours.data, shapes) - maker.lowest(body, model.data_of(row), of_robot)
        if np.isfinite(gap) and abs(gap) > CLEAR:
            row[2] += gap
        if model.heights is not None:
            row[2] += float(model.heights.at(row[None, :2])[0])
    return qpos, qvel.copy()


def made(
    model: Model,
    episode: Episode,
    robot: model_robot.Robot,
    interface: RobotInterface,
    ends: beginning.Ends,
    outlines: Sequence[Any],
    policy: FoldedPolicy,
    late: int = 0,
) -> Maker:
    """A model with a policy in an episode, before its first reset."""
    ours = Reference.of(robot, dt=0.005)
    joints = [ours.model.joint(name).id for name in robot.joint_names]
    clusters = maker.clusters_of(sorted(ends.groups), ours, outlines, joints)
    return Maker(model, clusters, episode.drive(robot, interface, policy, ends, late))


def _digest(path: Path) -> str:
    return hashlib.sha256(read_bytes(path, mjcf.MAX_BYTES)).hexdigest()


def _command(model: Path, checkpoint: Path, robot: str, options: Options) -> str:
    usual = Options()
    given: dict[str, Any] = {
        "--checkpoint": checkpoint,
        "--model": model,
        "--robot": robot,
        "--map": options.map,
        "--num-envs": options.episodes,
    }
    for flag, key in (
        ("--commands", "commands"),
        ("--phases", "phases"),
        ("--phase-s", "phase_s"),
        ("--rounds", "rounds"),
        ("--actuators", "actuators"),
        ("--contact", "contact"),
        ("--dt", "dt"),
        ("--integrator", "integrator"),
        ("--friction", "friction"),
    ):
        value = getattr(options, key)
        given[flag] = None if value == getattr(usual, key) else value
    given |= {"--seed": options.seed, "--no-differences": not options.differences}
    return text.command_line(("polypod", "sim2sim"), given, {"--set": options.overrides})
