"""`polypod sim2sim`."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from polypod import _core
from polypod.commands.arguments import (
    Count,
    Overrides,
    RobotNames,
    Velocity,
    arg,
    check_names,
    names,
    options_of,
    write_json,
)

if TYPE_CHECKING:
    from polypod.evaluation.tracking import ClipResult
    from polypod.sim2sim import Options


@dataclasses.dataclass(frozen=True)
class Sim2sim:
    """Let the exported policy drive the same robots in MuJoCo and in polypod.

    Needs the extras export and bench. Policies that get up or track motions are judged by that.

    Exit code 3 when a robot does not walk in MuJoCo, by the definition that eval judges by, or does
    not get up or track its motions there.
    """

    checkpoint: Path
    """A model_<n>.pt next to its manifest.json, a policy as ONNX, the name of a run or the end of
    it, or a bundled policy: flat, rough, legged, quadruped or two_legs."""
    robots: RobotNames = None
    """Names of the robots, with commas between. Default: the run's; with --model, the one whose
    joints it has."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    num_envs: Count = None
    """Envs per robot; for a policy that tracks motions, per robot and motion. Default: 32, with
    --model 20, with motions 16."""
    steps: Count = None
    """Control steps per episode. Default: 20 s, or a whole one."""
    commands: Annotated[Literal["walking", "task", "phases"] | None, arg(metavar="{walking,task,phases}")] = None
    """Commands of the episodes: those that walking is judged by, new ones every 5 s with turns,
    side-steps and stops; as the task draws them; or --phases. Default: walking, with --model
    phases."""
    command: Velocity = None
    """One forward and left velocity (m/s) and yaw rate (rad/s) for all envs, in place of
    --commands."""
    dt: Annotated[float | None, arg(metavar="S")] = None
    """MuJoCo's physics step, s. Default: the task's, on terrain and with motions 0.002; with
    --model the file's."""
    integrator: Annotated[Literal["implicitfast", "RK4"] | None, arg(metavar="{implicitfast,RK4}")] = None
    """Integrator of MuJoCo. Default: implicitfast; with --model the file's."""
    friction: Annotated[float | None, arg(metavar="MU")] = None
    """Friction coefficient of the ground in MuJoCo, with --model of all contacts. Default: the
    task's static friction, with --model the file's."""
    soft_contact: bool = False
    """MuJoCo's default contacts in place of the stiffest ones that the step allows."""
    seed: int = 0
    """Seed of initial states, commands and delays."""
    model: Annotated[Path | None, arg(metavar="FILE")] = None
    """Another MuJoCo model of the robot in place of polypod's: an MJCF file of the robot or of a
    scene, with its own masses, contacts, damping and actuators."""
    map: Annotated[Path | None, arg(metavar="FILE")] = None
    """TOML file that names the joints of --model where names and geometry do not tell."""
    actuators: Literal["model", "policy", "motors"] = "model"
    """Actuators of --model: its own; the policy's gains, limits and delays; or these with the
    rotors' inertia."""
    contact: Literal["asis", "stiff", "condim3"] = "asis"
    """Contacts of --model: its own; as stiff as the step allows; or without torsional and rolling
    friction."""
    phases: Annotated[str | None, arg(metavar="A,B")] = None
    """Commands of --model one after the other: forward, back, left, right (m/s), turn (rad/s),
    stop. Default: forward=0.8,turn=0.6,left=0.5,stop."""
    phase_s: Annotated[float, arg(metavar="S")] = 5.0
    """Length of a phase, s."""
    rounds: int = 1
    """Number of times that an episode goes through the phases."""
    differences: bool = True
    """Rank the differences of --model from polypod's robot by their effect on one step response."""
    video: Annotated[Path | None, arg(metavar="FILE")] = None
    """Film polypod above and --model below (.gif, .webp, .mp4); needs the extra play."""
    terms: Annotated[Path | None, arg(metavar="FILE")] = None
    """Python file of terms that the run began with; the file is run, see docs/write-a-term.md. Its
    commands, observations and terminations see MuJoCo's state."""
    set: Overrides = ()
    """Changes the task's configuration, on top of the run's own changes. May be repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        check_names(None, names(self.robots))
        self._check()
        return self._in_mujoco() if self.model is None else self._on_model(self.model)

    def _check(self) -> None:
        """Raises ConfigError for flags that do not go together."""
        usual = {field.name: field.default for field in dataclasses.fields(self)}
        if self.model is None:
            for key in ("map", "actuators", "contact", "phases", "phase_s", "rounds", "differences", "video"):
                if getattr(self, key) != usual[key]:
                    raise _core.ConfigError(f"--{key.replace('_', '-')} needs --model FILE, a MuJoCo model")
            if self.commands == "phases":
                raise _core.ConfigError("--commands phases needs --model FILE, a MuJoCo model")
            return
        for key, instead in (
            ("steps", "choose --phase-s and --rounds"),
            ("command", "choose --phases, such as forward=0.5"),
            ("soft_contact", "choose --contact"),
            ("terms", "leave out --model: terms see polypod's own model of the robot"),
        ):
            if getattr(self, key) != usual[key]:
                raise _core.ConfigError(f"--{key.replace('_', '-')} does not go with --model; {instead}")
        if self.commands == "task":
            raise _core.ConfigError("--commands task does not go with --model; choose phases or walking")
        if self.commands == "walking" and self.phases is not None:
            raise _core.ConfigError("--phases does not go with --commands walking; leave one out")
        robots = names(self.robots)
        if robots is not None and len(robots) != 1:
            raise _core.ConfigError(f"--robots {self.robots}: --model is a model of one robot; name one")

    def _in_mujoco(self) -> int:
        from polypod import runs, sim2sim
        from polypod.progress import Progress
        from polypod.sim2sim import asked, on_rising
        from polypod.sim2sim.report import show, show_rising

        checkpoint, robots = runs.resolve(self.checkpoint), names(self.robots)
        if (asks := asked.of(checkpoint, robots, self.set)) != "velocity":
            self._refuse_commands(asks)
        if asks == "motions":
            return self._with_motions(checkpoint, robots)
        options = self._options()
        with Progress(14) as bars:

            def progress(name: str, done: int, total: int) -> None:
                bars(name if name == "polypod" else f"mujoco {name}", done, total)

            if asks == "rising":
                risen = on_rising.compare(checkpoint, robots, options, progress)
            else:
                comparison = sim2sim.compare(checkpoint, robots, options, progress)
        if asks == "rising":
            show_rising(risen)
            write_json(self.json, risen.as_dict())
            return 0 if risen.transfers else 3
        show(comparison)
        write_json(self.json, comparison.as_dict())
        return 0 if comparison.transfers else 3

    def _options(self) -> "Options":
        from polypod.sim2sim import Options

        usual = Options()
        return options_of(
            Options,
            self,
            envs_per_robot=usual.envs_per_robot if self.num_envs is None else self.num_envs,
            commands="task" if self.commands == "task" else "walking",
            integrator=self.integrator or usual.integrator,
            overrides=self.set,
        )

    def _refuse_commands(self, asks: str) -> None:
        """Raises ConfigError for flags of a policy that follows no velocity command."""
        keys = ["commands", "command"]
        if asks == "motions":
            keys += ["steps", "terms"]
        usual = {field.name: field.default for field in dataclasses.fields(self)}
        for key in keys:
            if getattr(self, key) != usual[key]:
                what = "tracks motions" if asks == "motions" else "follows no velocity command"
                raise _core.ConfigError(f"--{key.replace('_', '-')}: the policy {what}; leave it out")

    def _with_motions(self, checkpoint: Path, robots: list[str] | None) -> int:
        from polypod.evaluation import tracking
        from polypod.sim2sim import on_motions

        found = {}
        how: dict[str, Any] = {"episodes": self.num_envs or 16, "seed": self.seed, "overrides": list(self.set)}
        measures: dict[str, Callable[..., dict[str, dict[str, ClipResult]]]] = {
            "polypod": tracking.measure_checkpoint,
            "MuJoCo": functools.partial(on_motions.measure_checkpoint, options=self._options()),
        }
        for where, measure in measures.items():
            found[where] = measure(checkpoint, robots, **how)
            print(f"in {where}")
            for text in tracking.lines_of(found[where]):
                print(text)
        write_json(self.json, {where.lower(): tracking.as_dict(results) for where, results in found.items()})
        return 0 if tracking.follows(found["MuJoCo"]) else 3

    def _on_model(self, model: Path) -> int:
        from polypod import runs
        from polypod.progress import Progress
        from polypod.sim2sim import model_report, on_model

        usual = on_model.Options()
        options = options_of(
            on_model.Options,
            self,
            episodes=usual.episodes if self.num_envs is None else self.num_envs,
            commands="walking" if self.commands == "walking" else "phases",
            phases=usual.phases if self.phases is None else self.phases,
            overrides=self.set,
        )
        options.check()
        film = None
        if self.video is not None:
            from polypod.sim2sim.side_by_side import SideBySide

            film = SideBySide(self.video)
        robots = names(self.robots)
        with Progress(14) as bars:
            comparison = on_model.play(
                model,
                runs.resolve(self.checkpoint),
                None if robots is None else robots[0],
                options,
                bars,
                None if film is None else film.watch,
            )
        model_report.show(comparison)
        write_json(self.json, comparison.as_dict())
        if film is not None:
            film.close(comparison.task, comparison.source, model.name, comparison.on_model.phases, self.phase_s)
        return 0 if comparison.transfers else 3
