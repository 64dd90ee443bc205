"""Scaling of trainings over workers of one machine: `polypod bench --workers`.

The same cores are shared out among more and more workers. The figures are the cost of several
workers: the time that they wait for one another, and the bytes that they send. With GPUs worker 0
learns on the first, worker 1 on the second; workers beyond the GPUs share them.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from polypod import _core
from polypod.bench.learners import Options, heading, training
from polypod.bench.report import Progress
from polypod.runs import config
from polypod.training.workers import Workers

ITERATIONS = 8
"""Timed after one that is not. The fastest one counts: whatever else the machine does makes workers
wait."""
NETWORKS = {"1 Gbit/s": 1e9 / 8, "10 Gbit/s": 1e10 / 8, "100 Gbit/s": 1e11 / 8}
"""Bytes per second that a worker sends, of the networks that limits are given for."""
CUDA = "cuda"
LEARNER = "native"
LONGEST_S = 600.0
"""Longest training of one number of workers."""


def measure(options: Options, counts: Sequence[int], progress: Progress, device: str = "cpu") -> dict[str, Any]:
    """Trains with each number of workers in turn.

    Args:
        options: what to train; its threads are those of all workers.
        counts: numbers of workers.
        progress: is told what is measured.
        device: cpu, or cuda for updates on GPUs.

    Raises:
        ConfigError: for envs that these numbers of workers cannot share, and for a training that
            fails.
    """
    cores = options.threads or _core.info()["threads"]
    train_config = config.with_run(config.load(options.train_config), num_envs=options.num_envs)
    if device == CUDA and not torch.cuda.is_available():
        raise _core.ConfigError("--device cuda, but torch finds no CUDA device; leave it out for the native learner")
    for count in counts:
        Workers(0, count, 0, count, None).share(train_config.run.num_envs, LEARNER)
    rows = {}
    for count in counts:
        threads = max(1, cores // count)
        progress(f"{count} workers of {threads} threads")
        rows[str(count)] = _measured(options, count, threads, device)
    samples = train_config.run.num_envs * train_config.run.num_steps_per_env
    gpus = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())] if device == CUDA else []
    return {**options.conditions(), "samples": samples, "device": device, "gpus": gpus, "workers": rows}


def _measured(options: Options, count: int, threads: int, device: str) -> dict[str, Any]:
    asked = {"train_config": options.train_config, "num_envs": options.num_envs, "seed": options.seed, "device": device}
    words = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
    words += ["-m", __name__, json.dumps({**asked, "threads": threads})]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(words, capture_output=True, text=True, env=environment, timeout=LONGEST_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise _core.ConfigError(f"{count} workers take more than {LONGEST_S:g} s; lower --num-envs") from error
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.startswith("polypod: ")] or done.stderr.splitlines()
        raise _core.ConfigError(f"{count} workers fail: {lines[0] if lines else 'without a word'}")
    row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return {"threads": threads, **row}


def table(result: Mapping[str, Any]) -> str:
    """The figures as Markdown, and the limits of networks that follow from them."""
    if result["device"] == CUDA:
        return _table_of_gpus(result)
    rows = result["workers"]
    first = next(iter(rows.values()))
    lines = [
        *heading(result, f"{result['samples']} samples an iteration, fastest of {ITERATIONS} iterations, one machine"),
        "| workers x threads | iteration, s | speed | waiting, s | processor time, s | sent by a worker, MB |",
        "|---|---|---|---|---|---|",
    ]
    for count, row in rows.items():
        speed = first["iteration_s"] / row["iteration_s"]
        lines.append(
            f"| {count} x {row['threads']} | {row['iteration_s']:.3f} | {speed:.0%} | {row['wait_s']:.3f} | "
            f"{row['cpu_s']:.2f} | {row['sent_bytes'] / 1e6:.2f} |"
        )
    most = max(rows, key=int)
    if int(most) > 1:
        work = first["cpu_s"]
        lines += ["", "Workers that halve the speed of each, by the model of docs/cluster.md, for these samples:", ""]
        lines += ["| network | bytes take, s | threads of one worker | workers |", "|---|---|---|---|"]
        for name, rate in NETWORKS.items():
            seconds = limit_s(rows, rate)
            for threads in (2, 16):
                lines.append(f"| {name} | {seconds:.3f} | {threads} | {work / threads / seconds:.0f} |")
    return "\n".join(lines)


def _table_of_gpus(result: Mapping[str, Any]) -> str:
    """Table of updates on GPUs, whose messages are not counted."""
    rows, gpus = result["workers"], result["gpus"]
    first = next(iter(rows.values()))
    names = ", ".join(f"{gpus.count(name)} x {name}" for name in dict.fromkeys(gpus))
    what = f"{result['samples']} samples an iteration, updates on {names}, fastest of {ITERATIONS} iterations"
    lines = [
        *heading(result, what),
        "| workers x threads | GPUs | messages of GPUs | iteration, s | samples/s | speed |",
        "|---|---|---|---|---|---|",
    ]
    for count, row in rows.items():
        seconds = row["iteration_s"]
        lines.append(
            f"| {count} x {row['threads']} | {min(int(count), len(gpus))} | {row['backend']} | {seconds:.3f} | "
            f"{result['samples'] / seconds:,.0f} | {first['iteration_s'] / seconds:.0%} |"
        )
    return "\n".join(lines)


def limit_s(rows: Mapping[str, Mapping[str, Any]], bytes_per_second: float) -> float:
    """Seconds that a network takes for what many workers send in an iteration.

    Each of W workers sends `2 (W - 1) / W * n` bytes for a mini-batch's gradients of `n` bytes; 2
    workers send `n`.
    """
    count = max(map(int, rows))
    sent = rows[str(count)]["sent_bytes"]
    return float(2 * sent * count / (2 * (count - 1)) if count > 2 else 2 * sent) / bytes_per_second


def _work(asked: Mapping[str, Any]) -> None:
    """Work of a worker; worker 0 prints the figures."""
    is_cuda = asked["device"] == CUDA
    workers = Workers.join(is_cuda)
    device = f"{CUDA}:{torch.cuda.current_device()}" if is_cuda else "cpu"
    options = Options(asked["train_config"], asked["num_envs"], asked["threads"], asked["seed"])
    times = []
    with training(options, LEARNER, device, workers=workers) as runner:
        runner.alg.train_mode()
        observations = runner.env.get_observations()
        for iteration in range(ITERATIONS + 1):
            begin, used, waited, sent = time.perf_counter(), time.process_time(), workers.waited, workers.sent
            observations = runner._iterate(iteration, ITERATIONS + 1, observations)
            if is_cuda:
                torch.cuda.synchronize()
            seconds, used = time.perf_counter() - begin, time.process_time() - used
            used = sum(workers.gather_messages(used))
            times.append((seconds, used, workers.waited - waited, workers.sent - sent))
    backend = workers.backend
    workers.close()
    if workers.is_first:
        names = ("iteration_s", "cpu_s", "wait_s", "sent_bytes")
        print(json.dumps({**dict(zip(names, min(times[1:]), strict=True)), "backend": backend}))


if __name__ == "__main__":
    _work(json.loads(sys.argv[1]))
