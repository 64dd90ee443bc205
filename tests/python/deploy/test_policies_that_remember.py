"""Policies with histories and recurrent ones act the same exported, in MuJoCo and in Rust."""

import json
import subprocess

import numpy as np
import onnx
import pytest
import torch

from common import ROOT, SHORT
from polypod import _core
from polypod.deploy import check
from polypod.export import OnnxPolicy, export_checkpoint, interfaces
from polypod.policy import load
from polypod.runs import run_dir
from polypod.training import session

SIMULATOR = ROOT / "target" / "release" / "polypod-sim"
ROBOTS = ["spot", "unitree_a1"]
BASE = (*SHORT, "train.run.num_steps_per_env=8", "train.actor.hidden_dims=[16]", "train.critic.hidden_dims=[16]")
HISTORY = (
    "observations.policy.joint_pos_rel.history_length=3",
    "observations.policy.velocity_commands.history_length=2",
    "observations.policy.last_action.history_length=4",
)


def recurrent(kind, layers):
    keys = ("class_name=RNNModel", f"rnn_type={kind}", "rnn_hidden_dim=12", f"rnn_num_layers={layers}")
    return tuple(f"train.{network}.{key}" for network in ("actor", "critic") for key in keys)


CASES = {
    "history": HISTORY,
    "lstm": recurrent("lstm", 2),
    "gru": recurrent("gru", 1),
    "both": (*HISTORY, *recurrent("gru", 2), "train.actor.obs_normalization=true"),
}
STATES = {
    "history": [],
    "lstm": [["h_in", [2, 0, 12]], ["c_in", [2, 0, 12]]],
    "gru": [["h_in", [1, 0, 12]]],
    "both": [["h_in", [2, 0, 12]]],
}


@pytest.fixture(scope="module", params=CASES)
def trained(request, built_once):
    """Name of the case, its checkpoint, and the folder of its export."""

    def fill(folder):
        options = {"num_envs": 16, "robots": ROBOTS, "seed": 5, "device": "cpu", "logger": "none", "max_iterations": 1}
        options["overrides"] = [*BASE, *CASES[request.param]]
        assert session.train(session.Options(log_dir=folder, **options)) == 0
        path = run_dir.find_checkpoint(folder, "latest")
        # weights that are far from their start, so that what is remembered matters
        state = torch.load(path, weights_only=False)
        torch.manual_seed(0)
        for key, value in state["actor_state_dict"].items():
            if value.dtype == torch.float32 and ("rnn" in key or "mlp" in key):
                value.add_(0.3 * torch.randn_like(value))
        torch.save(state, path)
        manifest = path.parent / "manifest.json"
        content = json.loads(manifest.read_text())
        content.pop("checkpoints", None)
        manifest.write_text(json.dumps(content))
        export_checkpoint(path, folder / "exported", fold=True)

    folder = built_once(f"remembers_{request.param}", fill)
    return request.param, run_dir.find_checkpoint(folder, "latest"), folder / "exported"


def make_sim(path, robots, num_envs=4, **options):
    manifest = run_dir.read_manifest(path)
    return _core.VecSim(
        # without events: a robot's base is at the place that its graph assumes
        manifest["task"].replace("-v0", "-Play-v0"),
        num_envs,
        robots=robots,
        seed=3,
        threads=1,
        overrides=[*manifest["overrides"], "sim.episode_length_s=0.5"],
        slots=manifest["canonical_joint_names"],
        **options,
    )


def rotation(qpos):
    w, x, y, z = qpos[:, 3:7].T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def sensors_of(sim, robot):
    """Readings of the sensors of the robot's envs."""
    qpos, qvel = sim.qpos(robot), sim.qvel(robot)
    turn = rotation(qpos)
    rows = slice(*sim.env_ids(robot))
    return {
        "base_lin_vel": np.einsum("eji,ej->ei", turn, qvel[:, :3]),
        "base_ang_vel": qvel[:, 3:6],
        "projected_gravity": -turn[:, 2, :],
        "velocity_commands": sim.command[rows],
        "joint_pos": qpos[:, 7:],
        "joint_vel": qvel[:, 6:],
    }


def assert_agree(given, wanted):
    """Within 2e-5 of the env's largest action: float32 rounds a sum of terms as large."""
    scale = np.maximum(1.0, np.abs(wanted).max(axis=-1, keepdims=True))
    np.testing.assert_array_less(np.abs(given - wanted), np.broadcast_to(2e-5 * scale, wanted.shape))


def test_exported_actions_are_the_policys_through_episodes(trained):
    """The graph alone and a graph per robot, in ONNX, over several episodes of each env."""
    name, path, folder = trained
    sim = make_sim(path, ROBOTS)
    policy, alone, again = (
        load(path).runner(),
        OnnxPolicy(folder / "policy.onnx"),
        load(folder / "policy.onnx").runner(),
    )
    folded = {robot: OnnxPolicy(folder / f"policy_{robot}.onnx") for robot in ROBOTS}
    last = {robot: np.zeros((2, sim.num_actions), dtype=np.float32) for robot in ROBOTS}
    ended = 0
    for _ in range(60):
        observation = sim.observation.copy()
        wanted = policy(observation)
        assert_agree(alone(obs=observation)["actions"], wanted)
        assert_agree(again(observation), wanted)
        for robot, graph in folded.items():
            rows = slice(*sim.env_ids(robot))
            given = sensors_of(sim, robot) | {"last_action": last[robot]}
            outputs = graph(**{key: given[key] for key in graph.inputs})
            np.testing.assert_allclose(outputs["actions"], wanted[rows], rtol=3e-4, atol=3e-4)
            last[robot] = outputs["actions"]
        sim.step(wanted)
        ends = sim.terminated | sim.truncated
        policy.reset(ends)
        alone.reset(ends)
        again.reset(ends)
        for robot, graph in folded.items():
            mine = ends[slice(*sim.env_ids(robot))]
            graph.reset(mine)
            last[robot][mine] = 0.0
        ended += int(ends.sum())
    assert ended >= 8
    # the memory matters: without it the actions are others
    if name != "history":
        policy.reset()
        assert np.abs(policy(observation) - wanted).max() > 1e-2


