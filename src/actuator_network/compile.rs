//! Compiler from the graph of an ONNX file to the instructions of a [`NetworkProgram`].
//!
//! Every node is either understood, or its outputs are marked with the reason why not. Only the
//! nodes behind the network's first output must be understood: the simulator keeps the states that
//! an LSTM hands out and takes in.

use std::collections::{HashMap, HashSet};
use std::rc::Rc;

use super::onnx::{Graph, Node, Tensor, ValueInfo};
use super::{NetworkError, NetworkKind};
use crate::dynamics::{Function, Instruction, NetworkProgram, Operation, Span};

/// Largest number of features of a joint; each is computed in every lane.
const MAX_FEATURES: usize = 4096;
/// Largest number of nodes of a graph.
const MAX_NODES: usize = 1000;
/// Largest number of values that a network remembers of a joint: LSTMs of 256 units in four layers.
const MAX_MEMORY: usize = 2048;

/// ONNX's codes of single precision, double precision and 64-bit integers.
const FLOAT: i32 = 1;
const INT64: i32 = 7;
const DOUBLE: i32 = 11;

const OPERATORS: &str = "Gemm, MatMul, LSTM, Add, Sub, Mul, Div, Relu, LeakyRelu, Elu, Tanh, Sigmoid, Softsign, Abs, Neg, \
    Identity, Dropout, Cast, Flatten, Reshape, Squeeze, Unsqueeze, Transpose, Gather, Slice";

/// Value of a name in the graph.
#[derive(Clone)]
enum Value {
    /// Numbers that are the same for every joint, row-major.
    Floats(Rc<[f32]>, Vec<usize>),
    Ints(Rc<[i64]>),
    /// Features of a joint, the last axis of a tensor with this many axes.
    Features(Span, usize),
    /// Unknown value, and the reason.
    Unknown(NetworkError),
}

struct Compiler {
    instructions: Vec<Instruction>,
    features: usize,
    memory: usize,
    lstm_layers: usize,
    /// Number of times that each name of the graph is read.
    uses: HashMap<String, usize>,
    /// Features that go by several names, by their first number: no node overwrites them.
    shared: HashSet<usize>,
    /// Features that are `|x|` or `1 + |x|` of others, by their first number: softsign is written
    /// so.
    magnitudes: HashMap<usize, (Span, bool)>,
}

