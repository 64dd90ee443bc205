"""Exported graphs compute what the checkpoint does, from a robot's sensors to its joints."""

import dataclasses
import hashlib
import json
import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict

import polypod
import polypod.cli
from common import FLAT_POLICY, PLAY_TERRAIN, ROOT, ROUGH_POLICY
from polypod.evaluation import load_policy
from polypod.export import OnnxPolicy, interfaces, onnx_graph, sources
from polypod.export import robot as robot_interface
from polypod.export.checkpoint import compare
from polypod.export.robot import OUTPUTS
from polypod.export.torch_graph import RobotPolicy
from polypod.networks.policies import load_network
from polypod.observation import Term
from polypod.runs import run_dir

EXPECTED = ROOT / "tests" / "data" / "policy_actions.json"
TASK = "Velocity-Flat-Universal-Play-v0"
ROBOTS = run_dir.read_manifest(FLAT_POLICY)["robots"]


@pytest.fixture(scope="module")
def trained():
    return load_policy(run_dir.load_checkpoint(FLAT_POLICY), run_dir.read_manifest(FLAT_POLICY)["policy"])


def read(path):
    return json.loads(path.read_text())


def test_every_robot_gets_its_files(exported_policy):
    out, done = exported_policy
    names = ["policy", *(f"policy_{robot}" for robot in ROBOTS)]
    assert {path.name for path in out.iterdir()} == {
        f"{name}.{kind}" for name in names for kind in ("onnx", "pt", "json")
    }
    assert set(done.files) == set(out.iterdir())
    assert done.difference <= 1e-5


def test_the_network_acts_as_torch_does(exported_policy, trained):
    out, _ = exported_policy
    observations = np.random.default_rng(1).normal(size=(500, 83)).astype(np.float32)
    wanted = trained(observations)
    np.testing.assert_allclose(OnnxPolicy(out / "policy.onnx")(obs=observations)["actions"], wanted, atol=1e-5)
    script = torch.jit.load(str(out / "policy.pt"))
    np.testing.assert_allclose(script(torch.from_numpy(observations)).detach().numpy(), wanted, atol=1e-5)


def test_the_rust_test_expects_these_actions(trained):
    """Expected outputs; POLYPOD_WRITE_EXPECTED=1 rewrites them.

    `tests/program/policies_run_without_python.rs` compares tract with them.
    """
    if os.environ.get("POLYPOD_WRITE_EXPECTED"):
        sim = polypod.VecSim(TASK, 16, seed=1, threads=1)
        for _ in range(25):
            sim.step(trained(sim.observation))
        observations = sim.observation.copy()
        content = {"observations": observations.tolist(), "actions": trained(observations).tolist()}
        EXPECTED.write_text(json.dumps(content) + "\n")
    expected = read(EXPECTED)
    observations = np.array(expected["observations"], dtype=np.float32)
    np.testing.assert_allclose(trained(observations), expected["actions"], atol=1e-5)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_folded_graph_goes_from_sensors_to_targets(exported_policy, trained, robot):
    """On states of the simulator: its observation and its targets are the reference."""
    out, _ = exported_policy
    sim = polypod.VecSim(TASK, 8, robots=[robot], seed=3, threads=1)
    random = np.random.default_rng(0)
    action = np.zeros((8, 12), dtype=np.float32)
    for _ in range(10):
        action = random.normal(size=(8, 12)).astype(np.float32)
        sim.step(action)
    running = sim.episode_length == 10
    assert running.sum() > 2
    qpos, qvel = sim.qpos(robot), sim.qvel(robot)
    w, x, y, z = qpos[:, 3:7].T
    up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    rows = [quaternion_to_matrix(q).T @ v for q, v in zip(qpos[:, 3:7], qvel[:, :3], strict=True)]
    inputs = {
        "base_lin_vel": np.array(rows),
        "base_ang_vel": qvel[:, 3:6],
        "projected_gravity": -up,
        "velocity_commands": sim.command,
        "joint_pos": qpos[:, 7:],
        "joint_vel": qvel[:, 6:],
        "last_action": action,
    }
    graph = OnnxPolicy(out / f"policy_{robot}.onnx")
    manifest = read(out / f"policy_{robot}.json")
    assert list(graph.inputs) == [entry["name"] for entry in manifest["inputs"]] == list(inputs)
    found = graph(**inputs)
    wanted = trained(sim.observation)
    np.testing.assert_allclose(found["actions"][running], wanted[running], atol=2e-4)
    info = manifest["robot_info"][robot]
    targets = np.tile(np.array(info["default_pose"]), (8, 1))
    for slot, joint in enumerate(info["joint_of_slot"]):
        targets[:, joint] += info["action_scale"] * found["actions"][:, slot]
    np.testing.assert_allclose(found["joint_pos_target"], targets, atol=1e-5)
    assert [info["joint_names"][joint] for joint in info["joint_of_slot"]] == [name for name, _ in sim.joint_map(robot)]

    script = torch.jit.load(str(out / f"policy_{robot}.pt"))
    tensors = [torch.from_numpy(np.asarray(value, dtype=np.float32)) for value in inputs.values()]
    target, actions = script(*tensors)
    np.testing.assert_allclose(actions.detach().numpy(), found["actions"], atol=1e-5)
    np.testing.assert_allclose(target.detach().numpy(), found["joint_pos_target"], atol=1e-5)


