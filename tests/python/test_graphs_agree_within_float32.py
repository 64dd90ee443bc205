"""Every sound policy is exported, however large its numbers.

A graph that computes something else is refused.
"""

import numpy as np
import onnx
import pytest
import torch

import polypod
import polypod.policy as policies
from common import FLAT_POLICY, MASKED_POLICY, ROUGH_POLICY
from polypod.export import OnnxPolicy, checkpoint, export_checkpoint, onnx_graph
from polypod.networks.agreement import TOLERANCE
from polypod.policy import load

SPOT = "Velocity-Flat-Spot-v0"


@pytest.mark.parametrize("file", [FLAT_POLICY, ROUGH_POLICY, MASKED_POLICY], ids=["flat", "rough", "masked"])
def test_perceptrons_are_exported_and_act_the_same(file, tmp_path):
    done = export_checkpoint(file, tmp_path, formats=("onnx",))
    assert done.difference <= TOLERANCE
    policy = load(file)
    observations = np.random.default_rng(1).standard_normal(
        (64, policy.manifest["policy"]["num_obs"]), dtype=np.float32
    )
    wanted = policy.act(observations)
    found = OnnxPolicy(tmp_path / "policy.onnx")(obs=observations)["actions"]
    assert np.abs(found - wanted).max() <= 1e-5 * np.abs(wanted).max()


def changed(model, change):
    """The bytes of a model whose second weight matrix is changed, and put back in it."""
    (weights,) = [entry for entry in model.graph.initializer if entry.name == "layer_2_weight"]
    array = onnx.numpy_helper.to_array(weights).copy()
    weights.CopyFrom(onnx.numpy_helper.from_array(np.ascontiguousarray(change(array)), weights.name))
    return model.SerializeToString()


def one_weight(array):
    array[3, 5] += 0.01 * np.abs(array).max()
    return array


@pytest.mark.parametrize(
    "change",
    [one_weight, lambda array: np.roll(array, 1, axis=0), lambda array: array[:, ::-1], lambda array: array * 1.001],
    ids=["one weight", "rows", "columns", "scale"],
)
def test_a_wrong_graph_is_refused(change):
    network = load(MASKED_POLICY).network
    sizes = load(MASKED_POLICY).manifest["policy"]
    model = onnx_graph.network_model(network, sizes["num_obs"], sizes["num_actions"], {})
    module = network.as_jit()
    sound, wrong = model.SerializeToString(), changed(model, change)
    differences = [
        checkpoint.compare(OnnxPolicy(data), module, {"obs": sizes["num_obs"]}, ["actions"]) for data in (sound, wrong)
    ]
    assert differences[0] <= TOLERANCE < differences[1]


def test_the_export_refuses_a_wrong_graph(tmp_path, monkeypatch):
    def transposed(*arguments):
        model = network_model(*arguments)
        (weights,) = [entry for entry in model.graph.initializer if entry.name == "layer_2_weight"]
        array = onnx.numpy_helper.to_array(weights)
        weights.CopyFrom(onnx.numpy_helper.from_array(np.ascontiguousarray(array.T), weights.name))
        return model

    network_model = onnx_graph.network_model
    monkeypatch.setattr(onnx_graph, "network_model", transposed)
    with pytest.raises(polypod.PolypodError, match=r"policy\.onnx differs from the checkpoint by"):
        export_checkpoint(FLAT_POLICY, tmp_path, formats=("onnx",))
    assert not list(tmp_path.iterdir())


class Cancelling(torch.nn.Module):
    """Small actions that are differences of large numbers."""

    def __init__(self):
        """Draws the weights."""
        super().__init__()
        self.layer = torch.nn.Linear(48, 12)

    def forward(self, observations):
        """Actions of observations."""
        wide = torch.cat([1e4 + self.layer(observations), 1e4 - self.layer(observations)], dim=1)
        return 0.5 * (wide[:, :12] - wide[:, 12:])


@pytest.fixture(scope="module")
def env():
    return polypod.make(SPOT, 1, seed=0)


@pytest.mark.parametrize("factor", [1.0, 30.0, 300.0, 1e5])
def test_weights_may_be_large(env, tmp_path, factor):
    torch.manual_seed(0)
    layers = [torch.nn.Linear(48, 256), torch.nn.ELU(), torch.nn.Linear(256, 256), torch.nn.ELU()]
    module = torch.nn.Sequential(*layers, torch.nn.Linear(256, 12))
    with torch.no_grad():
        module[-1].weight *= factor
    assert policies.save_onnx(module, env, tmp_path / "large.onnx").is_file()


def test_actions_may_be_differences_of_large_numbers(env, tmp_path):
    torch.manual_seed(0)
    assert policies.save_onnx(Cancelling(), env, tmp_path / "cancelling.onnx").is_file()


@pytest.mark.parametrize(
    ("forward", "message"),
    [
        (lambda x: x[:, :12] if bool(x[0, 0] > 0.0) else -x[:, :12], "without branches that depend on its input"),
        (lambda x: torch.where(x[:, :12].sum() > 0.0, x[:, :12], torch.full_like(x[:, :12], torch.nan)), "gives nan"),
        (lambda x: x[:, :12] * 1e38 * 1e2, "gives -?inf in output 0"),
        (lambda x: x[:, :12].double(), r"actions of torch\.float64; it must give float32"),
        (lambda x: x @ torch.zeros(3, 12), r"fails for observations \(64, 48\).*RuntimeError"),
        (lambda x: x[:, :12] + torch.rand_like(x[:, :12]), "without random numbers"),
    ],
    ids=["branch", "nan", "overflow", "double", "fails", "random"],
)
def test_a_module_that_is_no_policy_is_told_so(env, tmp_path, forward, message):
    class Module(torch.nn.Module):
        def forward(self, observations):
            return forward(observations)

    with pytest.raises(polypod.PolypodError, match=message):
        policies.save_onnx(Module(), env, tmp_path / "no.onnx")
    assert not list(tmp_path.iterdir())
