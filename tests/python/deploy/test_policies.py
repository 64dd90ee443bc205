"""A policy of any learner is evaluated, played and exported like a `polypod train` one."""

import json

import numpy as np
import onnx
import pytest
import torch

import polypod
from common import FLAT_POLICY
from polypod import policy as policies
from polypod.evaluation import evaluate_checkpoint
from polypod.export import export_checkpoint
from polypod.export.runtime import OnnxPolicy
from polypod.play import Player

SPOT = "Velocity-Flat-Spot-v0"


class Foreign(torch.nn.Module):
    """A network of nobody in particular: normalised input, a squashed output."""

    def __init__(self, num_obs: int = 48, num_actions: int = 12) -> None:
        """New weights, always the same."""
        super().__init__()
        torch.manual_seed(3)
        self.body = torch.nn.Sequential(torch.nn.Linear(num_obs, 32), torch.nn.GELU(), torch.nn.LayerNorm(32))
        self.head = torch.nn.Linear(32, num_actions)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Actions [batch, num_actions]."""
        return 0.1 * torch.tanh(self.head(self.body(observations / 2.0)))


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """The module, and the file that was written of it."""
    module = Foreign()
    env = polypod.make(SPOT, 1, seed=0)
    return module, policies.save_onnx(module, env, tmp_path_factory.mktemp("foreign") / "walk.onnx")


def test_what_a_policy_says_of_itself(foreign):
    module, path = foreign
    policy = policies.load(path)
    env = polypod.make(SPOT, 1, seed=0)
    assert (policy.task, policy.robots) == (SPOT, ["spot"])
    assert policy.observation_names == [term for term, _ in env.observation_layout]
    assert policy.joint_names == env.canonical_joint_names
    observations = np.random.default_rng(0).standard_normal((5, 48), dtype=np.float32)
    with torch.inference_mode():
        np.testing.assert_allclose(policy.act(observations), module(torch.from_numpy(observations)), atol=1e-6)
    with pytest.raises(polypod.ConfigError, match="takes observations of 48 numbers, and the task gives 47"):
        policy.act(observations[:, 1:])


def test_it_is_evaluated_and_played(foreign, cli, tmp_path):
    _, path = foreign
    done = cli("eval", "--checkpoint", str(path), "--num-envs", "4", "--steps", "10", "--json", "out.json")
    assert done.returncode == 0, done.stderr
    written = json.loads((tmp_path / "out.json").read_text())
    assert written["robots"].keys() == {"spot"}
    assert written["checkpoint"]["sha256"] == policies.load(path).sha256
    player = Player(path, command=(0.5, 0.0, 0.0))
    player.step()
    assert player.sim.robots == ["spot"]
    assert cli("play", "--checkpoint", str(path), "--headless", "--seconds", "0.2").returncode == 0


def test_it_is_exported_and_folded_like_others(foreign, tmp_path):
    module, path = foreign
    done = export_checkpoint(path, tmp_path / "out", fold=True, formats=("onnx",))
    assert done.difference < 1e-5
    folded = OnnxPolicy(tmp_path / "out" / "policy_spot.onnx")
    assert {"joint_pos", "joint_vel", "last_action"} <= folded.inputs.keys()
    observations = np.random.default_rng(1).standard_normal((4, 48), dtype=np.float32)
    again = policies.load(tmp_path / "out" / "policy.onnx")
    with torch.inference_mode():
        np.testing.assert_allclose(again.act(observations), module(torch.from_numpy(observations)), atol=1e-6)
    with pytest.raises(polypod.ConfigError, match="is an ONNX file, of which no TorchScript is made"):
        export_checkpoint(path, tmp_path / "out")


def test_it_runs_in_mujoco(foreign, cli):
    pytest.importorskip("mujoco")
    _, path = foreign
    done = cli("sim2sim", "--checkpoint", str(path), "--num-envs", "2", "--steps", "5")
    assert done.returncode in (0, 3), done.stderr
    assert "spot" in done.stdout


def test_an_export_of_polypod_is_a_policy_too(exported_policy):
    folder, _ = exported_policy
    exported, own = policies.load(folder / "policy.onnx"), policies.load(FLAT_POLICY)
    assert exported.robots == own.robots
    assert exported.task == own.task
    observations = np.random.default_rng(2).standard_normal((8, 83), dtype=np.float32)
    np.testing.assert_allclose(exported.act(observations), own.act(observations), atol=1e-5)
    with pytest.raises(polypod.ConfigError, match=r"pass policy\.onnx rather than a graph that is folded"):
        policies.load(folder / "policy_spot.onnx")


def test_the_same_figures_as_of_the_checkpoint(exported_policy):
    folder, _ = exported_policy
    arguments = {"robots": ["spot"], "num_envs": 4, "steps": 50, "threads": 1}
    exported = evaluate_checkpoint(folder / "policy.onnx", **arguments)
    own = evaluate_checkpoint(FLAT_POLICY, **arguments)
    ours, theirs = exported.robots["spot"], own.robots["spot"]
    assert ours.error_vel_xy == pytest.approx(theirs.error_vel_xy, abs=1e-3)


def test_a_file_of_unknown_origin_needs_its_task(foreign, tmp_path, cli):
    _, path = foreign
    model = onnx.load(path)
    del model.metadata_props[:]
    onnx.save(model, tmp_path / "bare.onnx")
    done = cli("eval", "--checkpoint", "bare.onnx")
    assert done.returncode == 2
    assert "does not say for which task it is; name it with --task" in done.stderr
    arguments = ("--num-envs", "4", "--steps", "5", "--checkpoint", "bare.onnx")
    assert cli("eval", "--task", SPOT, *arguments).returncode == 0
    assert cli("eval", "--task", "velocity_flat", "--robots", "spot,unitree_a1", *arguments).returncode == 0
    done = cli("eval", "--task", "velocity_flat_universal", *arguments)
    assert done.returncode == 2
    assert "takes observations of 48 numbers" in done.stderr
    assert done.stderr.count("\n") == 1


def test_modules_that_are_no_policy_are_refused(tmp_path):
    env = polypod.make(SPOT, 1, seed=0)
    with pytest.raises(polypod.ConfigError, match=r"gives \(64, 11\).*must give actions \(64, 12\)"):
        policies.save_onnx(Foreign(num_actions=11), env, tmp_path / "a.onnx")
    with pytest.raises(polypod.ConfigError, match=r"ends in \.onnx"):
        policies.save_onnx(Foreign(), env, tmp_path / "a.pt")

    class Random(torch.nn.Module):
        def forward(self, observations: torch.Tensor) -> torch.Tensor:
            return observations[:, :12] + torch.rand_like(observations[:, :12])

    with pytest.raises(polypod.PolypodError, match="without random numbers"):
        policies.save_onnx(Random(), env, tmp_path / "a.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", [b"", b"onnx", b"\x08\x08" * 50])
def test_broken_files_are_refused_in_one_line(content, cli, tmp_path):
    (tmp_path / "broken.onnx").write_bytes(content)
    for command in ("eval", "play", "export", "sim2sim"):
        done = cli(command, "--checkpoint", "broken.onnx")
        assert done.returncode == 2
        assert done.stderr.startswith("polypod: broken.onnx")
        assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "wrong", ["{", '{"format": 2}', '{"format": 1, "task": 3}', '"' * 10, json.dumps({"format": 1, "task": "x" * 5000})]
)
def test_broken_metadata_are_refused(wrong, foreign, tmp_path):
    model = onnx.load(foreign[1])
    onnx.helper.set_model_props(model, {policies.METADATA: wrong})
    onnx.save(model, tmp_path / "wrong.onnx")
    with pytest.raises(polypod.ConfigError, match=r"wrong\.onnx: metadata polypod"):
        policies.load(tmp_path / "wrong.onnx", task=SPOT)


def test_a_fixed_batch_is_refused(tmp_path, foreign):
    model = onnx.load(foreign[1])
    for tensor in (model.graph.input[0], model.graph.output[0]):
        tensor.type.tensor_type.shape.dim[0].dim_value = 1
    onnx.save(model, tmp_path / "one.onnx")
    with pytest.raises(polypod.ConfigError, match="with a batch axis of any size"):
        policies.load(tmp_path / "one.onnx")