def quaternion_to_matrix(quaternion):
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_the_manifest_says_what_a_deployment_needs(exported_policy):
    manifest = read(exported_policy[0] / "policy.json")
    assert manifest["checkpoint"]["sha256"] == hashlib.sha256(FLAT_POLICY.read_bytes()).hexdigest()
    layout = manifest["observation_layout"]
    assert sum(entry["size"] for entry in layout) == manifest["num_obs"] == 83
    assert [entry["start"] for entry in layout] == [0, 3, 6, 9, 12, 24, 36, 48]
    normalization = manifest["observation_normalization"]
    assert normalization["in_graph"]
    network = load_network(run_dir.load_checkpoint(FLAT_POLICY), run_dir.read_manifest(FLAT_POLICY)["policy"])
    observations = np.random.default_rng(4).normal(size=(5, 83)).astype(np.float32)
    wanted = network.obs_normalizer(torch.from_numpy(observations)).numpy()
    normalized = (observations - normalization["mean"]) / normalization["std"]
    np.testing.assert_allclose(normalized.reshape(5, 83), wanted, rtol=1e-5, atol=1e-6)
    assert manifest["step_dt"] == 0.02
    assert set(manifest["robot_info"]) == set(ROBOTS)
    for info in manifest["robot_info"].values():
        for key in ("joint_names", "default_pose", "stiffness", "damping", "effort_limit", "lower", "upper"):
            assert len(info[key]) == 12
        assert len(info["morphology"]) == 35
        assert info["action_scale"] > 0.0


def test_the_shipped_export_is_that_of_the_shipped_checkpoint(trained):
    manifest = read(FLAT_POLICY.parent / "exported" / "policy.json")
    assert manifest["checkpoint"]["sha256"] == hashlib.sha256(FLAT_POLICY.read_bytes()).hexdigest()
    observations = np.random.default_rng(2).normal(size=(100, 83)).astype(np.float32)
    actions = OnnxPolicy(FLAT_POLICY.parent / "exported" / "policy.onnx")(obs=observations)["actions"]
    np.testing.assert_allclose(actions, trained(observations), atol=1e-5)


@pytest.mark.parametrize(
    "activation", ["elu", "selu", "relu", "crelu", "lrelu", "tanh", "sigmoid", "softplus", "identity"]
)
def test_networks_of_every_activation(activation):
    network = build(activation, normalized=activation == "tanh")
    model = onnx_graph.network_model(network, 7, 3, {})
    assert compare(OnnxPolicy(model.SerializeToString()), network.as_jit(), {"obs": 7}, ["actions"]) <= 1e-5


def test_an_activation_that_onnx_lacks_is_refused():
    with pytest.raises(polypod.ConfigError, match="GELU"):
        onnx_graph.network_model(build("gelu"), 7, 3, {})


def build(activation, normalized=False):
    torch.manual_seed(0)
    like = TensorDict({"policy": torch.zeros(1, 7)}, batch_size=[1])
    network = MLPModel(like, {"actor": ["policy"]}, "actor", 3, [16, 16], activation, obs_normalization=normalized)
    if normalized:
        network.train()
        network.update_normalization(TensorDict({"policy": 2.0 + 3.0 * torch.randn(200, 7)}, batch_size=[200]))
        assert network.obs_normalizer.std.min() > 2.0
    return network.eval()


def test_a_term_of_its_own_is_an_input_of_its_own():
    """A deployment measures itself each term that no formula computes from other inputs."""
    robot = interfaces(run_dir.read_manifest(FLAT_POLICY), ["spot"])["spot"]
    own = Term(
        term="motor_temperature",
        size=2,
        units="K",
        description="temperature above the air",
        inputs=("motor_temperature",),
    )
    known = {term.term: term for term in robot.terms}
    warm = dataclasses.replace(robot, terms=(known["base_lin_vel"], own, known["joint_pos_rel"]))
    assert warm.inputs() == {"base_lin_vel": 3, "base_ang_vel": 3, "joint_pos": 12, "motor_temperature": 2}
    assert warm.meaning("motor_temperature") == "temperature above the air K"
    assert "rad" in warm.meaning("joint_pos")


