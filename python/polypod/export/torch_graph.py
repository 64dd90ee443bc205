"""The exported graphs as torch modules, and as TorchScript."""

import io
import warnings

import torch
from rsl_rl.models import MLPModel

from polypod.export.robot import RobotInterface, Treatment


class RobotPolicy(torch.nn.Module):
    """A policy folded for one robot: from the inputs of `RobotInterface.inputs` to joint targets and action."""

    lever: torch.Tensor
    spread: torch.Tensor
    default_pose: torch.Tensor
    joint_of_slot: torch.Tensor
    morphology: torch.Tensor

    def __init__(self, network: MLPModel, robot: RobotInterface) -> None:
        """Takes over a copy of the network."""
        super().__init__()
        self.network = network.as_jit()
        self.inputs = list(robot.inputs())
        self.terms = [(term, robot.treatment.get(term, Treatment())) for term, _ in robot.layout]
        self.register_buffer("lever", torch.from_numpy(robot.lever()))
        self.register_buffer("spread", torch.from_numpy(robot.spread()))
        self.register_buffer("default_pose", torch.from_numpy(robot.default_pose))
        self.register_buffer("joint_of_slot", torch.from_numpy(robot.joint_of_slot))
        self.register_buffer("morphology", torch.from_numpy(robot.morphology))

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """`inputs` in the order of `RobotInterface.inputs`, each [batch, size]."""
        actions = self.network(self.observe(*inputs))
        return self.default_pose + actions @ self.spread, actions

    def observe(self, *inputs: torch.Tensor) -> torch.Tensor:
        """The observation, [batch, num_obs]."""
        of = dict(zip(self.inputs, inputs, strict=True))
        columns = []
        for term, treatment in self.terms:
            if term == "base_lin_vel":
                column = of["base_lin_vel"] + of["base_ang_vel"] @ self.lever
            elif term == "joint_pos_rel":
                column = (of["joint_pos"] - self.default_pose).index_select(-1, self.joint_of_slot)
            elif term == "joint_vel_rel":
                column = of["joint_vel"].index_select(-1, self.joint_of_slot)
            elif term == "morphology":
                column = self.morphology.expand(inputs[0].shape[0], -1)
            else:
                column = of[term]
            if treatment.offset != 0.0:
                column = column - treatment.offset
            if treatment.clip is not None:
                column = column.clamp(*treatment.clip)
            if treatment.scale != 1.0:
                column = column * treatment.scale
            columns.append(column)
        return torch.cat(columns, dim=-1)


def torchscript(module: torch.nn.Module, example: tuple[torch.Tensor, ...]) -> bytes:
    """Traces `module`; returns the archive."""
    with warnings.catch_warnings():
        # torch advises against TorchScript; those who load it in C++ still want it
        warnings.simplefilter("ignore", FutureWarning)
        warnings.simplefilter("ignore", DeprecationWarning)
        traced = torch.jit.trace(module.eval(), example)  # type: ignore[no-untyped-call]
        buffer = io.BytesIO()
        torch.jit.save(traced, buffer)
        return buffer.getvalue()
