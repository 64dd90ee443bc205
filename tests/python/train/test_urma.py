"""The network of joints: the same weights for any bodies in one batch.

All tools use it like any other network.
"""

import dataclasses
import json

import numpy as np
import pytest
import torch
from rsl_rl.models import MLPModel
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

import polypod
import polypod.rsl_rl
from common import ROBOTS, ROOT
from polypod import _core, networks
from polypod.evaluation import evaluate_checkpoint, load_network
from polypod.export import OnnxPolicy, export_checkpoint, onnx_graph
from polypod.export.checkpoint import compare
from polypod.networks.joints import joint_columns
from polypod.observation import layout_of as layout_of_terms
from polypod.observation import terms_of
from polypod.runs import config, run_dir
from polypod.training import session
from polypod.training.symmetry import Mirror

URMA = "polypod.networks:UrmaModel"
TASK = "velocity_flat_joints"
FOLDER = ROOT / "tests/data/bodies/configs/robots"
BODIES = ["unitree_go2", *(str(FOLDER / f"small_{kind}.toml") for kind in ("biped", "hexapod", "quadruped"))]
"""With 12, 8, 18 and 8 joints, 38 slots in all."""
SLOTS = [f"J{joint}" for joint in range(12)]
GENERAL, STATES, NUMBERS = 12, 3, 19
"""Layout of the task: numbers that belong to no joint, numbers of a joint's state, numbers of its
description."""


def layout_of(joints):
    terms = ["base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands"]
    per_joint = ["joint_pos_rel", "joint_vel_rel", "last_action"]
    return [*((term, 3) for term in terms), *((term, joints) for term in per_joint), ("joint_descriptors", 19 * joints)]


def build(joints, layout=None, seed=0, **changes):
    """A network with this number of slots."""
    layout = layout or layout_of(joints)
    torch.manual_seed(seed)
    model = {
        "class_name": URMA,
        "num_obs": sum(size for _, size in layout),
        "num_actions": joints,
        "hidden_dims": [24, 16],
        "activation": "elu",
        "obs_normalization": False,
        "joint_dim": 16,
        "num_heads": 4,
        "observation_layout": layout,
        "joint_names": [f"L_KNEE_{joint + 2}" for joint in range(joints)],
        "distribution_cfg": {"class_name": "polypod.networks:JointGaussian"},
    }
    return networks.build_actor({**model, **changes}).eval()


def batch_of(observations):
    rows = torch.as_tensor(observations)
    return TensorDict({"policy": rows}, batch_size=[len(rows)])


def actions_of(network, observations):
    with torch.no_grad():
        return network(batch_of(observations))


def observations_of(rows, joints, lacks=(), seed=0):
    """Random observations [rows, n]; `lacks` names slots of rows (row, slot) that hold no joint."""
    generator = torch.Generator().manual_seed(seed)
    general = torch.randn(rows, GENERAL, generator=generator)
    of_joints = torch.randn(rows, STATES + NUMBERS, joints, generator=generator)
    for row, slot in lacks:
        of_joints[row, :, slot] = 0.0
    return torch.cat([general, of_joints.flatten(1)], dim=1)


def mixed_env(robots=BODIES, per_robot=3, slots=()):
    overrides = ["observations.enable_noise=false"]
    env = polypod.make(TASK, per_robot * len(robots), robots=robots, seed=3, overrides=overrides, slots=slots)
    rng = np.random.default_rng(0)
    for _ in range(3):
        env.step(rng.standard_normal((env.num_envs, env.sim.num_actions)).astype(np.float32))
    return env


def network_of(env, **changes):
    sim = env.sim
    layout = [tuple(entry) for entry in sim.observation_layout]
    network = build(sim.num_actions, layout, joint_names=sim.canonical_joint_names, obs_normalization=True, **changes)
    network.train()
    network.update_normalization(batch_of(sim.observation.copy()))
    return network.eval()


