"""Other learners see what `step` returned: observations of 50 steps are compared."""

import re
import subprocess
import sys

import numpy as np
import pytest

import polypod
from common import ROOT

STEPS = 50
ENVS = 16
OPTIONS = {"robots": ["spot", "unitree_a1"], "seed": 4, "overrides": {"sim.episode_length_s": 0.4}}
"""Episodes of 20 steps: some end in each run."""


class Record:
    """Copies of the results of `step` and `reset` of every env."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Listens to all vector envs."""
        self.observations: list[np.ndarray] = []
        self.rewards: list[np.ndarray] = []
        self.ends: list[np.ndarray] = []
        self.finals: list[dict[int, np.ndarray]] = []
        step, reset = polypod.VectorEnv.step, polypod.VectorEnv.reset

        def stepped(env, actions):
            result = step(env, actions)
            observations, rewards, terminated, truncated, infos = result
            self.observations.append(observations.copy())
            self.rewards.append(rewards.copy())
            self.ends.append(terminated | truncated)
            rows = np.flatnonzero(infos["_final_obs"]) if infos else []
            self.finals.append({int(row): infos["final_obs"][row].copy() for row in rows})
            return result

        def begun(env, **arguments):
            result = reset(env, **arguments)
            self.observations[:] = [result[0].copy()]
            self.rewards.clear()
            self.ends.clear()
            self.finals.clear()
            return result

        monkeypatch.setattr(polypod.VectorEnv, "step", stepped)
        monkeypatch.setattr(polypod.VectorEnv, "reset", begun)

    def check(self, observations: np.ndarray) -> None:
        """`observations` [steps, envs, n] are those that actions were chosen by."""
        assert len(observations) == STEPS
        assert sum(end.sum() for end in self.ends) >= 2 * ENVS
        np.testing.assert_array_equal(observations, self.observations[:STEPS])

    def last(self) -> np.ndarray:
        """[steps, envs, n], result of each step: the last observation where an episode ended."""
        last = np.array(self.observations[1:])
        for step, finals in enumerate(self.finals):
            for row, observation in finals.items():
                last[step, row] = observation
        return last


@pytest.fixture
def record(monkeypatch):
    return Record(monkeypatch)


def test_stable_baselines3(record):
    sb3 = pytest.importorskip("stable_baselines3", reason="needs stable-baselines3: make test ONLY=learners")
    import polypod.sb3

    env = polypod.sb3.VecEnv(polypod.make("velocity_flat", ENVS, **OPTIONS))
    model = sb3.PPO("MlpPolicy", env, n_steps=STEPS, batch_size=ENVS * STEPS, n_epochs=1, device="cpu", seed=0)
    kept = []
    callback = type("Keep", (sb3.common.callbacks.BaseCallback,), {"_on_step": lambda self: True})()
    callback._on_rollout_end = lambda: kept.append(model.rollout_buffer.observations.copy())
    model.learn(ENVS * STEPS, callback=callback)
    record.check(kept[0])
    ends = np.array(record.ends)
    assert {info["l"] for info in model.ep_info_buffer} <= set(range(1, 21))
    assert len(model.ep_info_buffer) == min(100, ends.sum())


@pytest.mark.parametrize("algorithm", ["PPO", "PPO with VecNormalize", "SAC"])
def test_the_actor_of_stable_baselines3(algorithm, tmp_path):
    sb3 = pytest.importorskip("stable_baselines3", reason="needs stable-baselines3: make test ONLY=learners")
    import polypod.policy
    import polypod.sb3

    batch = polypod.make("Velocity-Flat-Spot-v0", 4, seed=0)
    env = polypod.sb3.VecEnv(batch)
    if algorithm == "SAC":
        model = sb3.SAC("MlpPolicy", env, buffer_size=100, device="cpu", seed=0)
    else:
        if "VecNormalize" in algorithm:
            env = sb3.common.vec_env.VecNormalize(env, clip_obs=1.0)
        model = sb3.PPO("MlpPolicy", env, n_steps=4, batch_size=16, device="cpu", seed=0)
        model.learn(16)
    path = polypod.policy.save_onnx(polypod.sb3.Actor(model), batch, tmp_path / "sb3.onnx")
    observations = 3.0 * np.random.default_rng(0).standard_normal((32, 48), dtype=np.float32)
    seen = env.normalize_obs(observations) if "VecNormalize" in algorithm else observations
    expected, _ = model.predict(seen, deterministic=True)
    np.testing.assert_allclose(polypod.policy.load(path).act(observations), expected, atol=1e-5)


