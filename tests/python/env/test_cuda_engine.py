"""The engine `cuda`: a remedy where there is no card, the bits of the CPU where there is one.

`pytest -m cuda` runs the tests that need a card; elsewhere they are skipped and say why.
`tests/engines/the_device_has_the_bits_of_the_cpu.rs` runs the same engine on the host.
"""

import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
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


def test_steps_on_a_card_need_arrays_there() -> None:
    sim = VecSim("velocity_flat", 8)
    assert sim.device_arrays() is None
    with pytest.raises(ConfigError, match="there are no arrays on a device"):
        sim.step_device()
    # and nothing has changed
    other = VecSim("velocity_flat", 8)
    for action in actions(sim, 3):
        sim.step(action)
        other.step(action)
    assert sim.snapshot() == other.snapshot()


@pytest.mark.cuda
@pytest.mark.parametrize("task", ["velocity_flat", "velocity_flat_legged"])
def test_steps_whose_arrays_never_leave_the_card(card: str, task: str) -> None:
    torch = pytest.importorskip("torch")
    cpu, gpu = pair(task, 480, SHORT)
    arrays = gpu.device_arrays()
    assert arrays is not None
    shared = {name: torch.from_dlpack(array) for name, array in arrays.items()}
    for name, array in arrays.items():
        other = torch.as_tensor(array, device="cuda")
        assert other.data_ptr() == shared[name].data_ptr() == array.address, name
        assert list(other.shape) == array.shape
        assert str(other.dtype) == f"torch.{array.dtype}"
    streams, ended = [torch.cuda.current_stream(), torch.cuda.Stream()], 0
    for step, action in enumerate(actions(cpu, 120)):
        cpu.step(action)
        # streams take turns, each with work that the step must wait for
        stream = streams[step % 2]
        with torch.cuda.stream(stream):
            torch.cuda._sleep(1_000_000)
            shared["actions"].copy_(torch.from_numpy(action), non_blocking=True)
            gpu.step_device(stream.cuda_stream)
            kept = {name: tensor.clone() for name, tensor in shared.items()}
        stream.synchronize()
        ended += int(cpu.terminated.sum() + cpu.truncated.sum())
        for name in ("observation", "reward", "terminated", "truncated", "command"):
            assert kept[name].cpu().numpy().tobytes() == getattr(cpu, name).tobytes(), f"{task}, step {step}: {name}"
        if step % 40 == 20:
            for name in ("observation", "reward", "terminated", "final_mask"):
                assert getattr(gpu, name).tobytes() == getattr(cpu, name).tobytes(), f"{task}, step {step}: {name}"
            # rows of other envs are stale
            rows = cpu.final_mask
            assert gpu.final_obs[rows].tobytes() == cpu.final_obs[rows].tobytes(), f"{task}, step {step}: final_obs"
        if step == 60:
            assert cpu.snapshot() == gpu.snapshot()
        if step == 75:
            cpu.step(action)
            gpu.step(action)
    assert ended >= 100, f"{ended} episodes ended"
    assert gpu.steps_on_device == 121
    assert cpu.log() == gpu.log()
    assert cpu.snapshot() == gpu.snapshot()
    # the memory outlives the simulator
    last = shared["observation"].clone()
    del gpu, arrays
    assert torch.equal(shared["observation"], last)


@pytest.mark.cuda
@pytest.mark.parametrize("model", ["actuator_net_mlp", "actuator_net_lstm"])
def test_networks_drive_joints_with_the_bits_of_the_cpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, card: str, model: str
) -> None:
    torch = pytest.importorskip("torch")
    from lab.actuator_networks import BASE, MLP, lstm, onnx_of, toml

    robots = tmp_path / "configs/robots"
    robots.mkdir(parents=True)
    layers = [torch.nn.Linear(6, 32), torch.nn.Softsign(), torch.nn.Linear(32, 32), torch.nn.ELU()]
    perceptron = torch.nn.Sequential(*layers, torch.nn.Linear(32, 1))
    recurrent = model == "actuator_net_lstm"
    data, settings = (onnx_of(lstm()), {}) if recurrent else (onnx_of(perceptron, 6), MLP)
    (robots / "net_dog.onnx").write_bytes(data)
    limits = {"effort_limit": 30.0, "saturation_effort": 30.0, "velocity_limit": 30.0}
    text = f'extends = "{BASE}"\nname = "net_dog"\ntitle = "net_dog"\n[actuators.legs]\n'
    text += toml(model=model, network_file="net_dog.onnx", **limits, **settings) + "\n"
    (robots / "net_dog.toml").write_text(text, encoding="utf-8")
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path))
    check("velocity_flat", 512, 150, robots=["net_dog", BASE])


@pytest.mark.cuda
def test_many_steps_in_flight_have_the_bits_of_single_ones(card: str) -> None:
    torch = pytest.importorskip("torch")
    cpu, gpu = pair("velocity_flat", 2048, SHORT)
    arrays = gpu.device_arrays()
    assert arrays is not None
    given, observed = (torch.from_dlpack(arrays[name]) for name in ("actions", "observation"))
    weights = torch.from_numpy(np.random.default_rng(0).standard_normal((observed.shape[1], given.shape[1])))
    drawn = weights.to("cuda", torch.float32) * 0.1
    stream, taken = torch.cuda.current_stream(), []
    for _ in range(200):
        torch.matmul(observed, drawn, out=given).clamp_(-2.0, 2.0)
        taken.append(given.clone())
        gpu.step_device(stream.cuda_stream)
    for action in taken:
        cpu.step(action.cpu().numpy())
    assert cpu.snapshot() == gpu.snapshot()
    assert cpu.log() == gpu.log()
    assert cpu.episode_stats() == gpu.episode_stats()


