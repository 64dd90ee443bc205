"""The exported graphs as ONNX models.

They are a few dozen nodes at most, written down here: torch's exporter takes a minute for them and
leaves a graph that depends on its version. `checkpoint.export_checkpoint` compares every graph with
torch before it is done.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules import EmpiricalNormalization

from polypod import _core
from polypod.descriptions import LOG_FLOOR
from polypod.export import sources, states
from polypod.export.robot import INPUTS, OUTPUTS, RobotInterface
from polypod.export.states import HISTORY, Shape
from polypod.extras import package
from polypod.networks import JointNetwork
from polypod.networks.clipped import limit_of
from polypod.networks.onnx_network import OnnxNetwork, output_of
from polypod.networks.urma import KEY_SCALE, OUTSIDE, REFLEX_SCALE, RELATIVE_FLOOR
from polypod.observation import Term, Treatment

OPSET = 17
"""Opset of ONNX's default domain: old enough for the runtimes in use."""
IR_VERSION = 8
"""The one that came with it."""


class Graph:
    """An ONNX graph in the making; tensors go by their names."""

    def __init__(self, name: str) -> None:
        """An empty graph."""
        self.onnx = package("onnx", "exporting to ONNX", "export")
        self.name = name
        self.nodes: list[Any] = []
        self.states: dict[str, Shape] = {}
        """States of the graph, by the names of the inputs; nodes compute their outputs."""
        self.constants: list[Any] = []
        self.opsets = {"": OPSET}
        self.ir_version = IR_VERSION

    def constant(self, name: str, value: npt.NDArray[Any]) -> str:
        """Stores an array."""
        self.constants.append(self.onnx.numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def node(self, operator: str, *inputs: str, output: str, **attributes: Any) -> str:
        """Adds a node with one output, and returns that output's name."""
        self.nodes.append(self.onnx.helper.make_node(operator, list(inputs), [output], name=output, **attributes))
        return output

    def inline(self, network: OnnxNetwork, source: str, target: str) -> None:
        """Adds the graph of an ONNX file from tensor `source` to tensor `target`.

        Its other names get the prefix `network_`.
        """
        model = self.onnx.load_model_from_string(network.data)
        self.opsets |= {entry.domain.removeprefix("ai.onnx"): entry.version for entry in model.opset_import}
        if self.opsets[""] < OPSET:
            raise _core.ConfigError(
                f"{network.name} has operators of version {self.opsets['']}; write it with {OPSET} or later"
            )
        self.ir_version = max(model.ir_version, self.ir_version)
        names = {network.input: source, network.output: target}
        self.states |= network.states
        inner = self.onnx.compose.add_prefix_graph(model.graph, "network_", rename_inputs=False, rename_outputs=False)
        for node in inner.node:
            node.input[:] = [names.get(name, name) for name in node.input]
            node.output[:] = [names.get(name, name) for name in node.output]
        # the prefix is given to what a branch defines, not to what it uses of the graph around it
        around = [entry.name for entry in model.graph.initializer]
        around += [name for node in model.graph.node for name in node.output]
        _rename_in_branches(inner, {name: f"network_{name}" for name in around} | names)
        self.nodes += list(inner.node)
        self.constants += list(inner.initializer)

    def model(self, inputs: Mapping[str, int], outputs: Mapping[str, int], metadata: Mapping[str, str]) -> Any:
        """The checked model.

        Inputs and outputs are float32 [batch, size], and after them come the states.
        """
        helper = self.onnx.helper

        def tensors(sizes: Mapping[str, int], memory: Mapping[str, Shape]) -> list[Any]:
            kind = self.onnx.TensorProto.FLOAT
            documents = {**INPUTS, **OUTPUTS, **states.MEANINGS}
            shapes: dict[str, list[int | str]] = {name: ["batch", size] for name, size in sizes.items()}
            for name, shape in memory.items():
                shapes[name] = ["batch", *shape] if len(shape) == 1 else [shape[0], "batch", *shape[1:]]
            return [
                helper.make_tensor_value_info(name, kind, shape, doc_string=documents.get(name, ""))
                for name, shape in shapes.items()
            ]

        after = {output_of(name): shape for name, shape in self.states.items()}
        ends = tensors(inputs, self.states), tensors(outputs, after)
        graph = helper.make_graph(self.nodes, self.name, *ends, self.constants)
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid(domain, version) for domain, version in self.opsets.items()],
            ir_version=self.ir_version,
            producer_name="polypod",
            producer_version=_core.__version__,
        )
        fed_back = {
            "state_inputs": ",".join(self.states),
            "state_outputs": ",".join(after),
        }
        helper.set_model_props(model, {**metadata, **(fed_back if self.states else {})})
        try:
            self.onnx.checker.check_model(model, full_check=True)
        except Exception as error:  # an exception of onnx, or one of protobuf's
            reason = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
            raise _core.ConfigError(
                f"{self.name}: the network's operators make no sound ONNX graph ({reason}); write it without functions "
                "and operators of its own"
            ) from error
        return model


