"""Running the battery."""

import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

from polypod import _core, bundled, runs, text
from polypod.policy import LoadedPolicy, load
from polypod.provenance import measured
from polypod.robustness import in_polypod
from polypod.robustness.conditions import CONDIMS, Condition, chosen
from polypod.robustness.in_mujoco import AS_IS, MakersModel, Mujoco
from polypod.robustness.in_polypod import Nominal, Setting
from polypod.robustness.results import Battery, Cell, Row, cell
from polypod.sim2sim import on_model

SIMULATORS = ("polypod", "mujoco")
MAX_ENVS = 100_000
"""Envs of one robot."""

Progress = Callable[[str, int, int], None]
"""Called with a simulator, the runs of one condition done and those to do; in MuJoCo each robot is
a run."""

_NO_COMMANDS = "its command box has no such commands"
_NO_DESCRIPTION = "the observation does not describe the robot"
_POLYPOD_ALONE = "the randomisation of a training is polypod's alone"


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of a battery."""

    conditions: tuple[str, ...] | None = None
    """Names of conditions or families; None: all."""
    simulators: tuple[str, ...] = SIMULATORS
    condims: tuple[int, ...] | None = None
    """Dimensions of MuJoCo's contacts; None: those of each condition."""
    num_envs: int = 100
    """Envs per robot and condition in polypod: one of a hundred falls is 1 %."""
    mujoco_envs: int = 2
    """Envs per robot and condition in MuJoCo."""
    steps: int | None = None
    """Control steps per episode; None: a whole one."""
    seed: int = 0
    threads: int | None = None
    """None: one per core."""
    overrides: tuple[str, ...] = ()
    """`key=value` changes to the task, on top of the run's own and below those of the
    conditions."""
    model: MakersModel | None = None
    """Maker's model in place of polypod's robot in MuJoCo."""

    def check(self) -> None:
        """Raises ConfigError or UnknownNameError for what cannot be run."""
        for flag, count, most in (
            ("--num-envs", self.num_envs, MAX_ENVS),
            ("--mujoco-envs", self.mujoco_envs, MAX_ENVS),
            ("--steps", self.steps, 2**31 - 1),
        ):
            if count is not None and not 1 <= count <= most:
                raise _core.ConfigError(f"{flag} {count} must be from 1 to {most}")
        for name in self.simulators:
            if name not in SIMULATORS:
                raise _core.UnknownNameError(f"there is no simulator {name[:80]!r}; use {' or '.join(SIMULATORS)}")
        for condim in self.condims or ():
            if condim not in CONDIMS:
                raise _core.ConfigError(f"--condims {condim} must be 3, 4 or 6")
        chosen(self.conditions)


def measure(
    checkpoint: Path,
    robots: Sequence[str] | None = None,
    options: Options | None = None,
    progress: Progress = lambda simulator, done, total: None,
) -> Battery:
    """Runs a policy through the battery.

    The figures depend on the policy, the robots and the options but `threads` alone.

    Args:
        checkpoint: a `model_<n>.pt` next to its manifest, an ONNX file that says its task, or a
            bundled policy.
        robots: names or paths of configs; None: those that the policy was trained on.
        options: see `Options`.
        progress: told how far the battery is.

    Raises:
        ConfigError: for a checkpoint, robot or option that cannot be used, and with MuJoCo for what
            `polypod.sim2sim.compare` refuses.
    """
    options = options or Options()
    options.check()
    if options.model is not None and robots is None:
        robots = [on_model.robot_of(options.model.file, load(checkpoint).robots)]
    loaded = load(checkpoint, robots=robots)
    sources = list(loaded.manifest["robot_sources"] if robots is None else robots)
    if options.model is not None and len(sources) != 1:
        raise _core.ConfigError(f"--robots {','.join(sources)}: --model is a model of one robot; name one")
    setting = Setting.of(
        loaded.manifest,
        sources,
        given=options.overrides,
        seed=options.seed,
        steps=options.steps,
        threads=options.threads,
    )
    conditions = chosen(options.conditions)
    when = measured()
    nominal = Nominal.of(setting, options.num_envs)
    rows: dict[tuple[str, str], Row] = {}
    if "mujoco" in options.simulators:
        # it refuses what it cannot do before the minutes that polypod takes
        mujoco = Mujoco(loaded, setting, options.mujoco_envs, options.model)
    if "polypod" in options.simulators:
        for done, condition in enumerate(conditions):
            rows[condition.name, "polypod"] = _in_polypod(loaded, setting, nominal, condition, options.num_envs)
            progress("polypod", done + 1, len(conditions))
    if "mujoco" in options.simulators:
        rows |= _in_mujoco(mujoco, nominal, conditions, options, progress)
    sim = setting.sim(1)
    order = {condition.name: place for place, condition in enumerate(conditions)}
    return Battery(
        checkpoint={"file": bundled.shown(runs.resolve(checkpoint)), "sha256": loaded.sha256},
        command=_command(checkpoint, robots, options),
        task=sim.task_name,
        seed=options.seed,
        duration_s=setting.length(sim) * sim.step_dt,
        envs={
            name: count
            for name, count in (("polypod", options.num_envs), ("mujoco", options.mujoco_envs))
            if name in options.simulators
        },
        robots=list(nominal.robots),
        rows=[rows[key] for key in sorted(rows, key=lambda key: (order[key[0]], key[1] != "polypod", key[1]))],
        measured=when,
    )


