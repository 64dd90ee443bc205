"""`polypod robustness`."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from polypod import _core
from polypod.commands.arguments import (
    Count,
    Overrides,
    RobotNames,
    Robots,
    arg,
    check_names,
    names,
    options_of,
    torch_threads,
    write_json,
)

if TYPE_CHECKING:
    from polypod.robustness.in_mujoco import MakersModel


@dataclasses.dataclass(frozen=True)
class Robustness:
    """Run a policy through a fixed battery of conditions, in polypod and in MuJoCo.

    MuJoCo needs export and bench.

    Exit code 3 when a robot misses a bound; docs/robustness.md lists conditions and bounds.
    """

    checkpoint: Path
    """A model_<n>.pt next to its manifest.json, a policy as ONNX, the name of a run or the end of
    it, or a bundled policy: flat, rough, legged, quadruped or two_legs."""
    robots: RobotNames = None
    """Names of the robots, with commas between. Default: the run's."""
    conditions: Robots = None
    """Names of conditions or of families of them, with commas between, such as
    nominal,friction,turn. Default: all."""
    simulators: Annotated[str, arg(metavar="A,B")] = "polypod,mujoco"
    """Simulators that run: polypod, mujoco or both."""
    condims: Annotated[str | None, arg(metavar="N,N")] = None
    """Dimensions of MuJoCo's contacts for every condition: 3 (sliding), 4 (with torsional
    friction), 6 (with rolling friction). Default: 3, and 4 and 6 where they matter most."""
    num_envs: int = 100
    """Envs per robot and condition in polypod."""
    mujoco_envs: int = 2
    """Envs per robot and condition in MuJoCo."""
    steps: Count = None
    """Control steps per episode. Default: those of 20 s."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    picture: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also draw robots by conditions (.png, .svg, .pdf); needs the extra bench."""
    seed: int = 0
    """Seed of initial states, commands, pushes and wrong descriptions."""
    threads: Count = None
    """Threads of the simulators and the policy. Default: one per core."""
    model: Annotated[Path | None, arg(metavar="FILE")] = None
    """Another MuJoCo model of the robot in place of polypod's; see sim2sim."""
    map: Annotated[Path | None, arg(metavar="FILE")] = None
    """TOML file that names the joints of --model where names and geometry do not tell."""
    actuators: Literal["model", "policy", "motors"] = "model"
    """Actuators of --model: its own; the policy's gains, limits and delays; or these with the
    rotors' inertia."""
    contact: Literal["asis", "stiff", "condim3"] = "asis"
    """Contacts of --model: its own; as stiff as the step allows; or without torsional and rolling
    friction."""
    set: Overrides = ()
    """Changes the task's configuration, on top of the run's own changes and below the conditions'.
    May be repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code: 3 where a bound is missed."""
        check_names(None, names(self.robots))
        from polypod import robustness, runs
        from polypod.drawing import pyplot_for
        from polypod.progress import Progress
        from polypod.robustness import picture, report

        conditions, robots = names(self.conditions), names(self.robots)
        options = options_of(
            robustness.Options,
            self,
            conditions=None if conditions is None else tuple(conditions),
            simulators=tuple(names(self.simulators) or ()),
            condims=self._condims(),
            threads=torch_threads(self.threads),
            overrides=self.set,
            model=self._model(),
        )
        options.check()
        if self.picture is not None:
            pyplot_for("--picture")
        with Progress(8) as progress:
            battery = robustness.measure(runs.resolve(self.checkpoint), robots, options, progress)
        report.show(battery)
        write_json(self.json, battery.as_dict())
        if self.picture is not None:
            picture.draw(battery, self.picture)
        return 0 if battery.is_within else 3

    def _model(self) -> "MakersModel | None":
        if self.model is None:
            if self.map is not None or self.actuators != "model" or self.contact != "asis":
                raise _core.ConfigError("--map, --actuators and --contact need --model FILE, a MuJoCo model")
            return None
        from polypod.robustness.in_mujoco import MakersModel
        from polypod.sim2sim.maker import Choices

        return MakersModel(self.model, self.map, Choices(self.actuators, self.contact))

    def _condims(self) -> tuple[int, ...] | None:
        texts = names(self.condims)
        if texts is None:
            return None
        if not all(text in ("3", "4", "6") for text in texts):
            raise _core.ConfigError(f"--condims {self.condims} must be 3, 4 or 6, with commas between")
        return tuple(dict.fromkeys(map(int, texts)))