/// See [`read_onnx`](super::read_onnx).
pub(super) fn compile(graph: &Graph, inputs: usize, kind: NetworkKind) -> Result<NetworkProgram, NetworkError> {
    if graph.nodes.len() > MAX_NODES {
        let problem = format!("has {} nodes", graph.nodes.len());
        return Err(NetworkError::new("graph", problem, format!("simplify it: at most {MAX_NODES} are read")));
    }
    let mut values: HashMap<&str, Value> = HashMap::new();
    for tensor in &graph.initializers {
        values.insert(&tensor.name, constant(tensor));
    }
    let mut uses: HashMap<String, usize> = HashMap::new();
    let read = graph.nodes.iter().flat_map(|node| &node.inputs);
    for name in read.chain(graph.outputs.iter().map(|output| &output.name)) {
        *uses.entry(name.clone()).or_default() += 1;
    }
    let mut compiler = Compiler {
        instructions: Vec::new(),
        features: inputs,
        memory: 0,
        lstm_layers: 0,
        uses,
        shared: HashSet::new(),
        magnitudes: HashMap::new(),
    };
    let mut given = graph.inputs.iter().filter(|input| !graph.initializers.iter().any(|t| t.name == input.name));
    let input = given.next().ok_or_else(|| NetworkError::new("graph", "has no input", "export the network again"))?;
    values.insert(&input.name, Value::Features(Span { first: 0, len: inputs }, check_input(input, inputs)?));
    // hidden states follow the input
    for state in given {
        let problem = "is an input beside the first one, of which only an LSTM's states are known";
        let remedy = "give the network one input: position errors and velocities";
        values
            .insert(&state.name, Value::Unknown(NetworkError::new(format!("input `{}`", state.name), problem, remedy)));
    }
    for node in &graph.nodes {
        let given: Vec<Option<&Value>> = node.inputs.iter().map(|name| values.get(name.as_str())).collect();
        let found = compiler.node(node, &given).unwrap_or_else(|error| vec![Value::Unknown(error); node.outputs.len()]);
        for (name, value) in node.outputs.iter().zip(found).filter(|(name, _)| !name.is_empty()) {
            values.insert(name, value);
        }
    }
    let output = graph.outputs.first().map_or("", |output| output.name.as_str());
    let at = || format!("output `{output}`");
    let span = match values.get(output) {
        Some(Value::Features(span, _)) => *span,
        Some(Value::Unknown(error)) => return Err(error.clone()),
        _ => {
            let problem = "does not depend on the input";
            return Err(NetworkError::new(at(), problem, "export the network again"));
        }
    };
    if span.len != 1 {
        let problem = format!("gives {} numbers of a joint, not 1", span.len);
        return Err(NetworkError::new(at(), problem, "pass a network whose first output is the joint's torque"));
    }
    match (kind, compiler.lstm_layers) {
        (NetworkKind::Perceptron, 1..) => {
            let problem = "has LSTM layers";
            return Err(NetworkError::new("graph", problem, "set model = \"actuator_net_lstm\""));
        }
        (NetworkKind::Lstm, 0) => {
            let problem = "has no LSTM layer";
            return Err(NetworkError::new("graph", problem, "set model = \"actuator_net_mlp\""));
        }
        _ => {}
    }
    let Compiler { mut instructions, features, memory, .. } = compiler;
    leave_out_unread(&mut instructions, span);
    NetworkProgram::new(inputs, features, memory, span.first, instructions)
        .ok_or_else(|| NetworkError::new("graph", "cannot be put in order", "export the network again"))
}

/// Leaves out instructions whose results are never read. Cells have memory and stay.
fn leave_out_unread(instructions: &mut Vec<Instruction>, output: Span) {
    let mut read = vec![output];
    let mut kept = Vec::with_capacity(instructions.len());
    while let Some(instruction) = instructions.pop() {
        let (to, from): (Span, Vec<Span>) = match &instruction {
            Instruction::Constant { to, .. } | Instruction::Recall { to, .. } => (*to, Vec::new()),
            Instruction::Copy { from, to }
            | Instruction::Affine { from, to, .. }
            | Instruction::Map { from, to, .. }
            | Instruction::Cell { gates: from, to, .. } => (*to, vec![*from]),
            Instruction::Combine { a, b, to, .. } => (*to, vec![*a, *b]),
        };
        let overlaps = |span: &Span| span.first < to.first + to.len && to.first < span.first + span.len;
        if matches!(instruction, Instruction::Cell { .. }) || read.iter().any(overlaps) {
            read.extend(from);
            kept.push(instruction);
        }
    }
    kept.reverse();
    *instructions = kept;
}

/// The number of axes of the input, whose last one must have the size that the robot's config
/// gives.
fn check_input(input: &ValueInfo, inputs: usize) -> Result<usize, NetworkError> {
    let at = format!("input `{}`", input.name);
    let Some(dims) = input.dims() else { return Ok(2) };
    match dims.last() {
        Some(&last) if last == inputs as i64 || last <= 0 => Ok(dims.len()),
        last => {
            let problem = format!("takes {} numbers of a joint, and is given {inputs}", last.unwrap_or(&0));
            let remedy = "actuator_net_mlp gives a position error and a velocity for each entry of input_idx, \
                actuator_net_lstm one of each";
            Err(NetworkError::new(at, problem, remedy))
        }
    }
}

