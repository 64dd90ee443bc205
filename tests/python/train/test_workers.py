"""Several workers train what one process trains.

One that is lost, or that would train something else, is named.
"""

import os
import re
import signal
import subprocess
import sys
import threading
import time

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from polypod.runs import run_dir
from polypod.training.advantages import normalize_per_robot
from polypod.training.reward_scale import RewardScale
from polypod.training.workers import Workers, _backend, slow_workers
from same_bits import equal

CONFIG = """
extends = "flat"
run = { save_interval = 1, num_steps_per_env = 12, normalize_reward_per_robot = true }
algorithm = { num_learning_epochs = 2 }
actor = { obs_normalization = true }
critic = { obs_normalization = true }
"""
"""A training of which an iteration takes a tenth of a second."""
ROBOTS = "anymal_b,unitree_a1,spot"
"""Their blocks of 22, 21 and 21 envs are no blocks of the learner."""


@pytest.fixture(scope="module")
def team():
    if not hasattr(os, "fork"):
        pytest.skip("processes are not forked here")
    from worker_team import WorkerTeam

    team = WorkerTeam()
    yield team
    team.close()


@pytest.fixture
def train(team, tmp_path):
    """Trains with this number of workers; returns the last checkpoint."""
    (tmp_path / "mine.toml").write_text(CONFIG)

    def run(count, *words, logs="logs", iterations=2, new=True):
        ended = team.run(count, *command(tmp_path, logs, iterations, new), *words, folder=tmp_path)
        assert [code for code, _ in ended] == [0] * count, ended
        return run_dir.find_checkpoint(tmp_path / logs, "latest")

    return run


def command(folder, logs="logs", iterations=2, new=True):
    begin = (
        *("--train-config", str(folder / "mine.toml"), "--num-envs", "64", "--robots", ROBOTS, "--seed", "5"),
        *("--set", "sim.episode_length_s=1.0"),
    )
    end = ("--max-iterations", str(iterations), "--device", "cpu", "--log-dir", str(folder / logs))
    return ("train", *(begin if new else ()), *end)


def test_workers_do_not_change_a_checkpoint(train):
    one = train(1, "--learner", "native", logs="one")
    for count in (2, 3, 4):
        assert equal(one, train(count, "--learner", "native", logs=str(count))), count


def test_a_run_goes_on_with_other_numbers_of_workers(train):
    one = train(1, "--learner", "native", logs="one", iterations=4)
    train(2, "--learner", "native", iterations=1)
    for count in (4, 1, 3):
        last = train(count, "--resume", "latest", iterations=1, new=False)
    assert last.name == "model_4.pt"
    assert equal(one, last)


