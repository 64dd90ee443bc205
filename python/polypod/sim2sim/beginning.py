"""Initial states of robots that both simulators begin in, and the robots' twins in MuJoCo."""

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, simulated
from polypod.arrays import Array
from polypod.evaluation import play_task, rising, undisturbed
from polypod.evaluation.rollout import Commands as Drawn
from polypod.export.robot import RobotInterface
from polypod.mujoco_model import reference
from polypod.mujoco_model import robot as model_robot
from polypod.python_terms import Terms, TermSim
from polypod.sim2sim.driven import Drive, FoldedPolicy, Observed
from polypod.sim2sim.own_terms import OwnTerms
from polypod.sim2sim.twin import Physics, Twin
from polypod.vector_env import simulator

MAX_STEPS = 50_000_000
"""Control steps of all envs together. Their commands are drawn ahead, 24 bytes each."""
DT_ON_TERRAIN = 0.002
"""MuJoCo's step at most on terrain where none is named, s: its own default. At 5 ms some robots are
thrown off steep faces."""
DT_OF_LIGHT_JOINTS = 0.002
"""MuJoCo's step at most of robots with joints whose damping is much faster than the steps. At 5 ms
such legs slide, drift and fall under policies that lead them at 2 ms."""
COARSE = 5.0
"""Times of the fastest damping of joints that a step may take."""
MARGIN = 30.0
"""Level ground beyond that of the task, m: an episode leads some robots off their terrain."""

_MINIMUM_SHARE = 0.5
"""Share of the termination `root_height_below_minimum`, where the task does not say."""

Step = Callable[[npt.NDArray[np.float32], npt.NDArray[np.bool_]], Observed]
"""Makes a control step of commands [envs, 3] in the envs of a mask; see `Twin.step`."""


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
    """MuJoCo's physics step, s. None: the task's, on terrain at most `DT_ON_TERRAIN`, of robots
    with light joints at most `DT_OF_LIGHT_JOINTS`."""
    integrator: reference.Integrator = "implicitfast"
    friction: float | None = None
    """Friction of the ground in MuJoCo. None: the task's static one."""
    soft_contact: bool = False
    """See `Physics.soft_contact`."""
    overrides: tuple[str, ...] = ()
    """`key=value` changes to the task, on top of the run's own."""
    terms: Path | None = None
    """The Python file of terms that the run was begun with, which is run."""

    def check(self) -> None:
        """Raises ConfigError for numbers that cannot be used."""
        for name, count in (("num_envs", self.envs_per_robot), ("steps", self.steps)):
            if count is not None and count < 1:
                raise _core.ConfigError(f"{name} = {count} must be at least 1")
        for flag, value, least, most in (("--dt", self.dt, 1e-5, 0.1), ("--friction", self.friction, 0.0, 100.0)):
            if value is not None and not least <= value <= most:
                raise _core.ConfigError(f"{flag} {value} must be from {least:g} to {most:g}")
        if self.command is not None and not all(math.isfinite(value) for value in self.command):
            raise _core.ConfigError(f"--command {' '.join(map(str, self.command))} must be finite numbers")


@dataclasses.dataclass(frozen=True)
class Ends:
    """Conditions that end an episode of a robot in its task."""

    groups: frozenset[str]
    """Groups of bodies that must not touch the ground."""
    least_height: float
    """Least height of the base, m."""
    most_tilt: float
    """Largest tilt of the base, rad."""