/// A tensor of the file.
fn constant(tensor: &Tensor) -> Value {
    let at = format!("tensor `{}`", tensor.name);
    let unknown = |problem: String, remedy: &str| Value::Unknown(NetworkError::new(at.clone(), problem, remedy));
    if tensor.location != 0 {
        let remedy = "write the weights into the file itself: onnx.save(model, file), or external_data=False";
        return unknown("has its numbers in another file".into(), remedy);
    }
    let mut dims = Vec::with_capacity(tensor.dims.len());
    for &dim in &tensor.dims {
        match usize::try_from(dim) {
            Ok(dim) => dims.push(dim),
            Err(_) => return unknown(format!("has a size of {dim}"), "export the network again"),
        }
    }
    let Some(size) = dims.iter().try_fold(1_usize, |size, &dim| size.checked_mul(dim)) else {
        return unknown("is larger than any memory".into(), "export the network again");
    };
    let raw = |width: usize| tensor.raw.chunks_exact(width);
    let floats: Vec<f32> = match tensor.data_type {
        FLOAT if tensor.raw.is_empty() => tensor.floats.clone(),
        FLOAT => raw(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap_or_default())).collect(),
        DOUBLE if tensor.raw.is_empty() => tensor.doubles.iter().map(|&x| x as f32).collect(),
        DOUBLE => raw(8).map(|bytes| f64::from_le_bytes(bytes.try_into().unwrap_or_default()) as f32).collect(),
        INT64 => {
            let ints: Vec<i64> = match tensor.raw.is_empty() {
                true => tensor.ints.clone(),
                false => raw(8).map(|bytes| i64::from_le_bytes(bytes.try_into().unwrap_or_default())).collect(),
            };
            return if ints.len() == size {
                Value::Ints(ints.into())
            } else {
                unknown(format!("has {} numbers for {size} places", ints.len()), "copy the file again")
            };
        }
        other => {
            let problem = format!("has numbers of ONNX's type {other}, not in single or double precision");
            return unknown(problem, "export the network in float32");
        }
    };
    if floats.len() != size {
        return unknown(format!("has {} numbers for {size} places", floats.len()), "copy the file again");
    }
    if let Some(place) = floats.iter().position(|x| !x.is_finite()) {
        return unknown(format!("has {} at place {place}", floats[place]), "train the network again without NaN");
    }
    Value::Floats(floats.into(), dims)
}

impl Compiler {
    fn new_features(&mut self, len: usize, node: &Node) -> Result<Span, NetworkError> {
        let first = self.features;
        self.features = first.saturating_add(len);
        if self.features > MAX_FEATURES {
            let problem = format!("needs more than {MAX_FEATURES} numbers of a joint in all");
            return Err(NetworkError::new(node.title(), problem, "use a smaller network: 3 layers of 32 are common"));
        }
        Ok(Span { first, len })
    }

    fn remember(&mut self, len: usize, node: &Node) -> Result<usize, NetworkError> {
        let first = self.memory;
        self.memory = first.saturating_add(len);
        if self.memory > MAX_MEMORY {
            let problem = format!("remembers more than {MAX_MEMORY} numbers of a joint in all");
            return Err(NetworkError::new(node.title(), problem, "use a smaller network"));
        }
        Ok(first)
    }

