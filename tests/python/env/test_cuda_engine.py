"""The engine `cuda`: a remedy where there is no card, the bits of the CPU where there is one.

`pytest -m cuda` runs the tests that need a card; elsewhere they are skipped and say why.
`tests/engines/the_device_has_the_bits_of_the_cpu.rs` runs the same engine on the host.
"""

import re
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest

from common import ROOT
from polypod import ConfigError, VecSim, _core

sys.path.insert(0, str(ROOT / "tools"))
import ptx

CUDA = "physics.engine=cuda"
SHORT = ("sim.episode_length_s=1.2", "events.push_robot.interval_range_s=[0.2, 0.4]")
"""Short episodes and frequent pushes, so that a short run meets both."""


@pytest.fixture(params=["common", "own"])
def card(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The card, with the common kernel and with own ones; skips where there is none."""
    described = _core.cuda()
    if described.startswith("not used: "):
        pytest.skip(described)
    monkeypatch.setenv("POLYPOD_CUDA_KERNELS", request.param)
    return described


def pair(task: str, num_envs: int, overrides: Sequence[str] = (), **options: Any) -> tuple[VecSim, VecSim]:
    """The same simulation on the CPU and on the card."""
    cpu = VecSim(task, num_envs, overrides=[*overrides], **options)
    return cpu, VecSim(task, num_envs, overrides=[*overrides, CUDA], **options)


def actions(sim: VecSim, steps: int) -> Iterator[np.ndarray]:
    """Random actions, the same ones in each call."""
    random = np.random.default_rng(3)
    for _ in range(steps):
        yield random.uniform(-1, 1, (sim.num_envs, sim.num_actions)).astype(np.float32)


def check(
    task: str, num_envs: int, steps: int, overrides: Sequence[str] = SHORT, stay: bool = True, **options: Any
) -> None:
    """Compares observations and rewards in each step, and the snapshots at the end.

    With `stay` the card makes whole control steps, where all parts of the task have a form there.
    """
    cpu, gpu = pair(task, num_envs, overrides, **options)
    gpu.stay_on_device(stay)
    alone = stay and gpu.lacks_on_device() is None
    ended = 0
    for step, action in enumerate(actions(cpu, steps)):
        cpu.step(action)
        gpu.step(action)
        ended += int(cpu.terminated.sum() + cpu.truncated.sum())
        for name in ("observation", "reward", "terminated", "truncated", "command"):
            one, other = getattr(cpu, name), getattr(gpu, name)
            assert one.tobytes() == other.tobytes(), f"{task}, step {step}: {name}"
    assert ended >= num_envs // 4, f"{ended} episodes ended"
    assert gpu.steps_on_device == (steps - 2 if alone else 0)
    assert cpu.log() == gpu.log()
    assert cpu.snapshot() == gpu.snapshot(), f"{task}: a component differs"


def test_a_machine_without_a_card_gets_a_reason_and_a_remedy() -> None:
    described = _core.cuda()
    if not described.startswith("not used: "):
        assert "physics.engine=cuda" in described
        return
    with pytest.raises(ConfigError) as caught:
        VecSim("velocity_flat", 8, overrides=[CUDA])
    message = str(caught.value)
    assert "physics.engine" in message
    assert "articulated" in message
    # the command says the same in one line
    assert described.removeprefix("not used: ").split(";")[0] in message


def test_the_faster_engine_has_the_bits_of_the_cpu_with_a_card_or_without() -> None:
    cpu = VecSim("velocity_flat", 40, seed=4, overrides=SHORT)
    either = VecSim("velocity_flat", 40, seed=4, overrides=[*SHORT, "physics.engine=auto"])
    for action in actions(cpu, 100):
        cpu.step(action)
        either.step(action)
    assert cpu.snapshot() == either.snapshot()


def test_the_engine_compiles_with_the_flags_whose_result_is_read() -> None:
    source = (ROOT / "crates" / "cuda" / "src" / "nvrtc.rs").read_text(encoding="utf-8")
    options = re.findall(r'c"(--[^"]*)"', source)
    arch, *flags = options
    assert arch == "--gpu-architecture=compute_80"
    assert tuple(flags) == ptx.FLAGS
    assert f'".version {ptx.OLDEST["compute_80"]}"' in source


@pytest.mark.cuda
def test_flat_ground_with_resets_pushes_and_randomisation(card: str) -> None:
    check("velocity_flat", 1024, 500)
    check("velocity_flat", 1024, 100, stay=False)


@pytest.mark.cuda
def test_tasks_that_are_on_the_card_as_a_whole(card: str) -> None:
    for task in ("velocity_flat", "velocity_flat_legged"):
        assert VecSim(task, 48, overrides=[CUDA]).lacks_on_device() is None, task
    assert VecSim("velocity_rough", 48, overrides=[CUDA]).lacks_on_device() == "uneven ground"


@pytest.mark.cuda
def test_rough_ground(card: str) -> None:
    check("velocity_rough", 512, 200)


@pytest.mark.cuda
def test_all_robots_of_the_legged_task(card: str) -> None:
    check("velocity_flat_legged", 960, 200)
    check("velocity_rough_legged", 480, 60, ["sim.episode_length_s=0.6"])


@pytest.mark.cuda
def test_bodies_of_different_shapes_and_friction_that_resists_turning(card: str) -> None:
    check("velocity_flat_variation", 256, 100)
    check("velocity_flat", 256, 100, [*SHORT, "scene.ground.torsional_friction=0.01"])


@pytest.mark.cuda
def test_robots_that_lie_on_the_ground(card: str) -> None:
    cpu, gpu = pair("velocity_flat", 256, ["terminations={}"])
    for action in actions(cpu, 150):
        cpu.step(action)
        gpu.step(action)
    assert cpu.snapshot() == gpu.snapshot()


@pytest.mark.cuda
def test_a_snapshot_of_one_side_goes_on_on_the_other(card: str) -> None:
    cpu, gpu = pair("velocity_flat", 256, SHORT)
    first, second = np.split(np.stack(list(actions(cpu, 80))), 2)
    for action in first:
        cpu.step(action)
        gpu.step(action)
    new_cpu, new_gpu = pair("velocity_flat", 256, SHORT)
    new_cpu.restore(gpu.snapshot())
    new_gpu.restore(cpu.snapshot())
    for action in second:
        for sim in (cpu, new_cpu, new_gpu):
            sim.step(action)
    assert cpu.snapshot() == new_cpu.snapshot() == new_gpu.snapshot()