@pytest.mark.cuda
def test_actions_that_are_no_numbers_are_refused_some_steps_later(card: str) -> None:
    torch = pytest.importorskip("torch")
    cpu, gpu = pair("velocity_flat", 64)
    arrays = gpu.device_arrays()
    assert arrays is not None
    given = torch.from_dlpack(arrays["actions"])
    given.zero_()
    cpu.step(np.zeros(tuple(given.shape), np.float32))
    given[9, 2] = float("nan")
    gpu.step_device(torch.cuda.current_stream().cuda_stream)
    with pytest.raises(ConfigError, match="an action of env 9 was not a number"):
        _ = gpu.observation
    # the env has acted with zeros instead
    assert gpu.observation.tobytes() == cpu.observation.tobytes()
    assert gpu.snapshot() == cpu.snapshot()


def train(tmp_path: Path, learner: str, name: str, engine: str) -> tuple[list[bytes], bytes]:
    """Policy and simulation after three iterations with the card."""
    pytest.importorskip("torch")
    from polypod.training.session import Options, train_with
    from polypod.training.workers import Workers

    options = Options(
        task="velocity_flat",
        num_envs=256,
        max_iterations=3,
        learner=learner,
        logger="none",
        run_name=name,
        log_dir=tmp_path,
        device="cuda",
        overrides=[*SHORT, f"physics.engine={engine}"],
    )
    _, runner = train_with(options, Workers.alone())
    sim = runner.env.unwrapped.sim
    if runner.env.card is not None:
        assert sim.steps_on_device > 0
    return [weights.detach().cpu().numpy().tobytes() for weights in runner.alg.actor.parameters()], sim.snapshot()


@pytest.mark.cuda
def test_a_training_on_the_card_has_the_bits_of_one_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, card: str
) -> None:
    on_card = train(tmp_path, "rsl_rl", "card", "cuda")
    from polypod.rsl_rl import VecEnv

    monkeypatch.setattr(VecEnv, "_find_card", lambda _: None)
    assert train(tmp_path, "rsl_rl", "beside", "articulated") == on_card


@pytest.mark.cuda
def test_whichever_engine_is_faster_the_native_learner_trains_the_same_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, card: str
) -> None:
    on_card = train(tmp_path, "native", "card", "cuda")
    assert train(tmp_path, "native", "timed", "auto") == on_card
    from polypod.rsl_rl import VecEnv

    # as if the CPU were faster
    monkeypatch.setattr(VecEnv, "_find_card", lambda _: None)
    assert train(tmp_path, "native", "slower", "auto") == on_card


@pytest.mark.cuda
def test_flat_ground_with_resets_pushes_and_randomisation(card: str) -> None:
    check("velocity_flat", 1024, 500)
    check("velocity_flat", 1024, 100, stay=False)


@pytest.mark.cuda
def test_tasks_that_are_on_the_card_as_a_whole(card: str) -> None:
    tasks = ("velocity_flat", "velocity_flat_legged", "velocity_rough", "velocity_rough_legged", "getup_flat")
    for task in tasks:
        assert VecSim(task, 48, overrides=[CUDA]).lacks_on_device() is None, task
    sim = VecSim("velocity_flat", 48, overrides=[CUDA, 'events.body_variation={mode="reset", enabled=true}'])
    assert sim.lacks_on_device() == "the event `body_variation`"


@pytest.mark.cuda
def test_bodies_that_change_at_resets_and_curricula(card: str) -> None:
    names = ("actuator_gains", "joint_parameters", "motor_strength")
    events = [f'events.randomize_{name}={{mode="reset", enabled=true}}' for name in names]
    events += [f"events.{name}.mode=reset" for name in ("physics_material", "add_base_mass", "base_com")]
    check("velocity_flat", 512, 200, [*SHORT, *events])
    check("velocity_rough", 512, 100, [*SHORT, *events])
    terms = 'reward_terms=["track_lin_vel_xy_exp", "base_linear_velocity"]'
    widens = f"curriculum.command_curriculum={{{terms}, threshold=0.02, step=0.2, lin_vel_x=[-2.0, 2.0]}}"
    check("velocity_flat", 512, 150, [*SHORT, widens])


@pytest.mark.cuda
def test_robots_that_get_up(card: str) -> None:
    check("getup_flat", 256, 100, SHORT[:1])


@pytest.mark.cuda
def test_rough_ground(card: str) -> None:
    check("velocity_rough", 512, 200)
    # pushes so strong that robots leave their tiles, beyond the hardest one too
    pushes = ["events.push_robot.velocity_range=[-9.0, 9.0]", "scene.terrain.max_init_terrain_level=9"]
    check("velocity_rough", 512, 150, [*SHORT, *pushes])


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
