"""`polypod sim2sim`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from polypod.commands.arguments import Count, Overrides, RobotNames, Velocity, arg, check_names, names, write_json


@dataclasses.dataclass(frozen=True)
class Sim2sim:
    """Let the exported policy drive the same robots in MuJoCo, beside polypod; needs the extras export and bench.

    Exit code 3 when a robot does not walk in MuJoCo, by the definition that eval judges by.
    """

    checkpoint: Path
    """A model_<n>.pt beside its manifest.json, a policy as ONNX, the name of a run or the end of it, or a bundled
    policy: flat, rough, legged or quadruped."""
    robots: RobotNames = None
    """Names of the robots, with commas between. Default: the run's."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Also write the figures to this file."""
    num_envs: int = 32
    """Envs per robot."""
    steps: Count = None
    """Control steps per episode. Default: 20 s, or a whole one."""
    commands: Literal["walking", "task"] = "walking"
    """Commands that walking is judged by, new ones every 5 s, turns, side-steps and stops among them; or commands as
    the task draws them."""
    command: Velocity = None
    """Instead, one forward and left velocity (m/s) and yaw rate (rad/s) for all envs."""
    dt: Annotated[float | None, arg(metavar="S")] = None
    """MuJoCo's physics step, s. Default: the task's, on terrain 0.002."""
    integrator: Literal["implicitfast", "RK4"] = "implicitfast"
    """Integrator of MuJoCo."""
    friction: Annotated[float | None, arg(metavar="MU")] = None
    """Friction coefficient of the ground in MuJoCo. Default: the task's static friction."""
    soft_contact: bool = False
    """MuJoCo's default contacts in place of the stiffest ones that the step allows."""
    seed: int = 0
    """Seed of initial states, commands and delays."""
    set: Overrides = ()
    """Changes the task's configuration, on top of the run's own changes. May be repeated."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        check_names(None, names(self.robots))
        from polypod import bundled, sim2sim
        from polypod.progress import Progress
        from polypod.sim2sim.report import show

        options = sim2sim.Options(
            envs_per_robot=self.num_envs,
            steps=self.steps,
            seed=self.seed,
            command=self.command,
            commands=self.commands,
            dt=self.dt,
            integrator=self.integrator,
            friction=self.friction,
            soft_contact=self.soft_contact,
            overrides=self.set,
        )
        with Progress(14) as bars:

            def progress(name: str, done: int, total: int) -> None:
                bars(name if name == "polypod" else f"mujoco {name}", done, total)

            comparison = sim2sim.compare(bundled.resolve(self.checkpoint), names(self.robots), options, progress)
        show(comparison)
        write_json(self.json, comparison.as_dict())
        return 0 if comparison.transfers else 3
