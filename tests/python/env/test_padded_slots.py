"""One batch of bodies on two, four and six legs.

Masks, zeros where a robot lacks a joint, training, export.
"""

import json

import numpy as np
import pytest
import tomli_w
import torch

import polypod
from common import ROOT
from polypod import _core, sim2sim
from polypod.evaluation import load_network, load_policy
from polypod.evaluation.checkpoints import evaluate_checkpoint
from polypod.export import OnnxPolicy, export_checkpoint, interfaces, onnx_graph
from polypod.export.torch_graph import RobotPolicy
from polypod.mujoco_model import robot as model_robot
from polypod.networks import ACTION_MASK, MaskedGaussian
from polypod.networks.masked import MaskedNormalization
from polypod.rsl_rl import VecEnv
from polypod.runs import config, run_dir
from polypod.sim2sim import twin
from polypod.training.session import Options, train

FOLDER = ROOT / "tests/data/bodies/configs/robots"
BODIES = ["unitree_go2", *(str(FOLDER / f"small_{kind}.toml") for kind in ("biped", "hexapod", "quadruped"))]
"""With 12, 8, 18 and 8 joints."""
JOINTS = [12, 8, 18, 8]


def make(robots=BODIES, num_envs=8, **options):
    return polypod.make("velocity_flat", num_envs, robots=robots, seed=3, **options)


def test_masks_say_which_joints_there_are():
    env = make()
    assert env.num_envs == 8
    assert env.single_action_space.shape == (38,)
    assert env.canonical_joint_names[:12] == make(["spot"], 1).canonical_joint_names
    assert env.feet_names == ["LF", "LM", "LH", "RF", "RM", "RH", "L", "R"]
    mask = env.action_mask
    assert mask.dtype == np.bool_
    assert mask.shape == (8, 38)
    assert mask.sum(axis=1).tolist() == [count for count in JOINTS for _ in range(2)]
    assert (env.state.action_mask == mask).all()
    _, infos = env.reset()
    assert (infos["action_mask"] == mask).all()
    *_, infos = env.step(np.zeros((8, 38), dtype=np.float32))
    assert (infos["action_mask"] == mask).all()
    assert make(["spot", "unitree_go2"]).action_mask.all()
    assert make(["spot", "unitree_go2"]).reset()[1] == {}


def test_what_a_robot_lacks_is_zero_and_does_nothing():
    one, other = make(), make()
    mask = one.action_mask
    observed = np.array([one.sim.observation_mask(robot) for robot in one.robots]).repeat(2, axis=0)
    assert observed.shape == (8, one.sim.num_obs)
    assert not observed.all()
    rng = np.random.default_rng(0)
    for _ in range(30):
        actions = rng.standard_normal((8, 38), dtype=np.float32)
        a, b = one.step(actions), other.step(np.where(mask, actions, 50.0 * actions).astype(np.float32))
        assert a[0].tobytes() == b[0].tobytes()
        assert a[1].tobytes() == b[1].tobytes()
        assert (a[0][~observed] == 0.0).all()
        for field in ("joint_pos", "joint_vel", "joint_effort", "last_action", "default_joint_pos"):
            assert (getattr(one.state, field)[~mask] == 0.0).all(), field
    assert one.sim.snapshot() == other.sim.snapshot()


def test_a_robot_alone_may_have_the_slots_of_a_policy_that_knows_more():
    names = make().canonical_joint_names
    alone = make(BODIES[1:2], 2, slots=names)
    assert alone.canonical_joint_names == names
    assert alone.action_mask.sum() == 2 * 8
    with pytest.raises(_core.ConfigError, match="L_TOOTH"):
        make(slots=["L_TOOTH"])


def test_density_entropy_and_divergence_are_those_of_the_real_joints_alone():
    torch.manual_seed(0)
    mask = torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    masked, whole = MaskedGaussian(3, 0.7), torch.distributions.Normal
    masked.mask = mask
    means = torch.randn(2, 3)
    masked.update(means)
    actions = masked.sample()
    assert (actions[mask == 0] == 0).all()
    assert (masked.mean[mask == 0] == 0).all()
    for row, real in ((0, [0, 2]), (1, [1])):
        normal = whole(means[row, real], torch.full((len(real),), 0.7))
        assert torch.allclose(masked.log_prob(actions)[row], normal.log_prob(actions[row, real]).sum())
        assert torch.allclose(masked.entropy[row], normal.entropy().sum())
        new = (masked.mean + 0.1, masked.std * 1.3, mask)
        other = whole(means[row, real] + 0.1, torch.full((len(real),), 0.7 * 1.3))
        found = masked.kl_divergence(masked.params, new)[row]
        assert torch.allclose(found, torch.distributions.kl_divergence(normal, other).sum())