def test_torchrun_starts_workers(train, tmp_path):
    one = train(1, "--learner", "native", logs="one")
    torchrun = (sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--standalone", "-m", "polypod")
    done = subprocess.run([*torchrun, *command(tmp_path)], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("iteration 2/2") == 1, "worker 0 alone reports"
    assert "each of 2 workers" in done.stdout
    assert equal(one, run_dir.find_checkpoint(tmp_path / "logs", "latest"))


def test_rsl_rl_trains_with_workers_and_goes_on_with_others(train):
    half = run_dir.load_checkpoint(train(2, "--learner", "rsl_rl"))
    assert half["actor_state_dict"]["obs_normalizer.count"] == 2 * 12 * 64
    assert half["infos"]["logger"]["timesteps"] == 2 * 12 * 64
    assert len(half["infos"]["worker_rng"]) == 1
    assert half["infos"]["reward_scale"]["count"].sum() > 2 * 12 * 64 - 1
    for count in (1, 4):
        state = run_dir.load_checkpoint(train(count, "--resume", "latest", iterations=1, new=False))
    assert state["iter"] == 4
    assert len(state["infos"]["worker_rng"]) == 3
    weights = [of["actor_state_dict"]["mlp.0.weight"] for of in (half, state)]
    assert 0.0 < (weights[1] - weights[0]).norm() < weights[0].norm()


def test_an_rsl_rl_run_of_workers_resumes_exactly(train):
    whole = train(2, "--learner", "rsl_rl", logs="whole")
    train(2, "--learner", "rsl_rl", iterations=1)
    assert equal(whole, train(2, "--resume", "latest", iterations=1, new=False))


def test_curves_tell_how_long_each_worker_took(train):
    run = train(2, "--learner", "native").parent
    curves = EventAccumulator(str(run)).Reload()
    for index in range(2):
        for name in ("work", "wait"):
            seconds = [event.value for event in curves.Scalars(f"Perf/worker_{index}/{name}_time")]
            assert len(seconds) == 2
            assert all(0.0 < value < 30.0 for value in seconds)


@pytest.mark.parametrize("learner", ["native", "rsl_rl"])
def test_a_killed_worker_is_named(team, tmp_path, learner):
    (tmp_path / "mine.toml").write_text(CONFIG)
    processes = team.start(2, (*command(tmp_path, iterations=2000), "--learner", learner), tmp_path)
    end = time.monotonic() + 40
    while not list(tmp_path.glob("logs/rsl_rl/*/*/model_3.pt")):
        assert time.monotonic() < end
        time.sleep(0.01)
    os.kill(processes[1], signal.SIGKILL)
    begin = time.monotonic()
    (code, errors), (killed, _) = team.ended()
    assert (code, killed) == (2, -signal.SIGKILL), errors
    assert time.monotonic() - begin < 10
    assert f"worker 1 (process {processes[1]} on " in errors
    assert "is gone" in errors
    assert "--resume" in errors
    assert "Traceback" not in errors
    assert ".cc:" not in errors
    run_dir.load_checkpoint(run_dir.find_checkpoint(tmp_path / "logs", "latest"))


def test_a_signal_to_one_worker_ends_all_after_the_iteration(team, tmp_path):
    (tmp_path / "mine.toml").write_text(CONFIG.replace("save_interval = 1", "save_interval = 100000"))
    processes = team.start(3, command(tmp_path, iterations=2000), tmp_path)
    end = time.monotonic() + 40
    # the worker opens it when it has begun
    output = tmp_path / "worker_0" / ".output"
    while not output.exists() or "iteration 1/2000" not in output.read_text():
        assert time.monotonic() < end
        time.sleep(0.01)
    os.kill(processes[2], signal.SIGTERM)
    assert [code for code, _ in team.ended()] == [128 + signal.SIGTERM] * 3
    run_dir.load_checkpoint(run_dir.find_checkpoint(tmp_path / "logs", "latest"))


@pytest.mark.parametrize(
    ("own", "difference"),
    [
        ({"words": ["--seed", "6"]}, "worker 1 on .* has --seed 6, and worker 0 on .* has 5"),
        ({"words": ["--num-envs", "96"]}, "has run.num_envs 96, and worker 0 on .* has 64"),
        ({"words": ["--set", "sim.decimation=2"]}, "--set"),
        ({"environment": {"POLYPOD_SIMD": "portable"}}, "has the instruction set portable, and"),
    ],
)
def test_workers_that_differ_are_refused(team, tmp_path, own, difference):
    (tmp_path / "mine.toml").write_text(CONFIG)
    own = {1: own, 0: {"environment": {"POLYPOD_SIMD": "avx2"}} if "environment" in own else {}}
    ended = team.run(2, *command(tmp_path), folder=tmp_path, own=own)
    assert [code for code, _ in ended] == [2, 2], ended
    (_, errors), (_, others) = ended
    assert re.search(difference, errors), errors
    assert "use the same" in errors or "POLYPOD_SIMD" in errors
    assert others == "", "one worker says it"
    assert not list(tmp_path.glob("logs/rsl_rl/*/*")), "nothing is written"


@pytest.mark.parametrize(
    ("count", "learner", "remedy"), [(5, "native", "use at most 4"), (3, "rsl_rl", "multiple of 3")]
)
def test_envs_that_workers_cannot_share_are_refused(team, tmp_path, count, learner, remedy):
    (tmp_path / "mine.toml").write_text(CONFIG)
    ended = team.run(count, *command(tmp_path), "--learner", learner, folder=tmp_path)
    assert [code for code, _ in ended] == [2] * count, ended
    assert all(remedy in errors for _, errors in ended), ended


class Threads(Workers):
    """Workers that are threads of the test."""

    def __init__(self, index, sent, barrier):
        """Number `index`; all share `sent` and `barrier`."""
        super().__init__(index, len(sent), 0, 1, None)
        self._sent, self._barrier = sent, barrier

    def sum(self, tensor):
        """Adds up what the threads pass."""
        self._sent[self.index] = tensor.clone()
        self._barrier.wait()
        tensor.copy_(sum(self._sent))
        self._barrier.wait()
        return tensor


def test_rewards_and_advantages_are_scaled_as_by_one_process():
    generator = torch.Generator().manual_seed(3)
    rewards = torch.randn((5, 12), generator=generator) * torch.arange(1, 13)
    dones = torch.rand((5, 12), generator=generator) < 0.2
    blocks, shares = [(0, 7), (7, 12)], [(0, 4), (4, 12)]
    one = RewardScale(blocks, 0.9, "cpu")
    expected = torch.stack([one(*step) for step in zip(rewards, dones, strict=True)])
    advantages = rewards.unsqueeze(-1).clone()
    normalize_per_robot(advantages, blocks)

    sent, barrier, found = [None, None], threading.Barrier(2), [None, None]

    def work(index):
        start, stop = shares[index]
        own = [tuple(min(max(end, start), stop) - start for end in block) for block in blocks]
        workers = Threads(index, sent, barrier)
        scale = RewardScale(own, 0.9, "cpu", workers)
        pairs = zip(rewards[:, start:stop], dones[:, start:stop], strict=True)
        scaled = torch.stack([scale(*step) for step in pairs])
        mine = rewards[:, start:stop].unsqueeze(-1).clone()
        normalize_per_robot(mine, own, workers)
        found[index] = (scaled, mine)

    threads = [threading.Thread(target=work, args=(index,)) for index in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30)
    assert torch.allclose(torch.cat([of[0] for of in found], 1), expected, rtol=1e-5)
    assert torch.allclose(torch.cat([of[1] for of in found], 1), advantages, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("gpus", "backend"),
    [
        (["a", "b"], "cpu:gloo,cuda:nccl"),
        (["a", "a"], "gloo"),
        (["a", "b", "a"], "gloo"),
        (["a", ""], "gloo"),
        (["", ""], "gloo"),
    ],
)
def test_nccl_is_for_workers_with_gpus_of_their_own(gpus, backend):
    """All workers choose the same backend, although each knows its own GPU alone."""
    store, found = torch.distributed.HashStore(), []
    threads = [
        threading.Thread(target=lambda index=index: found.append(_backend(store, index, len(gpus), gpus[index])))
        for index in range(len(gpus))
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30)
    assert found == [backend] * len(gpus)


def test_slow_workers_are_those_far_above_the_median():
    assert slow_workers([(1.0, 0.0), (1.1, 0.0), (1.4, 0.0), (1.0, 0.5)]) == []
    assert slow_workers([(1.0, 1.0), (2.0, 0.0)]) == [1]
    assert slow_workers([(1.0, 0.0), (1.0, 0.0), (3.0, 0.0), (0.2, 2.0)]) == [2]
