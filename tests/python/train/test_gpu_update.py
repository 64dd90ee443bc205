"""The native learner's update on a GPU equals its update on the CPU.

Checkpoints are the same.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from test_native_learner_equals_rsl_rl import ENVS, ROBOTS, VARIANTS, assert_near, train_config

import polypod
from polypod.rsl_rl import VecEnv
from polypod.runs import run_dir
from polypod.training.gpu import GpuRunner
from polypod.training.native import NETWORKS, NativeRunner
from polypod.training.report import Reporter
from polypod.training.workers import Workers

CUDA = pytest.param("cuda:0", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"))
OWN_VARIANTS = {
    # networks of joints learn on a GPU with rsl_rl
    **{name: variant for name, variant in VARIANTS.items() if "joints" not in name and not name.endswith("groups")},
    "a_group_that_no_network_reads": {"run": {"task": "velocity_flat_asymmetric"}},
    "images_in_turn": {"run": {"symmetry": "alternate"}},
    "mirror_loss_in_turn": {"run": {"symmetry": "alternate"}, "algorithm": {"mirror_loss_coef": 5.0}},
    "masked_mirror_loss_in_turn": {
        "actor": {"init_std": 1.5},
        "run": {"symmetry": "alternate"},
        "algorithm": {"mirror_loss_coef": 5.0},
    },
    # parts of mini-batches of unequal sizes, with a graph for each size
    "unequal_mini_batches": {"algorithm": {"num_mini_batches": 7}},
}


def runner(kind, variant, tmp_path, device="cpu"):
    masked = variant.startswith("masked")
    config = train_config(OWN_VARIANTS[variant], masked)
    torch.manual_seed(3)
    env = polypod.make(config.run.task, ENVS, robots=ROBOTS[masked], seed=11, overrides=["sim.episode_length_s=0.8"])
    folder = tmp_path / kind.__name__
    folder.mkdir()
    run_dir.write_params(folder, env.sim, config, None, [], "a test")
    made = kind(VecEnv(env, device, log_extras=False), config, folder, device, Reporter())
    made.alg.train_mode()
    return made


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("variant", OWN_VARIANTS)
def test_updates_are_equal(variant, device, tmp_path):
    native, other = runner(NativeRunner, variant, tmp_path), runner(GpuRunner, variant, tmp_path, device)
    for update in range(2):
        native.current_learning_iteration = update
        native._collect(native.env.get_observations())
        # both learn from the same samples
        other._learner, own = native._learner, other._learner
        other._samples.take(native._learner, native.env.unwrapped.sim)
        other._learner = own
        algorithm = other.config.algorithm
        found = other._update_of.run(other.alg.learning_rate, algorithm.entropy_coef, algorithm.desired_kl)
        other.alg.learning_rate = found["learning_rate"]
        expected = native._update(native.env.get_observations())
        for name in ("value", "surrogate", "entropy"):
            allowed = 1e-4 * (abs(expected[name]) + (name == "surrogate"))
            assert abs(found[name] - expected[name]) <= allowed, (name, found, expected)
        assert found["learning_rate"] == pytest.approx(native.alg.learning_rate, rel=1e-5)
        native._give_to_rsl_rl()
        other._take_networks()
        for network in NETWORKS:
            mine, theirs = (getattr(of.alg, network) for of in (other, native))
            for (name, parameter), reference in zip(mine.named_parameters(), theirs.parameters(), strict=True):
                place = f"{network} {name} after update {update}"
                assert_near(parameter.detach().cpu(), reference.detach(), place)
                state, expected_state = other.alg.optimizer.state[parameter], native.alg.optimizer.state[reference]
                assert_near(state["exp_avg"].cpu(), expected_state["exp_avg"], f"gradients of {place}")
                assert state["step"] == expected_state["step"]
            for name, buffer in mine.named_buffers():
                assert_near(buffer.cpu(), theirs.get_buffer(name), f"{network} {name}")


def same_roots(found, expected):
    """Square roots of the same numbers.

    torch leaves them to libraries that miss the last bit on some processors.
    """
    return torch.allclose(found.cpu().ravel(), expected.ravel(), rtol=torch.finfo(torch.float32).eps, atol=0.0)


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_rollouts_have_the_policy_that_was_learnt(device, tmp_path):
    other = runner(GpuRunner, "universal", tmp_path, device)
    before, _, _, _ = other._learner.network("actor")
    other._collect(other.env.get_observations())
    other._update(other.env.get_observations())
    after, _, _, _ = other._learner.network("actor")
    for old, new, parameter in zip(before, after, other.alg.actor.parameters(), strict=True):
        assert np.array_equal(new, parameter.detach().cpu().numpy().ravel())
        assert not np.array_equal(new, old)
    mean, variance, count = other._learner.normalizer("actor")
    assert count == ENVS * other.config.run.num_steps_per_env
    normalizer = other.alg.actor.obs_normalizer
    assert np.array_equal(mean, normalizer.mean.cpu().numpy())
    assert np.array_equal(variance, normalizer.get_buffer("_var").cpu().numpy().ravel())
    assert same_roots(normalizer.std, torch.from_numpy(np.sqrt(variance)))


def test_what_graphs_read_stays_where_it_is(tmp_path):
    other = runner(GpuRunner, "universal", tmp_path)
    networks = (other.alg.actor, other.alg.critic)
    tensors = [tensor for network in networks for tensor in network.state_dict(keep_vars=True).values()]
    before = [tensor.clone() for tensor in tensors]
    other._collect(other.env.get_observations())
    other._update(other.env.get_observations())
    after = [tensor for network in networks for tensor in network.state_dict(keep_vars=True).values()]
    assert all(new is old for new, old in zip(after, tensors, strict=True))
    assert not any(torch.equal(new, old) for new, old in zip(after, before, strict=True))


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_either_learner_goes_on_from_a_checkpoint(device, tmp_path):
    other = runner(GpuRunner, "universal", tmp_path, device)
    for iteration in range(2):
        other.current_learning_iteration = iteration
        other._collect(other.env.get_observations())
        other._update(other.env.get_observations())
    path = run_dir.checkpoint_path(other.run, 2)
    other.save(str(path))
    native = runner(NativeRunner, "universal", tmp_path)
    native.load(str(path), map_location="cpu")
    again = run_dir.checkpoint_path(native.run, 2)
    native.save(str(again))
    first, second = (torch.load(of, map_location="cpu", weights_only=True) for of in (path, again))
    for part in ("actor_state_dict", "critic_state_dict"):
        for name, tensor in first[part].items():
            same = same_roots if name.endswith("._std") else torch.equal
            assert same(tensor, second[part][name]), name
    moments, others = (of["optimizer_state_dict"]["state"] for of in (first, second))
    for index, state in moments.items():
        for key, tensor in state.items():
            assert torch.equal(torch.as_tensor(tensor), torch.as_tensor(others[index][key])), (index, key)
    back = GpuRunner(other.env, other.config, tmp_path, device, Reporter())
    back.load(str(again))
    for parameter, expected in zip(back.alg.actor.parameters(), other.alg.actor.parameters(), strict=True):
        assert torch.equal(parameter, expected)


def learn(variant, folder, workers, device):
    """Two iterations; returns what the networks and their optimiser have become."""
    torch.manual_seed(3)
    config = train_config(OWN_VARIANTS[variant], variant.startswith("masked"))
    env = polypod.make(
        config.run.task,
        ENVS,
        robots=ROBOTS[variant.startswith("masked")],
        seed=11,
        overrides=["sim.episode_length_s=0.8"],
        share=workers.share(ENVS, "native"),
    )
    made = GpuRunner(VecEnv(env, device, log_extras=False), config, folder, device, Reporter(quiet=True), workers)
    made.alg.train_mode()
    for iteration in range(2):
        made.current_learning_iteration = iteration
        made._collect(made.env.get_observations())
        made._update(made.env.get_observations())
    made._give_to_rsl_rl()
    numbers = {f"{name}.{key}": x for name in NETWORKS for key, x in getattr(made.alg, name).state_dict().items()}
    moments = [of["exp_avg"] for of in made.alg.optimizer.state.values()]
    return {**numbers, **{f"gradient {i}": x for i, x in enumerate(moments)}, "rate": made.alg.learning_rate}


SHARED = ("mirror_images", "mirror_loss_in_turn", "masked", "advantages_of_mini_batches")
"""Variants that two workers learn, one after the other: their processes take longer to start than
to learn."""


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("variant", SHARED)
def test_workers_learn_what_one_learns(variant, device, tmp_path, built_once):
    kind = device.partition(":")[0]

    def learn_all(folder):
        torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
        command = [sys.executable, *torchrun, __file__, str(folder), kind]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr[-3000:]

    folder = built_once(f"workers_{kind}", learn_all)
    one = learn(variant, tmp_path, Workers.alone(), device)
    of_workers = [torch.load(folder / f"{variant}_{index}.pt", map_location="cpu") for index in range(2)]
    for name, mine in one.items():
        first, second = (torch.as_tensor(of[name]) for of in of_workers)
        assert torch.equal(first, second), name
        assert_near(first, torch.as_tensor(mine).cpu(), name)


if __name__ == "__main__":
    folder, kind = sys.argv[1:]
    workers = Workers.join(kind == "cuda")
    device = kind if kind == "cpu" else f"cuda:{torch.cuda.current_device()}"
    for variant in SHARED:
        torch.save(learn(variant, Path(folder), workers, device), Path(folder) / f"{variant}_{workers.index}.pt")
    workers.close()


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_the_critic_learns_alone(device, tmp_path):
    """The policy that acts stays too, and what graphs read stays where it is."""
    other = runner(GpuRunner, "universal", tmp_path, device)
    other._collect(other.env.get_observations())
    other.alg.desired_kl = other.config.algorithm.desired_kl
    other._update(other.env.get_observations())
    rate = other.alg.learning_rate
    networks = (other.alg.actor, other.alg.critic)
    before = [[parameter.detach().clone() for parameter in network.parameters()] for network in networks]
    acting = [array.copy() for array in other._learner.network("actor")[0]]
    moments = [state["exp_avg"].clone() for _, state in other._actor_parameters()]
    places = [parameter.data_ptr() for parameter in networks[0].parameters()]
    other.current_learning_iteration = 1
    other._collect(other.env.get_observations())
    other._update_critic(other.env.get_observations())
    assert all(torch.equal(a, b) for a, b in zip(networks[0].parameters(), before[0], strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(networks[1].parameters(), before[1], strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(other._learner.network("actor")[0], acting, strict=True))
    assert all(torch.equal(s["exp_avg"], m) for (_, s), m in zip(other._actor_parameters(), moments, strict=True))
    assert [parameter.data_ptr() for parameter in networks[0].parameters()] == places
    assert other.alg.learning_rate == pytest.approx(rate)
    other.alg.desired_kl = other.config.algorithm.desired_kl
    other._update(other.env.get_observations())
    assert not any(torch.equal(a, b) for a, b in zip(networks[0].parameters(), before[0], strict=True))