def test_normalisation_counts_what_is_there_and_leaves_what_is_missing_at_0():
    torch.manual_seed(0)
    present = torch.tensor([1.0, 1.0, 0.0, 1.0]).repeat(50).unsqueeze(1).repeat(1, 3)
    present[:, 0] = 1.0
    numbers = (torch.randn(200, 3) * torch.tensor([2.0, 2.0, 0.0]) + 5.0) * present
    normalizer = MaskedNormalization(torch.tensor([1.0, 0.75, 0.75])).train()
    normalizer.update(numbers[:80])
    normalizer.update(numbers[80:])
    assert torch.allclose(normalizer.mean[0], numbers[:, 0].mean(), rtol=1e-5)
    assert torch.allclose(normalizer.std[0], numbers[:, 0].std(unbiased=False), rtol=1e-2)
    assert (normalizer.mean[1:] == 0.0).all()
    assert torch.allclose(normalizer.std[1], numbers[present[:, 1] == 1, 1].square().mean().sqrt(), rtol=1e-5)
    normal = normalizer.eval()(numbers)
    assert (normal[present == 0] == 0.0).all()
    # a number that is the same in all robots that have it is as large as one that varies
    assert torch.allclose(normal[present[:, 2] == 1, 2], torch.tensor(1.0), rtol=1e-2)


def test_shares_are_those_of_all_workers():
    env = make()
    masks = [env.sim.observation_mask(robot) for robot in env.robots]
    assert env.sim.observation_shares() == np.mean(masks, axis=0).tolist()
    assert env.sim.is_padded
    # this share has one robot, which has 12 of the 38 joints
    part = _core.VecSim("velocity_flat", 8, BODIES, 3, share=(0, 2))
    assert part.observation_shares() == env.sim.observation_shares()
    assert part.is_padded
    with pytest.raises(_core.UnknownNameError, match="critics"):
        env.sim.observation_shares("critics")
    whole = make(["spot", "unitree_go2"]).sim
    assert not whole.is_padded
    assert set(whole.observation_shares()) == {1.0}


def test_the_mask_is_data_of_the_rollout():
    adapter = VecEnv(make(), log_extras=False)
    observations = adapter.get_observations()
    assert (observations[ACTION_MASK].numpy() == adapter.unwrapped.action_mask).all()
    assert set(VecEnv(make(["spot"])).get_observations().keys()) == {"policy"}


def assert_folded_graph_is_the_policy(checkpoint, source, folder):
    """On states of the simulator, also where joints turn the other way round than their slots."""
    manifest = run_dir.read_manifest(checkpoint)
    policy = load_policy(run_dir.load_checkpoint(checkpoint), manifest["policy"])
    names = manifest["canonical_joint_names"]
    env = make([source], 4, slots=names, overrides=["observations.enable_noise=false"])
    (robot,), sim = env.robots, env.sim
    info = json.loads(sim.robot_info())[robot]
    assert min(info["slot_signs"]) < 0.0
    rng = np.random.default_rng(0)
    for _ in range(3):
        action = np.where(env.action_mask, rng.standard_normal((4, len(names))), 0.0).astype(np.float32)
        sim.step(action)
    running = sim.episode_length == 3
    assert running.any()
    qpos, qvel = sim.qpos(robot), sim.qvel(robot)
    observation = sim.observation.copy()
    given = {
        # terms of the base have separate tests
        "base_ang_vel": qvel[:, 3:6],
        "projected_gravity": observation[:, 6:9],
        "velocity_commands": sim.command,
        "joint_pos": qpos[:, 7:],
        "joint_vel": qvel[:, 6:],
        "last_action": action,
    }
    com = np.array(json.loads(sim.robot_shapes())[robot]["base_com"])
    given["base_lin_vel"] = observation[:, :3] - np.cross(qvel[:, 3:6], com)
    graph = OnnxPolicy(folder / f"policy_{robot}.onnx")
    found = graph(**{name: np.asarray(given[name], dtype=np.float32) for name in graph.inputs})
    wanted = np.where(env.action_mask, policy(observation), 0.0)
    np.testing.assert_allclose(found["actions"][running], wanted[running], atol=2e-4)
    targets = np.tile(np.array(info["default_pose"]), (4, 1))
    for column, joint, sign in zip(info["columns"], info["joint_of_slot"], info["slot_signs"], strict=True):
        targets[:, joint] += info["action_scale"] * sign * found["actions"][:, column]
    np.testing.assert_allclose(found["joint_pos_target"], targets, atol=1e-5)
    script = torch.jit.load(str(folder / f"policy_{robot}.pt"))
    target, actions = script(*(torch.from_numpy(np.asarray(given[name], dtype=np.float32)) for name in graph.inputs))
    np.testing.assert_allclose(actions.detach().numpy(), found["actions"], atol=1e-5)
    np.testing.assert_allclose(target.detach().numpy(), found["joint_pos_target"], atol=1e-5)


