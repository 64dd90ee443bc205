"""The native learner's networks of joints are torch's: gradients, actions, checkpoints.

And they learn.
"""

import copy

import numpy as np
import pytest
import torch

import polypod
from common import ROOT
from polypod import policy
from polypod.rsl_rl import VecEnv
from polypod.runs import config, run_dir
from polypod.training import session
from polypod.training.native import NativeRunner
from polypod.training.report import Reporter
from polypod.training.workers import Workers
from same_bits import equal

BODIES = ROOT / "tests/data/bodies/configs/robots"
ROBOTS = ["unitree_go2", *(str(BODIES / f"small_{kind}.toml") for kind in ("biped", "hexapod"))]
"""With 12, 8 and 18 joints."""
SMALL = [
    *("train.actor.hidden_dims=[24, 16]", "train.actor.joint_dim=16", "train.actor.num_heads=6"),
    *("train.critic.hidden_dims=[24]", "train.run.num_steps_per_env=12"),
]
ALONE = [
    *("train.algorithm.num_learning_epochs=1", "train.algorithm.num_mini_batches=1", "train.algorithm.schedule=fixed"),
    *("train.algorithm.max_grad_norm=1000000.0", "train.run.symmetry=false"),
]
"""One step of the optimiser, with gradients as they are."""
ITERATIONS = 24
RELATIVE_ERROR = 1e-5
"""Bound relative to a gradient's norm. It is a sum over 576 samples of up to 18 joints in single
precision: a chain of n terms of either sign has an error of about sqrt(n) * 2^-24 of their root
mean square, 6e-6 here. A wrong term has a far larger one."""


def runner_of(folder, overrides=(), envs=48, robots=ROBOTS, of_task=()):
    """A native learner of `any_legged` with new small networks."""
    _, of_training = config.split_overrides([*SMALL, *overrides])
    train_config = config.with_run(config.load("any_legged", of_training), num_envs=envs).with_learner_resolved(
        "native"
    )
    torch.manual_seed(3)
    env = polypod.make(train_config.run.task, envs, seed=11, threads=1, robots=robots, overrides=of_task)
    folder.mkdir(exist_ok=True)
    return NativeRunner(VecEnv(env, log_extras=False), train_config, folder, "cpu", Reporter())


def iterate(runner, iteration):
    """The samples of an iteration that the runner has learnt from."""
    runner._collect(runner.env.get_observations())
    samples = runner._learner.rollout(runner.env.unwrapped.sim)
    runner.alg.learning_rate = 1e-3
    runner._update(runner.env.get_observations())
    runner._give_to_rsl_rl()
    return samples


def loss_of(runner, actor, critic, samples):
    """PPO's loss in double precision."""
    groups, algorithm = runner.env.unwrapped.sim.observation_groups, runner.config.algorithm
    of = {name: torch.from_numpy(samples[name].astype(np.float64)) for name in samples}
    count = len(of["rewards"])
    observations, actions = of["observations"].view(count, -1), of["actions"].view(count, -1)

    def seen(network):
        chosen = runner.config.observed_groups[network]
        return torch.cat([observations[:, slice(*groups[group])] for group in chosen], dim=1)

    mean, deviation, mask = actor.mlp(seen("actor")).unbind(1)
    normal = torch.distributions.Normal(mean, deviation)
    ratio = ((normal.log_prob(actions) * mask).sum(1) - of["log_probs"]).exp()
    clip, advantages = algorithm.clip_param, of["advantages"]
    surrogate = torch.max(-advantages * ratio, -advantages * ratio.clamp(1 - clip, 1 + clip)).mean()
    entropy = (normal.entropy() * mask).sum(1).mean()
    values = critic(seen("critic")).squeeze(1)
    near = of["values"] + (values - of["values"]).clamp(-clip, clip)
    value = torch.max((values - of["returns"]).square(), (near - of["returns"]).square()).mean()
    return surrogate + algorithm.value_loss_coef * value - algorithm.entropy_coef * entropy