@pytest.mark.parametrize("leg_heads", [None, 3])
def test_a_robot_acts_in_company_as_it_does_alone_and_what_it_lacks_is_zero(leg_heads):
    env = mixed_env()
    network = network_of(env, leg_heads=leg_heads)
    together = actions_of(network, env.sim.observation.copy())
    mask = torch.from_numpy(env.action_mask)
    assert (mask.sum(1).numpy() == np.repeat([12, 8, 18, 8], 3)).all()
    assert (together[~mask] == 0.0).all()
    assert (together[mask] != 0.0).all()
    for robot in env.robots:
        rows = slice(*env.sim.env_ids(robot))
        alone = actions_of(network, env.sim.observation[rows].copy())
        torch.testing.assert_close(alone, together[rows], rtol=1e-5, atol=1e-6)
        # and where there are no slots but its own
        own = [name for name, real in zip(env.canonical_joint_names, mask[rows.start], strict=True) if real]
        keep = torch.cat([torch.ones(GENERAL, dtype=torch.bool), mask[rows.start].repeat(STATES + NUMBERS)])
        small = build(len(own), joint_names=own, obs_normalization=True, leg_heads=leg_heads)
        small.load_state_dict(network.state_dict(), strict=True)
        observation = torch.from_numpy(env.sim.observation[rows])[:, keep]
        torch.testing.assert_close(actions_of(small, observation), alone[:, mask[rows.start]], rtol=1e-5, atol=1e-6)
    env.close()


