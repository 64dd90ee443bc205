"""`polypod adapt`: trains a policy until it walks with a robot.

A short training that begins with the policy, of the robot alone or with robots that are described
most like it, and ends when the robot walks. Where the policy falls at once, a robot on two legs, or
with a GPU any, gets a separate network. It begins with a pretrained one that is grown to the
robot's joints (`polypod.training.growth`), or from scratch. Measuring and stopping are
`polypod.training.goal`, training is `polypod.training.session`.
"""

import contextlib
import dataclasses
import math
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import torch

from polypod import _core, bundled, descriptions, runs, simulated, text
from polypod.add import add, sources
from polypod.evaluation import ENVS_PER_ROBOT, evaluate_checkpoint
from polypod.evaluation.walking import Walking, walks, why_not
from polypod.networks.transfer import of_observation
from polypod.new_robot import NewRobot, new_robot, robot_name
from polypod.runs import config, engines, run_dir
from polypod.runs.schema import URMA, TrainConfig
from polypod.tables import Rows
from polypod.tensors import torch_threads
from polypod.training import growth, session
from polypod.training.goal import CONFIRMING_SEED, Point, UntilWalks, progress_line, rank
from polypod.training.report import Iteration, Reporter, walking_cells
from polypod.training.workers import Workers

TRAIN_CONFIG, ON_GPU = "adapt", "adapt_on_gpu"
"""Train configs: on a CPU, and with a GPU."""
SEPARATE = "adapt_separate"
"""Train config of a separate network of the robot, on a CPU and with a GPU."""
CRITIC_WARMUP = 10
"""Iterations in which a new critic learns before the policy moves."""
HOPELESS = 0.5
"""A separate network is worth its training where the policy falls in more than this share of the
episodes, and before it ends any turn or stop."""
GLANCE = 16
"""Number of envs that tell whether a separate network is worth it: a policy under which every one
falls is measured no further."""
EXPERIMENT = "adapt"
"""Folder of the runs."""
MAX_MINUTES = 15.0
MANY_JOINTS, MANY_JOINTS_FROM_SCRATCH = 30, 26
"""A robot that drives more joints learns with those of its legs alone, with a pretrained network
and from scratch."""
EVERY, EVERY_PRETRAINED, EVERY_FROM_SCRATCH = 10, 20, 60
"""Iterations between two measurements: of the policy, and of separate networks that begin with a
pretrained one or from scratch. Iterations of these are shorter."""
FOUR_LEGS, OTHERS = "quadruped", "legged"
"""Bundled policies to begin with."""
URDF = ".urdf"
NO_NOISE = "observations.enable_noise=false"
_OF_POLICY = ("task", "task_changes", "symmetry", "normalize_reward_per_robot", "normalize_advantage_per_robot")
"""Keys of [run] that stay as the policy was trained."""
_NETWORKS = ("actor", "critic", "obs_groups")
"""Sections of the networks that a training begins with."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Robot, policy and budget of an adaptation."""

    robot: str
    """Name of a robot, path of its TOML, or path of a file that describes it."""
    checkpoint: Path | None = None
    """None: the bundled policy that fits best."""
    neighbours: int = 0
    """Robots of the library to train with, so that nothing is forgotten."""
    max_minutes: float = MAX_MINUTES
    every: int | None = None
    """Iterations between two measurements; None: `EVERY`, `EVERY_PRETRAINED` or
    `EVERY_FROM_SCRATCH`."""
    train_config: str | None = None
    """None: `adapt`, with a GPU `adapt_on_gpu`; of a separate network `adapt_separate`."""
    separate: Literal["auto", "always", "never"] = "auto"
    """Whether the robot gets a separate network: auto where the policy falls before it ends a turn
    or a stop, the robot has two legs or a GPU is there, and neither checkpoint nor neighbours are
    given."""
    from_scratch: bool = False
    """Whether a separate network begins from scratch although a pretrained one is there."""
    seed: int | None = None
    log_dir: Path = runs.LOGS
    device: str = "auto"
    threads: int | None = None
    overrides: tuple[str, ...] = ()
    package_dirs: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Folders of the packages that a robot's file names."""
    locked_joints: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Joints of a robot's file that are held, and their positions."""
    legs_alone: Literal["auto", "always", "never"] = "auto"
    """Whether all joints of a robot's file but those of its legs are held at their default pose:
    auto where it gets a separate network and has more than `MANY_JOINTS`, or
    `MANY_JOINTS_FROM_SCRATCH`."""

    @property
    def command(self) -> str:
        """The command line of these options, for the manifest."""
        given: dict[str, Any] = {"--checkpoint": self.checkpoint and bundled.shown(self.checkpoint)}
        names = ("neighbours", "max_minutes", "every", "train_config", "separate", "from_scratch", "seed", "legs_alone")
        for name in names:
            if (value := getattr(self, name)) != getattr(Options, name):
                given[f"--{name.replace('_', '-')}"] = value
        repeated = {
            "--set": self.overrides,
            "--package-dir": map("=".join, self.package_dirs.items()),
            "--lock": (f"{joint}={at}" for joint, at in self.locked_joints.items()),
        }
        return text.command_line(("polypod", "adapt", self.robot), given, repeated)


