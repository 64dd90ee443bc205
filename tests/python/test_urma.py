"""The network of joints: the same weights for any number of joints, and a network like any other to all tools."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from rsl_rl.models import MLPModel
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

import polypod
import polypod.rsl_rl
from common import ROBOTS
from polypod import networks
from polypod.evaluation import evaluate_checkpoint, load_network
from polypod.export import OnnxPolicy, export_checkpoint, onnx_graph
from polypod.export.checkpoint import compare
from polypod.networks.joints import joint_table
from polypod.observation import layout_of as layout_of_terms
from polypod.observation import terms_of
from polypod.training import config, run_dir, session

CONFIG = Path(__file__).parents[2] / "configs" / "train" / "flat_urma.toml"
URMA = "polypod.networks:UrmaModel"
TASK = "velocity_flat_universal"
BODIES = {
    "quadruped": [f"{leg}_{role}" for role in ("HAA", "HFE", "KFE") for leg in ("LF", "LH", "RF", "RH")],
    "two joints per leg": [f"{leg}_{role}" for role in ("HFE", "KFE") for leg in ("LF", "LH", "RF", "RH")],
    "hexapod": [f"{leg}_{role}" for role in ("HAA", "HFE", "KFE") for leg in ("LF", "LM", "LH", "RF", "RM", "RH")],
}


def layout_of(joint_names):
    joints, roles = len(joint_names), len({name.split("_")[1] for name in joint_names})
    terms = ["base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands"]
    per_joint = ["joint_pos_rel", "joint_vel_rel", "last_action"]
    return [
        *((term, 3) for term in terms),
        *((term, joints) for term in per_joint),
        ("morphology", 7 + 5 * roles + joints + 1),
    ]


def build(joint_names, layout=None, seed=0, **changes):
    """A network for these joints, and its number of observations."""
    layout = layout or layout_of(joint_names)
    num_obs = sum(size for _, size in layout)
    torch.manual_seed(seed)
    model = {
        "class_name": URMA,
        "num_obs": num_obs,
        "num_actions": len(joint_names),
        "hidden_dims": [24, 16],
        "activation": "elu",
        "obs_normalization": False,
        "joint_dim": 8,
        "num_heads": 4,
        "observation_layout": layout,
        "joint_names": joint_names,
        "distribution_cfg": {"class_name": "polypod.networks:RoleGaussian", "joint_names": joint_names},
    }
    return networks.build_actor({**model, **changes}).eval(), num_obs


def actions_of(network, observations):
    batch = TensorDict({"policy": torch.as_tensor(observations)}, batch_size=[len(observations)])
    with torch.no_grad():
        return network(batch)


def test_the_same_weights_serve_any_number_of_joints():
    first, _ = build(BODIES["quadruped"], obs_normalization=True)
    for names in BODIES.values():
        network, num_obs = build(names, seed=1, obs_normalization=True)
        network.load_state_dict(first.state_dict(), strict=True)
        batch = TensorDict({"policy": torch.randn(5, num_obs)}, batch_size=[5])
        actions = network(batch, stochastic_output=True)
        assert actions.shape == (5, len(names))
        assert torch.isfinite(actions).all()
        assert network.output_std.shape == (5, len(names))
        assert network.get_output_log_prob(actions).shape == (5,)
        network.output_mean.square().mean().backward()
        silent = [name for name, weight in network.mlp.named_parameters() if not weight.grad.abs().sum() > 0.0]
        assert silent == []


@pytest.mark.parametrize("names", BODIES.values(), ids=BODIES.keys())
def test_no_joint_has_a_column_of_its_own(names):
    """In another order of the joints, the same joints take the same actions."""
    order = np.random.default_rng(0).permutation(len(names))
    # the roles stay in their order, for which the description has a block each
    order = np.array(sorted(order, key=lambda joint: names[joint].split("_")[1]))
    assert (order != np.arange(len(names))).any()
    network, num_obs = build(names)
    other, _ = build([names[joint] for joint in order])
    observations = torch.randn(6, num_obs)
    columns = np.arange(num_obs)
    for start in (12, 12 + len(names), 12 + 2 * len(names), num_obs - 1 - len(names)):
        columns[start : start + len(names)] = start + order
    torch.testing.assert_close(actions_of(other, observations[:, columns]), actions_of(network, observations)[:, order])
    assert not torch.allclose(actions_of(network, observations[:, columns]), actions_of(network, observations))


def test_joints_are_told_apart():
    """By what the description says of them: equal states, different actions."""
    network, num_obs = build(BODIES["quadruped"])
    actions = actions_of(network, torch.full((1, num_obs), 0.3))[0]
    assert len({round(float(action), 5) for action in actions}) == 12


def test_features_are_read_from_their_columns():
    names = BODIES["quadruped"]
    table = joint_table(layout_of(names), names)
    observation = np.arange(83, dtype=np.float32)
    rows = observation[table.column] * table.factor + table.constant
    np.testing.assert_array_equal(table.selection() @ observation + table.constant, rows)
    joint = names.index("RH_HFE")
    description = 48
    expected = [
        *(12 + joint, 0.1 * (24 + joint), 36 + joint),  # position, velocity, last action
        *(0, 0, 0, 0, 1, -1, -1, 1, 0, 0, 0, 0),  # a right hind leg's flexion
        *(-0.5 * (description + 1), -0.5 * (description + 2)),  # its hip, behind and right
        description + 22 + joint,  # default position
        *range(description + 12, description + 17),  # stiffness, damping, effort, inertia, torque of the HFE
        *(description, *range(description + 3, description + 7), description + 34),
    ]
    np.testing.assert_allclose(rows[joint], expected, rtol=1e-6)
    normalized = joint_table(layout_of(names), names, normalized=True)
    assert (normalized.factor[:, :3] == 1.0).all()
    np.testing.assert_array_equal(normalized.factor[:, 3:], table.factor[:, 3:])
    assert table.general.tolist() == [*range(12), *range(description, description + 7), description + 34]


def test_terms_are_known_by_what_they_are():
    """Under other names, with what the simulator states of them, the observation is read in the same way."""
    names = BODIES["quadruped"]
    env = polypod.make(TASK, num_envs=8)
    layout = layout_of_terms(terms_of(env.sim))
    env.close()
    assert [(entry["term"], entry["size"]) for entry in layout] == layout_of(names)
    renamed = [{**entry, "term": f"own_{index}"} for index, entry in enumerate(layout)]
    old, new = joint_table(layout_of(names), names), joint_table(renamed, names)
    for field in dataclasses.fields(old):
        np.testing.assert_array_equal(getattr(new, field.name), getattr(old, field.name))
    # another term of a joint is one more number of its state
    more = [*renamed, {"term": "motor_temperature", "size": 12, "kind": "per_joint", "magnitude": 50.0, "blocks": []}]
    table = joint_table(more, names)
    assert table.num_states == 4
    assert (table.column[3, 3], table.factor[3, 3]) == (83 + 3, np.float32(0.02))
    blocks = [{**block, "per": "wheel"} if block["per"] == "length" else block for block in layout[-1]["blocks"]]
    with pytest.raises(polypod.ConfigError, match="own_7 has numbers per wheel"):
        joint_table([*renamed[:-1], {**renamed[-1], "blocks": blocks}], names)


def test_places_of_four_legs_are_orthogonal():
    place = joint_table(layout_of(BODIES["quadruped"]), BODIES["quadruped"]).place
    np.testing.assert_array_equal(place @ place.T, 4.0 * np.eye(12))


@pytest.mark.parametrize(
    ("names", "layout", "message"),
    [
        (["LF_HAA", "ankle"], None, "'ankle' is not the name"),
        (BODIES["quadruped"], [*layout_of(BODIES["quadruped"])[:-1]], "morphology, which the task lacks"),
        (BODIES["quadruped"], [*layout_of(BODIES["quadruped"])[:-1], ("morphology", 34)], "has 34 numbers"),
        (BODIES["quadruped"][:11], layout_of(BODIES["quadruped"]), "joint_pos_rel has 12 numbers"),
    ],
)
def test_what_does_not_fit_is_named(names, layout, message):
    with pytest.raises(polypod.ConfigError, match=message):
        build(names, layout or [("joint_pos_rel", len(names))])


def test_numbers_of_one_kind_are_normalised_alike():
    """The velocities of all knees by one mean and deviation, and so for every kind; checked against a plain sum."""
    names = BODIES["quadruped"]
    network, num_obs = build(names, obs_normalization=True)
    network.train()
    batches = [2.0 + torch.randn(50, num_obs) * torch.linspace(0.5, 3.0, num_obs) for _ in range(3)]
    for batch in batches:
        network.update_normalization(TensorDict({"policy": batch}, batch_size=[50]))
    rows = torch.cat(batches)
    kinds = [
        *([column] for column in range(12)),  # velocities, gravity and command
        *([24 + joint for joint in range(12) if names[joint].endswith(role)] for role in ("HAA", "HFE", "KFE")),
        *([48 + 22 + joint for joint in range(12) if names[joint].endswith(role)] for role in ("HAA", "HFE", "KFE")),
        *([48 + number] for number in (*range(22), 34)),  # body, and gains of the roles
    ]
    for columns in kinds:
        torch.testing.assert_close(network.obs_normalizer.mean[columns], rows[:, columns].mean().expand(len(columns)))
        deviation = rows[:, columns].std(unbiased=False)
        torch.testing.assert_close(network.obs_normalizer.std[columns], deviation.expand(len(columns)))
    network.eval()
    before = network.obs_normalizer.mean
    network.update_normalization(TensorDict({"policy": 100.0 + batches[0]}, batch_size=[50]))
    assert torch.equal(network.obs_normalizer.mean, before)


def test_what_a_body_lacks_is_not_forgotten():
    whole, num_obs = build(BODIES["quadruped"], obs_normalization=True)
    whole.train()
    whole.update_normalization(TensorDict({"policy": 3.0 + torch.randn(50, num_obs)}, batch_size=[50]))
    part, num_part = build(BODIES["two joints per leg"], obs_normalization=True)
    part.load_state_dict(whole.state_dict(), strict=True)
    part.train()
    part.update_normalization(TensorDict({"policy": torch.randn(50, num_part)}, batch_size=[50]))
    again, _ = build(BODIES["quadruped"], obs_normalization=True)
    again.load_state_dict(part.state_dict(), strict=True)
    hips, knees = (
        [24 + joint for joint in range(12) if BODIES["quadruped"][joint].endswith(r)] for r in ("HAA", "KFE")
    )
    torch.testing.assert_close(again.obs_normalizer.mean[hips], whole.obs_normalizer.mean[hips])
    assert (again.obs_normalizer.mean[knees] < whole.obs_normalizer.mean[knees] - 0.5).all()


@pytest.mark.parametrize("names", BODIES.values(), ids=BODIES.keys())
@pytest.mark.parametrize("activation", ["elu", "relu", "tanh"])
def test_the_graph_computes_what_torch_does(names, activation):
    network, num_obs = build(names, activation=activation, obs_normalization=activation != "relu")
    network.train()
    network.update_normalization(TensorDict({"policy": 1.0 + 2.0 * torch.randn(99, num_obs)}, batch_size=[99]))
    network.eval()
    graph = OnnxPolicy(onnx_graph.network_model(network, num_obs, len(names), {}).SerializeToString())
    assert compare(graph, network.as_jit(), {"obs": num_obs}, ["actions"]) <= 1e-5


def test_a_height_scan_belongs_to_the_body():
    layout = [*layout_of(BODIES["quadruped"]), ("height_scan", 187)]
    network, num_obs = build(BODIES["quadruped"], layout)
    assert num_obs == 270
    observations = torch.randn(3, 270)
    changed = observations.clone()
    changed[:, 200] += 1.0
    assert (actions_of(network, observations) != actions_of(network, changed)).any(dim=1).all()


@pytest.fixture
def small(tmp_path):
    """A train config of this network, small and with everything that may touch it switched on."""
    path = tmp_path / "small.toml"
    path.write_text(
        'extends = "flat"\n'
        f'[run]\ntask = "{TASK}"\nnum_envs = 32\nsymmetry = true\nnormalize_reward_per_robot = true\n'
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
    observations = torch.randn(7, 83)
    script = torch.jit.load(str(tmp_path / "exported" / "policy.pt"))
    torch.testing.assert_close(script(observations), actions_of(network, observations), rtol=1e-5, atol=1e-5)
    folded = torch.jit.load(str(tmp_path / "exported" / "policy_spot.pt"))
    sensors = [torch.randn(3, 3) for _ in range(4)] + [torch.randn(3, 12) for _ in range(3)]
    names = ("base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands")
    inputs = dict(zip((*names, "joint_pos", "joint_vel", "last_action"), sensors, strict=True))
    wanted = OnnxPolicy(tmp_path / "exported" / "policy_spot.onnx")(**{k: v.numpy() for k, v in inputs.items()})
    torch.testing.assert_close(folded(*sensors)[1], torch.from_numpy(wanted["actions"]), rtol=1e-5, atol=1e-5)


def test_mixed_precision_is_close(small):
    network, num_obs = build(BODIES["quadruped"])
    observations = torch.randn(64, num_obs)
    exact = actions_of(network, observations)
    with torch.amp.autocast("cpu", dtype=torch.bfloat16):
        rough = actions_of(network, observations)
    assert (exact - rough).abs().max() < 0.05 * exact.abs().max()


def test_the_shipped_config_is_no_larger_than_the_perceptron_for_rough_ground():
    actor = config.load(str(CONFIG)).actor
    env = polypod.make(TASK, num_envs=8)
    size = {"num_obs": env.sim.num_obs, "num_actions": 12}
    network = networks.build_actor({**size, **actor.model_cfg(env.sim)})
    perceptron = networks.build_actor({**size, **config.load("rough").actor.model_cfg(None)})
    weights, others = (sum(weight.numel() for weight in each.parameters()) for each in (network, perceptron))
    assert isinstance(perceptron, MLPModel)
    assert weights < others / 2
    env.close()
