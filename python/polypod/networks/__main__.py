"""Measures what the actors of train configs cost a learner: `python -m polypod.networks [CONFIG ...]`."""

import sys
import time
from collections.abc import Sequence

import torch

import polypod
from polypod.networks import build_actor
from polypod.training import config

ROWS = 4096
REPEATS = 5
CONFIGS = ("flat", "rough", "flat_urma")


def milliseconds(network: torch.nn.Module, observations: torch.Tensor) -> float:
    """CPU time of a forward and a backward pass, the shortest of `REPEATS`."""
    times = []
    for _ in range(REPEATS):
        started = time.process_time()
        network(observations).square().mean().backward()
        times.append(time.process_time() - started)
    return 1e3 * min(times)


def main(configs: Sequence[str]) -> None:
    """Prints a table of the configs' actors on the flat universal task."""
    torch.set_num_threads(1)
    sim = polypod.make("velocity_flat_universal", num_envs=ROWS, seed=0).sim
    observations = torch.from_numpy(sim.observation.copy())
    print("| actor of | weights | ms |\n|---|---|---|")
    for name in configs:
        actor = config.load(name).actor
        size = {"num_obs": sim.num_obs, "num_actions": sim.num_actions}
        network = build_actor({**size, **actor.model_cfg(sim)}).mlp
        weights = sum(weight.numel() for weight in network.parameters())
        print(f"| `{name}` | {weights} | {milliseconds(network, observations):.0f} |")


if __name__ == "__main__":
    main(sys.argv[1:] or CONFIGS)