@dataclasses.dataclass(frozen=True)
class Result:
    """Outcome of an adaptation."""

    name: str
    """Name of the robot."""
    robot: str
    """Name of the robot, or the path of its config."""
    checkpoint: Path
    """The best one: the policy that it began with where no training was needed or none got
    better."""
    before: Mapping[str, Walking]
    after: Mapping[str, Walking]
    walks: bool
    """Whether the robot walks, and every neighbour that walked before."""
    points: Sequence[Point]
    minutes: float
    """Time of the whole command: drafting, training, measuring."""
    stopped_by: int | None = None
    """The signal that ended it."""
    unfinished: Path | None = None
    """Best checkpoint of a separate network that does not beat the policy yet."""


@dataclasses.dataclass(frozen=True)
class Start:
    """A robot, and the policy that it begins with."""

    name: str
    robot: str
    """Name of the robot, or the path of its config, as in `Result`."""
    nearest: list[str]
    """The robot of the library whose description is most like it, where there is one."""
    neighbours: list[str]
    checkpoint: Path
    changes: list[str]
    """`key=value` pairs of the task."""
    before: Mapping[str, Walking]
    """Figures of the robot and of its neighbours."""


def adapt(options: Options, reporter: Reporter | None = None) -> Result:
    """Trains until the robot walks or the time is over.

    Raises:
        ConfigError: for options that name nothing, and for a policy that cannot act for the robot.
        RobotError: for a file that is no legged robot's.
    """
    began = time.monotonic()
    reporter = reporter or Progress()
    if options.neighbours and options.separate == "always":
        raise _core.ConfigError("--separate always trains the robot alone; leave out --neighbours")
    if options.from_scratch and _is_bound(options) and options.separate != "always":
        raise _core.ConfigError(
            "--from-scratch is of a separate network, and the policy goes on; leave it out, or add --separate always"
        )
    if options.train_config is not None:
        config.load(options.train_config)  # its mistakes are said before anything is written
    if _has_gpu(options):
        # a training needs seconds to begin, and none that pass next to the first measurement
        threading.Thread(target=_begin_gpu, daemon=True).start()
    given = Path(options.robot)
    run = run_dir.create(options.log_dir, EXPERIMENT, robot_name(given))
    with _removed_on_error(run):
        start = _start(options, run, reporter)
    name, robot, checkpoint, before = start.name, start.robot, start.checkpoint, start.before
    wanted = [each for each in before if each == name or walks(before[each])]
    reporter.message(f"begins with {bundled.shown(checkpoint)}: {_verdict(before, wanted)}")
    if walks(before[name]):
        if not sources.is_description(options.robot):
            shutil.rmtree(run, ignore_errors=True)
        return Result(name, robot, checkpoint, before, before, True, [], _minutes(began))
    is_separate = _is_separate(options, robot, before[name])
    first = None
    with _removed_on_error(run):
        pretrained = _pretrained(options, robot) if is_separate else None
        of_run, plan = _plan(options, start, run, is_separate, pretrained)
        if pretrained is not None:
            first = _first_point(pretrained, plan, run, options)
    if pretrained is not None and first is not None:
        of_run = dataclasses.replace(of_run, init=first.checkpoint)
        said = _verdict(first.robots, [name])
        reporter.message(f"{name}: a separate network begins with a bundled one: {said}")
        if walks(first.robots[name]):
            return Result(name, robot, first.checkpoint, before, first.robots, True, [], _minutes(began))
    elif is_separate:
        reporter.message(f"{name}: a separate network begins from scratch")
    every = EVERY_PRETRAINED if pretrained is not None else EVERY_FROM_SCRATCH if is_separate else EVERY
    goal = UntilWalks(
        options.every or every,
        wanted,
        say=lambda point: reporter.message(progress_line(point, wanted)),
        deadline=began + 60.0 * options.max_minutes,
        threads=options.threads,
        only_promising=is_separate,
        tell=reporter.message,
        first=first,
    )
    _, runner = session.train_with(of_run, Workers.alone(), goal=goal, plan=plan, reporter=reporter)
    runner.env.unwrapped.close()
    stopped_by = None if runner.stopped_by is None else int(runner.stopped_by)
    last = run_dir.checkpoint_path(run, runner.current_learning_iteration)
    if goal.best is None or not goal.points:
        # interrupted before the first measurement
        if first is not None and first.checkpoint != last:
            run_dir.remove_checkpoint(first.checkpoint)
        return Result(name, robot, last, before, {}, False, [], _minutes(began), stopped_by)
    best, after, unfinished = goal.best.checkpoint, goal.best.robots, None
    if rank(after, wanted) <= rank(before, wanted):
        # a policy that no measurement beats stays what it was
        unfinished = best if is_separate else None
        best, after = checkpoint, before
    elif goal.walked and goal.confirmation is not None:
        after = goal.confirmation
    elif stopped_by is None:
        after = _measured(best, None, [], options)
    if goal.best.checkpoint != last:
        run_dir.remove_checkpoint(last)
    return Result(
        name,
        robot,
        best,
        before,
        after,
        goal.walked,
        goal.points,
        _minutes(began),
        stopped_by,
        unfinished,
    )