    /// Outputs of a node.
    fn node(&mut self, node: &Node, given: &[Option<&Value>]) -> Result<Vec<Value>, NetworkError> {
        let failed = |problem: String, remedy: &str| NetworkError::new(node.title(), problem, remedy);
        if !node.domain.is_empty() && node.domain != "ai.onnx" {
            return Err(failed(format!("is of the domain {}", node.domain), "export with ONNX's own operators"));
        }
        let input = |i: usize| match given.get(i).copied().flatten() {
            Some(Value::Unknown(error)) => Err(error.clone()),
            Some(value) => Ok(value.clone()),
            None => Err(failed(format!("lacks input {i}"), "export the network again")),
        };
        let function = match node.operator.as_str() {
            "Relu" => Some(Function::Relu),
            "LeakyRelu" => Some(Function::LeakyRelu(node.float("alpha", 0.01))),
            "Elu" => Some(Function::Elu(node.float("alpha", 1.0))),
            "Tanh" => Some(Function::Tanh),
            "Sigmoid" => Some(Function::Sigmoid),
            "Softsign" => Some(Function::Softsign),
            "Abs" => Some(Function::Abs),
            "Neg" => Some(Function::Neg),
            _ => None,
        };
        if let Some(function) = function {
            let (from, axes) = features(node, &input(0)?)?;
            let is_read_once = node.inputs.first().is_some_and(|name| self.uses.get(name) == Some(&1));
            let in_place = is_read_once && !self.shared.contains(&from.first) && from.first > 0;
            let to = if in_place { from } else { self.new_features(from.len, node)? };
            self.instructions.push(Instruction::Map { function, from, to });
            if function == Function::Abs {
                self.magnitudes.insert(to.first, (from, false));
            }
            return Ok(vec![Value::Features(to, axes)]);
        }
        let moves = [
            "Identity",
            "Dropout",
            "Cast",
            "Transpose",
            "Flatten",
            "Reshape",
            "Squeeze",
            "Unsqueeze",
            "Gather",
            "Slice",
        ];
        if moves.contains(&node.operator.as_str())
            && let Ok(Value::Features(span, _)) = input(0)
            && node.inputs.first().is_some_and(|name| self.uses.get(name) != Some(&1))
        {
            self.shared.insert(span.first);
        }
        let value = match node.operator.as_str() {
            "Constant" => match node.attribute("value").and_then(|attribute| attribute.tensor.as_ref()) {
                Some(tensor) => constant(tensor),
                None => match node.attributes.first() {
                    Some(a) if a.name == "value_float" => Value::Floats([a.float].into(), Vec::new()),
                    Some(a) if a.name == "value_int" => Value::Ints([a.int].into()),
                    Some(a) if a.name == "value_ints" => Value::Ints(a.ints.clone().into()),
                    _ => return Err(failed("has no numbers".into(), "export the network again")),
                },
            },
            "Gemm" => self.gemm(node, &input(0)?, &input(1)?, given.get(2).copied().flatten())?,
            "MatMul" => {
                let ((from, axes), (weights, sizes)) = (features(node, &input(0)?)?, matrix(node, &input(1)?)?);
                let bias = vec![0.0; sizes[1]];
                self.affine(node, from, axes, &|i, o| weights[i * sizes[1] + o], sizes, &bias)?
            }
            "Add" => self.combine(node, Operation::Add, &input(0)?, &input(1)?)?,
            "Sub" => self.combine(node, Operation::Sub, &input(0)?, &input(1)?)?,
            "Mul" => self.combine(node, Operation::Mul, &input(0)?, &input(1)?)?,
            "Div" => self.combine(node, Operation::Div, &input(0)?, &input(1)?)?,
            "LSTM" => return self.lstm(node, &input(0)?, &input(1)?, &input(2)?, given.get(3).copied().flatten()),
            "Identity" | "Dropout" | "Cast" => input(0)?,
            "Transpose" | "Flatten" | "Reshape" | "Squeeze" | "Unsqueeze" | "Gather" | "Slice" => {
                reshape(node, &input(0)?, &input)?
            }
            _ => {
                let problem = "is an operator that actuator networks do not have here".into();
                return Err(failed(problem, &format!("build the network of {OPERATORS}")));
            }
        };
        Ok(vec![value])
    }

    fn gemm(&mut self, node: &Node, a: &Value, b: &Value, c: Option<&Value>) -> Result<Value, NetworkError> {
        let failed = |problem: &str| NetworkError::new(node.title(), problem, "export the network again");
        if node.int("transA", 0) != 0 {
            return Err(failed("transposes its input"));
        }
        let ((from, axes), (weights, [rows, columns])) = (features(node, a)?, matrix(node, b)?);
        let (alpha, beta) = (node.float("alpha", 1.0), node.float("beta", 1.0));
        let turned = node.int("transB", 0) != 0;
        let sizes = if turned { [columns, rows] } else { [rows, columns] };
        let bias = match c {
            None => vec![0.0; sizes[1]],
            Some(Value::Unknown(error)) => return Err(error.clone()),
            Some(Value::Floats(bias, _)) if bias.len() == sizes[1] => bias.iter().map(|x| beta * x).collect(),
            Some(Value::Floats(bias, _)) if bias.len() == 1 => vec![beta * bias[0]; sizes[1]],
            Some(_) => return Err(failed("has a bias of another size than its weights")),
        };
        let weight = |i: usize, o: usize| alpha * weights[if turned { o * columns + i } else { i * columns + o }];
        self.affine(node, from, axes, &weight, sizes, &bias)
    }

