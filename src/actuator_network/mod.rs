//! Learned actuators: a network file of a robot becomes a [`NetworkProgram`] that the physics
//! kernels evaluate.
//!
//! | file | what it holds |
//! |---|---|
//! | `onnx.rs` | the messages of an ONNX file |
//! | `compile.rs` | from a graph to instructions |

mod compile;
mod onnx;

use prost::Message;

use crate::dynamics::NetworkProgram;

/// Largest network file, bytes. Actuator networks have thousands of weights; these are a million.
pub(crate) const MAX_BYTES: u64 = 4 << 20;

/// Problem of a network file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct NetworkError {
    /// Place of the problem: a node, an input, a tensor.
    pub(crate) element: String,
    pub(crate) problem: String,
    pub(crate) remedy: String,
}

impl NetworkError {
    fn new(element: impl Into<String>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { element: element.into(), problem: problem.into(), remedy: remedy.into() }
    }
}

/// Whether a network has LSTM layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NetworkKind {
    Perceptron,
    Lstm,
}

/// Reads an ONNX file whose network takes `inputs` numbers of a joint and gives one.
///
/// # Errors
/// The file lacks something, or holds more than a program can.
pub(crate) fn read_onnx(bytes: &[u8], inputs: usize, kind: NetworkKind) -> Result<NetworkProgram, NetworkError> {
    let again = "pass the ONNX file of an actuator network; docs/actuator-networks.md shows how torch writes one";
    let model = onnx::Model::decode(bytes)
        .map_err(|_| NetworkError::new("file", "is no ONNX model, or a damaged one", again))?;
    let graph = model.graph.ok_or_else(|| NetworkError::new("graph", "is missing", again))?;
    compile::compile(&graph, inputs, kind)
}
