//! Robots whose joints actuator networks drive, with network files that are written here.

use std::fs;
use std::path::Path;
use std::sync::OnceLock;

use polypod::SimOptions;
use prost::Message;

use super::{busy, noise};

/// Gains that the networks imitate, so that robots stand: N m/rad and N m s/rad.
const GAINS: [f32; 2] = [30.0, 0.6];
/// Robots by the networks of their joints: perceptrons that look back, LSTMs, both next to gains.
pub const DRIVEN: [&str; 3] = ["remembering_dog", "recurrent_dog", "mixed_dog"];

#[derive(Clone, PartialEq, Message)]
struct Model {
    #[prost(message, optional, tag = "7")]
    graph: Option<Graph>,
}

#[derive(Clone, PartialEq, Message)]
struct Graph {
    #[prost(message, repeated, tag = "1")]
    nodes: Vec<Node>,
    #[prost(message, repeated, tag = "5")]
    initializers: Vec<Tensor>,
    #[prost(message, repeated, tag = "11")]
    inputs: Vec<Named>,
    #[prost(message, repeated, tag = "12")]
    outputs: Vec<Named>,
}

#[derive(Clone, PartialEq, Message)]
struct Node {
    #[prost(string, repeated, tag = "1")]
    inputs: Vec<String>,
    #[prost(string, repeated, tag = "2")]
    outputs: Vec<String>,
    #[prost(string, tag = "4")]
    operator: String,
}

#[derive(Clone, PartialEq, Message)]
struct Tensor {
    #[prost(int64, repeated, tag = "1")]
    dims: Vec<i64>,
    #[prost(int32, tag = "2")]
    data_type: i32,
    #[prost(float, repeated, tag = "4")]
    floats: Vec<f32>,
    #[prost(string, tag = "8")]
    name: String,
}

#[derive(Clone, PartialEq, Message)]
struct Named {
    #[prost(string, tag = "1")]
    name: String,
}

impl Graph {
    /// A graph with the input `x`.
    fn new() -> Self {
        Self { inputs: vec![Named { name: "x".into() }], ..Self::default() }
    }

    fn node(&mut self, operator: &str, inputs: &[&str]) -> String {
        let output = format!("n{}", self.nodes.len());
        let inputs = inputs.iter().map(|name| (*name).to_owned()).collect();
        self.nodes.push(Node { inputs, outputs: vec![output.clone()], operator: operator.to_owned() });
        output
    }

    fn tensor(&mut self, dims: &[usize], floats: Vec<f32>) -> String {
        let name = format!("w{}", self.initializers.len());
        let dims = dims.iter().map(|&dim| dim as i64).collect();
        self.initializers.push(Tensor { dims, data_type: 1, floats, name: name.clone() });
        name
    }

    fn random(&mut self, dims: &[usize], size: f32) -> String {
        let stream = self.initializers.len() as u64;
        let floats = (0..dims.iter().product()).map(|i| size * noise(stream, dims.len(), i, dims[0])).collect();
        self.tensor(dims, floats)
    }

    fn layer(&mut self, x: &str, [inputs, outputs]: [usize; 2], size: f32) -> String {
        let weights = self.random(&[inputs, outputs], size);
        let bias = self.random(&[outputs], size);
        self.node("Gemm", &[x, &weights, &bias])
    }

    fn lstm(&mut self, x: &str, inputs: usize, units: usize) -> String {
        let weights = self.random(&[1, 4 * units, inputs], 0.6);
        let recurrent = self.random(&[1, 4 * units, units], 0.6);
        let bias = self.random(&[1, 8 * units], 0.3);
        self.node("LSTM", &[x, &weights, &recurrent, &bias])
    }

    /// The file of the network whose result, a torque, comes on top of that of the gains.
    fn file(mut self, inputs: usize, torque: &str) -> Vec<u8> {
        let mut law = vec![0.0; inputs];
        (law[0], law[inputs / 2]) = (GAINS[0], -GAINS[1]);
        let law = self.tensor(&[inputs, 1], law);
        let law = self.node("MatMul", &["x", &law]);
        let name = self.node("Add", &[&law, torque]);
        self.outputs = vec![Named { name }];
        Model { graph: Some(self) }.encode_to_vec()
    }
}