    /// A layer of `[inputs, outputs]` weights.
    fn affine(
        &mut self,
        node: &Node,
        from: Span,
        axes: usize,
        weight: &dyn Fn(usize, usize) -> f32,
        [inputs, outputs]: [usize; 2],
        bias: &[f32],
    ) -> Result<Value, NetworkError> {
        if inputs != from.len {
            let problem = format!("has weights for {inputs} numbers, and is given {}", from.len);
            let remedy = "actuator_net_mlp gives a position error and a velocity for each entry of input_idx, \
                actuator_net_lstm one of each; set input_idx as the network was trained";
            return Err(NetworkError::new(node.title(), problem, remedy));
        }
        if outputs == 0 {
            return Err(NetworkError::new(node.title(), "gives no number", "export the network again"));
        }
        let to = self.new_features(outputs, node)?;
        let mut weights = Vec::with_capacity((inputs + 1) * outputs);
        for i in 0..inputs {
            weights.extend((0..outputs).map(|o| weight(i, o)));
        }
        weights.extend_from_slice(bias);
        self.instructions.push(Instruction::Affine { from, to, weights });
        Ok(Value::Features(to, axes))
    }

    fn combine(&mut self, node: &Node, operation: Operation, a: &Value, b: &Value) -> Result<Value, NetworkError> {
        let failed = |problem: String| NetworkError::new(node.title(), problem, "export the network again");
        let len = |value: &Value| match value {
            Value::Features(span, _) => span.len,
            Value::Floats(values, _) => values.len(),
            _ => 0,
        };
        let width = len(a).max(len(b));
        // softsign as torch spells it out: x / (1 + |x|)
        if let (Operation::Div, Value::Features(x, axes), Value::Features(y, _)) = (operation, a, b)
            && self.magnitudes.get(&y.first) == Some(&(*x, true))
        {
            let to = self.new_features(width, node)?;
            self.instructions.push(Instruction::Map { function: Function::Softsign, from: *x, to });
            return Ok(Value::Features(to, *axes));
        }
        let axes = match (a, b) {
            (Value::Features(_, axes), Value::Features(_, other)) => *axes.max(other),
            (Value::Features(_, axes), _) | (_, Value::Features(_, axes)) => *axes,
            _ => return Err(failed("computes with constants alone".into())),
        };
        let mut spans = [Span { first: 0, len: 0 }; 2];
        for (span, value) in spans.iter_mut().zip([a, b]) {
            *span = match value {
                Value::Features(span, _) if span.len == width => *span,
                Value::Features(span, _) if span.len == 1 => {
                    let to = self.new_features(width, node)?;
                    self.instructions.push(Instruction::Copy { from: *span, to });
                    to
                }
                // constants over rows alone: other axes are of size one
                Value::Floats(values, dims)
                    if (values.len() == width || values.len() == 1) && dims.iter().rev().skip(1).all(|&d| d == 1) =>
                {
                    let to = self.new_features(width, node)?;
                    let values = (0..width).map(|i| values[i % values.len()]).collect();
                    self.instructions.push(Instruction::Constant { values, to });
                    to
                }
                _ => return Err(failed(format!("has arguments of {} and {} numbers", len(a), len(b)))),
            };
        }
        let to = self.new_features(width, node)?;
        let is_one = |value: &Value| matches!(value, Value::Floats(values, _) if values.iter().all(|&x| x == 1.0));
        if operation == Operation::Add {
            for (span, other) in [(spans[0], b), (spans[1], a)] {
                if let Some(&(of, false)) = self.magnitudes.get(&span.first).filter(|_| is_one(other)) {
                    self.magnitudes.insert(to.first, (of, true));
                }
            }
        }
        self.instructions.push(Instruction::Combine { operation, a: spans[0], b: spans[1], to });
        Ok(Value::Features(to, axes))
    }

