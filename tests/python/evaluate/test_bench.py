"""`polypod bench` measures what it says, on the same robot and targets in both simulators."""

import json
import sys

import numpy as np
import pytest

from common import size
from polypod import cli
from polypod.bench import physics, report, sampling
from polypod.bench.steps import control_steps
from polypod.mujoco_model import robot as robots


def test_rates_are_work_per_second_in_turn() -> None:
    order = []

    def sample(name: str, work: int):
        def run() -> int:
            order.append(name)
            return work

        return run

    measured = sampling.rates({"a": sample("a", 3), "b": sample("b", 6)}, seconds=0.0, rounds=3)
    assert order == ["a", "b"] * 4
    assert {name: len(rates) for name, rates in measured.items()} == {"a": 3, "b": 3}
    assert sampling.medians({"a": [1.0, 9.0, 2.0]}) == {"a": 2.0}


def closure_of(sample) -> dict:
    """The variables that a sample keeps, by name."""
    return dict(zip(sample.__code__.co_freevars, (cell.cell_contents for cell in sample.__closure__), strict=True))


@pytest.mark.parametrize("name", ["unitree_a1", "unitree_go2"])
def test_both_simulators_tread_on_the_spot(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Robots of both simulators stand on their feet after the settling before a timing.

    With MuJoCo's standard softness of contacts, its fastest, the feet of heavy robots creep apart:
    they are left out.
    """
    states = {}
    simulation = physics._core.Simulation

    def kept(*args, **kwargs):
        states["polypod"] = simulation(*args, **kwargs)
        return states["polypod"]

    monkeypatch.setattr(physics._core, "Simulation", kept)
    assert physics.polypod(name, 16, 1, 0)() == 16 * physics.HOLD
    mine = states["polypod"].qpos
    sample = physics.rollout(name, 16, 1, 0)
    assert sample() == 16 * physics.HOLD
    # full physics state: time, then qpos
    rolled = closure_of(sample)["state"][:, 1:8]
    batch = physics.batch(name, 16, 1, 0)
    assert batch() == 16 * physics.HOLD
    batched = closure_of(batch)["simulations"].bind("qpos")[:, :7]
    height = robots.load(name).base_height
    for where in (mine[:, 2], rolled[:, 2], batched[:, 2]):
        assert np.all(np.abs(where - height) < 0.25 * height)
    for quaternion in (mine[:, 3:7], rolled[:, 3:7], batched[:, 3:7]):
        upright = 1.0 - 2.0 * (quaternion[:, 1] ** 2 + quaternion[:, 2] ** 2)
        assert np.all(upright > 0.8)


@pytest.mark.parametrize("name", ["unitree_a1", "anymal_c", "phantomx"])
def test_rollout_and_batch_step_the_same_model_to_the_same_targets(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """`batch` keeps the solver's warm start between calls and `rollout` does not.

    So their last digits differ.
    """
    monkeypatch.setattr(physics, "SETTLE", 3)
    rolled = closure_of(physics.rollout(name, 4, 2, seed=5))["state"]
    simulations = closure_of(physics.batch(name, 4, 2, seed=5))["simulations"]
    qpos = simulations.bind("qpos")
    np.testing.assert_allclose(rolled[:, 0], 3 * physics.HOLD * physics.DT)
    np.testing.assert_allclose(simulations.bind("time"), 3 * physics.HOLD * physics.DT)
    np.testing.assert_allclose(rolled[:, 1 : 1 + qpos.shape[1]], qpos, atol=1e-5)
    # the envs have different targets, and they move
    assert np.all(np.abs(np.diff(qpos, axis=0)).max(axis=1) > 1e-3)


def test_warp_steps_the_same_model_to_the_same_targets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warp computes in single precision, so that digits differ.

    It steps on the CPU here, as it does on a card.
    """
    pytest.importorskip("mujoco_warp", reason="mujoco-warp is not installed")
    monkeypatch.setattr(physics, "SETTLE", 3)
    simulations = closure_of(physics.batch("unitree_a1", 4, 2, seed=5))["simulations"]
    data = closure_of(physics.warp("unitree_a1", 4, seed=5, device="cpu"))["data"]
    np.testing.assert_allclose(data.time.numpy(), 3 * physics.HOLD * physics.DT, rtol=1e-5)
    np.testing.assert_allclose(data.qpos.numpy(), simulations.bind("qpos"), atol=0.02)


def test_a_card_is_compared_with_warp_where_both_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    assert physics.warp("unitree_a1", 4, seed=5) is None or report._has_card()
    makes = physics.polypod
    monkeypatch.setattr(report, "_has_card", lambda: True)
    monkeypatch.setattr(physics, "warp", lambda *_: lambda: 100)
    monkeypatch.setattr(physics, "polypod", lambda *given, engine="articulated": makes(*given))
    work = {"cuda_steps_per_s": 300.0, "mujoco_warp_steps_per_s": 100.0}
    monkeypatch.setattr(sampling, "rates", lambda samples, *_: {name: [work.get(name, 50.0)] for name in samples})
    figures = report._physics(report.Options(num_envs=16, quick=True), 0.0, 1)
    assert figures["warp_ratio"] == 3.0
    assert "3.0 times MuJoCo Warp, both on the card" in report._ratios({"mujoco": "4.0.0", "physics": figures})


@pytest.mark.parametrize("name", ["phantomx", "unitree_h1", "unitree_go2"])
def test_robots_of_every_class_are_measured(name: str) -> None:
    assert control_steps(report.task_of(name), 2, 1, 0, robots=[name])() == 2


def test_a_mujoco_without_batch_is_said_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo 3.16 and older lack `mujoco.batch`.

    The figures are null and the table names the remedy.
    """
    monkeypatch.setitem(sys.modules, "mujoco.batch", None)
    options = report.Options(num_envs=16, quick=True)
    monkeypatch.setattr(
        sampling, "rates", lambda samples, *_: {name: [float(sample())] for name, sample in samples.items()}
    )
    figures = report._physics(options, 0.0, 1)
    assert figures["mujoco_batch_steps_per_s"] is None
    assert figures["batch_ratio"] is None
    assert figures["ratio"] > 0.0
    result = {"mujoco": "3.16.0", "physics": figures}
    assert "MuJoCo 3.16.0 has no mujoco.batch; 3.17 and newer have it" in report._ratios(result)


def test_json_has_the_promised_figures(
    tmp_path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rates = sampling.rates
    # timings of 0.1 s are long enough for a ratio that is far from 1
    monkeypatch.setattr(sampling, "rates", lambda samples, seconds, rounds: rates(samples, size(0.1, seconds), rounds))
    out = tmp_path / "bench.json"
    assert cli.main(["bench", "--quick", "--num-envs", "64", "--json", str(out)]) == 0
    result = json.loads(out.read_text())
    physics_figures = result["physics"]
    assert physics_figures["env_steps_per_s"] > 0
    assert physics_figures["mujoco_steps_per_s"] > 0
    assert physics_figures["ratio"] > 1.0
    assert physics_figures["mujoco_batch_steps_per_s"] > 0
    assert physics_figures["batch_ratio"] > 1.0
    assert result["env_step"]["env_steps_per_s"] > 0
    assert result["rough"]["env_steps_per_s"] > 0
    assert result["simd"] in ("avx512", "avx2", "neon", "portable")
    assert result["threads"] == 1
    shown = capsys.readouterr().out
    assert "| mujoco.rollout, MuJoCo" in shown
    assert "| mujoco.batch, MuJoCo" in shown
    assert f"{physics_figures['batch_ratio']:.1f} times mujoco.batch" in shown


def test_bad_arguments_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "--quick", "--robot", "nobodys_robot"]) == 2
    assert "unitree_a" in capsys.readouterr().err
    assert cli.main(["bench", "--threads", "0"]) == 2
    assert "--threads" in capsys.readouterr().err


@pytest.mark.parametrize("flags", [("--workers", "1"), ("--learner",)])
def test_a_robot_that_nothing_is_measured_on_is_refused(cli, flags) -> None:
    done = cli("bench", "--robot", "spot", *flags)
    assert done.returncode == 2
    assert "--robot" in done.stderr
    assert done.stderr.count("\n") == 1