@contextlib.contextmanager
def _removed_on_error(run: Path) -> Iterator[None]:
    """Removes a run that cannot begin."""
    try:
        yield
    except BaseException:
        shutil.rmtree(run, ignore_errors=True)
        raise


def _start(options: Options, run: Path, reporter: Reporter) -> Start:
    """Drafts the robot of a file, and chooses and measures the policy to begin with."""
    is_drafted = sources.is_description(options.robot)
    above = _above_legs_of_file(options) if is_drafted and options.legs_alone == "always" else {}
    robot = _draft(options, run, reporter, above) if is_drafted else run_dir.source(options.robot)
    checkpoint = options.checkpoint or _fitting_policy(robot)
    run_dir.load_checkpoint(checkpoint)  # a broken one is refused by its name
    manifest = run_dir.read_manifest(checkpoint)
    ((name, body),) = descriptions.describe([robot]).items()
    training = descriptions.training_of(manifest, str(checkpoint))
    if training is not None and name not in training.bodies:
        reporter.message(f"{name}: its description is {training.distance(body)}")
    library = {entry["name"] for entry in _core.robots()}
    near = [] if training is None else [of for of in training.nearest(body) if of in library and of != name]
    neighbours = near[: options.neighbours]
    changes = _changes(manifest, robot, name, near[:1], options.overrides)
    is_alone = _is_alone(options, robot)
    before = _measured(checkpoint, [robot, *neighbours], changes, options, GLANCE) if is_alone else {}
    if not before or not _is_separate(options, robot, before[name]):
        before = _measured(checkpoint, [robot, *neighbours], changes, options)
    is_bound = options.checkpoint is not None or neighbours or options.separate == "always"
    other = None if is_bound else _other_policy(checkpoint, robot)
    if other is not None and not walks(before[name]):
        checkpoint, before = _better(checkpoint, before, other, robot, name, near[:1], options)
    if is_drafted and options.legs_alone == "auto" and _is_separate(options, robot, before[name]):
        joints = len(_robot_of(robot)["slots"])
        if joints > (MANY_JOINTS_FROM_SCRATCH if _pretrained(options, robot) is None else MANY_JOINTS):
            reporter.message(
                f"{name}: of its {joints} joints those of the legs alone move; --legs-alone never moves all"
            )
            robot = _draft(options, run, reporter, _above_legs(robot))
            changes = _changes(manifest, robot, name, near[:1], options.overrides)
            before = _measured(checkpoint, [robot], changes, options, GLANCE)
            if other is not None:
                checkpoint, before = _better(checkpoint, before, other, robot, name, near[:1], options)
    return Start(name, robot, near[:1], neighbours, checkpoint, changes, before)