    /// A layer of an LSTM, whose states begin at zero and are kept by the simulator. Gates are in
    /// ONNX's order: input, output, forget, candidate.
    fn lstm(
        &mut self,
        node: &Node,
        x: &Value,
        w: &Value,
        r: &Value,
        bias: Option<&Value>,
    ) -> Result<Vec<Value>, NetworkError> {
        let failed = |problem: &str, remedy: &str| NetworkError::new(node.title(), problem, remedy);
        let plain = "use torch.nn.LSTM as it is: forward, without projections";
        let is_default = |name: &str, default: &str| match node.attribute(name) {
            Some(a) => a.string == default.as_bytes() || (a.string.is_empty() && a.strings.is_empty()),
            None => true,
        };
        let activations = node.attribute("activations").map_or(&[][..], |a| &a.strings);
        let standard: [&[u8]; 3] = [b"Sigmoid", b"Tanh", b"Tanh"];
        if !is_default("direction", "forward")
            || node.attribute("clip").is_some()
            || node.int("input_forget", 0) != 0
            || !(activations.is_empty() || activations.iter().eq(standard))
            || node.inputs.get(7).is_some_and(|name| !name.is_empty())
        {
            return Err(failed("is another cell than torch's", plain));
        }
        let (from, _) = features(node, x)?;
        let (Value::Floats(w, w_dims), Value::Floats(r, r_dims)) = (w, r) else {
            return Err(failed("has weights that are no constants", "export the network again"));
        };
        let (&[1, gates, inputs], &[1, same_gates, hidden]) = (&w_dims[..], &r_dims[..]) else {
            return Err(failed("has weights of another shape than [1, 4 hidden, inputs]", plain));
        };
        if inputs != from.len || gates != 4 * hidden || same_gates != gates || hidden == 0 {
            return Err(failed("has weights of sizes that do not fit together", "export the network again"));
        }
        let bias = match bias {
            None => vec![0.0; gates],
            Some(Value::Unknown(error)) => return Err(error.clone()),
            Some(Value::Floats(bias, _)) if bias.len() == 2 * gates => {
                (0..gates).map(|g| bias[g] + bias[gates + g]).collect()
            }
            Some(_) => return Err(failed("has a bias of another size than its weights", "export the network again")),
        };
        let (h, c) = (self.remember(hidden, node)?, self.remember(hidden, node)?);
        let both = self.new_features(inputs + hidden, node)?;
        let recalled = Span { first: both.first + inputs, len: hidden };
        self.instructions.push(Instruction::Copy { from, to: Span { len: inputs, ..both } });
        self.instructions.push(Instruction::Recall { memory: h, to: recalled });
        let weight = |i: usize, o: usize| if i < inputs { w[o * inputs + i] } else { r[o * hidden + i - inputs] };
        let Value::Features(of_gates, _) = self.affine(node, both, 2, &weight, [inputs + hidden, gates], &bias)? else {
            return Err(failed("has no gates", plain));
        };
        let to = self.new_features(hidden, node)?;
        self.instructions.push(Instruction::Cell { gates: of_gates, hidden: h, cell: c, to });
        self.lstm_layers += 1;
        // two names of the same numbers
        self.shared.insert(to.first);
        let states = failed("gives a cell state, which is no torque", "let the torque follow from the layer's output");
        // the sequence has one step: the output of all steps, then that of the last
        Ok(vec![Value::Features(to, 4), Value::Features(to, 3), Value::Unknown(states)])
    }
}