def _in_polypod(loaded: LoadedPolicy, setting: Setting, nominal: Nominal, condition: Condition, num_envs: int) -> Row:
    if condition.description_error > 0.0 and not len(nominal.columns):
        return Row(condition.name, condition.varies, "polypod", {}, dict.fromkeys(nominal.robots, _NO_DESCRIPTION))
    ran = in_polypod.run(setting, nominal, condition, loaded.runner(), num_envs, lambda done, total: None)
    cells = {
        name: cell(ran.record, ran.envs[name], condition.bound.of(body), whole=setting.steps is None)
        for name, body in nominal.robots.items()
        if name not in ran.lacking
    }
    return Row(condition.name, condition.varies, "polypod", cells, dict.fromkeys(ran.lacking, _NO_COMMANDS))


def _in_mujoco(
    mujoco: Mujoco, nominal: Nominal, conditions: Sequence[Condition], options: Options, progress: Progress
) -> dict[tuple[str, str], Row]:
    rows: dict[tuple[str, str], Row] = {}
    jobs = []
    for condition in conditions:
        for condim in _condims(condition, options):
            simulator = "mujoco" if options.model is None else "model"
            row = Row(
                condition.name, condition.varies, simulator if condim == AS_IS else f"{simulator}-{condim}", {}, {}
            )
            rows[row.condition, row.simulator] = row
            for body in nominal.robots.values():
                if condition.twin is None:
                    row.not_applicable[body.name] = _POLYPOD_ALONE
                elif condition.description_error > 0.0 and not len(nominal.columns):
                    row.not_applicable[body.name] = _NO_DESCRIPTION
                elif mujoco.schedule(condition, body) is None:
                    row.not_applicable[body.name] = _NO_COMMANDS
                else:
                    jobs.append((row, condition, condim, body))

    def work(condition: Condition, condim: int, name: str) -> Cell:
        body = nominal.robots[name]
        schedule = mujoco.schedule(condition, body)
        assert schedule is not None  # such a robot has no job
        record = mujoco.run(condition, condim, body, schedule)
        return cell(record, slice(None), condition.bound.of(body), whole=options.steps is None)

    with ThreadPoolExecutor(options.threads or os.cpu_count() or 1) as threads:
        waiting = {
            threads.submit(work, condition, condim, body.name): (row, body) for row, condition, condim, body in jobs
        }
        try:
            for done, future in enumerate(_as_they_end(waiting)):
                row, body = waiting[future]
                row.robots[body.name] = future.result()
                progress("mujoco", done + 1, len(jobs))
        except BaseException:
            mujoco.stop()
            threads.shutdown(wait=False, cancel_futures=True)
            raise
    for row in rows.values():
        in_order = {name: row.robots[name] for name in nominal.robots if name in row.robots}
        row.robots.clear()
        row.robots.update(in_order)
    return rows


def _condims(condition: Condition, options: Options) -> tuple[int, ...]:
    """Dimensions of MuJoCo's contacts; a maker's model keeps its own, unless varied."""
    if options.condims is not None:
        return options.condims
    is_of_contacts = 3 not in condition.condims
    return condition.condims if options.model is None or is_of_contacts else (AS_IS,)


def _as_they_end(futures: Iterable[Future[Cell]]) -> Iterator[Future[Cell]]:
    """The futures as they end; the main thread hears Ctrl-C meanwhile."""
    left = set(futures)
    while left:
        ended, left = wait(left, timeout=0.5, return_when=FIRST_COMPLETED)
        yield from ended


def _command(checkpoint: Path, robots: Sequence[str] | None, options: Options) -> str:
    given: dict[str, Any] = {
        "--checkpoint": bundled.shown(runs.resolve(checkpoint)),
        "--robots": None if robots is None else list(robots),
        "--conditions": None if options.conditions is None else list(options.conditions),
        "--simulators": list(options.simulators),
        "--condims": None if options.condims is None else list(options.condims),
        "--num-envs": options.num_envs,
        "--mujoco-envs": options.mujoco_envs,
        "--steps": options.steps,
        "--seed": options.seed,
    }
    if options.model is not None:
        choices = options.model.choices
        given |= {"--model": str(options.model.file), "--actuators": choices.actuators, "--contact": choices.contact}
        given["--map"] = options.model.map
    return text.command_line(("polypod", "robustness"), given, {"--set": options.overrides})
