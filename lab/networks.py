"""Measures the cost of train configs' actors: `python -m lab.networks [CONFIG ...]`."""

import sys
import time
from collections.abc import Sequence

import torch
from tensordict import TensorDict

import polypod
from polypod.networks import build_actor
from polypod.runs import config

ROWS = 2400
"""Samples of a pass: a multiple of the robots of any shipped task."""
REPEATS = 5
CONFIGS = ("flat_universal", "rough", "flat_joints", "legged_joints")
SAMPLES = 98_304
"""Samples of an iteration: 4096 envs, 24 steps."""


def seconds(network: torch.nn.Module, observations: torch.Tensor) -> tuple[float, float]:
    """Shortest of `REPEATS` times of a forward pass, and of a forward and a backward pass."""
    cuda = observations.is_cuda
    times = []
    for _ in range(REPEATS):
        network.zero_grad()
        marks = []
        for step in ("begin", "forward", "backward"):
            if step == "forward":
                loss = network(observations).square().mean()
            elif step == "backward":
                loss.backward()
            if cuda:
                torch.cuda.synchronize()
            marks.append(time.perf_counter() if cuda else time.process_time())
        times.append((marks[1] - marks[0], marks[2] - marks[0]))
    forward, both = (min(column) for column in zip(*times, strict=True))
    return forward, both


def main(configs: Sequence[str]) -> None:
    """Prints a table of the configs' actors, each on its own task.

    On a GPU if there is one, else on one CPU core.
    """
    torch.set_num_threads(1)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    where = torch.cuda.get_device_name() if device == "cuda" else "one CPU core"
    print(f"On {where}; an iteration has {SAMPLES:,} samples.\n")
    print("| actor of | inputs | actions | weights | forward, us | with backward, us | an iteration, s |")
    print("|---|---|---|---|---|---|---|")
    rows = ROWS * (10 if device == "cuda" else 1)
    for name in configs:
        learn = config.load(name)
        sim = polypod.make(learn.run.task, num_envs=ROWS, seed=0).sim
        observations = torch.from_numpy(sim.observation.copy()).repeat(rows // ROWS, 1).to(device)
        size = {"num_obs": sim.num_obs, "num_actions": sim.num_actions}
        model = build_actor({**size, **learn.actor.model_cfg(sim)}).to(device).train()
        model.update_normalization(TensorDict({"policy": observations}, batch_size=[rows]))
        forward, both = (time / rows for time in seconds(model.mlp, model.obs_normalizer(observations)))
        images = 2 if learn.run.symmetry is True else 1
        iteration = SAMPLES * (forward + images * learn.algorithm.num_learning_epochs * both)
        weights = sum(weight.numel() for weight in model.mlp.parameters())
        print(
            f"| `{name}` | {sim.num_obs} | {sim.num_actions} | {weights:,} | {1e6 * forward:.2f} | {1e6 * both:.2f} | "
            f"{iteration:.2f} |"
        )


if __name__ == "__main__":
    main(sys.argv[1:] or CONFIGS)