def test_manifests_say_what_is_fed_back(trained):
    name, path, folder = trained
    described = {graph: json.loads((folder / f"{graph}.json").read_text()) for graph in ("policy", "policy_spot")}
    found = [[state["input"], state["shape"]] for state in described["policy"]["states"]]
    assert found == STATES[name]
    states = [state["input"] for state in described["policy_spot"]["states"]]
    network = [state for state, _ in STATES[name]]
    assert states == (["history_in"] if name in ("history", "both") else []) + network
    metadata = {entry.key: entry.value for entry in onnx.load(folder / "policy_spot.onnx").metadata_props}
    assert metadata["state_inputs"].split(",") == states
    assert metadata["state_outputs"].split(",") == [state["output"] for state in described["policy_spot"]["states"]]
    lengths = "1,1,1,2,3,1,4" if name in ("history", "both") else "1,1,1,1,1,1,1"
    assert metadata["observation_history_lengths"] == lengths
    if name in ("history", "both"):
        (spot,) = interfaces(run_dir.read_manifest(path), ["spot"]).values()
        assert described["policy_spot"]["states"][0]["shape"] == [0, 1 + 2 * 12 + 3 + 3 * 12]
        assert spot.inputs()["joint_pos"] == 12


def test_torchscript_takes_and_gives_states(trained):
    name, _, folder = trained
    graph, script = OnnxPolicy(folder / "policy_spot.onnx"), torch.jit.load(str(folder / "policy_spot.pt"))
    random = np.random.default_rng(0)
    states = {
        key: np.zeros([3 if isinstance(n, str) else n for n in shape], np.float32)
        for key, shape in graph.states.items()
    }
    for _ in range(3):
        given = {key: random.standard_normal((3, size)).astype(np.float32) for key, size in graph.inputs.items()}
        wanted = graph(**given, **states)
        found = script(*(torch.from_numpy(value) for value in (given | states).values()))
        for key, value in zip(graph.outputs, found, strict=True):
            np.testing.assert_allclose(value.detach().numpy(), wanted[key], atol=1e-5, err_msg=f"{name} {key}")
        states = dict(zip(states, (value.detach().numpy() for value in found[2:]), strict=True))


def test_mujoco_runs_it(trained, cli, tmp_path):
    """Its actions are the policy's on its sensors' readings from the first control step on."""
    _, path, _ = trained
    done = cli("sim2sim", "--checkpoint", str(path), "--num-envs", "2", "--steps", "4", "--json", "out.json")
    # these policies do not walk, which is the result 1
    assert done.returncode in (0, 3), done.stderr
    assert json.loads((tmp_path / "out.json").read_text())["robots"].keys() == set(ROBOTS)


def test_rust_plays_it(trained):
    """`polypod-sim play` measures what Python measures with the checkpoint on the same envs."""
    if not SIMULATOR.exists():
        pytest.skip("needs target/release/polypod-sim")
    _, path, folder = trained
    steps, overrides = 20, ["sim.episode_length_s=0.3"]
    command = [SIMULATOR, "play", "--policy", folder / "policy.onnx", "--num-envs", "4", "--steps", str(steps)]
    command += ["--json", "--seed", "7", "--set", *overrides]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    found = {row["robot"]: row for row in json.loads(done.stdout)}
    manifest = run_dir.read_manifest(path)
    task = manifest["task"].replace("-v0", "-Play-v0")
    sim = _core.VecSim(
        task,
        4,
        robots=ROBOTS,
        seed=7,
        overrides=[*manifest["overrides"], *overrides],
        autoreset="disabled",
        slots=manifest["canonical_joint_names"],
    )
    policy = load(path).runner()
    errors, counts, active = np.zeros(4), np.zeros(4), np.ones(4, dtype=bool)
    for _ in range(steps):
        sim.step(policy(sim.observation.copy()))
        error = np.linalg.norm(sim.command[:, :2] - sim.state("base_lin_vel")[:, :2], axis=1)
        errors += np.where(active, error, 0.0)
        counts += active
        active &= ~(sim.terminated | sim.truncated)
    for robot in ROBOTS:
        rows = slice(*sim.env_ids(robot))
        wanted = float((errors[rows] / counts[rows]).mean())
        assert found[robot]["error_vel_xy"] == pytest.approx(wanted, rel=2e-3), robot


def test_the_loop_of_a_deployed_policy_remembers(trained):
    """The loop passes states and histories from one control step to the next.

    They are those of the checkpoint's network.
    """
    name, path, exported = trained
    found = check.check(exported / "policy_spot.onnx", check.Options(num_envs=3, steps=15))
    assert found.reference == f"the checkpoint {path}"
    assert list(found.contract.states) == [
        *(["history_in"] if HISTORY[0] in CASES[name] else []),
        *(s for s, _ in STATES[name]),
    ]
    for played in found.played.values():
        assert played.steps >= 6
        assert played.holds, played
