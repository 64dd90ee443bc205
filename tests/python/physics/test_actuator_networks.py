"""A network file drives joints as torch computes it.

Bits are the same everywhere, snapshots and resets exact.
"""

import contextlib
import json
import warnings

import numpy as np
import onnx
import pytest
import torch

import polypod
from common import ROOT
from lab.actuator_networks import BASE, MLP, TASK, Lstm, lstm, onnx_of, toml
from polypod import _core

FREE = ("sim.decimation=1", "sim.dt=0.005", "observations.enable_noise=false")
"""One physics step per control step, so that every torque is seen."""


def mlp(inputs, activation, width=16):
    layers = [torch.nn.Linear(inputs, width), activation, torch.nn.Linear(width, width), activation]
    return torch.nn.Sequential(*layers, torch.nn.Linear(width, 1))


@pytest.fixture
def robot(tmp_path, monkeypatch):
    """Makes a robot whose legs a network drives; returns its name."""

    def make(data, name="net_dog", *, base=BASE, keys=(), **settings):
        settings = {"model": "actuator_net_mlp", **MLP, **settings} if "model" not in settings else settings
        (tmp_path / "configs/robots").mkdir(parents=True, exist_ok=True)
        if data is not None:
            (tmp_path / "configs/robots" / f"{name}.onnx").write_bytes(data)
            settings["network_file"] = f"{name}.onnx"
        limits = {"effort_limit": 1e4, "saturation_effort": 1e4, "velocity_limit": 1e4}
        text = [f'extends = "{base}"', f'name = "{name}"', f'title = "{name}"', *keys, "[actuators.legs]"]
        text.append(toml(**{**limits, **settings}))
        (tmp_path / "configs/robots" / f"{name}.toml").write_text("\n".join(text) + "\n")
        return name

    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path))
    return make


def make_sim(robots, num_envs=4, overrides=FREE, **options):
    return _core.VecSim(TASK, num_envs, robots=list(robots), seed=3, overrides=list(overrides), **options)


def random_actions(sim, step):
    return np.random.default_rng(step).uniform(-0.6, 0.6, (sim.num_envs, sim.num_actions)).astype(np.float32)


class Seen:
    """Control steps of one robot, one physics step each: error and velocity, then torque."""

    def __init__(self, sim, name):
        """Watches the robot of that name."""
        self.sim, self.name = sim, name
        self.info = json.loads(sim.robot_info())[name]
        self.spread = np.zeros((sim.num_actions, len(self.info["joint_names"])))
        columns, joints = self.info["columns"], self.info["joint_of_slot"]
        self.spread[columns, joints] = self.info["action_scale"] * np.array(self.info["slot_signs"])

    def step(self, actions):
        """Steps the simulation; returns errors, velocities and torques, [envs, joints]."""
        before = self.sim.qpos(self.name)[:, 7:], self.sim.qvel(self.name)[:, 6:]
        targets = np.array(self.info["default_pose"]) + actions @ self.spread
        self.sim.step(actions)
        torque = np.zeros_like(before[0])
        torque[:, self.info["joint_of_slot"]] = self.sim.state("joint_effort") * np.array(self.info["slot_signs"])
        return targets - before[0], before[1], torque


def in_torch(network, errors, velocities, settings):
    """Torques [steps, joints] of Isaac Lab's `ActuatorNetMLP` and `ActuatorNetLSTM`."""
    joints = errors.shape[1]
    torques, state = [], (torch.zeros(2, joints, 8), torch.zeros(2, joints, 8))
    ages = settings.get("input_idx", [0])
    history = torch.zeros(2, max(ages) + 1, joints)
    for error, velocity in zip(errors, velocities, strict=True):
        history = history.roll(1, dims=1)
        history[0, 0], history[1, 0] = torch.tensor(error), torch.tensor(velocity)
        with torch.no_grad():
            if isinstance(network, Lstm):
                torque, state = network(history[:, 0].T.unsqueeze(1).float(), state)
            else:
                position = history[0, ages].T * settings["pos_scale"]
                speed = history[1, ages].T * settings["vel_scale"]
                both = (position, speed) if settings["input_order"] == "pos_vel" else (speed, position)
                torque = network(torch.cat(both, dim=1)) * settings["torque_scale"]
        torques.append(torque[:, 0].numpy())
    return np.array(torques)