/// Features, or an error that says so.
fn features(node: &Node, value: &Value) -> Result<(Span, usize), NetworkError> {
    match value {
        Value::Features(span, axes) => Ok((*span, *axes)),
        _ => Err(NetworkError::new(node.title(), "computes with constants alone", "export the network again")),
    }
}

/// Weights `[rows, columns]`.
fn matrix(node: &Node, value: &Value) -> Result<(Rc<[f32]>, [usize; 2]), NetworkError> {
    match value {
        Value::Floats(values, dims) if dims.len() == 2 && dims[1] > 0 => Ok((values.clone(), [dims[0], dims[1]])),
        _ => {
            Err(NetworkError::new(node.title(), "has weights that are no constant matrix", "export the network again"))
        }
    }
}

/// Operators that move numbers and compute nothing. A joint's features must stay the last axis.
fn reshape(
    node: &Node,
    value: &Value,
    input: &dyn Fn(usize) -> Result<Value, NetworkError>,
) -> Result<Value, NetworkError> {
    let failed = |problem: String| {
        NetworkError::new(node.title(), problem, "let each row of the network's input be one joint's numbers")
    };
    let (span, axes) = match value {
        Value::Features(span, axes) => (*span, *axes),
        // weights are transposed by some exporters
        Value::Floats(values, dims) if node.operator == "Transpose" && dims.len() == 2 => {
            let (rows, columns) = (dims[0], dims[1]);
            let turned = (0..values.len()).map(|i| values[i % rows * columns + i / rows]);
            return Ok(Value::Floats(turned.collect(), vec![columns, rows]));
        }
        constant => return Ok(constant.clone()),
    };
    let ints_of = |i: usize| match input(i) {
        Ok(Value::Ints(ints)) => Some(ints),
        _ => None,
    };
    let ints = || ints_of(1);
    let of_attribute = |name: &str| node.attribute(name).map(|a| Rc::from(a.ints.clone()));
    let negative = |axis: i64, axes: usize| if axis < 0 { axis + axes as i64 } else { axis };
    let axes = match node.operator.as_str() {
        "Transpose" => {
            let perm: Option<Rc<[i64]>> = of_attribute("perm");
            if perm.is_none_or(|perm| perm.last() != Some(&(perm.len() as i64 - 1))) {
                return Err(failed("moves the last axis".into()));
            }
            axes
        }
        "Flatten" if negative(node.int("axis", 1), axes) == axes as i64 - 1 => 2,
        "Flatten" => return Err(failed("puts several axes together".into())),
        "Reshape" => match ints() {
            Some(shape) => match shape.last() {
                Some(&last) if last == span.len as i64 || last == -1 => shape.len(),
                _ => return Err(failed("splits or joins the last axis".into())),
            },
            None => axes,
        },
        "Squeeze" | "Unsqueeze" => {
            let moved = of_attribute("axes").or_else(ints).ok_or_else(|| failed("does not say which axes".into()))?;
            let count = moved.len();
            if node.operator == "Squeeze" {
                let hits = moved.iter().any(|&axis| negative(axis, axes) == axes as i64 - 1);
                if hits && span.len != 1 {
                    return Err(failed("removes the last axis".into()));
                }
                axes.saturating_sub(count).max(1)
            } else {
                let after = axes + count;
                let hits = moved.iter().any(|&axis| negative(axis, after) == after as i64 - 1);
                if hits && span.len != 1 {
                    return Err(failed("adds a last axis".into()));
                }
                after
            }
        }
        // a sequence has one step; all rows are taken
        "Slice" => {
            let moved = ints_of(3).ok_or_else(|| failed("does not say which axes".into()))?;
            if moved.iter().any(|&axis| negative(axis, axes) >= axes as i64 - 1) {
                return Err(failed("picks some of a joint's numbers".into()));
            }
            axes
        }
        _ => {
            if negative(node.int("axis", 0), axes) >= axes as i64 - 1 {
                return Err(failed("picks some of a joint's numbers".into()));
            }
            axes - 1
        }
    };
    Ok(Value::Features(span, axes))
}