def _plan(
    options: Options, start: Start, run: Path, is_separate: bool, pretrained: Path | None
) -> tuple[session.Options, session.Plan]:
    """The training of the policy, or of a separate network, which may begin with `pretrained`."""
    of_run = session.Options(
        init=None if is_separate else start.checkpoint,
        seed=options.seed,
        device=options.device,
        threads=options.threads,
        log_dir=options.log_dir,
        run=run,
        origin=options.command,
    )
    slots: list[str] = []
    if is_separate:
        train_config = _own_train_config(options, pretrained)
        overrides = [] if pretrained is None else of_observation(run_dir.read_manifest(pretrained)["overrides"])
        task = {"task": train_config.run.task, "overrides": overrides}
        own_set = _set_of_two_legs(start.robot)
        changes = _changes(task, start.robot, start.name, start.nearest, options.overrides, own_set)
    else:
        manifest = run_dir.read_manifest(start.checkpoint)
        # shares of the training alone, which no evaluation needs
        count = len(start.neighbours)
        shares = [f"env_shares.{start.name}={count}"] if count > 1 else []
        has_critic = "critic_state_dict" in run_dir.load_checkpoint(start.checkpoint)
        train_config = _train_config(options, manifest, shares, has_critic)
        # a policy that was taught had sensors better than the task's; later changes outweigh this
        # one
        is_taught = "distillation" in manifest["train_config"]
        changes = [NO_NOISE, *start.changes] if is_taught else start.changes
        if manifest["policy"]["class_name"] != URMA:
            slots = manifest["canonical_joint_names"]
    robots = [start.robot, *start.neighbours]
    return of_run, session.settle(of_run, train_config, changes, robots=robots, slots=slots)


def _draft(options: Options, run: Path, reporter: Reporter, above: Mapping[str, float]) -> str:
    """Drafts a file's config next to the run; returns its path.

    URDFs are drafted like `polypod robot new`, other files like `polypod add`. `above` are joints
    above the legs that are held, and their positions.
    """
    folder = run / ("legs_alone" if above else "robot")
    folder.mkdir()
    new, notes = _drafted(options, folder, {**above, **options.locked_joints})
    reporter.message(f"drafted {new.path}")
    for note in notes:
        reporter.message(f"  {note}")
    return run_dir.source(str(new.path))


def _drafted(options: Options, folder: Path, held: Mapping[str, float]) -> tuple[NewRobot, Sequence[str]]:
    """Drafts a file's config in a folder, with joints held; returns it and what it assumes."""
    file = Path(options.robot)
    name = robot_name(file)
    given: dict[str, Any] = {"package_dirs": options.package_dirs, "locked_joints": held}
    if file.suffix == URDF:
        new = new_robot(file, folder / f"{name}.toml", **given)
        return new, new.notes
    is_taken = any(entry["name"] == name for entry in _core.robots())
    added = add(options.robot, folder, name=f"{name}_file" if is_taken else name, **given)
    return added.new, added.notes


def _above_legs_of_file(options: Options) -> dict[str, float]:
    """`_above_legs` of a file that is not drafted yet."""
    with tempfile.TemporaryDirectory() as scratch:
        new, _ = _drafted(options, Path(scratch), options.locked_joints)
        return _above_legs(str(new.path))


