"""Prints the cost of networks in place of a DC motor's gains, measured in one run.

Writes the table of docs/actuator-networks.md.

OMP_NUM_THREADS=1 .venv/bin/python -m lab.actuator_networks
"""

import io
import json
import os
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from polypod import _core
from polypod.provenance import measured, sentence

TASK = "velocity_flat_legged"
BASE = "unitree_go2"
MLP = {"input_order": "pos_vel", "input_idx": [0, 1, 2], "pos_scale": -1.0, "vel_scale": 0.1, "torque_scale": 10.0}
GAINS = 25.0, 0.5
"""N m/rad, N m s/rad: the robot stands in all three cases, so that contacts cost the same."""
NUM_ENVS = 1024
ROUNDS = 60
BEST = 10
"""The machine does other things too: processor time of the fastest rounds counts."""


class Lstm(torch.nn.Module):
    """Two layers and a head, called as Isaac Lab calls the networks of its `ActuatorNetLSTM`."""

    def __init__(self) -> None:
        """Makes both layers and the head."""
        super().__init__()
        self.lstm = torch.nn.LSTM(2, 8, num_layers=2, batch_first=True)
        self.head = torch.nn.Linear(8, 1)

    def forward(
        self, x: torch.Tensor, state: tuple[torch.Tensor, torch.Tensor]
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        """Torque and state, [rows, 1]."""
        y, state = self.lstm(x, state)
        return self.head(y[:, -1]), state


def lstm() -> Lstm:
    """A recurrent network whose torques are of the order of 10 N m."""
    network = Lstm()
    with torch.no_grad():
        network.head.weight.mul_(20.0)
    return network


def onnx_of(network: torch.nn.Module, inputs: int | None = None) -> bytes:
    """The module as torch writes it. `inputs` of a perceptron; None: an LSTM's."""
    state = (torch.zeros(2, 3, 8), torch.zeros(2, 3, 8))
    example = (torch.zeros(3, 1, 2), state) if inputs is None else (torch.zeros(3, inputs),)
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(network, example, buffer, opset_version=17, dynamo=False)  # type: ignore[arg-type]
    return buffer.getvalue()


def toml(**values: Any) -> str:
    """Lines of a TOML table."""
    return "\n".join(f"{key} = {json.dumps(value)}" for key, value in values.items())


class Standing(torch.nn.Module):
    """A network of the common size in addition to the PD law, to which it adds next to nothing."""

    def __init__(self, network: torch.nn.Module, inputs: int) -> None:
        """Takes `inputs` numbers, position errors first."""
        super().__init__()
        self.network, self.law = network, torch.nn.Linear(inputs, 1, bias=False)
        with torch.no_grad():
            self.law.weight.zero_()
            self.law.weight[0, 0], self.law.weight[0, inputs // 2] = GAINS[0], -GAINS[1]

    def forward(self, x: torch.Tensor, *state: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Torque of each row."""
        found = self.network(x, *state)
        torque = found[0] if state else found
        return self.law(x[:, -1] if state else x) + 1e-3 * torque


def main() -> None:
    """Steps one robot three times, in turn, on one thread."""
    softsign = torch.nn.Softsign()
    plain = {**MLP, "pos_scale": 1.0, "vel_scale": 1.0, "torque_scale": 1.0}
    layers = [torch.nn.Linear(6, 32), softsign, torch.nn.Linear(32, 32), softsign, torch.nn.Linear(32, 32), softsign]
    networks = {
        "`dc_motor`": None,
        "`dc_motor`, `explicit = true`": None,
        "`actuator_net_mlp`, 6-32-32-32-1, softsign": onnx_of(
            Standing(torch.nn.Sequential(*layers, torch.nn.Linear(32, 1)), 6), 6
        ),
        "`actuator_net_lstm`, 2 layers of 8": onnx_of(Standing(lstm(), 2)),
    }
    models = ["dc_motor", "dc_motor", "actuator_net_mlp", "actuator_net_lstm"]
    sims = []
    with tempfile.TemporaryDirectory() as folder:
        robots = Path(folder) / "configs/robots"
        robots.mkdir(parents=True)
        os.environ["POLYPOD_PATH"] = folder
        for number, (model, data) in enumerate(zip(models, networks.values(), strict=True)):
            name = f"dog_{number}"
            settings = {"model": model, "explicit": number > 0, **(plain if model == "actuator_net_mlp" else {})}
            if data is not None:
                (robots / f"{name}.onnx").write_bytes(data)
                settings["network_file"] = f"{name}.onnx"
            head = [
                f"{key} = {json.dumps(value)}" for key, value in (("extends", BASE), ("name", name), ("title", name))
            ]
            (robots / f"{name}.toml").write_text("\n".join([*head, "[actuators.legs]", toml(**settings)]) + "\n")
            sims.append(_core.VecSim(TASK, NUM_ENVS, robots=[name], seed=1, threads=1))
    times = np.zeros((ROUNDS, len(sims)))
    random = np.random.default_rng(0)
    for row in times:
        actions = (0.2 * random.standard_normal((NUM_ENVS, 12))).astype(np.float32)
        for column, sim in enumerate(sims):
            began = time.process_time()
            sim.step(actions)
            row[column] = time.process_time() - began
    best = np.sort(times, axis=0)[:BEST].mean(axis=0)
    print(f"{sentence(measured())}\n")
    print("| actuators | env-steps/s | time of a control step |\n|---|---|---|")
    for name, seconds in zip(networks, best, strict=True):
        print(f"| {name} | {NUM_ENVS / seconds:,.0f} | {seconds / best[0]:.1f} |")


if __name__ == "__main__":
    main()