def _rename_in_branches(graph: Any, names: Mapping[str, str]) -> None:
    """Gives tensors of a graph other names where its branches and loops use them."""
    for node in graph.node:
        for attribute in node.attribute:
            for branch in (attribute.g, *attribute.graphs):
                for inner in branch.node:
                    inner.input[:] = [names.get(name, name) for name in inner.input]
                _rename_in_branches(branch, names)


def network_model(network: MLPModel | OnnxNetwork, num_obs: int, num_actions: int, metadata: Mapping[str, str]) -> Any:
    """The network alone: `obs` [batch, num_obs] to `actions` [batch, num_actions]."""
    graph = Graph("policy")
    _add_network(graph, network, "obs", "actions")
    return graph.model({"obs": num_obs}, {"actions": num_actions}, metadata)


def robot_model(network: MLPModel | OnnxNetwork, robot: RobotInterface, metadata: Mapping[str, str]) -> Any:
    """The network folded for a robot: see `polypod.export.robot` for inputs and outputs."""
    graph = Graph(f"policy_{robot.name}")
    inputs = robot.inputs()
    do = _Operations(graph, robot)
    history = _History(graph, robot) if robot.states() else None
    columns = []
    for term in robot.terms:
        do.term = term.term
        column = sources.compute(do, term, term.inputs)
        # a constant is what the policy observes already
        if term.inputs:
            column = _add_treatment(graph, term.treatment, column, term.term)
            if history is not None and term.history_length > 1:
                column = history.add(term, column)
        columns.append(column)
    if history is not None:
        history.finish()
    observation = graph.node("Concat", *columns, output="obs", axis=1)
    if len(robot.columns) == robot.num_actions:
        _add_network(graph, network, observation, "actions")
    else:
        _add_network(graph, network, observation, "all_actions")
        graph.node("Mul", "all_actions", graph.constant("action_mask", robot.mask()), output="actions")
    spread = graph.constant("action_spread", robot.spread())
    graph.node("Gemm", "actions", spread, do.default_pose, output="joint_pos_target")
    outputs = {"joint_pos_target": len(robot.joint_names), "actions": robot.num_actions}
    return graph.model(inputs, outputs, metadata)


class _History:
    """History of the terms of a folded graph, see `polypod.export.states`."""

    def __init__(self, graph: Graph, robot: RobotInterface) -> None:
        self.graph = graph
        graph.states |= robot.states()
        self.start = 1
        flag = self._columns(HISTORY, 0, 1, "history_flag")
        half = graph.constant("history_half", np.array(0.5, dtype=np.float32))
        self.begun = graph.node("Greater", flag, half, output="history_begun")
        zero, one = (graph.constant(f"history_{x:g}", np.array(x, dtype=np.float32)) for x in (0.0, 1.0))
        # as many rows as the input has
        self.after = [graph.node("Add", graph.node("Mul", flag, zero, output="history_none"), one, output="history_on")]

    def add(self, term: Term, newest: str) -> str:
        """The whole of a term, the oldest numbers first.

        A new episode remembers its first numbers.
        """
        graph, name, past = self.graph, term.term, term.size - term.width
        remembered = self._columns(HISTORY, self.start, self.start + past, f"{name}_remembered")
        self.start += past
        repeated = graph.node("Concat", *[newest] * (term.history_length - 1), output=f"{name}_repeated", axis=1)
        older = graph.node("Where", self.begun, remembered, repeated, output=f"{name}_older")
        whole = graph.node("Concat", older, newest, output=f"{name}_whole", axis=1)
        self.after.append(self._columns(whole, term.width, term.size, f"{name}_kept"))
        return whole

    def finish(self) -> None:
        """Adds the nodes that write the history."""
        self.graph.node("Concat", *self.after, output=output_of(HISTORY), axis=1)

    def _columns(self, source: str, start: int, end: int, output: str) -> str:
        limits = [
            self.graph.constant(f"{output}_{name}", np.array([value], dtype=np.int64))
            for name, value in (("start", start), ("end", end), ("axis", 1))
        ]
        return self.graph.node("Slice", source, *limits, output=output)


