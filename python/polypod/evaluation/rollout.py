"""Running a policy for the figures of an evaluation."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from polypod import _core, simulated
from polypod.arrays import Array
from polypod.evaluation import measures, rising, walking
from polypod.evaluation.results import Evaluation, RobotResult, robot_result
from polypod.motions.names import split
from polypod.networks.policies import Policy, reset
from polypod.python_terms import Terms
from polypod.registration import num_robots
from polypod.vector_env import simulator

ENVS_PER_ROBOT = 64

MAX_GRID = 1_000_000
"""Commands of a grid."""
MAX_STEPS = 10_000_000
"""Control steps of all episodes together: hours, even of few envs."""

Commands = Literal["walking", "task"]
"""Source of the commands: the schedule of `walking`, or the task's sampling."""

Grid = tuple[int, int, int]
"""Numbers of forward velocities, left velocities and yaw rates, each evenly over a robot's
range."""


def play_task(task: str) -> str:
    """The Play variant of a task: without noise, pushes, randomisation and curriculum.

    It is the task of that name, or one that the library makes. Raises UnknownNameError.
    """
    return _core.play_task(task)


def undisturbed(task: str, overrides: Sequence[str]) -> list[str]:
    """`key=value` pairs that switch off the disturbances of a task as `overrides` change it.

    A training may have changed the noise or an event; on top of a Play variant, such a change would
    switch it on.
    """
    return [f"{key}=false" for key in _core.disturbances(task, list(overrides))]


def evaluate(
    policy: Policy,
    task: str,
    robots: Sequence[str] | None = None,
    num_envs: int | None = None,
    episodes: int = 1,
    steps: int | None = None,
    seed: int = 0,
    threads: int | None = None,
    overrides: Sequence[str] = (),
    grid: Grid | None = None,
    randomized: bool = False,
    slots: Sequence[str] = (),
    trained: Sequence[str] = (),
    commands: Commands = "walking",
    terms: Terms | None = None,
) -> Evaluation:
    """Runs a policy in a task's Play variant.

    By default the commands are those that walking is judged by, see `polypod.evaluation.walking`.

    Args:
        policy: see `Policy`.
        task: name or alias of the task, or of its Play variant.
        robots: names of the robots; None: those of the task.
        num_envs: number of envs; None: `ENVS_PER_ROBOT` per robot.
        episodes: full episodes per env.
        steps: control steps per episode, when a whole one is too long; an env that still stands
            then has not fallen. None: a whole one, with the commands of `walking` at most 20 s
            of it.
        seed: of the first episode; each further one takes the next.
        threads: worker threads; None: one per core.
        overrides: `key=value` pairs for the task's configuration; they come last, and may switch on
            any noise or event.
        grid: let every episode hold one command of a grid, all commands equally often but for a
            remainder; None: see `commands`.
        randomized: with the noise, the pushes and the randomisation of the training.
        slots: names of the policy's actions, where it knows more robots than are here.
        trained: `key=value` pairs that the policy was trained with; their noise and events are on
            with `randomized` alone.
        commands: "walking" for the schedule that walking is judged by, "task" for commands as the
            task draws them; without effect with a grid.
        terms: terms of the task in Python; curricula and disturbing events of theirs are on with
            `randomized` alone.

    Raises:
        ConfigError: for an unknown task or robot, for counts below one, and for more than
            `MAX_STEPS` control steps.
    """
    _check(num_envs, episodes, steps, grid, commands)
    name = play_task(task)
    named = list(robots) if robots is not None else None
    switches = as_trained(name, trained) if randomized else undisturbed(name, trained)
    changes = [*trained, *switches, *overrides]
    of_task, _ = split(changes)
    if num_envs is None:
        num_envs = ENVS_PER_ROBOT * (len(named) if named else num_robots(name, of_task))
    sim = simulator(
        terms,
        name,
        num_envs,
        play=not randomized,
        robots=named,
        seed=seed,
        threads=threads,
        overrides=changes,
        autoreset="disabled",
        slots=list(slots),
    )
    configs = simulated.config(sim)
    if "base_velocity" not in configs["task"]["commands"]:
        if grid is not None:
            raise _core.ConfigError(f"{sim.task_name}: grid: the task gives no velocity command (`base_velocity`)")
        # nothing to schedule: the task draws what it asks for
        commands = "task"
    is_scheduled = grid is None and commands == "walking"
    longest = walking.episode_steps(sim.step_dt) if is_scheduled else sim.max_episode_length
    length = min(steps or longest, sim.max_episode_length)
    if episodes * length > MAX_STEPS:
        raise _core.ConfigError(
            f"episodes = {episodes} of {length} control steps are more than {MAX_STEPS:,} steps; "
            "choose smaller --episodes or --steps"
        )
    on_grid = _commands(sim, grid) if grid is not None else None
    runs, records, rises = [], [], []
    wanted = rising.goals(sim, configs)
    for episode in range(episodes):
        sim.reset(seed + episode)
        record, first = None, None
        if on_grid is not None:
            first = _held(sim, on_grid, episode)
        elif is_scheduled:
            record = walking.Record(walking.schedule_of(sim, length, seed + episode), sim.step_dt)
            records.append(record)
            first = record.schedule.at(0)
        if first is not None:
            # a seed releases the commands, so they are pinned after it; the second reset shows them
            # from the beginning
            sim.set_command(first)
            sim.reset()
        levels, kinds = sim.terrain_tiles()
        rise = rising.Record(sim, wanted) if wanted else None
        sums = {**_episode(sim, policy, length, record, rise), "level": levels.astype(np.float64)}
        if rise is not None:
            rises.append(rise.episodes())
        runs.append(sums if on_grid is None or first is None else {**sums, "command": first.astype(np.float64)})
    disturbances = _core.disturbances(name, of_task)
    figures = {key: np.stack([run[key] for run in runs]) for key in runs[0]}
    return Evaluation(
        task=sim.task_name,
        num_envs=sim.num_envs,
        episodes=episodes,
        steps=steps,
        seed=seed,
        overrides=list(overrides),
        duration_s=length * sim.step_dt,
        randomized=bool(disturbances),
        grid=grid,
        commands="grid" if grid is not None else commands,
        robots=_results(sim, figures, kinds, length, records, rises, wanted),
        disturbances=disturbances,
    )