def _above_legs(source: str) -> dict[str, float]:
    """Joints of a robot that are no leg's, and their default positions, rad."""
    robot = _robot_of(source)
    names, pose = robot["joint_names"], robot["default_pose"]
    are_of_legs = zip(robot["joint_of_slot"], _core.slots_of_legs(robot["slots"]), strict=True)
    return {names[joint]: pose[joint] for joint, is_of_leg in are_of_legs if not is_of_leg}


def _robot_of(source: str) -> simulated.RobotInfo:
    """Numbers of a robot, by its name or the path of its config."""
    sim = _core.VecSim(_core.play_task(descriptions.TASK), 1, robots=[source], threads=1)
    (robot,) = simulated.robots(sim).values()
    return robot


def _fitting_policy(robot: str) -> Path:
    """The bundled policy to begin with, by the number of legs."""
    info = _robot_of(robot)
    return bundled.checkpoint(FOUR_LEGS if len(info["legs"]) == 4 else OTHERS)


def _better(
    checkpoint: Path,
    before: dict[str, Walking],
    other: Path,
    robot: str,
    name: str,
    nearest: Sequence[str],
    options: Options,
) -> tuple[Path, dict[str, Walking]]:
    """The other policy and its figures if the robot walks with it, else the first ones."""
    changes = _changes(run_dir.read_manifest(other), robot, name, nearest, options.overrides)
    found = _measured(other, [robot], changes, options)
    return (other, found) if walks(found[name]) else (checkpoint, before)


def _other_policy(checkpoint: Path, robot: str) -> Path | None:
    """The policy that a robot is measured with if it does not walk with the first.

    Robots on four legs are measured with the policy of all legs, robots on two legs with ankles
    with that of strangers.
    """
    if checkpoint == bundled.checkpoint(FOUR_LEGS):
        return bundled.checkpoint(OTHERS)
    return bundled.of_strangers(2) if _set_of_two_legs(robot) == "two_legs" else None


def _set_of_two_legs(robot: str) -> str | None:
    """The reward set in units of the body of a robot on two legs; None for other numbers."""
    info = _robot_of(robot)
    if len(info["legs"]) != 2:
        return None
    return "two_legs" if any("_ANKLE_PITCH" in slot for slot in info["slots"]) else "two_points"


def _changes(
    manifest: Mapping[str, Any],
    robot: str,
    name: str,
    nearest: Sequence[str],
    given: Sequence[str],
    own_set: str | None = None,
) -> list[str]:
    """`key=value` pairs of the task: the policy's, and a reward set for a robot new to the task.

    The set is `own_set`, or that of the robot with the nearest description.
    """
    trained = descriptions.without_shares(manifest["overrides"])
    of_robot = []
    key = f"robot_overrides.{name}.reward_set"
    if robot.endswith(".toml") and own_set is not None:
        of_robot = [f"{key}={own_set}"]
    elif robot.endswith(".toml") and nearest and not any(change.startswith(f"{key}=") for change in trained):
        # a draft names a set of another task; the robot that is described most like it has this
        # task's
        sim = _core.VecSim(manifest["task"], 1, robots=list(nearest), threads=1, overrides=trained)
        (like,) = simulated.config(sim)["robots"].values()
        of_robot = [f"{key}={like['reward_set']}"]
    of_task, _ = config.split_overrides(given)
    return [*trained, *of_robot, *of_task]


def _has_gpu(options: Options) -> bool:
    return options.device != "cpu" and torch.cuda.is_available()


def _begin_gpu() -> None:
    """Makes what a training on a GPU needs: torch's context, and the simulator's kernels."""
    # the training says what is wrong
    with contextlib.suppress(RuntimeError, AssertionError):
        torch.zeros(1, device="cuda")
    with contextlib.suppress(RuntimeError, _core.PolypodError):
        _smallest("cuda").device_arrays()