class _Operations:
    """See `sources.Operations`; values are the names of tensors."""

    def __init__(self, graph: Graph, robot: RobotInterface) -> None:
        self.graph, self.robot = graph, robot
        self.term = ""
        """The term that is computed: its name begins those of its tensors."""
        self.any_input = next(iter(robot.inputs()))
        self.default_pose = graph.constant("default_pose", robot.default_pose)

    # a runtime warns of constants that nothing uses

    @functools.cached_property
    def slots(self) -> str:
        return self.graph.constant("joint_of_slot", self.robot.joint_of_slot)

    @functools.cached_property
    def gather(self) -> str:
        return self.graph.constant("joints_to_slots", self.robot.gather())

    @functools.cached_property
    def lever(self) -> str:
        return self.graph.constant("base_com_lever", self.robot.lever())

    @functools.cached_property
    def first(self) -> str:
        return self.graph.constant("first", np.array([0], dtype=np.int64))

    def robot_constant(self, term: str) -> str:
        # as many rows as the inputs have
        graph, value = self.graph, self.robot.constants[term]
        shape = graph.node("Shape", self.any_input, output=f"{term}_input_shape")
        batch = graph.node("Gather", shape, self.first, output=f"{term}_batch_size", axis=0)
        width = graph.constant(f"{term}_size", np.array([len(value)], dtype=np.int64))
        wanted = graph.node("Concat", batch, width, output=f"{term}_shape", axis=0)
        return graph.node("Expand", graph.constant(term, value), wanted, output=f"obs_{term}")

    def plus(self, a: str, b: str) -> str:
        return self.graph.node("Add", a, b, output=f"obs_{self.term}")

    def about_center_of_mass(self, rate: str) -> str:
        return self.graph.node("MatMul", rate, self.lever, output=f"{self.term}_turning")

    def less_default_pose(self, positions: str) -> str:
        return self.graph.node("Sub", positions, self.default_pose, output=f"{self.term}_from_default")

    def canonical(self, joints: str) -> str:
        if self.robot.is_plain():
            return self.graph.node("Gather", joints, self.slots, output=f"obs_{self.term}", axis=1)
        return self.graph.node("MatMul", joints, self.gather, output=f"obs_{self.term}")


def _add_treatment(graph: Graph, treatment: Treatment, source: str, term: str) -> str:
    """Adds the noise-free processing of a term, such as clipping and scaling.

    Returns the name of the result.
    """

    def constant(name: str, value: float) -> str:
        return graph.constant(f"{term}_{name}", np.array(value, dtype=np.float32))

    value = source
    if treatment.offset != 0.0:
        value = graph.node("Sub", value, constant("offset", treatment.offset), output=f"{term}_less_offset")
    if treatment.clip is not None:
        low, high = (constant(name, limit) for name, limit in zip(("low", "high"), treatment.clip, strict=True))
        value = graph.node("Clip", value, low, high, output=f"{term}_clipped")
    if treatment.scale != 1.0:
        value = graph.node("Mul", value, constant("scale", treatment.scale), output=f"{term}_scaled")
    return value