/// A perceptron of layers of that many units, with one function after the other.
fn perceptron(inputs: usize, layers: &[(usize, &str)]) -> Vec<u8> {
    let (mut graph, mut x, mut width) = (Graph::new(), "x".to_owned(), inputs);
    for &(units, function) in layers {
        let y = graph.layer(&x, [width, units], 0.5);
        (x, width) = (graph.node(function, &[&y]), units);
    }
    let torque = graph.layer(&x, [width, 1], 0.5);
    graph.file(inputs, &torque)
}

/// LSTM layers of that many units.
fn recurrent(layers: &[usize]) -> Vec<u8> {
    let (mut graph, mut x, mut width) = (Graph::new(), "x".to_owned(), 2);
    for &units in layers {
        (x, width) = (graph.lstm(&x, width, units), units);
    }
    let torque = graph.layer(&x, [width, 1], 2.0);
    graph.file(2, &torque)
}

/// A group of actuators that a network drives, by name, joints and file.
fn group(name: &str, joints: &str, file: &str, ages: Option<&[u32]>) -> String {
    let limits = "saturation_effort = 40.0\nvelocity_limit = 25.0\neffort_limit = 35.0";
    let model = match ages {
        None => "model = \"actuator_net_lstm\"".to_owned(),
        Some(ages) => format!(
            "model = \"actuator_net_mlp\"\ninput_order = \"pos_vel\"\ninput_idx = {ages:?}\npos_scale = 1.0\n\
             vel_scale = 1.0\ntorque_scale = 1.0"
        ),
    };
    format!("[actuators.{name}]\njoints = [\"{joints}\"]\nnetwork_file = \"{file}\"\n{model}\n{limits}\n")
}

/// Writes the robots of [`DRIVEN`] to a folder.
fn write(root: &Path) {
    let folder = root.join("configs/robots");
    fs::create_dir_all(&folder).unwrap();
    let files = [
        ("remembering", perceptron(6, &[(32, "Softsign"), (13, "Tanh"), (8, "Elu")])),
        ("recurrent", recurrent(&[8, 5])),
        ("leaky", perceptron(4, &[(9, "LeakyRelu"), (3, "Sigmoid"), (17, "Relu")])),
        ("small", recurrent(&[3])),
    ];
    for (name, file) in files {
        fs::write(folder.join(format!("{name}.onnx")), file).unwrap();
    }
    let robots = [
        ("unitree_a1", group("legs", "*", "remembering.onnx", Some(&[0, 1, 4]))),
        ("anymal_c", group("legs", "*", "recurrent.onnx", None)),
        (
            "unitree_go2",
            [
                "[actuators.legs]\njoints = [\"*_HAA\"]\n".to_owned(),
                group("thighs", "*_HFE", "leaky.onnx", Some(&[0, 2])),
                group("knees", "*_KFE", "small.onnx", None),
            ]
            .concat(),
        ),
    ];
    for (name, (base, groups)) in DRIVEN.iter().zip(robots) {
        let head = format!("extends = \"{base}\"\nname = \"{name}\"\ntitle = \"{name}\"\n");
        fs::write(folder.join(format!("{name}.toml")), head + &groups).unwrap();
    }
}

/// The flat task of [`busy`] with the robots of [`DRIVEN`], and one without networks.
pub fn driven(num_envs: usize) -> SimOptions {
    static WRITTEN: OnceLock<()> = OnceLock::new();
    let root = std::env::temp_dir().join(format!("polypod-driven-{}", std::process::id()));
    WRITTEN.get_or_init(|| write(&root));
    SimOptions { roots: vec![root], ..busy(&[&DRIVEN[..], &["spot"]].concat(), num_envs) }
}
