"""Numbers out of bounds are `ConfigError`s that name the argument, never a crash."""

import os
import subprocess
import sys

import numpy as np
import pytest

import polypod
from common import ROOT
from polypod import _core

URDF = ROOT / "tests/data/urdf"
OPTIONS = "{}"
"""Options of a learner; they are read after its numbers."""


def refusal(call):
    with pytest.raises(polypod.ConfigError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize("number", [-1, 0, 2**31, 2**64, -(2**63) - 1, 2**70])
@pytest.mark.parametrize("argument", ["num_envs", "threads", "solver_iterations", "avian_substeps"])
def test_counts_of_a_simulation(argument, number):
    options = {"num_envs": 1, argument: number}
    message = refusal(lambda: polypod.Simulation(URDF / "biped.urdf", **options))
    assert message.startswith(f"{argument}: ")
    assert str(number) in message


@pytest.mark.parametrize("number", [-1, 0, 2**31, 2**64, 2**70])
def test_envs_of_a_task(number):
    assert refusal(lambda: _core.VecSim("velocity_flat", number)).startswith("num_envs: ")


@pytest.mark.parametrize("number", [-1, 0, 1025, 2**70])
def test_threads_have_the_bound_of_the_commands(number):
    for build in (
        lambda: _core.VecSim("velocity_flat", 8, threads=number),
        lambda: polypod.make("velocity_flat", 8, threads=number),
        lambda: polypod.Simulation(URDF / "biped.urdf", threads=number),
    ):
        message = refusal(build)
        assert message.startswith("threads: ")
        assert str(number) in message


@pytest.mark.parametrize("share", [(-1, 8), (0, 2**70), (2**70, 8), (0, 9), (8, 8), (-(2**200), 2**200)])
def test_shares_of_a_batch(share):
    for build in (_core.VecSim, polypod.make):
        assert refusal(lambda build=build: build("velocity_flat", 8, share=share)).startswith("share: ")


@pytest.mark.parametrize("share", [(0,), (0, 4, 8), (0.0, 8), "08", 8, (False, True)])
def test_shares_that_are_no_pairs_of_integers(share):
    with pytest.raises((TypeError, ValueError)) as caught:
        _core.VecSim("velocity_flat", 8, share=share)
    assert not isinstance(caught.value, OverflowError)


@pytest.mark.parametrize("n", [-1, 0, 2**31, 2**64, 2**70, -(2**70)])
def test_steps_of_a_simulation(n):
    sim = polypod.Simulation(URDF / "biped.urdf")
    assert refusal(lambda: sim.step(n=n)).startswith("n: ")
    assert sim.time == 0.0


@pytest.mark.parametrize("number", [-1, 2**64, 2**70])
def test_every_integer_of_the_core_is_checked(number):
    """Integers of workers, of seeds and of the learner's own counters."""
    assert refusal(lambda: _core.share_of_worker(number, 0, 1)).startswith("num_envs: ")
    assert refusal(lambda: _core.share_of_worker(8, number, 1)).startswith("worker: ")
    assert refusal(lambda: _core.share_of_worker(8, 0, number)).startswith("workers: ")
    sim = _core.VecSim("velocity_flat", 8)
    assert refusal(lambda: _core.VecSim("velocity_flat", 8, seed=number)).startswith("seed: ")
    assert refusal(lambda: sim.reset(seed=number)).startswith("seed: ")
    assert refusal(lambda: _core.Learner(sim, OPTIONS, worker=number)).startswith("worker: ")
    assert refusal(lambda: _core.Learner(sim, OPTIONS, workers=number)).startswith("workers: ")
    if number < 0:
        assert refusal(lambda: polypod.make("velocity_flat", 8, seed=number)).startswith("seed=")


def test_slots_are_named_once():
    message = refusal(lambda: _core.VecSim("velocity_flat", 8, slots=["LF_HAA"] * 1000))
    assert message.startswith("slots: `LF_HAA` is listed twice, last at place 1")
    assert _core.VecSim("velocity_flat", 8, slots=["LF_HAA", "LF_HFE"]).num_actions == 12


def test_a_folder_that_no_system_has():
    for build in (_core.VecSim, polypod.make):
        assert refusal(lambda build=build: build("velocity_flat", 8, dump_dir="a\0b")).startswith("dump_dir: ")
    sim = _core.VecSim("velocity_flat", 8)
    assert refusal(lambda: sim.set_dump_dir("\0")).startswith("dump_dir: ")


@pytest.mark.parametrize("task", [None, 5, 5.0, b"velocity_flat", ["velocity_flat"], URDF])
def test_a_task_is_named_by_a_text(task):
    for build in (polypod.make, polypod.VectorEnv):
        with pytest.raises(TypeError, match="pass a name or a path as text"):
            build(task)


def test_tensors_that_are_part_of_a_gradient():
    import torch

    from polypod.rsl_rl import VecEnv

    env = polypod.make("velocity_flat", 8)
    env.reset()
    actions = torch.zeros(8, 12, requires_grad=True)
    for take in (env.step, env.send):
        with pytest.raises(TypeError, match=r"pass actions.detach\(\)"):
            take(actions)
    env.step(actions.detach())
    # the adapter of a torch library takes them: a policy asked outside of inference mode gives such
    _, rewards, _, _ = VecEnv(polypod.make("velocity_flat", 8)).step(actions * 1.0)
    assert not rewards.requires_grad


def test_seeds_of_a_task():
    assert refusal(lambda: _core.VecSim("velocity_flat", 8, seed=-1)).startswith("seed: ")
    sim = _core.VecSim("velocity_flat", 8, seed=2**64 - 1)
    assert sim.seed == 2**64 - 1
    assert refusal(lambda: sim.reset(seed=2**64)).startswith("seed: ")
    sim.reset(seed=3)
    assert sim.seed == 3


def test_threads_are_no_more_than_have_work():
    assert _core.VecSim("velocity_flat", 8, threads=1024).threads <= 8
    assert polypod.Simulation(URDF / "biped.urdf", 3, threads=1024).threads <= 3


@pytest.mark.parametrize("dtype", [np.int64, np.uint8, np.int32])
def test_numpy_integers_are_integers(dtype):
    assert polypod.Simulation(URDF / "biped.urdf", dtype(2), threads=dtype(1)).num_envs == 2
    assert _core.VecSim("velocity_flat", dtype(8), threads=dtype(1), seed=dtype(5)).seed == 5


def test_other_types_are_type_errors():
    with pytest.raises(TypeError, match="threads"):
        polypod.Simulation(URDF / "biped.urdf", 1, threads=1.5)
    with pytest.raises(TypeError, match="num_envs"):
        _core.VecSim("velocity_flat", "8")


def test_actions_that_make_rewards_infinite_change_nothing():
    sim = _core.VecSim("velocity_flat", 8)
    before = sim.snapshot()
    actions = np.zeros((8, sim.num_actions), np.float32)
    actions[3, 5] = 1e19
    message = refusal(lambda: sim.step(actions))
    assert message.startswith("actions: ")
    assert "env 3" in message
    assert "LH_HFE" in message
    assert sim.snapshot() == before
    actions[3, 5] = 1e6
    sim.step(actions)
    assert np.isfinite(sim.reward).all()


def test_links_that_are_not_there():
    sim = polypod.Simulation(URDF / "biped.urdf")
    message = refusal(lambda: sim.set_mass(-1, 1.0))
    assert "no link -1" in message
    assert "0 to 6" in message
    message = refusal(lambda: sim.set_mass(7, 1.0))
    assert "no link 7" in message
    assert "0 to 6" in message


def test_a_normal_without_length():
    message = refusal(lambda: polypod.Simulation(URDF / "biped.urdf", ground_normal=(1e-300, 0, 0)))
    assert message.startswith("ground_normal: ")


def test_a_name_without_letters():
    with pytest.raises(polypod.ConfigError, match="name"):
        _core.draft_robot(ROOT / "assets/robots/unitree_a1/robot.urdf", name="")


STARVED = """
import resource

import polypod
from polypod import _core

size = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (size + (400 << 20),) * 2)
try:
    _core.VecSim("velocity_flat", 64, robots=["unitree_a1"], threads=2)
except polypod.PolypodError as error:
    print("refused:", error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
def test_a_panic_is_an_exception_of_polypod():
    """Threads that the machine does not give are a panic of the thread pool."""
    # A stack of 2 GiB is beyond the limit, so the first thread fails and the memory for the report
    # is still there.
    env = {**os.environ, "RUST_MIN_STACK": str(2 << 30)}
    command = [sys.executable, "-c", STARVED]
    result = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False, env=env)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("refused: ")
    assert "please report" in result.stdout
    assert result.stdout.count("\n") == 1