CASES = {
    "softsign": (lambda: mlp(6, torch.nn.Softsign(), 32), 6, {}),
    "elu": (lambda: mlp(4, torch.nn.ELU()), 4, {"input_idx": [0, 3], "input_order": "vel_pos"}),
    "relu": (lambda: mlp(2, torch.nn.ReLU()), 2, {"input_idx": [0]}),
    "tanh": (lambda: mlp(2, torch.nn.Tanh(), 5), 2, {"input_idx": [2]}),
    "leaky": (lambda: mlp(2, torch.nn.LeakyReLU(0.2)), 2, {"input_idx": [0]}),
    "lstm": (lstm, None, {"model": "actuator_net_lstm"}),
}


@pytest.mark.parametrize("engine", ["articulated", "avian"])
@pytest.mark.parametrize("case", CASES)
def test_torques_are_torchs(robot, case, engine):
    if engine == "avian" and case not in ("softsign", "lstm"):
        pytest.skip("the engines share the networks")
    build, inputs, settings = CASES[case]
    network = build()
    sim = make_sim([robot(onnx_of(network, inputs), **settings)], 2, [*FREE, f'physics.engine="{engine}"'])
    seen = Seen(sim, "net_dog")
    tracks: list[list] = [[], []]
    compared = []

    def compare(track):
        if track:
            errors, velocities, torques = (np.array(x) for x in zip(*track, strict=True))
            wanted = in_torch(network, errors, velocities, {**MLP, **settings})
            np.testing.assert_allclose(torques, wanted, rtol=1e-5, atol=1e-5 * max(1.0, np.abs(wanted).max()))
            compared.append(len(track))
        track.clear()

    for step in range(60):
        if step == 25:
            # an episode starts with a history of zeros
            compare(tracks[0])
            sim.reset(mask=np.array([True, False]))
        rows = seen.step(random_actions(sim, step))
        for env, track in enumerate(tracks):
            if sim.terminated[env] or sim.truncated[env]:
                compare(track)
            else:
                track.append(tuple(row[env] for row in rows))
    for track in tracks:
        compare(track)
    assert len(compared) >= 3
    assert sum(compared) > 100


def test_python_asks_the_same_network(robot):
    """`VecSim.network_torques`, which sim2sim drives MuJoCo with."""
    for case, (build, inputs, settings) in CASES.items():
        network = build()
        sim = make_sim([robot(onnx_of(network, inputs), **settings)], 2)
        random = np.random.default_rng(0)
        errors, velocities = random.normal(0.0, 0.3, (20, 3, 12)), random.normal(0.0, 3.0, (20, 3, 12))
        memory, found = None, []
        for error, velocity in zip(errors, velocities, strict=True):
            torque, memory = sim.network_torques(
                "net_dog", error.astype(np.float32), velocity.astype(np.float32), memory
            )
            found.append(torque)
        for row in range(3):
            wanted = in_torch(network, errors[:, row], velocities[:, row], {**MLP, **settings})
            atol = 1e-5 * max(1.0, np.abs(wanted).max())
            np.testing.assert_allclose(np.array(found)[:, row], wanted, rtol=1e-5, atol=atol, err_msg=case)


