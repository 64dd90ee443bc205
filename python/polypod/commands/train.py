"""`polypod train`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from polypod import _core, runs
from polypod.commands.arguments import (
    Count,
    Name,
    Overrides,
    Robots,
    arg,
    check_names,
    names,
    options_of,
    positive,
    thread_count,
)
from polypod.motions.names import split

Learner = Literal["auto", "native", "rsl_rl"]


@dataclasses.dataclass(frozen=True)
class Train:
    """Train one policy over many robots."""

    task: Name = None
    """Name or alias of the task (`polypod list`). Default: the train config's."""
    num_envs: Count = None
    """Number of envs, shared out among the robots. Default: the train config's, 4096 of most."""
    robots: Robots = None
    """Names of the robots, with commas between (`polypod list`). Default: the task's."""
    max_iterations: Count = None
    """Learning iterations; with --resume, further ones. Default: the train config's; with --resume,
    the rest."""
    until_walks: Count = None
    """End the training as soon as all robots walk, by the definition of docs/evaluate.md, and
    measure it every N iterations. The exit code is 3 where they do not walk after the last one."""
    seed: Count = None
    """Seed of every random stream. Default: 42."""
    train_config: Name = None
    """Name of a train config (`polypod list train_configs`), or the path of a .toml. Default:
    flat."""
    learner: Annotated[Learner | None, arg(metavar="{auto,native,rsl_rl}")] = None
    """The learner: the native one, on a CPU or a GPU, or rsl_rl. `auto` is native for perceptrons,
    and rsl_rl for all other networks. Default: the train config's. A resumed run may go on with the
    other one."""
    logger: Literal["tensorboard", "wandb", "neptune", "none"] = "tensorboard"
    """Destination of the curves. wandb and neptune need their package and account; TensorBoard's
    files are written too."""
    log_project: str = "polypod"
    """Project of wandb or neptune."""
    resume: Annotated[str | None, arg(metavar="RUN")] = None
    """Go on with a run: its name or the end of it, its directory, a checkpoint, or `latest` (also
    when RUN is left out)."""
    init: Annotated[Path | None, arg(metavar="FILE")] = None
    """Initialise the networks from this checkpoint, bundled policy, or run by its name or the end
    of it. Observation and sizes of networks must be the same."""
    terms: Annotated[Path | None, arg(metavar="FILE")] = None
    """Terms of a task in a Python file: observations, commands, rewards, terminations, events and
    curricula, see docs/write-a-term.md. The file is run."""
    run_name: Name = None
    """Suffix of the name of the run's directory."""
    log_dir: Path = Path("logs")
    """Folder of runs: the run is written to LOG_DIR/rsl_rl/<experiment>/."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the learner; the simulator runs on the CPU."""
    threads: Count = None
    """Threads of the simulator, and of the learner on the CPU. Default: one per core."""
    set: Overrides = ()
    """Changes the task's configuration, e.g. --set sim.episode_length_s=10.0, or with train. before
    the key the train config, e.g. --set train.algorithm.entropy_coef=0.01. May be repeated."""
    headless: bool = False
    """Ignored; accepted for compatibility. Trainings open no window."""
    ray: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Train with workers on the Ray cluster at this address; without ADDRESS on this machine's
    cluster, which is started if there is none. Needs the extra ray."""
    workers: Count = None
    """Workers of --ray. Default: one per node. Without Ray, torchrun starts workers: see
    docs/cluster.md."""

    def run(self) -> int:
        """Runs the command and returns its exit code."""
        if self.resume is None:
            self._check()
        from polypod.training import session

        options = options_of(
            session.Options,
            self,
            robots=names(self.robots),
            until_walks=positive(self.until_walks, "--until-walks"),
            init=self.init and runs.resolve(self.init, self.log_dir),
            threads=thread_count(self.threads, "--threads"),
            overrides=list(self.set),
        )
        if self.ray is not None:
            if self.until_walks is not None:
                raise _core.ConfigError("--until-walks is of trainings in one process; leave it out, or --ray")
            from polypod.training import on_ray

            return on_ray.train(options, self.ray, positive(self.workers, "--workers"))
        if self.workers is not None:
            raise _core.ConfigError(
                "--workers is of --ray; on one machine use torchrun --nproc-per-node N -m polypod train"
            )
        return session.train(options)

    def _check(self) -> None:
        """Refuses names and keys that do not exist before torch is imported."""
        from polypod.runs import config

        of_task, of_training = config.split_overrides(self.set)
        run = config.load(self.train_config or config.DEFAULT, of_training).run
        of_task, _ = split(of_task)
        check_names(self.task or run.task, names(self.robots), of_task)
