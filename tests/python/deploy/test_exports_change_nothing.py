"""An export, even a failed one, leaves the module and the process as they were."""

import pytest
import torch

import polypod
import polypod.policy as policies
from polypod.export.torch_graph import torchscript
from polypod.networks.agreement import untouched

SPOT = "Velocity-Flat-Spot-v0"


def network(outputs=12):
    torch.manual_seed(0)
    module = torch.nn.Sequential(
        torch.nn.Linear(48, 16), torch.nn.BatchNorm1d(16), torch.nn.Dropout(0.5), torch.nn.Linear(16, outputs)
    ).train()
    # a part that its owner keeps frozen
    module[1].eval()
    module[0].bias.requires_grad_(False)
    return module


def told(module):
    """All that a caller can see of a module and of torch."""
    numbers = {name: (value.clone(), value.data_ptr(), value.device) for name, value in module.state_dict().items()}
    learnt = [parameter.requires_grad for parameter in module.parameters()]
    modes = [part.training for part in module.modules()]
    return numbers, learnt, modes, torch.get_rng_state(), torch.get_num_threads(), torch.is_grad_enabled()


def same(before, after):
    for name, (value, place, device) in before[0].items():
        found = after[0][name]
        assert torch.equal(value, found[0]), name
        assert (place, device) == found[1:], name
    assert before[1:3] == after[1:3]
    assert torch.equal(before[3], after[3])
    assert before[4:] == after[4:]


@pytest.fixture(scope="module")
def env():
    return polypod.make(SPOT, 1, seed=0)


@pytest.mark.parametrize("outputs", [12, 13])
def test_save_onnx(env, tmp_path, outputs):
    module = network(outputs)
    before = told(module)
    if outputs == 12:
        policies.save_onnx(module, env, tmp_path / "x.onnx")
    else:
        with pytest.raises(polypod.ConfigError, match="it must give actions"):
            policies.save_onnx(module, env, tmp_path / "x.onnx")
    same(before, told(module))
    # it goes on learning: nothing of the export is in its graph
    module(torch.zeros(4, 48)).sum().backward()


def test_torchscript():
    module = network()
    before = told(module)
    torchscript(module, (torch.zeros(2, 48),))
    same(before, told(module))


def test_a_module_that_counts_and_draws():
    """Changes by the module's own code while it is lent.

    Buffers in place, replaced buffers, random numbers.
    """

    class Counting(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.register_buffer("calls", torch.zeros(1))
            self.register_buffer("last", torch.zeros(3))

        def forward(self, rows):
            self.calls += 1
            self.last = rows.mean(dim=0)
            return rows + torch.rand_like(rows)

    module = Counting()
    before = told(module)
    with untouched(module):
        module(torch.ones(2, 3))
    same(before, told(module))
    with pytest.raises(RuntimeError, match="expand"), untouched(module):
        module(torch.ones(2, 3)).expand(7, 7)
    same(before, told(module))