@pytest.mark.parametrize("critic", ["MLPModel", "polypod.networks:UrmaModel"])
def test_gradients_are_those_of_autograd_in_double_precision(critic, tmp_path):
    of_critic = [f'train.critic.class_name="{critic}"', "train.critic.joint_dim=8", "train.critic.num_heads=5"]
    joints = of_critic if critic != "MLPModel" else of_critic[:1]
    runner = runner_of(tmp_path / "run", overrides=[*ALONE, *joints])
    iterate(runner, 0)  # statistics and deviations that differ from the first ones
    before = {name: copy.deepcopy(getattr(runner.alg, name)).double() for name in ("actor", "critic")}
    moments = {
        name: [runner.alg.optimizer.state[parameter]["exp_avg"].double() for parameter in runner._parameters(name)]
        for name in before
    }
    samples = iterate(runner, 1)
    actor, critic_model = before["actor"].train(), before["critic"].train()

    def critic_of(observations):
        if hasattr(critic_model.mlp, "moments"):
            return critic_model.mlp(observations)
        return critic_model.mlp(critic_model.obs_normalizer(observations))

    loss_of(runner, actor, critic_of, samples).backward()
    for name, model in before.items():
        # a shift of all joints' attention changes no share: the derivative of its bias is a sum of
        # roundings
        whole = float(torch.cat([parameter.grad.flatten() for parameter in model.parameters()]).norm())
        parameters = zip(model.named_parameters(), runner._parameters(name), moments[name], strict=True)
        for (place, parameter), learnt, first in parameters:
            state = runner.alg.optimizer.state[learnt]
            found = (state["exp_avg"].double() - 0.9 * first) / 0.1
            error = float((found - parameter.grad).norm()) / (float(parameter.grad.norm()) + 1e-3 * whole)
            assert error <= RELATIVE_ERROR, (name, place, error)


def test_a_short_training_learns(tmp_path):
    """Where jerks cost most, a policy learns to be calm."""
    costs = ["rewards.quadruped.action_rate_l2.weight=-0.5"]
    runner = runner_of(tmp_path / "run", envs=128, robots=["unitree_go2"], of_task=costs)
    rewards = []
    for iteration in range(ITERATIONS):
        runner.current_learning_iteration = iteration
        runner._collect(runner.env.get_observations())
        rewards.append(float(runner._learner.rollout(runner.env.unwrapped.sim)["rewards"].mean()))
        runner._update(runner.env.get_observations())
    first, last = np.mean(rewards[:4]), np.mean(rewards[-4:])
    assert first < 0.0, rewards
    assert last > 0.7 * first, rewards


def test_a_checkpoint_acts_in_torch_as_in_the_learner(tmp_path):
    options = session.Options(
        train_config="any_legged", robots=ROBOTS, num_envs=48, max_iterations=2, seed=5, learner="native",
        logger="none", device="cpu", log_dir=tmp_path, overrides=SMALL, threads=1,
    )  # fmt: skip
    run, runner = session.train_with(options, Workers.alone())
    samples = iterate(runner, 2)
    sim = runner.env.unwrapped.sim
    observations = samples["observations"].reshape(48 * 12, -1)[:, slice(*sim.observation_groups["policy"])]
    loaded = policy.load(run_dir.latest_checkpoint(run))
    actions = loaded.act(np.ascontiguousarray(observations))
    means = samples["means"].reshape(actions.shape)
    np.testing.assert_allclose(actions, means, atol=1e-5, rtol=1e-5)
    assert np.abs(means).max() > 0.01
    runner.env.close()


def test_a_run_that_goes_on_is_one_that_never_stopped(tmp_path):
    tiny = {"num_envs": 48, "robots": ROBOTS, "seed": 5, "overrides": [*SMALL, "sim.episode_length_s=1.0"]}
    common = {"learner": "native", "logger": "none", "device": "cpu"}

    def train(folder, **options):
        assert session.train(session.Options(log_dir=tmp_path / folder, **common, **options)) == 0
        return run_dir.find_checkpoint(tmp_path / folder, "latest")

    whole = train("whole", train_config="any_legged", max_iterations=4, threads=2, **tiny)
    tiny["overrides"] = [*tiny["overrides"], "train.run.save_interval=2"]
    train("parts", train_config="any_legged", max_iterations=4, threads=1, **tiny)
    half = next((tmp_path / "parts").rglob("model_2.pt"))
    resumed = train("parts", resume=str(half), max_iterations=2, threads=1)
    assert equal(whole, resumed)