def test_heads_of_legs_read_the_same_whatever_other_limbs_a_body_has():
    legs = ["L_HIP_PITCH", "R_HIP_PITCH", "L_KNEE", "R_KNEE"]
    names = [*legs, "TORSO_YAW", "HEAD_YAW", "ARM_ROLL_2", "L_SHOULDER_ROLL", "R_ELBOW", "L_WRIST_YAW"]
    whole = observations_of(4, len(names))
    bare = whole.clone()
    bare[:, GENERAL:] *= torch.tensor([name in legs for name in names]).repeat(STATES + NUMBERS)
    network = build(len(names), joint_names=names, leg_heads=3).mlp
    alone = build(len(legs), joint_names=legs, leg_heads=3).mlp
    alone.load_state_dict(network.state_dict())
    keep = torch.cat([torch.ones(GENERAL, dtype=torch.bool), bare[0, GENERAL:] != 0.0])
    readings = []
    for of, observations in ((network, whole), (network, bare), (alone, bare[:, keep])):
        with torch.no_grad():
            joints = of._joints(observations)
            description = of.describe(joints.descriptions)
            code = torch.sin(of.code(joints.relative))
            shares = of._shares(joints.at_places(of.attention(description) + of.focus(code)), joints)
            state = of.activation(of.state(joints.states) + of.state_by_description(description))
            gathered = torch.matmul(shares.transpose(1, 2), joints.at_places(of.value(state)))
        codes = joints.at_places(code)[:, : len(legs)]
        readings.append((codes, gathered[:, :3], gathered[:, 3:]))
    for codes, of_legs, of_others in readings[1:]:
        torch.testing.assert_close(codes, readings[0][0], rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(of_legs, readings[0][1], rtol=1e-6, atol=1e-6)
        assert (of_others == 0.0).all()
    assert (readings[0][2] != 0.0).all()
    # and a network without heads of legs does not
    plain = build(len(names), joint_names=names).mlp
    with torch.no_grad():
        assert not torch.allclose(plain._joints(whole).relative[:4], plain._joints(bare).relative[:4], atol=1e-2)


def test_slots_of_legs_are_told_by_their_roles():
    of_legs = ["LF_HAA", "RM_HIP_LIFT", "L_HIP_YAW", "R_KNEE", "LH_WHEEL", "L_ANKLE_ROLL", "R_SLIDE"]
    others = ["TORSO_YAW", "HEAD_PITCH", "ARM_ROLL_2", "TAIL_SLIDE", "L_SHOULDER_YAW", "R_ELBOW", "no slot"]
    assert _core.slots_of_legs(of_legs + others) == [True] * len(of_legs) + [False] * len(others)


@pytest.mark.parametrize("leg_heads", [None, 3])
def test_a_robot_without_joints_takes_no_actions(leg_heads):
    observations = observations_of(3, 5)
    observations[:, GENERAL:] = 0.0
    network = build(5, obs_normalization=True, leg_heads=leg_heads)
    assert (actions_of(network, observations) == 0.0).all()


def test_no_slot_has_a_column_of_its_own():
    """In another order of the slots, the same joints take the same actions."""
    joints, rows = 14, 6
    lacks = [(row, slot) for row in range(rows) for slot in range(joints) if (row + slot) % 5 == 0]
    observations = observations_of(rows, joints, lacks)
    order = torch.from_numpy(np.random.default_rng(0).permutation(joints))
    of_joints = observations[:, GENERAL:].unflatten(1, (-1, joints))[:, :, order]
    permuted = torch.cat([observations[:, :GENERAL], of_joints.flatten(1)], dim=1)
    network = build(joints)
    torch.testing.assert_close(actions_of(network, permuted), actions_of(network, observations)[:, order])
    critic = networks.UrmaModel(
        batch_of(observations),
        {"critic": ["policy"]},
        "critic",
        1,
        joint_dim=16,
        num_heads=4,
        observation_layout=layout_of(joints),
        joint_names=[""] * joints,
    )
    torch.testing.assert_close(critic(batch_of(permuted)), critic(batch_of(observations)))


def test_density_entropy_and_divergence_are_those_of_the_real_joints_alone():
    env = mixed_env()
    network = network_of(env)
    observations = batch_of(env.sim.observation.copy())
    mask = torch.from_numpy(env.action_mask)
    actions = network(observations, stochastic_output=True)
    assert (actions[~mask] == 0.0).all()
    normal = torch.distributions.Normal(network.output_mean, network.output_std)
    real = mask.float()
    torch.testing.assert_close(network.get_output_log_prob(actions), (normal.log_prob(actions) * real).sum(1))
    torch.testing.assert_close(network.output_entropy, (normal.entropy() * real).sum(1))
    old = tuple(tensor.detach() for tensor in network.output_distribution_params)
    # numbers in slots that a robot lacks count for nothing
    new = (old[0] + 0.3 + 5.0 * ~mask, old[1], old[2])
    expected = (real * (0.3 / old[1]).square() / 2.0).sum(1)
    torch.testing.assert_close(network.get_kl_divergence(old, new), expected)
    (network.get_output_log_prob(actions).sum() + network.output_entropy.sum()).backward()
    gradients = {name: weight.grad for name, weight in network.named_parameters()}
    assert [name for name, gradient in gradients.items() if gradient is None or not gradient.abs().sum() > 0] == []
    env.close()


def test_joints_begin_apart_and_alike_ones_of_different_robots_together():
    """A network of joints learns only what it can tell apart.

    Codes of one robot's joints, and of two robots'.
    """
    env = polypod.make(TASK, 8, seed=0)
    network = build(12, joint_dim=256, obs_normalization=True)
    network.train()
    network.update_normalization(batch_of(env.sim.observation.copy()))
    joints = network.mlp._joints(torch.from_numpy(env.sim.observation.copy()))
    code = torch.sin(network.mlp.code(joints.relative)).unflatten(0, (8, 12))
    code = code / code.norm(dim=2, keepdim=True)
    within = torch.einsum("rjk,rik->rji", code, code) - torch.eye(12)
    # a correlation of 1 would be a joint that acts as another one does
    assert within.abs().max() < 0.85
    assert within.abs().mean() < 0.15
    a1, go2 = (env.robots.index(name) for name in ("unitree_a1", "unitree_go2"))
    between = torch.einsum("jk,ik->ji", code[a1], code[go2])
    assert (between.argmax(dim=1) == torch.arange(12)).all()
    env.close()


def first_step(network, observations):
    """Mean square of the actions' change in a step of the optimiser.

    The advantages have no pattern.
    """
    generator = torch.Generator().manual_seed(1)
    weights = [weight for weight in network.parameters() if weight.requires_grad]
    optimizer = torch.optim.Adam(weights, 1e-3)
    before = network(observations)
    drawn = torch.randn(before.shape, generator=generator) * torch.randn(len(before), 1, generator=generator)
    (before * drawn).mean().backward()
    optimizer.step()
    return (network(observations) - before).detach().square().mean().item()


@pytest.mark.parametrize("seed", range(3))
def test_a_step_of_the_optimiser_moves_the_policy_no_further_than_a_perceptrons(seed):
    """Else PPO's divergence holds the learning rate down, and the network learns little."""
    moves = []
    for name in ("flat_universal", "flat_joints"):
        shipped = config.load(name)
        env = polypod.make(shipped.run.task, num_envs=256, seed=seed)
        for action in np.random.default_rng(seed).standard_normal((10, 256, 12)):
            env.step(0.3 * action.astype(np.float32))
        size = {"num_obs": env.sim.num_obs, "num_actions": env.sim.num_actions}
        torch.manual_seed(seed)
        network = networks.build_actor({**size, **shipped.actor.model_cfg(env.sim)}).train()
        observations = batch_of(env.sim.observation.copy())
        network.update_normalization(observations)
        moves.append(first_step(network, observations))
        env.close()
    assert 0.1 < moves[1] / moves[0] < 2.0


def test_columns_are_read_by_what_their_terms_are():
    """The observation is read in the same way under other names with their descriptions."""
    env = polypod.make(TASK, num_envs=8)
    layout = layout_of_terms(terms_of(env.sim))
    env.close()
    assert [(entry["term"], entry["size"]) for entry in layout] == layout_of(12)
    renamed = [{**entry, "term": f"own_{index}"} for index, entry in enumerate(layout)]
    old, new = joint_columns(layout_of(12), SLOTS), joint_columns(renamed, SLOTS)
    for field in dataclasses.fields(old):
        np.testing.assert_array_equal(getattr(new, field.name), getattr(old, field.name))
    assert old.states[1].tolist() == list(range(24, 36))
    assert old.magnitudes.tolist() == [1.0, 10.0, 1.0]
    assert old.descriptions[2].tolist() == list(range(48 + 24, 48 + 36))
    assert old.general.tolist() == list(range(12))
    # another term of a joint is one more number of its state
    more = [*renamed, {"term": "motor_temperature", "size": 12, "kind": "per_joint", "magnitude": 50.0, "blocks": []}]
    table = joint_columns(more, SLOTS)
    assert table.states.shape == (4, 12)
    assert table.states[3, 3] == table.num_obs - 12 + 3


@pytest.mark.parametrize(
    ("joints", "layout", "message"),
    [
        (12, layout_of(12)[:-1], "says what each joint is, such as joint_descriptors, which the task lacks"),
        (12, [layout_of(12)[0], layout_of(12)[-1]], "says what each joint does, such as joint_pos_rel"),
        (11, layout_of(12), "joint_pos_rel has 12 numbers, which are no multiple of 11 joints"),
    ],
)
def test_what_does_not_fit_is_named(joints, layout, message):
    with pytest.raises(polypod.ConfigError, match=message):
        build(joints, layout)


def test_normalisation_counts_the_joints_that_there_are():
    """One mean and deviation for all joints of all robots; checked against a plain sum."""
    joints, rows = 6, 50
    lacks = [(row, slot) for row in range(rows) for slot in range(joints) if slot > 3 or row % 3 == slot]
    network = build(joints, obs_normalization=True).train()
    batches = [2.0 * observations_of(rows, joints, lacks, seed) for seed in range(3)]
    for batch in batches:
        network.update_normalization(batch_of(batch))
    every = torch.cat(batches)
    of_joints = every[:, GENERAL:].unflatten(1, (-1, joints)).transpose(1, 2).flatten(0, 1)
    real = of_joints[(of_joints[:, STATES:] != 0.0).any(1)]
    assert len(real) == 3 * (rows * joints - len(lacks))
    scale = torch.tensor([1.0, 0.1, 1.0])
    moments = network.mlp.moments
    for name, numbers in (("states", real[:, :STATES] * scale), ("numbers", real[:, STATES:])):
        torch.testing.assert_close(moments[name].mean, numbers.mean(0))
        torch.testing.assert_close(moments[name].std, numbers.std(0, unbiased=False))
    torch.testing.assert_close(moments["general"].mean, every[:, :GENERAL].mean(0))
    network.eval()
    before = moments["states"].mean
    network.update_normalization(batch_of(100.0 + batches[0]))
    assert torch.equal(moments["states"].mean, before)


@pytest.mark.parametrize(("activation", "leg_heads"), [("elu", None), ("elu", 3), ("relu", None), ("tanh", 4)])
def test_the_graph_computes_what_torch_does(activation, leg_heads):
    joints = 9
    names = [*(f"L_KNEE_{joint}" for joint in range(2, 8)), "TORSO_YAW", "L_ELBOW", "HEAD_YAW"]
    lacks = [(row, slot) for row in range(99) for slot in range(joints) if (row + slot) % 4 == 0 or row < slot - 5 < 4]
    observations = observations_of(99, joints, lacks)
    changes = {"activation": activation, "leg_heads": leg_heads, "joint_names": names}
    network = build(joints, obs_normalization=activation != "relu", **changes).train()
    network.update_normalization(batch_of(observations))
    network.eval()
    num_obs = observations.shape[1]
    graph = OnnxPolicy(onnx_graph.network_model(network, num_obs, joints, {}).SerializeToString())
    assert compare(graph, network.as_jit(), {"obs": num_obs}, ["actions"]) <= 1e-5
    found = torch.from_numpy(graph(obs=observations.numpy())["actions"])
    torch.testing.assert_close(found, actions_of(network, observations), rtol=1e-5, atol=1e-5)
    assert (found[[row for row, _ in lacks], [slot for _, slot in lacks]] == 0.0).all()


def test_a_height_scan_belongs_to_the_body():
    network = build(12, [*layout_of(12), ("height_scan", 187)])
    observations = torch.cat([observations_of(3, 12), torch.randn(3, 187)], dim=1)
    changed = observations.clone()
    changed[:, -50] += 1.0
    assert (actions_of(network, observations) != actions_of(network, changed)).any(dim=1).all()


def test_mirror_images_of_different_bodies_are_observations_of_bodies():
    """The image of a symmetric body in a mirrored pose is the mirrored observation."""
    env = mixed_env()
    adapter = polypod.rsl_rl.VecEnv(env)
    observations = adapter.get_observations()
    images, actions = Mirror(adapter, "cpu").augment(adapter, observations, torch.ones(env.num_envs, 38))
    count = env.num_envs
    mask = torch.from_numpy(env.action_mask)
    network = network_of(env)
    network(images, stochastic_output=True)
    assert torch.equal(network.distribution.mask[:count].bool(), mask)
    assert torch.equal(network.distribution.mask[count:].bool(), actions[count:].abs().bool() & mask)
    # descriptions of a robot that is its own image stay, up to the small differences of its URDF
    numbers = images["policy"][:, GENERAL + STATES * 38 :].unflatten(1, (NUMBERS, 38))
    go2 = slice(*env.sim.env_ids("unitree_go2"))
    torch.testing.assert_close(numbers[count:][go2][:, :13], numbers[:count][go2][:, :13], atol=2e-3, rtol=0.0)
    env.close()


@pytest.fixture
def small(tmp_path):
    """A train config of this network, small and with everything that may touch it switched on."""
    path = tmp_path / "small.toml"
    path.write_text(
        'extends = "flat"\n'
        f'[run]\ntask = "{TASK}"\nnum_envs = 32\nsymmetry = true\nnormalize_reward_per_robot = true\n'
        "normalize_advantage_per_robot = true\n"
        f'[actor]\nclass_name = "{URMA}"\nhidden_dims = [24, 16]\njoint_dim = 8\nnum_heads = 4\n'
        "obs_normalization = true\n"
        f'[critic]\nclass_name = "{URMA}"\nhidden_dims = [24]\njoint_dim = 8\nnum_heads = 4\n'
    )
    return str(path)


def train(log_dir, train_config, **options):
    arguments = {"robots": ROBOTS, "seed": 5, "overrides": ["sim.episode_length_s=1.0"], "train_config": train_config}
    arguments = {"log_dir": log_dir, "device": "cpu", "logger": "none", **arguments, **options}
    assert session.train(session.Options(**arguments)) == 0
    return run_dir.find_checkpoint(log_dir, "latest")


def test_rsl_rls_own_runner_finds_it_by_its_name(small):
    env = polypod.rsl_rl.VecEnv(polypod.make(TASK, num_envs=16, seed=1))
    cfg = config.load(small).rsl_rl_cfg(env.unwrapped.sim)
    runner = OnPolicyRunner(env, cfg, log_dir=None, device="cpu")
    before = [weight.clone() for weight in runner.alg.actor.mlp.parameters()]
    runner.learn(num_learning_iterations=1)
    after = list(runner.alg.actor.mlp.parameters())
    assert isinstance(runner.alg.actor, networks.UrmaModel)
    assert isinstance(runner.alg.critic, networks.UrmaModel)
    assert all(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
    with pytest.raises(polypod.ConfigError, match=r"env\.sim"):
        config.load(small).rsl_rl_cfg()


def test_it_trains_resumes_exports_and_is_evaluated_like_any_other(tmp_path, small):
    whole = train(tmp_path / "whole", small, max_iterations=2)
    half = train(tmp_path / "halves", small, max_iterations=1)
    resumed = train(tmp_path / "halves", None, max_iterations=1, resume=str(half), robots=None, seed=None, overrides=[])
    states = [run_dir.load_checkpoint(path)["actor_state_dict"] for path in (whole, resumed, half)]
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])
    assert any(not torch.equal(states[0][key], states[2][key]) for key in states[0])

    first, second = (evaluate_checkpoint(whole, ["spot", "anymal_b"], num_envs=4, steps=20) for _ in range(2))
    assert first == second
    done = export_checkpoint(whole, tmp_path / "exported", robots=["spot"])
    assert done.difference <= 1e-5
    network = load_network(run_dir.load_checkpoint(whole), run_dir.read_manifest(whole)["policy"])
    observations = observations_of(7, 12)
    script = torch.jit.load(str(tmp_path / "exported" / "policy.pt"))
    torch.testing.assert_close(script(observations), actions_of(network, observations), rtol=1e-5, atol=1e-5)
    folded = torch.jit.load(str(tmp_path / "exported" / "policy_spot.pt"))
    sensors = [torch.randn(3, 3) for _ in range(4)] + [torch.randn(3, 12) for _ in range(3)]
    names = ("base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands")
    inputs = dict(zip((*names, "joint_pos", "joint_vel", "last_action"), sensors, strict=True))
    wanted = OnnxPolicy(tmp_path / "exported" / "policy_spot.onnx")(**{k: v.numpy() for k, v in inputs.items()})
    torch.testing.assert_close(folded(*sensors)[1], torch.from_numpy(wanted["actions"]), rtol=1e-5, atol=1e-5)


