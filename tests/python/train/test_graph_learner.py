"""The learner of CUDA graphs computes what rsl_rl computes, for any network."""

import pytest
import torch
from test_native_learner_equals_rsl_rl import TOLERANCE, assert_near
from test_urma import BODIES, TASK, URMA

import polypod
from common import ROBOTS
from polypod.rsl_rl import VecEnv
from polypod.runs import config, run_dir
from polypod.training import session
from polypod.training.adam import give_moments
from polypod.training.graph_runner import GraphRunner
from polypod.training.native import NETWORKS
from polypod.training.report import Reporter
from polypod.training.reward_scale import RewardScale
from polypod.training.runner import Runner

CUDA = pytest.param("cuda:0", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"))
ENVS, STEPS, UPDATES = 32, 8, 2
JOINTS = {"class_name": URMA, "joint_dim": 8, "num_heads": 4, "hidden_dims": [16]}
MEMORY = [f"observations.policy.{term}.history_length=3" for term in ("base_ang_vel", "joint_pos_rel", "last_action")]
PRIVILEGED = ['observations.critic=[{term="base_lin_vel"},{term="joint_vel_rel"},{term="feet_contact_force"}]']
VARIANTS = {
    "joints": {},
    "joints_estimate": {"critic": JOINTS},
    "padded": {"robots": BODIES, "critic": JOINTS},
    "padded_uneven": {"robots": BODIES, "algorithm": {"num_mini_batches": 3}},
    "mirror_images": {"run": {"symmetry": True}},
    "padded_mirror_images": {"robots": BODIES, "run": {"symmetry": True}},
    "padded_mirror_loss": {"robots": BODIES, "run": {"symmetry": True}, "algorithm": {"mirror_loss_coef": 5.0}},
    "memory": {"overrides": MEMORY},
    "privileged": {"overrides": PRIVILEGED, "obs_groups": {"critic": ["policy", "critic"]}, "critic": JOINTS},
    "privileged_perceptron": {
        "robots": BODIES,
        "overrides": [*MEMORY, *PRIVILEGED],
        "obs_groups": {"critic": ["policy", "critic"]},
    },
    "plain_rewards": {"run": {"normalize_reward_per_robot": False, "normalize_advantage_per_robot": False}},
    "advantages_of_mini_batches": {
        "run": {"normalize_advantage_per_robot": False},
        "algorithm": {"normalize_advantage_per_mini_batch": True},
    },
    "perceptron": {"actor": {"class_name": "MLPModel", "joint_dim": None, "num_heads": None}},
}


def train_config(variant, **run):
    changes = {key: value for key, value in VARIANTS[variant].items() if key not in ("robots", "overrides")}
    base = config.load("flat_joints").as_dict()
    base["run"] |= {"task": TASK, "num_envs": ENVS, "num_steps_per_env": STEPS, "learner": "rsl_rl", "symmetry": False}
    base["run"] |= {"normalize_reward_per_robot": True, "normalize_advantage_per_robot": True}
    base["algorithm"] |= {"num_learning_epochs": 2, "num_mini_batches": 4, "mixed_precision": "off"}
    base["actor"] |= JOINTS
    for section, values in (*changes.items(), ("run", run)):
        base[section] = {**base.get(section, {}), **values}
    base["actor"] = {key: value for key, value in base["actor"].items() if value is not None}
    return config.parse(base, "test")


def runner(kind, variant, folder, device="cpu", **run):
    settings = VARIANTS[variant]
    made_of = train_config(variant, **run)
    overrides = ["sim.episode_length_s=0.1", *settings.get("overrides", [])]
    robots = settings.get("robots", ROBOTS)
    env = polypod.make(TASK, ENVS, robots=robots, seed=11, overrides=overrides)
    torch.manual_seed(3)
    folder.mkdir(exist_ok=True)
    run_dir.write_params(folder, env.sim, made_of, robots, [], "a test")
    made = kind(VecEnv(env, device, log_extras=False), made_of, folder, device, Reporter(quiet=True))
    made.alg.train_mode()
    return made


def store(reference, rollout, last):
    """Puts a rollout's samples into rsl_rl's storage as rsl_rl does; estimates advantages."""
    alg = reference.alg

    def rows(tensor, step):
        return tensor.view(STEPS, ENVS, -1)[step].cpu()

    for step in range(STEPS):
        observations = last.clone()
        for name, tensor in rollout.observations.items():
            observations[name] = rows(tensor, step)
        alg.act(observations)
        for name, found in (("values", alg.transition.values), ("means", alg.transition.distribution_params[0])):
            assert_near(rows(rollout[name], step), found, name)
        actions = rows(rollout["actions"], step)
        alg.transition.actions, alg.transition.actions_log_prob = actions, alg.actor.get_output_log_prob(actions)
        assert_near(rows(rollout["log_probs"], step), alg.transition.actions_log_prob, "log-densities")
        rewards, dones, time_outs = (
            rollout._exchange.told[name][step].clone() for name in ("rewards", "dones", "time_outs")
        )
        if reference.reward_scale is not None:
            rewards = reference.reward_scale(rewards, dones)
        alg.process_env_step(last, rewards, dones.long(), {"time_outs": time_outs})
    reference._update_alone(last)
    for name in ("returns", "advantages"):
        if name == "returns" or not reference.cfg["algorithm"]["normalize_advantage_per_mini_batch"]:
            assert_near(rollout[name].cpu(), getattr(alg.storage, name), name)


class Reference(Runner):
    """rsl_rl's own update, in two parts."""

    def _update_alone(self, last):
        update, self.alg.update = self.alg.update, dict
        try:
            self._update(last)
        finally:
            self.alg.update = update


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("variant", VARIANTS)
def test_updates_are_equal(variant, device, tmp_path, monkeypatch):
    graphs = runner(GraphRunner, variant, tmp_path / "graphs", device)
    reference = runner(Reference, variant, tmp_path / "reference")
    for update in range(UPDATES):
        graphs._collect(graphs.env.get_observations())
        rollout = graphs._rollout
        last = graphs.env.get_observations().cpu()
        with torch.inference_mode():
            store(reference, rollout, last)
        assert {0.0, 1.0} == set(rollout._exchange.told["dones"].unique().tolist())
        order = rollout.order.cpu().clone()
        assert len(order.unique()) == len(order) == STEPS * ENVS // len(rollout.batch_sizes) * len(rollout.batch_sizes)
        monkeypatch.setattr(torch, "randperm", lambda count, order=order, **_: order[:count])
        expected = reference.alg.update()
        monkeypatch.undo()
        found = graphs._update(last)
        for name in ("value", "surrogate", "entropy"):
            # a surrogate loss is a sum of terms that cancel
            assert abs(found[name] - expected[name]) <= TOLERANCE * (abs(expected[name]) + (name == "surrogate")), name
        assert graphs.alg.learning_rate == pytest.approx(reference.alg.learning_rate, rel=1e-5)
        give_moments(graphs._update_of.optimizer, graphs.alg.optimizer)
        for network in NETWORKS:
            mine, theirs = (getattr(of.alg, network) for of in (graphs, reference))
            for (name, parameter), other in zip(mine.named_parameters(), theirs.parameters(), strict=True):
                if name.endswith("attention.bias"):
                    continue  # a softmax is the same for any: its gradient is rounding, of which Adam makes whole steps
                place = f"{network} {name} after update {update}"
                assert_near(parameter.detach().cpu(), other.detach(), place)
                state, other_state = graphs.alg.optimizer.state[parameter], reference.alg.optimizer.state[other]
                assert_near(state["exp_avg"].cpu(), other_state["exp_avg"], f"gradients of {place}")
                assert state["step"] == other_state["step"]
            for name, buffer in mine.named_buffers():
                assert_near(buffer.cpu(), theirs.get_buffer(name), f"{network} {name}")


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_a_training_goes_on_as_if_it_had_not_stopped(device, tmp_path):
    whole = runner(GraphRunner, "padded", tmp_path / "whole", device, symmetry="alternate", max_iterations=3)
    whole.learn(3)
    half = runner(GraphRunner, "padded", tmp_path / "half", device, symmetry="alternate", max_iterations=3)
    half.learn(2)
    again = runner(GraphRunner, "padded", tmp_path / "again", device, symmetry="alternate", max_iterations=3)
    again.load(str(run_dir.checkpoint_path(half.run, 2)))
    again.learn(1)
    first, second = (
        torch.load(run_dir.checkpoint_path(of.run, 3), map_location="cpu", weights_only=True) for of in (whole, again)
    )
    for part in ("actor_state_dict", "critic_state_dict"):
        for name, tensor in first[part].items():
            assert torch.equal(tensor, second[part][name]), name
    for index, state in first["optimizer_state_dict"]["state"].items():
        for key, tensor in state.items():
            assert torch.equal(tensor, second["optimizer_state_dict"]["state"][index][key]), (index, key)
    logs = (first["infos"]["logger"], second["infos"]["logger"])
    for key in ("reward_sum", "episode_length"):
        assert torch.equal(*(of[key] for of in logs)), key
    # and rsl_rl's own loop goes on from it
    other = runner(Runner, "padded", tmp_path / "other", symmetry=True)
    other.load(str(run_dir.checkpoint_path(half.run, 2)), map_location="cpu")
    assert other.alg.learning_rate == half.alg.learning_rate
    other.learn(1)


def test_what_graphs_read_stays_where_it_is(tmp_path):
    made = runner(GraphRunner, "joints_estimate", tmp_path)
    models = (made.alg.actor, made.alg.critic)
    tensors = [tensor for model in models for tensor in model.state_dict(keep_vars=True).values()]
    scale = list(made.reward_scale.state().values())
    before = [tensor.clone() for tensor in (*tensors, *scale)]
    made._update(made._collect(made.env.get_observations()))
    after = [tensor for model in models for tensor in model.state_dict(keep_vars=True).values()]
    after += made.reward_scale.state().values()
    assert all(new is old for new, old in zip(after, (*tensors, *scale), strict=True))
    assert not any(torch.equal(new, old) for new, old in zip(after, before, strict=True))


def test_images_take_turns(tmp_path):
    """Over two epochs every sample is learnt from as it is and as its image."""
    made = runner(GraphRunner, "joints", tmp_path, symmetry="alternate")
    made._collect(made.env.get_observations())
    seen = []
    update = made._update_of
    with_images = update._with_images

    def spy(index, observations, actions):
        found = with_images(index, observations, actions)
        seen.append((index.clone(), found[2].clone()))
        return found

    update._with_images = spy
    made._update(made.env.get_observations())
    as_they_are = [torch.cat([index[kept] for index, kept in seen[start : start + 4]]) for start in (0, 4)]
    assert sorted(torch.cat(as_they_are).tolist()) == list(range(STEPS * ENVS))
    assert len(as_they_are[0]) == STEPS * ENVS // 2


def test_mini_batches_hold_every_env_equally_often(tmp_path):
    rollout = runner(GraphRunner, "padded", tmp_path)._rollout
    rollout._draw_order()
    for batch in torch.split(rollout.order, rollout.batch_sizes):
        assert ((batch % ENVS).bincount() == STEPS // 4).all()
    # in every iteration others
    before = rollout.order.clone()
    rollout._draw_order()
    assert not torch.equal(before, rollout.order)


def test_descriptions_that_are_not_of_the_robots_joints_are_refused(tmp_path, monkeypatch):
    made = runner(GraphRunner, "padded", tmp_path)
    get_observations = made.env.get_observations

    def changed():
        observations = get_observations().clone()
        observations["policy"][5] = 0.0
        return observations

    monkeypatch.setattr(made.env, "get_observations", changed)
    with pytest.raises(polypod.ConfigError, match="env 5 observes are not of the joints of its robot"):
        made._prepare()


def test_rewards_scaled_together_are_those_scaled_one_by_one():
    generator = torch.Generator().manual_seed(0)
    blocks = [(0, 5), (5, 6), (6, 20)]
    apart, together = (RewardScale(blocks, 0.9, "cpu", together=together) for together in (False, True))
    for _ in range(20):
        rewards = 3.0 + torch.randn(20, generator=generator) * torch.linspace(0.1, 30.0, 20)
        dones = torch.rand(20, generator=generator) < 0.1
        torch.testing.assert_close(together(rewards, dones), apart(rewards, dones))
    for name, value in apart.state().items():
        torch.testing.assert_close(together.state()[name], value, msg=name)


def test_who_learns(tmp_path):
    """On a GPU all networks without a recurrent state.

    Rsl_rl's own loop on a CPU, which knows no images in turn.
    """
    for symmetry, kind in ((False, Runner), ("alternate", GraphRunner)):
        made = runner(Runner, "joints", tmp_path)
        settings = train_config("joints", symmetry=symmetry)
        assert type(session.runner_of(made.env, settings, tmp_path, "cpu", Reporter(quiet=True))) is kind


def test_the_critic_learns_alone(tmp_path):
    """Tensors that graphs read stay in place, and the actor's moments begin with its first step."""
    made = runner(GraphRunner, "plain_rewards", tmp_path)
    before = [parameter.detach().clone() for parameter in made.alg.actor.parameters()]
    critic = [parameter.detach().clone() for parameter in made.alg.critic.parameters()]
    places, rate = [parameter.data_ptr() for parameter in made.alg.actor.parameters()], made.alg.learning_rate
    for update in (made._update_critic, made._update_critic):
        made._collect(made.env.get_observations())
        update(made.env.get_observations())
    assert all(torch.equal(a, b) for a, b in zip(made.alg.actor.parameters(), before, strict=True))
    assert [parameter.data_ptr() for parameter in made.alg.actor.parameters()] == places
    assert not any(torch.equal(a, b) for a, b in zip(made.alg.critic.parameters(), critic, strict=True))
    assert not any(state["step"] or state["exp_avg"].any() for _, state in made._actor_parameters())
    assert made.alg.learning_rate == pytest.approx(rate)
