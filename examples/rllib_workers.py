"""PPO of RLlib with several env runners, on this machine or on the Ray cluster of RAY_ADDRESS.

python examples/rllib_workers.py --runners 2 --iterations 10
"""

import argparse

from ray.rllib.algorithms.ppo import PPOConfig

import polypod.rllib


def main() -> None:
    """Trains, and prints the mean return of each iteration."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="velocity_flat")
    parser.add_argument("--num-envs", type=int, default=512, help="number of envs over all runners")
    parser.add_argument("--runners", type=int, default=2)
    parser.add_argument("--steps", type=int, default=24, help="steps of each env in an iteration")
    parser.add_argument("--iterations", type=int, default=10)
    options = parser.parse_args()

    samples = options.num_envs * options.steps
    config = (
        PPOConfig()
        .environment(polypod.rllib.register(), env_config={"task": options.task, "seed": 42})
        .env_runners(
            env_runner_cls=polypod.rllib.EnvRunner,
            num_env_runners=options.runners,
            num_envs_per_env_runner=options.num_envs // options.runners,
            rollout_fragment_length=options.steps,
        )
        .training(
            train_batch_size_per_learner=samples,
            minibatch_size=samples // 4,
            num_epochs=5,
            lr=1e-3,
            gamma=0.99,
            lambda_=0.95,
            entropy_coeff=0.01,
            grad_clip=1.0,
        )
    )
    algorithm = config.build_algo()
    for iteration in range(options.iterations):
        result = algorithm.train()["env_runners"]
        steps, reward = result["num_env_steps_sampled"], result.get("episode_return_mean", float("nan"))
        print(f"iteration {iteration + 1}: {steps:.0f} steps, mean return {reward:.3f}", flush=True)
    algorithm.stop()


if __name__ == "__main__":
    main()