def test_the_infos_of_stable_baselines3():
    pytest.importorskip("stable_baselines3", reason="needs stable-baselines3: make test ONLY=learners")
    import polypod.sb3

    env, twin = (polypod.make("velocity_flat", ENVS, **OPTIONS) for _ in range(2))
    env = polypod.sb3.VecEnv(env)
    env.seed(7)
    np.testing.assert_array_equal(env.reset(), twin.reset(seed=7)[0])
    actions, returns = np.zeros((ENVS, 12)), np.zeros(ENVS)
    for _ in range(20):
        observations, _, dones, infos = env.step(actions)
        expected, theirs, terminated, truncated, final = twin.step(actions)
        np.testing.assert_array_equal(observations, expected)
        np.testing.assert_array_equal(dones, terminated | truncated)
        returns += theirs
        for row in np.flatnonzero(dones):
            np.testing.assert_array_equal(infos[row]["terminal_observation"], final["final_obs"][row])
            assert infos[row]["TimeLimit.truncated"] == (truncated[row] and not terminated[row])
            assert infos[row]["episode"]["r"] == pytest.approx(returns[row], abs=1e-5)
            returns[row] = 0.0
        assert all(infos[row] == {} for row in np.flatnonzero(~dones))
    assert dones.any()
    assert env.get_attr("step_dt", [0, 3]) == [0.02, 0.02]
    assert env.env_method("env_ids", "spot", indices=0)[0].tolist() == list(range(8))
    with pytest.raises(polypod.ConfigError, match="share one simulator"):
        env.set_attr("note", 1, indices=[0])
    with pytest.raises(polypod.ConfigError, match="same_step"):
        polypod.sb3.VecEnv(polypod.make("velocity_flat", ENVS, **OPTIONS, autoreset="disabled"))
    env.close()


def test_skrl(record):
    pytest.importorskip("skrl", reason="needs skrl: make test ONLY=learners")
    torch = pytest.importorskip("torch")
    from skrl.envs.wrappers.torch import wrap_env

    env = wrap_env(polypod.make("velocity_flat", ENVS, **OPTIONS))
    states, kept = env.reset()[0], []
    for _ in range(STEPS):
        kept.append(states)
        states = env.step(torch.zeros(ENVS, 12))[0]
    record.check(torch.stack(kept).numpy())


def test_torchrl(record):
    pytest.importorskip("torchrl", reason="needs torchrl: make test ONLY=learners")
    from torchrl.envs import GymWrapper
    from torchrl.envs.utils import check_env_specs

    env = GymWrapper(polypod.make("velocity_flat", ENVS, **OPTIONS))
    check_env_specs(env)
    data = env.rollout(STEPS, break_when_any_done=False)
    record.check(data["observation"].transpose(0, 1).numpy())
    np.testing.assert_array_equal(data["next", "observation"].transpose(0, 1).numpy(), record.last())
    np.testing.assert_array_equal(data["next", "reward"].transpose(0, 1)[..., 0].numpy(), record.rewards)


def test_rllib(record):
    pytest.importorskip("ray.rllib", reason="needs ray[rllib]: make test ONLY=learners")
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

    import polypod.rllib

    config = PPOConfig().environment(polypod.rllib.register(), env_config={"task": "velocity_flat", **OPTIONS})
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=ENVS, gym_env_vectorize_mode="vector_entry_point")
    runner = SingleAgentEnvRunner(config=config)
    assert isinstance(runner.env.unwrapped, polypod.VectorEnv)
    assert runner.num_envs == ENVS
    episodes = runner.sample(num_timesteps=ENVS * STEPS, random_actions=True)
    runner.stop()
    seen = {row.tobytes() for rows in record.observations for row in rows}
    kept = [row for episode in episodes for row in np.asarray(episode.get_observations())]
    assert len(kept) > 0.9 * ENVS * STEPS
    assert {row.tobytes() for row in kept} <= seen
    assert len({row.tobytes() for row in kept}) > 0.9 * ENVS * STEPS


def test_rllib_needs_a_task():
    pytest.importorskip("ray.rllib", reason="needs ray[rllib]: make test ONLY=learners")
    import polypod.rllib

    with pytest.raises(polypod.ConfigError, match="env_config names no task"):
        polypod.rllib.make({})
    env = polypod.rllib.make({"task": "Velocity-Flat-Spot-v0", "seed": 1})
    assert env.observation_space.shape == (48,)


