"""The exported graphs as ONNX models.

They are a few dozen nodes at most, written down here: torch's exporter takes a minute for them and leaves a graph that
depends on its version. `checkpoint.export_checkpoint` compares every graph with torch before it is done.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules import EmpiricalNormalization

from polypod import _core
from polypod.export import sources, states
from polypod.export.robot import INPUTS, OUTPUTS, RobotInterface
from polypod.export.states import HISTORY, Shape
from polypod.extras import package
from polypod.networks import JointNetwork
from polypod.networks.onnx_network import OnnxNetwork, output_of
from polypod.observation import Term, Treatment

OPSET = 17
"""Of ONNX's default domain: old enough for the runtimes in use."""
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
        """What it remembers, by the names of the inputs; their outputs are computed by nodes."""
        self.constants: list[Any] = []
        self.opsets = {"": OPSET}
        self.ir_version = IR_VERSION

    def constant(self, name: str, value: npt.NDArray[Any]) -> str:
        """Stores an array."""
        self.constants.append(self.onnx.numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def node(self, operator: str, *inputs: str, output: str, **attributes: Any) -> str:
        """Adds a node."""
        self.nodes.append(self.onnx.helper.make_node(operator, list(inputs), [output], name=output, **attributes))
        return output

    def inline(self, network: OnnxNetwork, source: str, target: str) -> None:
        """Adds the graph of an ONNX file from tensor `source` to tensor `target`, its other names behind `network_`."""
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
        self.nodes += list(inner.node)
        self.constants += list(inner.initializer)

    def model(self, inputs: Mapping[str, int], outputs: Mapping[str, int], metadata: Mapping[str, str]) -> Any:
        """The checked model; inputs and outputs are float32 [batch, size], and after them come the states."""
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
        self.onnx.checker.check_model(model, full_check=True)
        return model


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
    """What the terms of a folded graph remember, see `polypod.export.states`."""

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
        """The whole of a term, the oldest numbers first; a new episode remembers its first numbers."""
        graph, name, past = self.graph, term.term, term.size - term.width
        remembered = self._columns(HISTORY, self.start, self.start + past, f"{name}_remembered")
        self.start += past
        repeated = graph.node("Concat", *[newest] * (term.history_length - 1), output=f"{name}_repeated", axis=1)
        older = graph.node("Where", self.begun, remembered, repeated, output=f"{name}_older")
        whole = graph.node("Concat", older, newest, output=f"{name}_whole", axis=1)
        self.after.append(self._columns(whole, term.width, term.size, f"{name}_kept"))
        return whole

    def finish(self) -> None:
        """Gives back what is to be remembered."""
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
    """What the task does to a term after it is measured; returns the name of the result."""

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
    """Adds the recurrent layers, each fed with one step of a sequence; returns the name of the last one's output."""
    rnn: Any = network.rnn.rnn
    graph.states |= states.of_network(network)
    is_lstm = isinstance(rnn, torch.nn.LSTM)
    # torch has the gates of an LSTM as input, forget, cell, output, and ONNX as input, output, forget, cell; those of a
    # GRU are reset, update, new, and update, reset, new
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
    """Adds what `JointNetwork.forward` does, with the layers of all joints written out."""
    joints, joint_dim = network.num_joints, network.state.out_features

    def shape(name: str, *sizes: int) -> str:
        return graph.constant(name, np.array(sizes, dtype=np.int64))

    def of_each_joint(name: str, matrix: torch.Tensor, offset: torch.Tensor) -> str:
        weight, bias = graph.constant(f"{name}_weight", _numpy(matrix)), graph.constant(f"{name}_bias", _numpy(offset))
        encoded = graph.node("Gemm", source, weight, bias, output=f"{name}_encoded")
        active = _add_activation(graph, network.activation, encoded, f"{name}_active")
        return graph.node("Reshape", active, shape(f"{name}_shape", 0, joints, joint_dim), output=name)

    def linear(layer: torch.nn.Linear, value: str, name: str) -> str:
        weight = graph.constant(f"{name}_weight", _numpy(layer.weight.t()))
        product = graph.node("MatMul", value, weight, output=f"{name}_product")
        return graph.node("Add", product, graph.constant(f"{name}_bias", _numpy(layer.bias)), output=name)

    descriptions = of_each_joint("descriptions", *network.description_layer())
    states = of_each_joint("states", *network.state_layer())
    by_place = graph.constant("attention_by_place", _numpy(network.place_attention(network.place)))
    attention = linear(network.attention, descriptions, "attention_by_description")
    attention = graph.node("Add", attention, by_place, output="attention")
    weights = graph.node("Softmax", attention, output="attention_weights", axis=1)
    heads = graph.node("Transpose", weights, output="attention_heads", perm=[0, 2, 1])
    gathered = graph.node("MatMul", heads, states, output="gathered_heads")
    flat = shape("gathered_shape", 0, network.attention.out_features * joint_dim)
    gathered = graph.node("Reshape", gathered, flat, output="gathered")
    general = graph.node(
        "Gather", source, shape("general_columns", *network.general.tolist()), output="general", axis=1
    )
    whole = graph.node("Concat", gathered, general, output="body_0", axis=1)
    _add_layers(graph, list(network.body), whole, "body", "body_layer")
    decoder = graph.constant("decoder_weight", _numpy(network.decoder.weight.t()))
    view = graph.node("MatMul", "body", decoder, output="view")
    view = graph.node("Unsqueeze", view, shape("last_axis", 2), output="view_column")
    read = graph.node("MatMul", descriptions, view, output="read_by_description")
    read = graph.node("Add", read, linear(network.reflex, states, "reflex"), output="read_column")
    read = graph.node("Reshape", read, shape("actions_shape", 0, joints), output="read")
    by_place = graph.constant("decoder_by_place", _numpy((network.place @ network.place_decoder.weight).t()))
    graph.node("Add", read, graph.node("MatMul", "body", by_place, output="read_by_place"), output=target)


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