def fitted(kp, kd):
    """A small network that was taught the PD law by its samples."""
    network = mlp(2, torch.nn.Softsign())
    torch.manual_seed(1)
    inputs = torch.rand(2000, 2) * torch.tensor([1.6, 20.0]) - torch.tensor([0.8, 10.0])
    wanted = (kp * inputs[:, :1] - kd * inputs[:, 1:]) / 10.0
    scaled = inputs * torch.tensor([1.0, 0.1])
    optimizer = torch.optim.LBFGS(network.parameters(), max_iter=100, line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        error = torch.nn.functional.mse_loss(network(scaled), wanted)
        error.backward()
        return error

    optimizer.step(loss)
    assert loss().item() < 1e-3
    return network


def test_a_network_that_learnt_a_pd_controller_behaves_as_one(robot):
    kp, kd = 25.0, 0.5
    line = torch.nn.Linear(2, 1)
    with torch.no_grad():
        line.weight.copy_(torch.tensor([[kp, -kd]]))
        line.bias.zero_()
    plain = {"input_order": "pos_vel", "input_idx": [0], "pos_scale": 1.0, "vel_scale": 1.0, "torque_scale": 1.0}
    names = [
        robot(None, "pd_dog", model="dc_motor", stiffness=kp, damping=kd, explicit=True),
        robot(onnx_of(line, 2), "line_dog", **plain),
        robot(onnx_of(fitted(kp, kd), 2), "fitted_dog", **{**plain, "vel_scale": 0.1, "torque_scale": 10.0}),
    ]
    sims = [polypod.Simulation(name, dt=0.005, friction=0.8) for name in names]
    begin = sims[0].qpos[0, 7:].copy()
    for step in range(400):
        targets = begin + 0.1 * np.sin(0.02 * step + np.arange(12))
        for sim in sims:
            sim.step(targets=targets)
        pd, line, learnt = (sim.qpos[0] for sim in sims)
        if step < 20:
            # rounding alone; contacts make more of it as time goes on
            np.testing.assert_allclose(line, pd, atol=1e-5)
        np.testing.assert_allclose(line[7:], pd[7:], atol=0.02)
        np.testing.assert_allclose(learnt[7:], pd[7:], atol=0.05)
        assert abs(learnt[2] - pd[2]) < 0.02
    assert np.abs(pd[7:] - begin).max() > 0.1
    assert pd[2] > 0.2


@pytest.mark.parametrize("case", ["softsign", "lstm"])
def test_bits_are_those_of_any_threads_lanes_and_company(robot, case, monkeypatch):
    build, inputs, settings = CASES[case]
    name = robot(onnx_of(build(), inputs), **settings)
    ordinary = ["observations.enable_noise=false"]

    def run(robots, num_envs, **options):
        sim = make_sim(robots, num_envs, ordinary, **options)
        for step in range(25):
            actions = np.zeros((num_envs, sim.num_actions), dtype=np.float32)
            # the same to every env of the robot, whatever the batch
            actions[:] = np.random.default_rng(step).uniform(-0.6, 0.6, (1, sim.num_actions))
            sim.step(actions)
        return np.concatenate([sim.qpos(name), sim.qvel(name)], axis=1)

    alone, available = run([name], 19, threads=1), []
    for simd in ("avx512", "avx2", "portable"):
        monkeypatch.setenv("POLYPOD_SIMD", simd)
        with contextlib.suppress(polypod.PolypodError):
            make_sim([name], 1)
            available.append(simd)
        if simd not in available:
            continue
        again = run([name], 19, threads=2)
        np.testing.assert_array_equal(alone, again)
    assert "portable" in available
    monkeypatch.delenv("POLYPOD_SIMD")
    beside = run([name, BASE], 38, threads=2)
    np.testing.assert_array_equal(alone, beside)


@pytest.mark.parametrize("engine", ["articulated", "avian"])
@pytest.mark.parametrize("case", ["softsign", "lstm"])
def test_snapshots_hold_what_networks_remember(robot, case, engine):
    build, inputs, settings = CASES[case]
    name = robot(onnx_of(build(), inputs), **settings)
    overrides = [f'physics.engine="{engine}"']
    sim = make_sim([name], 5, overrides)
    for step in range(7):
        sim.step(random_actions(sim, step))
    snapshot = sim.snapshot()

    def go_on(sim):
        for step in range(7, 14):
            sim.step(random_actions(sim, step))
        return sim.qpos(name), sim.qvel(name), sim.observation.copy()

    wanted = go_on(sim)
    other = make_sim([name], 5, overrides)
    other.restore(snapshot)
    assert other.snapshot() == snapshot
    for found, expected in zip(go_on(other), wanted, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_a_snapshot_of_another_network_is_refused(robot):
    first = make_sim([robot(onnx_of(CASES["relu"][0](), 2), input_idx=[0])], 2)
    second = make_sim([robot(onnx_of(CASES["relu"][0](), 2), input_idx=[0])], 2)
    with pytest.raises(polypod.PolypodError):
        second.restore(first.snapshot())


def test_simulations_without_a_task_ask_networks_too(robot):
    network = CASES["softsign"][0]()
    name = robot(onnx_of(network, 6))
    for dtype in ("float32", "float64"):
        sim = polypod.Simulation(name, num_envs=2, dt=0.005, dtype=dtype)
        joints = sim.qpos.shape[1] - 7
        random = np.random.default_rng(0)
        track = []
        for step in range(30):
            targets = sim.default_qpos[7:] + random.uniform(-0.2, 0.2, (2, joints))
            track.append((targets - sim.qpos[:, 7:], sim.qvel[:, 6:].copy()))
            if step == 15:
                snapshot = sim.snapshot()
            sim.step(targets=targets)
            track[-1] += (np.array(sim.joint_torque),)
        for env in range(2):
            errors, velocities, torques = (np.array([row[i][env] for row in track]) for i in range(3))
            wanted = in_torch(network, errors, velocities, MLP)
            np.testing.assert_allclose(torques, wanted, atol=1e-4)
        after = sim.qpos.copy()
        sim.restore(snapshot)
        for error, _, _ in track[15:]:
            sim.step(targets=error + sim.qpos[:, 7:])
        np.testing.assert_allclose(sim.qpos, after, atol=1e-9)
        with pytest.raises(polypod.PolypodError, match="networks, which have no gains"):
            sim.step(targets=targets, kp=10.0)


def test_gains_that_are_drawn_leave_networks_alone(robot):
    network = CASES["relu"][0]()
    draw = '{ operation = "add", distribution_params = [50.0, 60.0] }'
    keys = [f"randomization.{gain} = {draw}" for gain in ("stiffness", "damping")]
    name = robot(onnx_of(network, 2), input_idx=[0], keys=keys)
    seen = Seen(make_sim([name], 2, [*FREE, "events.randomize_actuator_gains.enabled=true"]), name)
    for step in range(5):
        error, velocity, torque = seen.step(random_actions(seen.sim, step))
        for env in range(2):
            wanted = in_torch(network, error[env : env + 1], velocity[env : env + 1], {**MLP, "input_idx": [0]})
            np.testing.assert_allclose(torque[env : env + 1], wanted, rtol=1e-5, atol=1e-4)


def test_mujoco_is_driven_by_the_same_torques(robot):
    """A policy on a robot whose network is the PD law, in both simulators.

    Engines are compared under gains alone.
    """
    from common import FLAT_POLICY
    from polypod import sim2sim
    from polypod.mujoco_model.robot import load

    line = torch.nn.Linear(2, 1)
    with torch.no_grad():
        line.weight.copy_(torch.tensor([[25.0, -0.5]]))
        line.bias.zero_()
    plain = {"input_order": "pos_vel", "input_idx": [0], "pos_scale": 1.0, "vel_scale": 1.0, "torque_scale": 1.0}
    name = robot(onnx_of(line, 2), **plain, effort_limit=23.5, saturation_effort=23.5, velocity_limit=30.0)
    options = sim2sim.Options(envs_per_robot=2, steps=60, command=(0.5, 0.0, 0.0))
    found = sim2sim.compare(FLAT_POLICY, [name], options).robots[name]
    assert found.polypod.fall_rate == found.mujoco.fall_rate == 0.0
    assert abs(found.polypod.error_vel_xy - found.mujoco.error_vel_xy) < 0.1
    with pytest.raises(polypod.ConfigError, match="its actuators are networks"):
        load(name)


def test_the_manifest_names_the_network(robot):
    sim = make_sim([robot(onnx_of(CASES["softsign"][0](), 6))], 1)
    (network,) = json.loads(sim.robot_info())["net_dog"]["actuator_networks"]
    assert network["group"] == "legs"
    assert network["model"] == "actuator_net_mlp"
    assert network["inputs"] == [f"{kind}[{age}]" for kind in ("pos_error", "vel") for age in (0, 1, 2)]
    assert network["joints"] == list(range(12))
    assert (network["pos_scale"], network["vel_scale"], network["torque_scale"]) == (-1.0, 0.1, 10.0)
    assert len(network["checksum"]) == 16
    assert f'network_checksum = "{network["checksum"]}"' in sim.resolved_config()


def test_torchscript_becomes_onnx_as_the_docs_say(robot, tmp_path):
    """The snippet of docs/actuator-networks.md converts a TorchScript network of Isaac Lab."""
    text = (ROOT / "docs/actuator-networks.md").read_text()
    (snippet,) = [part.split("```")[0] for part in text.split("```python")[1:] if "torch.jit.load" in part]
    snippet = snippet.split("\n", 1)[1]
    for network, name in ((mlp(6, torch.nn.Softsign()), "mlp"), (lstm(), "lstm")):
        source = tmp_path / "actuator.pt"
        torch.jit.script(network).save(source)
        code = snippet.replace("actuator.pt", str(source)).replace("actuator.onnx", str(tmp_path / f"{name}.onnx"))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            exec(compile(code, "snippet", "exec"), {})
        data = (tmp_path / f"{name}.onnx").read_bytes()
        settings = {"model": "actuator_net_lstm"} if name == "lstm" else {}
        sim = make_sim([robot(data, **settings)], 1)
        error = np.full((1, 12), 0.1, dtype=np.float32)
        torque, _ = sim.network_torques("net_dog", error, np.zeros_like(error))
        wanted = in_torch(network, error, np.zeros_like(error), {**MLP, **settings})
        np.testing.assert_allclose(torque, wanted, atol=1e-5 * max(1.0, np.abs(wanted).max()))


def changed(data, change):
    model = onnx.load_model_from_string(data)
    change(model.graph)
    return model.SerializeToString()


def poison(graph):
    tensor = graph.initializer[0]
    values = onnx.numpy_helper.to_array(tensor).copy()
    values.flat[3] = np.nan
    tensor.CopyFrom(onnx.numpy_helper.from_array(values, tensor.name))


def odd_operator(graph):
    next(node for node in graph.node if node.op_type == "Relu").op_type = "HardSwish"


@pytest.mark.parametrize(
    ("data", "settings", "words"),
    [
        (b"no model", {}, ["net_dog.onnx: file", "is no ONNX model", "docs/actuator-networks.md"]),
        (b"", {}, ["net_dog.onnx: graph", "is missing"]),
        (
            lambda: onnx_of(mlp(2, torch.nn.ReLU()), 2),
            {},
            ["net_dog.onnx", "takes 2 numbers of a joint, and is given 6"],
        ),
        (lambda: onnx_of(mlp(6, torch.nn.Mish()), 6), {}, ["net_dog.onnx: node", "is an operator", "Softsign"]),
        (
            lambda: changed(onnx_of(mlp(6, torch.nn.ReLU()), 6), odd_operator),
            {},
            ["(HardSwish)", "is an operator that actuator networks do not have here", "LSTM"],
        ),
        (lambda: changed(onnx_of(mlp(6, torch.nn.ReLU()), 6), poison), {}, ["tensor `0.weight`", "has NaN at place 3"]),
        (
            lambda: onnx_of(torch.nn.Linear(6, 2), 6),
            {},
            ["output", "gives 2 numbers of a joint, not 1"],
        ),
        (lambda: onnx_of(lstm()), {"input_idx": [0]}, ["has LSTM layers", 'model = "actuator_net_lstm"']),
        (
            lambda: onnx_of(mlp(2, torch.nn.ReLU()), 2),
            {"model": "actuator_net_lstm"},
            ["has no LSTM layer", 'model = "actuator_net_mlp"'],
        ),
        (bytes(5 << 20), {}, ["net_dog.onnx", "larger than 4 MiB"]),
        (None, {}, ["net_dog.toml", "actuators.legs", 'model "actuator_net_mlp" needs `network_file`']),
        (None, {"network_file": "nowhere.onnx"}, ["actuators.legs.network_file", "there is no such file; tried"]),
        (
            b"",
            {"model": "actuator_net_mlp"},
            ["needs `input_order`, `input_idx`, `pos_scale`, `vel_scale`, `torque_scale`"],
        ),
        (b"", {"input_idx": []}, ["actuators.legs.input_idx", "is empty"]),
        (b"", {"input_idx": [0, 101]}, ["actuators.legs.input_idx", "101 physics steps ago"]),
        (b"", {"model": "actuator_net_lstm", "pos_scale": 1.0}, ["actuators.legs.pos_scale", "actuator_net_lstm"]),
        (b"", {"model": "dc_motor"}, ["actuators.legs.network_file", 'model "dc_motor" does not have it']),
        (
            b"",
            {"network_checksum": "0123456789abcdef"},
            ["network_checksum", "is 0123456789abcdef, and", "remove the key"],
        ),
    ],
)
def test_what_is_wrong_is_named(robot, data, settings, words):
    given = data() if callable(data) else data
    name = robot(given, **settings)
    with pytest.raises(polypod.PolypodError) as refused:
        make_sim([name], 1)
    for word in words:
        assert word in str(refused.value)


def test_a_model_with_gains_needs_them(tmp_path, monkeypatch):
    folder = tmp_path / "configs/robots"
    folder.mkdir(parents=True)
    text = (ROOT / f"configs/robots/{BASE}.toml").read_text()
    lines = [line for line in text.splitlines() if not line.startswith("stiffness = 25.0")]
    (folder / "soft_dog.toml").write_text("\n".join(lines).replace(f'name = "{BASE}"', 'name = "soft_dog"'))
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path))
    with pytest.raises(polypod.PolypodError, match=r"actuators\.legs: key `stiffness` is missing; add `stiffness`"):
        make_sim(["soft_dog"], 1)


def test_random_bytes_break_nothing(robot):
    """The rest of a file gives an error or a network, and no panic."""
    data = onnx_of(lstm())
    random = np.random.default_rng(0)
    refused = []
    for _ in range(60):
        broken = bytearray(data)
        for place in random.integers(0, len(broken), random.integers(1, 12)):
            broken[place] = random.integers(0, 256)
        if random.random() < 0.3:
            broken = broken[: random.integers(0, len(broken))]
        name = robot(bytes(broken), model="actuator_net_lstm")
        try:
            sim = make_sim([name], 1)
        except polypod.PolypodError as error:
            refused.append(str(error))
            continue
        sim.step(np.zeros((1, sim.num_actions), dtype=np.float32))
    assert len(refused) > 5
    assert not any("please report it" in error for error in refused)