def assert_mujoco_observes_the_same(checkpoint, source):
    """Through the sensors of `polypod sim2sim`, in the columns of the batch.

    Then both simulators run an episode.
    """
    manifest = run_dir.read_manifest(checkpoint)
    network = load_network(run_dir.load_checkpoint(checkpoint), manifest["policy"])
    slots = manifest["canonical_joint_names"]
    (interface,) = interfaces(manifest, [source]).values()
    robot = interface.name
    graph = OnnxPolicy(onnx_graph.robot_model(network, interface, {}).SerializeToString())
    sim = _core.VecSim("velocity_flat_play", 3, robots=[source], seed=5, threads=1, autoreset="disabled", slots=slots)
    described = model_robot.of(sim, robot, source)
    bodies = [body["name"] for body in json.loads(sim.robot_shapes())[robot]["bodies"] if body["group"] == "base"]
    delays = np.zeros((3, len(interface.joint_names)))
    places = sim.env_origins() * [1.0, 1.0, 0.0]
    drive = twin.Drive(interface, graph, step_dt=0.02, physics_dt=0.005, delays=delays, places=places)
    mujoco = twin.Twin(described, bodies, twin.Physics(), drive)
    random = np.random.default_rng(0)
    for _ in range(4):
        sim.step(random.normal(size=(3, sim.num_actions)).astype(np.float32))
    mujoco.reset(sim.qpos(robot), sim.qvel(robot))
    sensors = mujoco.sensors() | {"velocity_commands": sim.command}
    policy = RobotPolicy(network, interface)
    observed = policy.observe(
        *(torch.from_numpy(np.asarray(sensors[name], dtype=np.float32)) for name in policy.inputs)
    )
    wanted = sim.observation.copy()
    wanted[:, -len(slots) :] = 0.0  # no action has been taken yet in MuJoCo
    np.testing.assert_allclose(observed.numpy(), wanted, atol=1e-4)
    result = sim2sim.compare(checkpoint, [source], sim2sim.Options(envs_per_robot=2, steps=3))
    assert result.robots[robot].mujoco.episode_length_s == pytest.approx(0.06)


@pytest.mark.parametrize("learner", ["native", "rsl_rl"])
def test_a_mixed_batch_trains_and_its_policy_serves_each_robot(learner, tmp_path):
    options = {"num_envs": 32, "num_steps_per_env": 4, "learner": learner, "task": "velocity_flat"}
    base = config.load("flat").as_dict()
    base["run"] |= options | {"max_iterations": 2}
    base["actor"] |= {"hidden_dims": [16], "obs_normalization": True}
    file = tmp_path / "small.toml"
    file.write_text(tomli_w.dumps(base))
    assert train(Options(train_config=str(file), robots=BODIES, log_dir=tmp_path, seed=1, device="cpu")) == 0
    (checkpoint,) = tmp_path.rglob("model_2.pt")
    manifest = run_dir.read_manifest(checkpoint)
    assert manifest["policy"]["class_name"] == "MLPModel"
    assert manifest["policy"]["num_actions"] == 38
    assert [len(manifest["joint_maps"][robot]) for robot in manifest["robots"]] == JOINTS
    # one robot alone
    evaluation = evaluate_checkpoint(checkpoint, robots=BODIES[1:2], num_envs=2, steps=5)
    assert list(evaluation.robots) == ["small_biped"]
    exported = export_checkpoint(checkpoint, fold=True)
    graphs = {path.name for path in exported.files}
    assert {"policy.onnx", "policy_small_biped.onnx", "policy_small_hexapod.pt"} <= graphs
    folder = exported.files[0].parent
    biped = json.loads((folder / "policy_small_biped.json").read_text())
    sizes = {tensor["name"]: tensor["shape"][1] for tensor in biped["inputs"] + biped["outputs"]}
    for index in (1, 2, 3):
        assert_folded_graph_is_the_policy(checkpoint, BODIES[index], folder)
    for index in (1, 2):
        assert_mujoco_observes_the_same(checkpoint, BODIES[index])
    assert (sizes["joint_pos"], sizes["joint_pos_target"], sizes["actions"], sizes["last_action"]) == (8, 8, 38, 38)


def test_statistics_of_numbers_that_no_robot_has_stay_as_they_are():
    """A policy of many robots goes on with one, and keeps what it knows of the others' numbers."""
    torch.manual_seed(0)
    normalizer = MaskedNormalization(torch.tensor([1.0, 0.5, 0.0]))
    normalizer._mean[:], normalizer._var[:], normalizer._std[:] = 3.0, 4.0, 2.0
    normalizer.count.fill_(10)
    samples = torch.randn(1000, 3) * torch.tensor([1.0, 1.0, 0.0])
    samples[500:, 1] = 0.0
    normalizer.update(samples)
    assert (normalizer._mean[0, 2], normalizer._var[0, 2], normalizer._std[0, 2]) == (3.0, 4.0, 2.0)
    assert torch.isfinite(normalizer(samples)).all()
    assert normalizer._mean[0, 0].abs() < 0.2
