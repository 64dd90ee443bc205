"""Trainings on a Ray cluster: `polypod train --ray`.

Ray starts the workers, and replaces those that die.

Workers find task, train config and run by the paths that the command line had: on several nodes the
log directory must be one that all nodes share, such as a network file system.
"""

import dataclasses
import os
from pathlib import Path
from typing import Any

from polypod import _core
from polypod.evaluation import evaluate_checkpoint
from polypod.extras import package
from polypod.files import real_path
from polypod.runs import run_dir
from polypod.training import session
from polypod.training.report import Reporter
from polypod.training.workers import LostWorkerError, Workers, is_among_workers
from polypod.vector_env import make

AUTO = "auto"
"""Address: the cluster of this machine if there is one, else a new one for the time of the
command."""
MOST_FAILURES = 10
"""Largest number of restarts of a training's workers."""


def connected(address: str, purpose: str, module: str) -> tuple[Any, Any]:
    """Connects to a cluster; returns Ray and a module of it.

    Raises:
        ConfigError: where Ray is not installed, or the cluster cannot be reached.
    """
    ray = package("ray", purpose, "ray")
    part = package(module, purpose, "ray")
    # trials and workers work in the folders that they are told; Ray's own usage reports are not
    # ours to send
    os.environ.setdefault("RAY_CHDIR_TO_TRIAL_DIR", "0")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_TRAIN_ENABLE_PRINT_PATCH", "0")
    passed = {name: value for name, value in os.environ.items() if name.startswith(("POLYPOD_", "PYTHONPATH"))}
    try:
        where = None if address == AUTO else address
        ray.init(where, ignore_reinit_error=True, log_to_driver=True, runtime_env={"env_vars": passed})
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise _core.ConfigError(
            f"cannot reach the Ray cluster {address}: {error}; set RAY_AUTH_MODE=token if it was started with a token; "
            "see docs/cluster.md"
        ) from error
    return ray, part


def train(options: session.Options, address: str, count: int | None) -> int:
    """Trains with workers on a cluster, then evaluates; returns the exit code.

    Args:
        options: of the training.
        address: of the cluster, or `AUTO`.
        count: number of workers; None: one for each node.

    Raises:
        ConfigError: as `session.train`, where Ray is missing, and where the workers fail for good.
    """
    if is_among_workers():
        raise _core.ConfigError("--ray starts its workers itself; run it without torchrun")
    options = absolute(options)
    package("ray", "--ray", "ray")
    if options.resume is None:
        session.new_plan(options)  # report errors before a cluster is asked
    ray, train_torch = connected(address, "--ray", "ray.train.torch")
    run, target = (_new_run if options.resume is None else _begun_run)(options)
    ray_train = package("ray.train", "--ray", "ray")
    nodes = [node for node in ray.nodes() if node["Alive"]]
    count = count or len(nodes)
    cores = int(ray.cluster_resources().get("CPU", 1))
    threads = options.threads or max(1, cores // count)
    use_gpu = options.device == "cuda"
    reporter = Reporter()
    reporter.message(f"Ray: {len(nodes)} nodes with {cores} cores; {count} workers of {threads} threads; {run}")
    trainer = train_torch.TorchTrainer(
        _work,
        train_loop_config={"options": dataclasses.replace(options, threads=threads, run=run), "target": target},
        scaling_config=ray_train.ScalingConfig(
            num_workers=count, use_gpu=use_gpu, resources_per_worker={"CPU": threads, **({"GPU": 1} if use_gpu else {})}
        ),
        torch_config=train_torch.TorchConfig(backend="cpu:gloo,cuda:nccl" if use_gpu else "gloo"),
        run_config=ray_train.RunConfig(
            name=run.name,
            storage_path=str(options.log_dir / "ray"),
            failure_config=ray_train.FailureConfig(max_failures=MOST_FAILURES),
        ),
    )
    try:
        trainer.fit()
    except ray_train.v2.api.exceptions.TrainingFailedError as error:
        raise _core.ConfigError(f"the workers fail: {_reason(error)}; the run is {run}") from error
    finally:
        ray.shutdown()
    checkpoint = run_dir.latest_checkpoint(run)
    reporter.message(f"checkpoint {checkpoint}")
    reporter.evaluation(evaluate_checkpoint(checkpoint, threads=options.threads))
    return 0


def absolute(options: session.Options) -> session.Options:
    """The options with paths that mean the same in any folder."""
    return dataclasses.replace(
        options,
        task=None if options.task is None else run_dir.source(options.task),
        robots=None if options.robots is None else [run_dir.source(robot) for robot in options.robots],
        train_config=None if options.train_config is None else run_dir.source(options.train_config),
        init=None if options.init is None else real_path(options.init),
        log_dir=real_path(options.log_dir),
    )


def _new_run(options: session.Options) -> tuple[Path, int]:
    """Makes the directory of a new run whose options are in order.

    Returns it and its iterations.
    """
    plan = session.new_plan(options)
    task = plan.config.run.task
    env = make(task, robots=plan.robots, seed=plan.seed, threads=1, overrides=plan.overrides)
    run = run_dir.create(options.log_dir, env.sim.experiment_name, options.run_name)
    env.close()
    return run, plan.config.run.max_iterations


def _begun_run(options: session.Options) -> tuple[Path, int]:
    """The directory of the run to go on with, and its iterations when that is done."""
    checkpoint = run_dir.find_checkpoint(options.log_dir, str(options.resume))
    done = run_dir.iterations_of(checkpoint)
    if checkpoint != run_dir.latest_checkpoint(checkpoint.parent):
        raise _core.ConfigError(f"{checkpoint} is not the last of its run; with --ray go on with the run's directory")
    total = run_dir.read_manifest(checkpoint)["train_config"]["run"]["max_iterations"]
    target = total if options.max_iterations is None else done + options.max_iterations
    if target <= done:
        raise _core.ConfigError(f"this run has finished its {total} iterations; set --max-iterations to how many more")
    return checkpoint.parent, target


def _work(config: dict[str, Any]) -> None:
    """Work of one worker; after a failure it continues from the last checkpoint."""
    options, target = config["options"], config["target"]
    workers = Workers.join(options.device == "cuda")
    begun = workers.from_first(lambda: any(options.run.glob("model_*.pt")))
    if begun and not any(options.run.glob("model_*.pt")):
        raise RuntimeError(f"{options.run} is on another node alone; choose a --log-dir that all nodes share")
    following = session.next_options(options, options.run, target)
    if following is None:
        return
    try:
        _, runner = session.train_with(following, workers)
    except LostWorkerError:
        raise
    except SystemExit as error:
        raise RuntimeError("another worker has failed") from error
    runner.env.unwrapped.close()


def _reason(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
