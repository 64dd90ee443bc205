"""Rollouts of a simulator whose steps are on the learner's device: the samples of any other one.

The host's memory stands for the card's, and the simulator's steps on the host for those on the
card.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import polypod
from common import ROBOTS, TASK
from polypod.rsl_rl import VecEnv
from polypod.runs import config, run_dir
from polypod.training import session
from polypod.training.graph_runner import GraphRunner
from polypod.training.report import Reporter
from polypod.training.session import runner_of

ENVS, STEPS = 24, 6


class OnCard(VecEnv):
    """An env whose simulator's arrays are where the learner is."""

    def _find_card(self) -> dict[str, torch.Tensor]:
        sim = self.unwrapped.sim
        columns = max(stop for _, stop in sim.observation_groups.values())
        numbers = {"actions": sim.num_actions, "observation": columns}
        card = {name: torch.full((self.num_envs, width), 1e9) for name, width in numbers.items()}
        card["reward"] = torch.full((self.num_envs,), 1e9)
        return card | {name: torch.zeros(self.num_envs, dtype=torch.bool) for name in ("terminated", "truncated")}

    @property
    def has_state_on_card(self) -> bool:
        """As with a state that somebody has brought to the host."""
        self._show()
        return True

    def step_on_card(self) -> None:
        """The step of the host, with the actions that `card` has."""
        assert self.card is not None
        self.unwrapped.sim.step(self.card["actions"].numpy())
        self._show()

    def _show(self) -> None:
        sim, card = self.unwrapped.sim, self.card
        assert card is not None
        for group, (start, stop) in sim.observation_groups.items():
            card["observation"][:, start:stop] = torch.from_numpy(sim.observation_of(group).copy())
        for name in ("reward", "terminated", "truncated"):
            card[name].copy_(torch.from_numpy(getattr(sim, name).copy()))


def make(kind: type[VecEnv], clip_actions: float | None = None, engine: str = "articulated") -> VecEnv:
    """Envs with short episodes."""
    overrides = ["sim.episode_length_s=0.1", f"physics.engine={engine}"]
    env = polypod.make(TASK, ENVS, robots=ROBOTS, seed=11, overrides=overrides)
    return kind(env, "cpu", log_extras=False, clip_actions=clip_actions)


def trained(kind: type[VecEnv], folder: Any, clip_actions: float | None) -> dict[str, Any]:
    """A runner's state after two iterations."""
    base = config.load("flat").as_dict()
    run = {"task": TASK, "num_envs": ENVS, "num_steps_per_env": STEPS, "learner": "rsl_rl"}
    base["run"] |= {**run, "normalize_reward_per_robot": True, "clip_actions": clip_actions}
    made_of = config.parse(base, "test")
    env = make(kind, clip_actions)
    torch.manual_seed(3)
    folder.mkdir()
    run_dir.write_params(folder, env.unwrapped.sim, made_of, ROBOTS, [], "a test")
    runner = GraphRunner(env, made_of, folder, "cpu", Reporter(quiet=True))
    scalars: list[Any] = []
    runner.watch = lambda _, of_iteration: scalars.append(dict(of_iteration))
    runner.learn(3)
    for of_iteration in scalars:
        assert of_iteration.pop("Loss/value") > 0.0
    ended = (list(runner.logger.rewbuffer), list(runner.logger.lenbuffer))
    return {
        "weights": [parameter.detach().numpy().tobytes() for parameter in runner.alg.actor.parameters()],
        "sim": env.unwrapped.sim.snapshot(),
        "ended": ended,
        "scalars": scalars,
    }


@pytest.mark.parametrize("clip_actions", [None, 0.7])
def test_a_training_on_the_card_is_that_of_the_host(tmp_path: Any, clip_actions: float | None) -> None:
    host = trained(VecEnv, tmp_path / "host", clip_actions)
    card = trained(OnCard, tmp_path / "card", clip_actions)
    assert len(host["ended"][0]) > ENVS
    for name, of_host in host.items():
        assert card[name] == of_host, name


def test_the_adapter_steps_on_the_card_as_on_the_host() -> None:
    host, card = make(VecEnv), make(OnCard)
    for step in range(8):
        actions = torch.from_numpy(np.random.default_rng(step).uniform(-1, 1, (ENVS, host.num_actions))).float()
        of_host, of_card = host.step(actions), card.step(actions)
        assert torch.equal(of_host[0]["policy"], of_card[0]["policy"]), step
        for one, other in zip(of_host[1:3], of_card[1:3], strict=True):
            assert one.dtype == other.dtype
            assert torch.equal(one, other), step
        assert torch.equal(of_host[3]["time_outs"], of_card[3]["time_outs"])
    kept = card.step(actions)[0]["policy"]
    before = kept.clone()
    card.step(actions)
    assert torch.equal(kept, before), "observations survive the next step"


def test_the_native_learner_acts_on_the_card_too(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made_of = config.load("flat")
    chosen: list[str] = []
    for name in ("GraphRunner", "GpuRunner"):
        monkeypatch.setattr(f"polypod.training.session.{name}", lambda *_, name=name: chosen.append(name))
    made_of = made_of.with_learner_resolved("native", "cuda")
    for env in (make(VecEnv), make(OnCard)):
        runner_of(env, made_of, tmp_path, "cuda:0", Reporter(quiet=True))
    assert chosen == ["GpuRunner", "GraphRunner"]


class CouldBeOnCard(VecEnv):
    """An env whose steps a card could make, and the CPU makes faster."""

    could_have_card = True


@pytest.mark.parametrize("engine", ["articulated", "auto"])
def test_an_engine_that_times_itself_does_not_decide_the_policy(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch, engine: str
) -> None:
    chosen: list[str] = []
    for name in ("GraphRunner", "GpuRunner"):
        monkeypatch.setattr(f"polypod.training.session.{name}", lambda *_, name=name: chosen.append(name))
    made_of = config.load("flat").with_learner_resolved("native", "cuda")
    # no card here; one that could make the steps, and is slower or faster
    for kind in (VecEnv, CouldBeOnCard, OnCard):
        runner_of(make(kind, engine=engine), made_of, tmp_path, "cuda:0", Reporter(quiet=True))
    assert chosen == ["GpuRunner", "GraphRunner" if engine == "auto" else "GpuRunner", "GraphRunner"]


@pytest.mark.parametrize(
    ("engine", "said"),
    [
        ("auto", "physics.engine=auto: the card makes the steps: 1 ms"),
        ("cuda", "physics.engine=cuda: the CPU makes all but the physics: no form on the card has uneven ground"),
        ("articulated", None),
    ],
)
def test_a_training_says_who_makes_the_steps(monkeypatch: pytest.MonkeyPatch, engine: str, said: str | None) -> None:
    sim: Any = SimpleNamespace(
        choice_of_engine="the card makes the steps: 1 ms", lacks_on_device=lambda: "uneven ground"
    )
    monkeypatch.setattr(session.simulated, "config", lambda _: {"task": {"physics": {"engine": engine}}})
    assert session._why(sim) == said
    silent: Any = SimpleNamespace(choice_of_engine=None, lacks_on_device=lambda: None)
    assert session._why(silent) is None