def whole_batch() -> np.ndarray:
    """The observations that the shares of several workers are rows of."""
    return polypod.make("velocity_flat", ENVS, **OPTIONS, threads=1).sim.observation.copy()


def test_env_runners_of_rllib_share_one_batch():
    pytest.importorskip("ray.rllib", reason="needs ray[rllib]: make test ONLY=learners")
    from ray.rllib.algorithms.ppo import PPOConfig

    import polypod.rllib

    config = PPOConfig().environment(polypod.rllib.register(), env_config={"task": "velocity_flat", **OPTIONS})
    config.env_runners(env_runner_cls=polypod.rllib.EnvRunner, num_env_runners=2, num_envs_per_env_runner=ENVS // 2)
    seen = []
    for index in (1, 2):
        runner = polypod.rllib.EnvRunner(config=config.copy(copy_frozen=True), worker_index=index, num_workers=2)
        batch = runner.env.unwrapped
        assert (batch.num_envs, batch.sim.threads) == (ENVS // 2, 1)
        seen.append(batch.sim.observation.copy())
        runner.stop()
    np.testing.assert_array_equal(np.concatenate(seen), whole_batch())


def test_workers_of_torchrl_share_one_batch():
    pytest.importorskip("torchrl", reason="needs torchrl: make test ONLY=learners")
    import polypod.torchrl

    options = {key: value for key, value in OPTIONS.items() if key != "seed"}
    envs = [create() for create in polypod.torchrl.creators("velocity_flat", ENVS, 2, **OPTIONS)]
    assert [env.batch_size for env in envs] == [(ENVS // 2,)] * 2
    seen = [env._env.reset(seed=OPTIONS["seed"])[0] for env in envs]
    np.testing.assert_array_equal(np.concatenate(seen), whole_batch())
    seeds = {create.keywords["seed"] for create in polypod.torchrl.creators("velocity_flat", ENVS, 2, **options)}
    assert len(seeds) == 1, "workers without a seed draw one together"
    with pytest.raises(polypod.ConfigError, match="multiple of the workers"):
        polypod.torchrl.creators("velocity_flat", ENVS, 3)
    with pytest.raises(polypod.ConfigError, match="copy=False"):
        polypod.torchrl.make("velocity_flat", ENVS, copy=False)


@pytest.mark.parametrize(
    ("package", "script", "flag"),
    [("ray.rllib", "rllib_workers.py", "--runners"), ("torchrl", "torchrl_workers.py", "--workers")],
)
def test_examples_train_with_two_workers(package, script, flag, tmp_path):
    pytest.importorskip(package, reason=f"needs {package}: make test ONLY=learners")
    words = [sys.executable, ROOT / "examples" / script, flag, "2", "--num-envs", "64", "--iterations", "10"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    figures = re.findall(r"^iteration (\d+): (\d+) steps, mean \w+ (-?[\d.]+)$", done.stdout, re.MULTILINE)
    assert [int(number) for number, _, _ in figures] == list(range(1, 11))
    assert all(int(steps) >= 24 * 64 for _, steps, _ in figures)


def test_rsl_rl(record):
    torch = pytest.importorskip("torch")
    from rsl_rl.runners import OnPolicyRunner

    from polypod.rsl_rl import VecEnv
    from polypod.runs import config

    batch = polypod.make("velocity_flat", ENVS, **OPTIONS)
    settings = config.load("flat", [f"run.num_steps_per_env={STEPS}", "algorithm.num_learning_epochs=1"])
    runner = OnPolicyRunner(VecEnv(batch), settings.rsl_rl_cfg(batch.sim), log_dir=None, device="cpu")
    # the adapter steps the simulator itself: its inputs stand next to what rsl_rl stores
    told, ends = [batch.sim.observation.copy()], 0
    step = batch.sim.step
    sim = runner.env._source

    class Listening:
        def __getattr__(self, name):
            return getattr(sim, name)

        def step(self, actions):
            nonlocal ends
            step(actions)
            told.append(sim.observation.copy())
            ends += int((sim.terminated | sim.truncated).sum())

    runner.env._source = Listening()
    kept = []
    update = runner.alg.update
    runner.alg.update = lambda: kept.append(runner.alg.storage.observations["policy"].clone()) or update()
    runner.learn(1)
    assert ends >= 2 * ENVS
    np.testing.assert_array_equal(kept[0].numpy(), told[:STEPS])
    assert torch.isfinite(kept[0]).all()