def _smallest(engine: str) -> _core.VecSim:
    """A simulator with an engine; one kernel of a card steps all robots."""
    robots = [_core.robots()[0]["name"]]
    return _core.VecSim(descriptions.TASK, 1, robots=robots, threads=1, overrides=[f"physics.engine={engine}"])


def _is_separate(options: Options, robot: str, before: Walking) -> bool:
    """Whether a separate network promises more than the policy; a given policy is kept."""
    if options.separate != "auto":
        return options.separate == "always"
    falls_at_once = before.fall_rate > HOPELESS and math.isnan(before.turn_reached) and math.isnan(before.drift_xy)
    return falls_at_once and _is_alone(options, robot)


def _is_alone(options: Options, robot: str) -> bool:
    """Whether the robot gets a separate network if the policy falls with it at once.

    Without a GPU only robots on two legs: those on more walk sooner with the policy.
    """
    return not _is_bound(options) and (_has_gpu(options) or _set_of_two_legs(robot) is not None)


def _is_bound(options: Options) -> bool:
    """Whether the options say what is trained, and leave nothing to the figures of the policy."""
    return options.checkpoint is not None or options.neighbours > 0 or options.separate != "auto"


def _pretrained(options: Options, robot: str) -> Path | None:
    """The network with which a separate one begins; None: it begins from scratch."""
    return None if options.from_scratch else bundled.pretrained(len(_robot_of(robot)["legs"]))


def _first_point(pretrained: Path, plan: session.Plan, run: Path, options: Options) -> Point:
    """Writes the run's first checkpoint, a pretrained network for the robot, and measures it."""
    settings, robots = plan.config, plan.robots or []
    # the CPU has the bits of a card
    changes = [*settings.run.task_changes, *plan.overrides]
    sim = _core.VecSim(
        settings.run.task,
        growth.SAMPLES,
        robots=robots,
        seed=plan.seed,
        threads=options.threads,
        overrides=engines.on_the_cpu(changes),
    )
    state = growth.grow(pretrained, sim, robots, settings)
    run_dir.write_params(run, sim, settings, robots, plan.overrides, options.command)
    checkpoint = run_dir.checkpoint_path(run, 0)
    run_dir.save_checkpoint(checkpoint, lambda file: torch.save(state, file))
    return Point(0, 0, 0.0, _measured(checkpoint, None, [], options), checkpoint)


def _own_train_config(options: Options, pretrained: Path | None) -> TrainConfig:
    """The settings of a separate network; task and networks are those of a pretrained one."""
    _, of_training = config.split_overrides(options.overrides)
    name = options.train_config or SEPARATE
    if pretrained is None:
        return config.load(name, of_training)
    if given := [change for change in of_training if change.startswith(_NETWORKS)]:
        raise _core.ConfigError(
            f"--set train.{given[0][:80]}: the separate network begins with a bundled one; leave it out, or add "
            "--from-scratch"
        )
    tables, manifest = config.load(name).as_dict(), run_dir.read_manifest(pretrained)
    tables["run"] = {**tables["run"], "task": manifest["task"]}
    has_critic = "critic_state_dict" in run_dir.load_checkpoint(pretrained)
    return _with_networks(tables, manifest, has_critic, name, of_training)


def _train_config(
    options: Options, manifest: Mapping[str, Any], shares: Sequence[str], has_critic: bool
) -> TrainConfig:
    """The settings of the train config with networks, task and ranges of the policy."""
    _, of_training = config.split_overrides(options.overrides)
    name = options.train_config or (ON_GPU if _has_gpu(options) else TRAIN_CONFIG)
    tables, policy = config.load(name).as_dict(), manifest["train_config"]
    kept = {key: policy["run"][key] for key in _OF_POLICY if key in policy["run"]}
    changes = descriptions.without_shares(kept.get("task_changes", []))
    tables["run"] = {**tables["run"], **kept, "task_changes": [*changes, *shares], "task": manifest["task"]}
    return _with_networks(tables, manifest, has_critic, name, of_training)