class Beginning:
    """Initial states of a task's Play variant, the same for both simulators."""

    always_illegal: tuple[str, ...] = ("base", "torso")
    """Groups of bodies that must not touch the ground, whatever the task says."""

    def __init__(
        self, manifest: dict[str, Any], sources: list[str], options: Options, terms: Terms | None = None
    ) -> None:
        """Draws the initial states; `terms` are the run's. Raises ConfigError."""
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
        self.steps = min(options.steps or self.longest(options), self.sim.max_episode_length)
        """Control steps of an episode."""
        if self.steps * self.sim.num_envs > MAX_STEPS:
            raise _core.ConfigError(
                f"{self.sim.num_envs} envs of {self.steps} control steps are more than {MAX_STEPS:,} steps; "
                "choose smaller --steps or --num-envs"
            )
        self.seed = options.seed
        self.resolved: dict[str, Any] = simulated.config(self.sim)
        self.task: dict[str, Any] = self.resolved["task"]
        if self.task["scene"].get("obstacles"):
            raise _core.ConfigError(
                f"{self.sim.task_name}: scene.obstacles: MuJoCo is given the task's ground and gravity; compare in a "
                "task without obstacles"
            )
        self.terminations: dict[str, dict[str, Any]] = self.task["terminations"]
        self.heights = heights(self.sim)
        # a pose's height is the world's already
        self.places = self.sim.env_origins() * [1.0, 1.0, 0.0]
        self.task_dt: float = self.task["sim"]["dt"]
        most = math.inf if self.heights is None else DT_ON_TERRAIN
        self.physics = physics_of(self.task, options, self.at_most(self.task_dt, most))
        self.names_step = options.dt is not None
        self.finer: dict[str, float] = {}
        """Steps of MuJoCo, s, of the robots made so far that have finer ones."""
        self.start = {name: (self.sim.qpos(name), self.sim.qvel(name)) for name in self.sim.robots}
        self.outlines: dict[str, Any] = simulated.shapes(self.sim)

    def at_most(self, dt: float, most: float) -> float:
        """A step of at most `most` of which whole ones make up the control step, s."""
        return dt if dt <= most else self.step_dt / math.ceil(self.step_dt / most - 1e-6)

    def longest(self, options: Options) -> int:
        """Control steps of an episode where `options` do not say."""
        return self.sim.max_episode_length

    def own_terms(self, name: str) -> OwnTerms | None:
        """Terms in Python of one robot in MuJoCo, at the beginning of the episode; None: none."""
        sim = self._begin() if isinstance(self.sim, TermSim) else None
        return OwnTerms(sim, name) if isinstance(sim, TermSim) else None

    def ends(self, name: str, interface: RobotInterface) -> Ends:
        """Conditions that end an episode of one robot."""
        ends = self.terminations
        groups = {*self.always_illegal, *ends.get("illegal_contact", {}).get("bodies", ())}
        lowest = ends.get("root_height_below_minimum")
        least_height = -np.inf
        if lowest is not None:
            share = lowest.get("minimum_share", _MINIMUM_SHARE)
            least_height = lowest.get("minimum_height", rising.least_height(share, interface.info))
        return Ends(frozenset(groups), least_height, ends.get("bad_orientation", {}).get("limit_angle", np.pi))

    def delays(self, robot: model_robot.Robot) -> Array:
        """Delays [envs, joints] in physics steps, one draw per env and group of actuators."""
        random = np.random.default_rng((self.seed, 1))
        delays = np.zeros((self.envs_per_robot, robot.num_joints))
        groups = np.array(robot.actuators.groups)
        for group in dict.fromkeys(robot.actuators.groups):
            joints = np.flatnonzero(groups == group)
            fewest, most = robot.actuators.delay[joints[0]]
            delays[:, joints] = random.integers(fewest, most, size=(self.envs_per_robot, 1), endpoint=True)
        return delays

    def drive(
        self,
        robot: model_robot.Robot,
        interface: RobotInterface,
        policy: FoldedPolicy,
        ends: Ends,
        late: int = 0,
    ) -> Drive:
        """A policy that drives one robot of the episode, on a plane about the world's origin.

        `late` physics steps are added to its delays.
        """
        return Drive(
            interface,
            policy,
            step_dt=self.step_dt,
            physics_dt=self.task_dt,
            delays=self.delays(robot) + late,
            network_torques=functools.partial(self.sim.network_torques, robot.name),
            least_height=ends.least_height,
            most_tilt=ends.most_tilt,
        )


def physics_of(task: dict[str, Any], options: Options, dt: float) -> Physics:
    """Steps of MuJoCo in a task, by `dt` where the options name no step."""
    friction = _combined_friction(task) if options.friction is None else options.friction
    return Physics(options.dt or dt, options.integrator, friction, options.soft_contact, **_spin_friction(task))


def heights(sim: _core.VecSim) -> reference.Heights | None:
    """The ground of a sim and `MARGIN` beyond it; None for a plane."""
    terrain = sim.terrain()
    if terrain is None:
        return None
    x, y = terrain["origin"]
    return reference.Heights(terrain["heights"], (x, y), terrain["cell"]).widened(MARGIN)


def twin_of(
    episode: Beginning, name: str, source: str, interface: RobotInterface, policy: FoldedPolicy, late: int = 0
) -> Twin:
    """One robot of an episode in MuJoCo, before its first reset.

    Its steps are finer where its damping is much faster than those of the episode, and no step is
    named. `late` physics steps are added to its delays.
    """
    robot = model_robot.of(episode.sim, name, source)
    ends = episode.ends(name, interface)
    bodies = [body["name"] for body in episode.outlines[name]["bodies"] if body["group"] in ends.groups]
    drive = dataclasses.replace(
        episode.drive(robot, interface, policy, ends, late),
        heights=episode.heights,
        places=episode.places[slice(*episode.sim.env_ids(name))],
        gravity=episode.sim.gravity,
    )
    twin, dt = Twin(robot, bodies, episode.physics, drive), episode.physics.dt
    rate = reference.damping_rate(twin.reference.model, twin.reference.v[6:], robot.actuators.damping)
    finer = episode.at_most(dt, DT_OF_LIGHT_JOINTS)
    if episode.names_step or dt * rate <= COARSE or finer == dt:
        return twin
    episode.finer[name] = finer
    return Twin(robot, bodies, dataclasses.replace(episode.physics, dt=finer), drive)


def begun(
    episode: Beginning, name: str, source: str, interface: RobotInterface, policy: FoldedPolicy
) -> tuple[Twin, Step]:
    """One robot of an episode in MuJoCo in its first state, and its control step.

    Terms in Python that the run has take part.
    """
    terms = episode.own_terms(name)
    twin = twin_of(episode, name, source, interface, policy if terms is None else terms.policy(policy))
    twin.reset(*episode.start[name])
    if terms is None:
        return twin, twin.step
    terms.begin(twin)
    return twin, functools.partial(terms.step, twin)


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
