"""The exported graphs as torch modules, and as TorchScript."""

import io
import warnings

import torch
from rsl_rl.models import MLPModel

from polypod.export import sources, states
from polypod.export.robot import RobotInterface
from polypod.networks.agreement import untouched
from polypod.networks.onnx_network import OnnxNetwork
from polypod.observation import Treatment


class RobotPolicy(torch.nn.Module):
    """A policy folded for one robot.

    From the inputs of `RobotInterface.inputs`, then the states, to joint targets, action and the
    next states.
    """

    lever: torch.Tensor
    spread: torch.Tensor
    default_pose: torch.Tensor
    joint_of_slot: torch.Tensor
    gather: torch.Tensor
    mask: torch.Tensor

    def __init__(self, network: MLPModel | OnnxNetwork, robot: RobotInterface) -> None:
        """Takes over a copy of the network."""
        super().__init__()
        self.network = states.as_module(network)
        self.inputs = list(robot.inputs())
        self.has_history = bool(robot.states())
        self.terms = robot.terms
        self.register_buffer("lever", torch.from_numpy(robot.lever()))
        self.register_buffer("spread", torch.from_numpy(robot.spread()))
        self.register_buffer("default_pose", torch.from_numpy(robot.default_pose))
        self.is_plain = robot.is_plain()
        self.is_whole = len(robot.columns) == robot.num_actions
        if self.is_plain:
            self.register_buffer("joint_of_slot", torch.from_numpy(robot.joint_of_slot))
        else:
            self.register_buffer("gather", torch.from_numpy(robot.gather()))
        if not self.is_whole:
            self.register_buffer("mask", torch.from_numpy(robot.mask()))
        for term, value in robot.constants.items():
            self.register_buffer(f"constant_{term}", torch.from_numpy(value))

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """`inputs` in the order of `RobotInterface.inputs`, each [batch, size], then the states."""
        sensors, memory = inputs[: len(self.inputs)], inputs[len(self.inputs) :]
        history, memory = (memory[0], memory[1:]) if self.has_history else (None, memory)
        observation, *after = self._observe(sensors, history)
        found = self.network(observation, *memory)
        actions, *later = (found,) if isinstance(found, torch.Tensor) else found
        if not self.is_whole:
            actions = actions * self.mask
        return self.default_pose + actions @ self.spread, actions, *after, *later

    def observe(self, *inputs: torch.Tensor) -> torch.Tensor:
        """The observation, [batch, num_obs], of an episode that begins."""
        rows = inputs[0].shape[0]
        remembered = sum(term.size - term.width for term in self.terms if term.inputs)
        return self._observe(inputs, torch.zeros(rows, 1 + remembered) if self.has_history else None)[0]

    def _observe(self, inputs: tuple[torch.Tensor, ...], history: torch.Tensor | None) -> tuple[torch.Tensor, ...]:
        """The observation, and with a history the next one."""
        of = dict(zip(self.inputs, inputs, strict=True))
        do = _Operations(self, inputs[0].shape[0])
        columns, after, start = [], [], 1
        if history is not None:
            begun = history[:, :1] > 0.5
            after.append(torch.ones_like(history[:, :1]))
        for term in self.terms:
            column = sources.compute(do, term, [of[name] for name in term.inputs])
            # a constant is what the policy observes already
            treatment = term.treatment if term.inputs else Treatment()
            if treatment.offset != 0.0:
                column = column - treatment.offset
            if treatment.clip is not None:
                column = column.clamp(*treatment.clip)
            if treatment.scale != 1.0:
                column = column * treatment.scale
            if history is not None and term.inputs and term.history_length > 1:
                length = term.size - term.width
                past = torch.where(begun, history[:, start : start + length], column.repeat(1, term.history_length - 1))
                column = torch.cat((past, column), dim=-1)
                after.append(column[:, term.width :])
                start += length
            columns.append(column)
        observation = torch.cat(columns, dim=-1)
        return (observation,) if history is None else (observation, torch.cat(after, dim=-1))


class _Operations:
    """See `sources.Operations`."""

    def __init__(self, policy: RobotPolicy, rows: int) -> None:
        self.policy, self.rows = policy, rows

    def robot_constant(self, term: str) -> torch.Tensor:
        value: torch.Tensor = self.policy.get_buffer(f"constant_{term}")
        return value.expand(self.rows, -1)

    def plus(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return a + b

    def about_center_of_mass(self, rate: torch.Tensor) -> torch.Tensor:
        return rate @ self.policy.lever

    def less_default_pose(self, positions: torch.Tensor) -> torch.Tensor:
        return positions - self.policy.default_pose

    def canonical(self, joints: torch.Tensor) -> torch.Tensor:
        if self.policy.is_plain:
            return joints.index_select(-1, self.policy.joint_of_slot)
        return joints @ self.policy.gather


def torchscript(module: torch.nn.Module, example: tuple[torch.Tensor, ...]) -> bytes:
    """Traces `module`, which stays as it is; returns the archive."""
    with untouched(module), warnings.catch_warnings():
        # torch advises against TorchScript; those who load it in C++ still want it
        warnings.simplefilter("ignore", FutureWarning)
        warnings.simplefilter("ignore", DeprecationWarning)
        # recurrent layers check sizes, which are constants here
        warnings.simplefilter("ignore", torch.jit.TracerWarning)  # type: ignore[attr-defined]
        traced = torch.jit.trace(module, example)  # type: ignore[no-untyped-call]
        buffer = io.BytesIO()
        torch.jit.save(traced, buffer)
        return buffer.getvalue()