def _with_networks(
    tables: dict[str, Any], manifest: Mapping[str, Any], has_critic: bool, name: str, changes: Sequence[str]
) -> TrainConfig:
    """The settings `tables`, with changes and with networks of a manifest's sizes."""
    for section in _NETWORKS:
        if section in manifest["train_config"]:
            tables[section] = manifest["train_config"][section]
    if not has_critic:
        # advantages of a critic that knows nothing yet undo the policy
        least = max(CRITIC_WARMUP, tables["algorithm"]["critic_warmup_iterations"])
        tables["algorithm"] = {**tables["algorithm"], "critic_warmup_iterations": least}
    return config.changed(config.parse(tables, f"{name} for the policy"), list(changes), "adapt")


def _measured(
    checkpoint: Path,
    robots: list[str] | None,
    changes: Sequence[str],
    options: Options,
    envs_per_robot: int = ENVS_PER_ROBOT,
) -> dict[str, Walking]:
    """Figures with the seed that selects nothing."""
    count = len(run_dir.read_manifest(checkpoint)["robots"]) if robots is None else len(robots)
    with torch_threads(1) if envs_per_robot * count <= GLANCE else contextlib.nullcontext():
        result = evaluate_checkpoint(
            checkpoint,
            robots,
            num_envs=envs_per_robot * count,
            seed=CONFIRMING_SEED,
            threads=options.threads,
            overrides=changes,
        )
    return {name: robot.walking for name, robot in result.robots.items() if robot.walking is not None}


def _verdict(figures: Mapping[str, Walking], wanted: Sequence[str]) -> str:
    """Says how many robots walk, and why the others do not."""
    reasons = {name: "; ".join(why_not(walking)) for name, walking in figures.items()}
    walking = f"{sum(not reason for reason in reasons.values())} of {len(reasons)} walk"
    return "; ".join([walking, *(f"{name}: {reasons[name]}" for name in wanted if reasons[name])])


def _minutes(began: float) -> float:
    return (time.monotonic() - began) / 60.0


def table(result: Result) -> Rows:
    """The figures of the definition of walking before and after."""
    rows = None
    for name, before in result.before.items():
        for when, figures in (("before", before), ("after", result.after.get(name))):
            if figures is None:
                continue
            cells = walking_cells(figures)
            rows = rows or Rows("robot", *cells)
            rows.add_row(f"{name}, {when}", *cells.values())
    return rows or Rows("robot")


def verdict(result: Result) -> str:
    """The end of an adaptation in words."""
    spent = f"{result.minutes:.1f} min"
    if result.points:
        spent = f"{result.points[-1].samples / 1e6:.2f} million samples, {spent}"
    shown = bundled.shown(result.checkpoint)
    robots = f" --robots {result.robot}"
    if result.walks and not result.points:
        return f"{result.name} walks without training; see it:  polypod play --checkpoint {shown}{robots}"
    if result.walks:
        return f"{result.name} walks after {spent}; see it:  polypod play --checkpoint {shown}"
    if not result.after:
        return f"interrupted before the first measurement, after {spent}; {shown}"
    reasons = {name: "; ".join(why_not(walking)) for name, walking in result.after.items()}
    why = "; ".join(f"{name}: {reason}" for name, reason in reasons.items() if reason)
    end = "interrupted" if result.stopped_by is not None else "it does not walk"
    if result.unfinished is None:
        next_step = f"go on with  polypod adapt {result.robot} --checkpoint {shown}"
    else:
        next_step = (
            "the separate network does not beat it yet; go on with  "
            f"polypod adapt {result.robot} --checkpoint {result.unfinished} --train-config {SEPARATE}"
        )
    return (
        f"{result.name}: {end} after {spent}; {why or 'it walks with one of two seeds'}. The best policy is {shown}; "
        f"{next_step}"
    )


class Progress(Reporter):
    """Shows messages, and no lines of iterations."""

    @contextlib.contextmanager
    def training(self, start: int, stop: int) -> Iterator[None]:
        """Shows nothing while the context lasts."""
        yield

    def iteration(self, figures: Iteration) -> None:
        """Shows nothing."""

    def robots(self, stats: Mapping[str, Mapping[str, float]]) -> None:
        """Shows nothing."""