def _check(num_envs: int | None, episodes: int, steps: int | None, grid: Grid | None, commands: Commands) -> None:
    """Refuses counts and names that no evaluation has."""
    for name, count in (("num_envs", num_envs), ("episodes", episodes), ("steps", steps), ("grid", min(grid or [1]))):
        if count is not None and count < 1:
            raise _core.ConfigError(f"{name} = {count} must be at least 1")
    if commands not in get_args(Commands):
        raise _core.ConfigError(f"commands = {commands!r}; use one of {', '.join(get_args(Commands))}")
    if grid is not None and np.prod(grid, dtype=object) > MAX_GRID:
        raise _core.ConfigError(f"grid = {grid} has more than {MAX_GRID:,} commands; choose fewer")


def _results(
    sim: _core.VecSim,
    figures: Mapping[str, Array],
    kinds: Sequence[str],
    length: int,
    records: Sequence[walking.Record],
    rises: Sequence[Mapping[str, Array]],
    wanted: Mapping[str, rising.Goal],
) -> dict[str, RobotResult]:
    """Figures of each robot, of [episodes, envs].

    Walking and getting up have figures where the episodes ask for them.
    """
    infos = simulated.robots(sim)
    gravity = float(np.linalg.norm(sim.gravity))
    results = {}
    for robot in sim.robots:
        envs = slice(*sim.env_ids(robot))
        of_robot = {key: value[:, envs] for key, value in figures.items()}
        found = robot_result(of_robot, length, sim.step_dt, infos[robot]["mass"] * gravity, kinds[envs])
        asked = walking.kinds_of(sim.command_ranges()[robot])
        risen = {key: np.concatenate([each[key][envs] for each in rises]) for key in ("up", "held") if rises}
        results[robot] = dataclasses.replace(
            found,
            robot_class=infos[robot]["class"],
            walking=walking.figures(records, envs, asked) if records else None,
            rising=rising.rising(**risen) if robot in wanted else None,
        )
    return results


def _episode(
    sim: _core.VecSim, policy: Policy, length: int, record: walking.Record | None, rise: rising.Record | None
) -> dict[str, Array]:
    """Sums of `measures.of_step` over each env's first episode.

    `record` says and sees the commands, `rise` sees who is up.
    """
    sums: dict[str, Array] = {}
    running = np.ones(sim.num_envs, dtype=np.bool_)
    reset(policy)
    for step in range(length):
        if record is not None and step and record.schedule.changes_at(step):
            sim.set_command(record.schedule.at(step))
        sim.step(policy(sim.observation))
        for key, value in measures.of_step(sim).items():
            sums[key] = sums.get(key, 0.0) + np.where(running, value, 0.0)
        if record is not None:
            record.add(sim.state("base_lin_vel")[:, :2], sim.state("base_ang_vel")[:, 2], sim.terminated)
        if rise is not None:
            rise.add(running & ~sim.terminated)
        done = sim.terminated | sim.truncated
        running &= ~done
        if not running.any():
            break
        if done.any():
            sim.reset(mask=done)
            reset(policy, done)
    return sums


def _commands(sim: _core.VecSim, grid: Grid) -> dict[str, npt.NDArray[np.float32]]:
    """Commands of each robot [n, 3], the last axis running fastest.

    A single value on an axis is the middle of the robot's range.
    """
    commands = {}
    for robot, ranges in sim.command_ranges().items():
        axes = []
        for key, count in zip(("lin_vel_x", "lin_vel_y", "ang_vel_z"), grid, strict=True):
            low, high = ranges[key]
            axes.append(np.linspace(low, high, count) if count > 1 else np.array([0.5 * (low + high)]))
        commands[robot] = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    return commands


def _held(sim: _core.VecSim, commands: Mapping[str, npt.NDArray[np.float32]], episode: int) -> npt.NDArray[np.float32]:
    """The commands of an episode, [num_envs, 3].

    Each robot's envs go on through the grid where the last one ended.
    """
    held = np.empty((sim.num_envs, 3), dtype=np.float32)
    for robot in sim.robots:
        start, stop = sim.env_ids(robot)
        grid = commands[robot]
        held[start:stop] = grid[(np.arange(stop - start) + episode * (stop - start)) % len(grid)]
    return held


def as_trained(play: str, trained: Sequence[str]) -> list[str]:
    """Overrides that give a Play variant the noise and the events of its task."""
    return [f"{key}=true" for key in _core.disturbances(_core.training_task(play), list(trained))]