def _add_network(graph: Graph, network: MLPModel | OnnxNetwork, source: str, target: str) -> None:
    """Adds the deterministic network from tensor `source` to tensor `target`."""
    if isinstance(network, OnnxNetwork):
        graph.inline(network, source, target)
        return
    if (limit := limit_of(network)) is not None:
        end, target = target, f"{target}_unclipped"
    value = source
    if isinstance(network.obs_normalizer, EmpiricalNormalization):
        normalizer = network.obs_normalizer
        mean = graph.constant("obs_mean", _numpy(normalizer.mean))
        scale = graph.constant("obs_std", _numpy(normalizer.std + normalizer.eps))
        value = graph.node("Div", graph.node("Sub", value, mean, output="obs_centred"), scale, output="obs_normalized")
    if isinstance(network, RNNModel):
        value = _add_recurrent_layers(graph, network, value)
    if isinstance(network.mlp, JointNetwork):
        _add_joint_network(graph, network.mlp, value, target)
    else:
        _add_layers(graph, list(network.mlp), value, target, "layer")
    if limit is not None:
        sides = (("low", -limit), ("high", limit))
        low, high = (graph.constant(f"action_{name}", np.array(side, np.float32)) for name, side in sides)
        graph.node("Clip", target, low, high, output=end)


def _add_layers(graph: Graph, layers: Sequence[torch.nn.Module], source: str, target: str, name: str) -> None:
    """Adds layers one after the other; tensors between them go by `name`."""
    value = source
    for index, layer in enumerate(layers):
        output = target if index + 1 == len(layers) else f"{name}_{index}"
        if isinstance(layer, torch.nn.Linear):
            value = _add_gemm(graph, layer, value, output)
        else:
            value = _add_activation(graph, layer, value, output)


def _add_recurrent_layers(graph: Graph, network: RNNModel, source: str) -> str:
    """Adds the recurrent layers, each fed with one step of a sequence.

    Returns the name of the last one's output.
    """
    rnn: Any = network.rnn.rnn
    graph.states |= states.of_network(network)
    is_lstm = isinstance(rnn, torch.nn.LSTM)
    # torch has the gates of an LSTM as input, forget, cell, output, and ONNX as input, output,
    # forget, cell; those of a GRU are reset, update, new, and update, reset, new
    order = [0, 3, 1, 2] if is_lstm else [1, 0, 2]

    def gates(name: str) -> npt.NDArray[np.float32]:
        parts = np.split(_numpy(getattr(rnn, name)), len(order))
        return np.concatenate([parts[gate] for gate in order])

    axis = graph.constant("sequence_axis", np.array([0], dtype=np.int64))
    value = graph.node("Unsqueeze", source, axis, output="sequence")
    ends: dict[str, list[str]] = {name: [] for name in graph.states if name != HISTORY}
    for layer in range(rnn.num_layers):
        name = f"recurrent_{layer}"
        weights = [graph.constant(f"{name}_{key}", gates(f"weight_{key}_l{layer}")[np.newaxis]) for key in ("ih", "hh")]
        bias = np.concatenate([gates(f"bias_{key}_l{layer}") for key in ("ih", "hh")])[np.newaxis]
        begins = []
        for state in ends:
            limits = [
                graph.constant(f"{name}_{state}_{key}", np.array([at], dtype=np.int64))
                for key, at in (("start", layer), ("end", layer + 1), ("axis", 0))
            ]
            begins.append(graph.node("Slice", state, *limits, output=f"{name}_{state}"))
            ends[state].append(f"{name}_{output_of(state)}")
        inputs = [value, *weights, graph.constant(f"{name}_bias", bias), "", *begins]
        outputs = [f"{name}_all", *(names[-1] for names in ends.values())]
        extra = {} if is_lstm else {"linear_before_reset": 1}
        operator = "LSTM" if is_lstm else "GRU"
        graph.nodes.append(
            graph.onnx.helper.make_node(operator, inputs, outputs, name=name, hidden_size=rnn.hidden_size, **extra)
        )
        value = ends["h_in"][-1]
    for state, names in ends.items():
        graph.node("Concat", *names, output=output_of(state), axis=0)
    return graph.node("Squeeze", value, axis, output="recurrent")


