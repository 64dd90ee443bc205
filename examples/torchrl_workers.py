"""PPO of TorchRL with several processes that collect.

python examples/torchrl_workers.py --workers 2 --iterations 10
"""

import argparse

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import MultiSyncCollector
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import polypod.torchrl


def network(inputs: int, outputs: int) -> nn.Sequential:
    """A perceptron of two hidden layers."""
    return nn.Sequential(nn.Linear(inputs, 128), nn.ELU(), nn.Linear(128, 128), nn.ELU(), nn.Linear(128, outputs))


def main() -> None:
    """Trains, and prints the mean reward of each iteration."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="velocity_flat")
    parser.add_argument("--num-envs", type=int, default=512, help="number of envs over all workers")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--steps", type=int, default=24, help="steps of each env in an iteration")
    parser.add_argument("--iterations", type=int, default=10)
    options = parser.parse_args()

    torch.manual_seed(42)
    creators = polypod.torchrl.creators(options.task, options.num_envs, options.workers, seed=42)
    env = creators[0]()
    num_obs, space = env.observation_spec["observation"].shape[-1], env.action_spec_unbatched.space
    env.close()
    # actions begin small: the space ends where the joints do
    extractor = NormalParamExtractor(scale_mapping="biased_softplus_0.15")
    parameters = nn.Sequential(network(num_obs, 2 * len(space.low)), extractor)
    actor = ProbabilisticActor(
        TensorDictModule(parameters, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": space.low, "high": space.high},
        return_log_prob=True,
    )
    critic = ValueOperator(network(num_obs, 1), in_keys=["observation"])
    advantages = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    loss_of = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.01)
    optimizer = torch.optim.Adam(loss_of.parameters(), lr=1e-3)

    samples = options.num_envs * options.steps
    collector = MultiSyncCollector(creators, actor, frames_per_batch=samples, total_frames=samples * options.iterations)
    for iteration, data in enumerate(collector):
        with torch.no_grad():
            advantages(data)
        flat = data.reshape(-1)
        for _ in range(5):
            for rows in torch.randperm(len(flat)).chunk(4):
                losses = loss_of(flat[rows])
                optimizer.zero_grad()
                sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
                nn.utils.clip_grad_norm_(loss_of.parameters(), 1.0)
                optimizer.step()
        collector.update_policy_weights_()
        reward = data["next", "reward"].mean().item()
        print(f"iteration {iteration + 1}: {len(flat)} steps, mean reward {reward:.4f}", flush=True)
    collector.shutdown()


if __name__ == "__main__":
    main()