def test_different_bodies_train_in_one_batch_and_each_is_served(tmp_path, small, robot_loop):
    checkpoint = train(tmp_path / "run", small, robots=BODIES, max_iterations=1)
    assert run_dir.read_manifest(checkpoint)["policy"]["num_actions"] == 38
    # one robot alone, and one that the training did not know
    assert list(evaluate_checkpoint(checkpoint, robots=BODIES[1:2], num_envs=2, steps=5).robots) == ["small_biped"]
    exported = export_checkpoint(checkpoint, fold=True, robots=[BODIES[2]])
    graph = OnnxPolicy(exported.files[0].parent / "policy_small_hexapod.onnx")
    found = graph(**{name: np.ones((2, size), dtype=np.float32) for name, size in graph.inputs.items()})
    assert found["actions"].shape == (2, 38)
    assert (found["actions"] != 0.0).sum() == 2 * 18
    assert found["joint_pos_target"].shape == (2, 18)
    # the loop of the example runs it
    loop = robot_loop.open_loop(exported.files[0].parent / "policy_small_hexapod.onnx")
    robot = robot_loop.SimulatedRobot(BODIES[2], loop.contract.joint_names)
    first = robot_loop.run(loop, robot, (0.5, 0.0, 0.0), loop.contract.control_dt)
    assert (first.mode, first.fault) == ("walk", None)
    next_one = loop.step(robot.read().time, robot.read(), (0.5, 0.0, 0.0))
    assert (first.q != next_one.q).all()


