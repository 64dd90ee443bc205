"""`arithmetic = "native"`: the update on a card gives the policy of the CPU, and so does the CPU.

The bits of the card's text: `crates/cuda/tests/updates_have_the_bits_of_the_learner.rs`.
"""

from types import SimpleNamespace

import pytest

import polypod
from common import TINY
from polypod import _core
from polypod.runs import config, run_dir
from polypod.training import native, session
from same_bits import equal

NATIVE = "train.run.arithmetic=native"
ON_CPU = "polypod: the CPU computes the updates, with the same policy: "


def train(folder, device, changes=(), **options):
    """Trains; returns the last checkpoint's path."""
    choices = {**TINY, "max_iterations": 2, **options}
    choices["overrides"] = [*choices["overrides"], NATIVE, *changes]
    assert session.train(session.Options(log_dir=folder, device=device, logger="none", **choices)) == 0
    return run_dir.find_checkpoint(folder, "latest")


def test_a_machine_without_a_card_learns_the_same_policy_and_says_so(tmp_path, capsys, monkeypatch):
    on_cpu = train(tmp_path / "cpu", "cpu")
    assert ON_CPU not in capsys.readouterr().out
    # libcuda finds no device
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    without = train(tmp_path / "cuda", "cuda")
    assert capsys.readouterr().out.count(f"{ON_CPU}card: ") == 1
    assert equal(on_cpu, without)


def test_networks_of_joints_stay_on_the_cpu():
    class Refusing:
        """A learner whose networks no card learns."""

        def use_card(self):
            raise polypod.ConfigError("actor: a card learns perceptrons, and this is a network of joints")

    runner, said = object.__new__(native.CardRunner), []
    runner.reporter = SimpleNamespace(message=said.append)
    runner._learner = Refusing()
    runner._ask_for_card()
    assert runner.card is None
    assert said == [f"{ON_CPU}actor: a card learns perceptrons, and this is a network of joints"]


class Losing:
    """The native learner with a card that is lost in the second update."""

    def __init__(self, *arguments):
        """Makes the learner."""
        self._learner, self._updates = _core.Learner(*arguments), 0

    def __getattr__(self, name):
        """Everything else is the learner's."""
        return getattr(self._learner, name)

    def use_card(self):
        """Takes the card."""
        return "a card"

    def update(self, *arguments):
        """Counts the updates."""
        self._updates += 1
        return self._learner.update(*arguments)

    def take_card_failure(self):
        """Loses the card once."""
        return "cuLaunchKernel: no card" if self._updates == 2 else None


def test_a_card_that_is_lost_is_told_once(tmp_path, capsys, monkeypatch):
    expected = train(tmp_path / "cpu", "cpu", max_iterations=3)
    monkeypatch.setattr(native, "_core", SimpleNamespace(Learner=Losing, ConfigError=_core.ConfigError))
    lost = train(tmp_path / "lost", "cuda", max_iterations=3)
    said = capsys.readouterr().out
    assert "its update on a card with the bits of the CPU" in said
    assert said.count("polypod: warning: a card: cuLaunchKernel: no card; the CPU computes") == 1
    assert equal(expected, lost)


def test_where_a_card_is_asked_for(monkeypatch):
    chosen = config.load("flat", ["run.arithmetic=native"])
    asked = {}
    for has_gpu in (False, True):
        monkeypatch.setattr(session.torch.cuda, "is_available", lambda has_gpu=has_gpu: has_gpu)
        for device in ("cpu", "cuda", "auto"):
            plan = session.settle(session.Options(device=device), chosen, [], None)
            assert (plan.device, plan.config.run.learner) == ("cpu", "native")
            asked[has_gpu, device] = plan.wants_card
    assert [key for key, wants in asked.items() if wants] == [(False, "cuda"), (True, "cuda"), (True, "auto")]


def test_it_goes_with_neither_bfloat16_nor_rsl_rl():
    with pytest.raises(polypod.ConfigError, match=r'arithmetic = "native" computes in single precision'):
        config.load("flat", ["run.arithmetic=native", "algorithm.mixed_precision=on"])
    with pytest.raises(polypod.ConfigError, match=r'arithmetic = "native" is of the native learner'):
        config.load("flat", ["run.arithmetic=native"]).with_learner_resolved("rsl_rl")
    with pytest.raises(polypod.ConfigError, match="not one of torch, native"):
        config.load("flat", ["run.arithmetic=exact"])


@pytest.mark.cuda
@pytest.mark.parametrize("symmetry", ["false", "true", '"alternate"'])
def test_twenty_iterations_on_a_card_give_the_policy_of_the_cpu(symmetry, tmp_path, capsys):
    if (described := _core.cuda()).startswith("not used: "):
        pytest.skip(described)
    changes = [f"train.run.symmetry={symmetry}"]
    options = {"num_envs": 512, "max_iterations": 20}
    on_cpu = train(tmp_path / "cpu", "cpu", changes, **options)
    capsys.readouterr()
    on_card = train(tmp_path / "cuda", "cuda", changes, **options)
    assert "with the bits of the CPU" in capsys.readouterr().out
    assert equal(on_cpu, on_card)
