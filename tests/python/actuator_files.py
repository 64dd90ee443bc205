"""Networks that drive joints, as files, and the lines of configs that name them."""

import io
import json
import warnings

import torch

TASK = "velocity_flat_legged"
BASE = "unitree_go2"


class Lstm(torch.nn.Module):
    """Two layers and a head, called as Isaac Lab calls the networks of its `ActuatorNetLSTM`."""

    def __init__(self) -> None:
        """Makes both layers and the head."""
        super().__init__()
        self.lstm = torch.nn.LSTM(2, 8, num_layers=2, batch_first=True)
        self.head = torch.nn.Linear(8, 1)

    def forward(self, x: torch.Tensor, state: tuple[torch.Tensor, torch.Tensor]):
        """Torque and state, [rows, 1]."""
        y, state = self.lstm(x, state)
        return self.head(y[:, -1]), state


def lstm():
    network = Lstm()
    with torch.no_grad():
        network.head.weight.mul_(20.0)
    return network


def onnx_of(network, inputs=None):
    """The module as torch writes it. `inputs` of a perceptron; None: an LSTM's."""
    state = (torch.zeros(2, 3, 8), torch.zeros(2, 3, 8))
    example = (torch.zeros(3, 1, 2), state) if inputs is None else (torch.zeros(3, inputs),)
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(network, example, buffer, opset_version=17, dynamo=False)
    return buffer.getvalue()


MLP = {"input_order": "pos_vel", "input_idx": [0, 1, 2], "pos_scale": -1.0, "vel_scale": 0.1, "torque_scale": 10.0}


def toml(**values):
    return "\n".join(f"{key} = {json.dumps(value)}" for key, value in values.items())