def _add_joint_network(graph: Graph, network: JointNetwork, source: str, target: str) -> None:
    """Adds what `JointNetwork.forward` gives as means, for all slots.

    See there for what each step is for.
    """
    slots, last, of_joints = network.num_joints, _index(graph, "last_axis", 2), _index(graph, "joint_axis", 1)

    def linear(layer: torch.nn.Linear, value: str, name: str) -> str:
        product = graph.node(
            "MatMul", value, graph.constant(f"{name}_weight", _numpy(layer.weight.t())), output=f"{name}_product"
        )
        if layer.bias is None:
            return product
        return graph.node("Add", product, graph.constant(f"{name}_bias", _numpy(layer.bias)), output=name)

    def layers(modules: torch.nn.Sequential, value: str, name: str) -> str:
        for index, layer in enumerate(modules):
            output = f"{name}_{index}"
            if isinstance(layer, torch.nn.Linear):
                value = linear(layer, value, output)
            else:
                value = _add_activation(graph, layer, value, output)
        return value

    def number(name: str, value: float) -> str:
        return graph.constant(name, np.array(value, dtype=np.float32))

    def affine(value: str, scale: torch.Tensor, offset: torch.Tensor, name: str) -> str:
        scaled = graph.node("Mul", value, graph.constant(f"{name}_scale", _numpy(scale)), output=f"{name}_scaled")
        return graph.node("Add", scaled, graph.constant(f"{name}_offset", _numpy(offset)), output=name)

    def normalized(value: str, name: str, magnitude: torch.Tensor | None = None) -> str:
        moments = network.moments[name]
        if isinstance(moments, EmpiricalNormalization):
            scale = 1.0 / (moments.std + moments.eps)
            return affine(value, scale * (1.0 if magnitude is None else magnitude), -moments.mean * scale, name)
        if magnitude is not None:
            return graph.node("Mul", value, graph.constant(f"{name}_magnitude", _numpy(magnitude)), output=name)
        return value

    def gathered(columns: torch.Tensor, name: str) -> str:
        indices = graph.constant(f"{name}_columns", columns.cpu().numpy())
        return graph.node("Gather", source, indices, output=f"{name}_observed", axis=1)

    def of_each_joint(columns: torch.Tensor, name: str) -> str:
        shape = graph.constant(f"{name}_shape", np.array([0, len(columns) // slots, slots], dtype=np.int64))
        rows = graph.node("Reshape", gathered(columns, name), shape, output=f"{name}_by_number")
        return graph.node("Transpose", rows, output=f"{name}_by_joint", perm=[0, 2, 1])

    def total(value: str, axis: str, name: str) -> str:
        return graph.node("ReduceSum", value, axis, output=name, keepdims=1)

    def per_joint(value: str, name: str) -> str:
        if compared != present:
            value = graph.node("Mul", value, compared, output=f"{name}_compared")
        return graph.node("Div", total(value, of_joints, f"{name}_total"), joints, output=name)

    states = normalized(of_each_joint(network.state_columns, "state"), "states", network.state_scale)
    numbers = of_each_joint(network.description_columns, "description")
    sizes = graph.node("Abs", numbers, output="description_sizes")
    present = graph.node("Sign", total(sizes, last, "description_size"), output="present")
    compared, are_legs = present, network.leg_slots.cpu().numpy().reshape(1, slots, 1)
    if network.leg_heads is not None:
        compared = graph.node("Mul", present, graph.constant("leg_slots", are_legs.astype(np.float32)), output="legs")
    joints = graph.node("Max", total(compared, of_joints, "joints_found"), number("one", 1.0), output="joints")
    absolute = graph.node("Mul", normalized(numbers, "numbers"), present, output="absolute")
    apart = graph.node("Sub", absolute, per_joint(absolute, "mean_joint"), output="apart_of_all")
    apart = graph.node("Mul", apart, present, output="apart")
    spread = graph.node(
        "Sqrt", per_joint(graph.node("Mul", apart, apart, output="apart_squared"), "variance"), output="spread"
    )
    spread = graph.node("Add", spread, number("relative_floor", RELATIVE_FLOOR), output="spread_floored")
    relative = graph.node("Div", apart, spread, output="relative")
    logarithms = graph.node("Add", sizes, number("log_floor", LOG_FLOOR), output="description_floored")
    logarithms = normalized(graph.node("Log", logarithms, output="description_logarithms"), "logarithms")
    logarithms = graph.node("Mul", logarithms, present, output="logarithms_present")
    described = graph.node("Concat", absolute, logarithms, relative, output="described", axis=2)

    description = layers(network.describe, described, "describe")
    state = graph.node(
        "Add",
        linear(network.state, states, "state_read"),
        linear(network.state_by_description, description, "state_by_description"),
        output="state_sum",
    )
    state = _add_activation(graph, network.activation, state, "state")
    code = graph.node("Sin", linear(network.code, relative, "code_angle"), output="code_sine")
    code = graph.node("Mul", code, number("code_scale", math.sqrt(2.0)), output="code")
    attention = graph.node(
        "Add", linear(network.attention, description, "attention"), linear(network.focus, code, "focus"), output="looks"
    )
    seen = present
    if network.leg_heads is not None:
        of_legs = np.arange(network.attention.out_features) < network.leg_heads
        seen = graph.constant("heads_of_slots", (are_legs == of_legs).astype(np.float32))
        seen = graph.node("Mul", present, seen, output="seen_by_heads")
    outside = graph.node("Sub", seen, "one", output="less_present")
    outside = graph.node("Mul", outside, number("outside", -OUTSIDE), output="outside_of_body")
    attention = graph.node("Add", attention, outside, output="looks_at_body")
    shares = graph.node("Softmax", attention, output="shares", axis=1)
    if network.leg_heads is not None:
        shares = graph.node("Mul", shares, seen, output="shares_of_seen")
    heads = graph.node("Transpose", shares, output="heads", perm=[0, 2, 1])
    pooled = graph.node("MatMul", heads, linear(network.value, state, "value"), output="pooled_heads")
    flat = np.array([0, network.attention.out_features * network.value.out_features], dtype=np.int64)
    pooled = graph.node("Reshape", pooled, graph.constant("pooled_shape", flat), output="pooled")
    if len(network.general_columns):
        general = normalized(gathered(network.general_columns, "general"), "general")
        pooled = graph.node("Concat", pooled, general, output="body_0", axis=1)
    _add_layers(graph, list(network.body), pooled, "body", "body_layer")

    request = graph.node("Unsqueeze", _add_gemm(graph, network.request, "body", "request"), last, output="requested")
    keys = graph.node("Concat", code, description, output="keys_unscaled", axis=2)
    keys = graph.node("Mul", keys, number("key_scale", KEY_SCALE / network.code.out_features), output="keys")
    read = graph.node("MatMul", keys, request, output="read")
    reflex = layers(network.reflex, state, "reflex")
    reflex = graph.node("Mul", reflex, number("reflex_scale", REFLEX_SCALE), output="reflex_scaled")
    read = graph.node("Add", read, reflex, output="read_with_reflex")
    read = graph.node("Mul", read, present, output="read_present")
    graph.node("Reshape", read, graph.constant("slots", np.array([0, slots], dtype=np.int64)), output=target)


def _index(graph: Graph, name: str, value: int) -> str:
    return graph.constant(name, np.array([value], dtype=np.int64))


def _add_gemm(graph: Graph, layer: torch.nn.Linear, value: str, output: str) -> str:
    weight = graph.constant(f"{output}_weight", _numpy(layer.weight))
    bias = graph.constant(f"{output}_bias", _numpy(layer.bias))
    return graph.node("Gemm", value, weight, bias, output=output, transB=1)


def _add_activation(graph: Graph, layer: torch.nn.Module, value: str, output: str) -> str:
    operator, attributes = _activation(layer)
    return graph.node(operator, value, output=output, **attributes)


def _activation(layer: torch.nn.Module) -> tuple[str, dict[str, float]]:
    match layer:
        case torch.nn.ELU() | torch.nn.CELU():
            return type(layer).__name__.capitalize(), {"alpha": layer.alpha}
        case torch.nn.LeakyReLU():
            return "LeakyRelu", {"alpha": layer.negative_slope}
        case torch.nn.SELU() | torch.nn.ReLU() | torch.nn.Tanh() | torch.nn.Sigmoid() | torch.nn.Softplus():
            return type(layer).__name__.capitalize(), {}
        case torch.nn.Identity():
            return "Identity", {}
    raise _core.ConfigError(
        f"the activation {type(layer).__name__} is not exported to ONNX; train with elu, relu, tanh or another of "
        "ONNX's own, or leave out the format onnx"
    )


def _numpy(tensor: torch.Tensor) -> npt.NDArray[np.float32]:
    return tensor.detach().cpu().numpy().astype(np.float32)