def test_a_new_term_of_a_known_source_needs_no_python():
    """Absolute joint positions and the angular velocity, under names new to Python."""
    state, manifest = run_dir.load_checkpoint(FLAT_POLICY), run_dir.read_manifest(FLAT_POLICY)
    robot = interfaces(manifest, ["spot"])["spot"]
    own = (
        {"term": "angles", "size": 12, "kind": "per_joint", "source": "joint_position", "inputs": ["joint_pos"]},
        {"term": "turning", "size": 3, "source": "base_angular_velocity", "inputs": ["base_ang_vel"], "scale": 2.0},
        {"term": "leaning", "size": 12, "source": "joint_position_minus_default", "inputs": ["joint_pos"]},
    )
    known = {term.term: term for term in robot.terms}
    terms = (*(Term.read(entry) for entry in own), known["joint_pos_rel"], known["morphology"])
    robot = dataclasses.replace(robot, terms=terms)
    sizes = {"base_ang_vel": 3, "joint_pos": 12}
    assert robot.inputs() == sizes
    network = load_network(state, manifest["policy"])
    network.mlp, network.obs_normalizer = torch.nn.Sequential(torch.nn.Linear(74, 12)), torch.nn.Identity()
    folded = RobotPolicy(network, robot).eval()
    rate, angles = torch.randn(4, 3), torch.randn(4, 12)
    seen = folded.observe(rate, angles)
    torch.testing.assert_close(seen[:, :12], angles[:, robot.joint_of_slot])
    torch.testing.assert_close(seen[:, 12:15], 2.0 * rate)
    torch.testing.assert_close(seen[:, 15:27], (angles - torch.from_numpy(robot.default_pose))[:, robot.joint_of_slot])
    assert torch.equal(seen[:, 15:27], seen[:, 27:39])
    graph = OnnxPolicy(onnx_graph.robot_model(network, robot, {}).SerializeToString())
    assert compare(graph, folded, sizes, list(OUTPUTS)) < 1e-5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": "sonar"}, "base_ang_vel is computed from 'sonar', for which .* register it with one of measured, "),
        ({"source": "measured"}, "base_ang_vel is measured by itself, but .* rename it"),
    ],
)
def test_a_source_that_is_not_known_is_refused(monkeypatch, changes, message):
    read = robot_interface.terms_of

    def changed(sim):
        return tuple(dataclasses.replace(t, **changes) if t.term == "base_ang_vel" else t for t in read(sim))

    monkeypatch.setattr(robot_interface, "terms_of", changed)
    with pytest.raises(polypod.ConfigError, match=message):
        interfaces(run_dir.read_manifest(FLAT_POLICY), ["spot"])