def test_a_network_with_heads_of_legs_trains_and_exports(tmp_path, small):
    overrides = ["train.actor.leg_heads=3", "train.critic.leg_heads=4"]
    checkpoint = train(tmp_path / "run", small, robots=BODIES, max_iterations=1, overrides=overrides)
    network = load_network(run_dir.load_checkpoint(checkpoint), run_dir.read_manifest(checkpoint)["policy"])
    assert network.mlp.leg_heads == 3
    assert export_checkpoint(checkpoint, fold=True, robots=[BODIES[2]]).difference <= 1e-5
    path = checkpoint.parent / "manifest.json"
    manifest = json.loads(path.read_text())
    path.write_text(json.dumps({**manifest, "policy": {**manifest["policy"], "leg_heads": 5}}))
    with pytest.raises(_core.ConfigError, match="leg_heads = 5 is more than num_heads = 4"):
        run_dir.read_manifest(checkpoint)


def test_mixed_precision_is_close():
    network = build(12)
    observations = observations_of(64, 12)
    exact = actions_of(network, observations)
    with torch.amp.autocast("cpu", dtype=torch.bfloat16):
        rough = actions_of(network, observations)
    assert (exact - rough).abs().max() < 0.05 * exact.abs().max()


def test_a_policy_for_averages_of_legs_says_what_it_lacks():
    """Networks of joints of earlier versions read the term `morphology`."""
    layout = [*layout_of(12)[:-1], ("morphology", 35)]
    with pytest.raises(_core.ConfigError, match="joint_descriptors, which the task lacks"):
        build(12, layout)


@pytest.mark.parametrize("name", ["flat_joints", "legged_joints"])
def test_the_shipped_configs_are_no_larger_than_the_perceptron_for_rough_ground(name):
    shipped = config.load(name)
    env = polypod.make(shipped.run.task, num_envs=24)
    size = {"num_obs": env.sim.num_obs, "num_actions": env.sim.num_actions}
    network = networks.build_actor({**size, **shipped.actor.model_cfg(env.sim)})
    perceptron = networks.build_actor({"num_obs": 235, "num_actions": 12, **config.load("rough").actor.model_cfg(None)})
    weights, others = (sum(weight.numel() for weight in each.parameters()) for each in (network, perceptron))
    assert isinstance(perceptron, MLPModel)
    assert weights < 1.1 * others
    env.close()