def test_every_source_has_a_formula():
    """The sources in the compiled module's stub, and all sources that registered terms state."""
    stub = (Path(polypod.__file__).parent / "_core.pyi").read_text(encoding="utf-8")
    listed = stub.split("`source`: ")[1].split("`inputs`")[0].split(": ")[1]
    names = set(re.findall(r"[a-z]+(?:_[a-z]+)*", re.sub(r"\(.*?\)", "", listed, flags=re.DOTALL))) - {"or"}
    assert names == set(sources._FORMULAS)
    assert {spec["source"] for spec in json.loads(polypod._core.observation_specs()).values()} <= names


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        [
            "observations.policy.height_scan.offset=0.3",
            "observations.policy.height_scan.clip=[-0.4, 0.2]",
            "observations.policy.height_scan.scale=2.0",
            "observations.policy.base_ang_vel.scale=0.25",
            "observations.policy.joint_vel_rel.clip=[-0.5, 0.5]",
            "observations.policy.morphology.scale=0.5",
        ],
    ],
)
def test_a_graph_folded_on_rough_ground_takes_heights(overrides):
    """The graph processes terms like the task: the simulator's observation is the reference."""
    state, manifest = run_dir.load_checkpoint(ROUGH_POLICY), run_dir.read_manifest(ROUGH_POLICY)
    manifest = {**manifest, "overrides": [*manifest["overrides"], *PLAY_TERRAIN, *overrides]}
    robot = interfaces(manifest, ["unitree_b2"])["unitree_b2"]
    network = load_network(state, manifest["policy"])
    sim = polypod.VecSim(
        "velocity_rough_universal_play", 16, robots=["unitree_b2"], seed=3, threads=1, overrides=manifest["overrides"]
    )
    for _ in range(8):
        sim.step(np.random.default_rng(0).normal(size=(16, 12)).astype(np.float32))
    qpos, qvel, ground = sim.qpos("unitree_b2"), sim.qvel("unitree_b2"), sim.terrain()
    turns = np.stack([quaternion_to_matrix(q) for q in qpos[:, 3:7]])
    heading = np.arctan2(turns[:, 1, 0], turns[:, 0, 0])
    forward, left = robot.scan_points.T
    x = qpos[:, :1] + sim.env_origins()[:, :1] + np.outer(np.cos(heading), forward) - np.outer(np.sin(heading), left)
    y = qpos[:, 1:2] + sim.env_origins()[:, 1:2] + np.outer(np.sin(heading), forward) + np.outer(np.cos(heading), left)
    grid = [
        np.rint((at - start) / ground["cell"]).astype(int) for at, start in zip((x, y), ground["origin"], strict=True)
    ]
    inputs = {
        "base_lin_vel": np.einsum("eji,ej->ei", turns, qvel[:, :3]),
        "base_ang_vel": qvel[:, 3:6],
        "projected_gravity": -turns[:, 2, :],
        "velocity_commands": sim.command,
        "joint_pos": qpos[:, 7:],
        "joint_vel": qvel[:, 6:],
        "height_scan": qpos[:, 2:3] - ground["heights"][grid[0], grid[1]],
        "last_action": sim.state("last_action"),
    }
    assert list(robot.inputs()) == list(inputs)
    tensors = [torch.from_numpy(np.asarray(value, dtype=np.float32)) for value in inputs.values()]
    observed = RobotPolicy(network, robot).observe(*tensors).numpy()
    # the nearest point's height is not the one below a ray: on a wall it is a step off
    scale = 2.0 if overrides else 1.0
    np.testing.assert_allclose(observed[:, :83], sim.observation[:, :83], atol=1e-4)
    off = np.abs(observed[:, 83:] - sim.observation[:, 83:]) / scale
    assert np.median(off) < 1e-3
    assert (off < 0.03).mean() > 0.97
    model = onnx_graph.robot_model(network, robot, {})
    sizes = {name: value.shape[1] for name, value in inputs.items()}
    assert (
        compare(OnnxPolicy(model.SerializeToString()), RobotPolicy(network, robot).eval(), sizes, list(OUTPUTS)) < 1e-5
    )


def test_a_graph_that_is_not_the_manifests_is_refused(exported_policy, tmp_path):
    folder = Path(shutil.copytree(exported_policy[0], tmp_path / "exported"))
    for name in ("policy", "policy_spot"):
        file = folder / f"{name}.onnx"
        data = bytearray(file.read_bytes())
        data[-1] ^= 1
        file.write_bytes(data)
        with pytest.raises(polypod.ConfigError, match=f"{name}.onnx is damaged or of another export"):
            OnnxPolicy(file)
    (folder / "policy_spot.onnx").write_bytes((exported_policy[0] / "policy_spot.onnx").read_bytes())
    OnnxPolicy(folder / "policy_spot.onnx")
    (folder / "policy_spot.json").write_text("{}")
    with pytest.raises(polypod.ConfigError, match=r"policy_spot\.json is not a manifest"):
        OnnxPolicy(folder / "policy_spot.onnx")
    with pytest.raises(polypod.ConfigError, match="cannot be read"):
        OnnxPolicy(folder / "nothing.onnx")


def test_the_command_line(tmp_path, capsys):
    arguments = ["export", "--checkpoint", str(FLAT_POLICY), "--out", str(tmp_path), "--robot", "spot"]
    assert polypod.cli.main([*arguments, "--formats", "onnx"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "policy.onnx",
        "policy.json",
        "policy_spot.onnx",
        "policy_spot.json",
    }
    assert "policy_spot.onnx" in capsys.readouterr().out
    assert polypod.cli.main([*arguments[:-1], "spott"]) == 2
    assert "spot" in capsys.readouterr().err


@pytest.mark.parametrize("module", ["onnx", "onnxruntime"])
def test_the_missing_extra_is_named(monkeypatch, tmp_path, capsys, module):
    monkeypatch.setitem(sys.modules, module, None)
    assert polypod.cli.main(["export", "--checkpoint", str(FLAT_POLICY), "--out", str(tmp_path)]) == 2
    errors = capsys.readouterr().err
    assert f"needs the package {module}" in errors
    assert "pip install 'polypod[export]'" in errors
    assert not list(tmp_path.iterdir())
