//! Actuator networks as lists of the tables: what `device/networks.h` reads.

use polypod_dynamics::{ActuatorNetwork, Function, Instruction, Operation};

use crate::layout::*;
use crate::tables::Lists;

/// Numbers that a load of the device reads at a time: weights begin at a multiple of them.
const ALIGNMENT: usize = 4;

/// Numbers of scratch memory that a tile has for the features of networks: those of the largest
/// one, for all threads of a warp.
pub(crate) fn num_features(networks: &[ActuatorNetwork]) -> usize {
    let most = networks.iter().map(|network| network.program().num_features()).max().unwrap_or(0);
    TOGETHER * WARP * most
}

/// Writes networks to the tables.
pub(crate) fn write_networks(networks: &[ActuatorNetwork], header: &mut [usize], lists: &mut Lists) {
    let (mut entries, mut memory) = (Vec::new(), 0);
    for network in networks {
        let (program, joints) = (network.program(), lists.here());
        lists.integers.extend(network.joints());
        let inputs = lists.here();
        lists.integers.extend(network.inputs().iter().flat_map(|of| [usize::from(of.is_velocity), of.age]));
        let numbers = lists.numbers.len();
        lists.numbers.push(network.effort_scale());
        lists.numbers.extend(network.inputs().iter().map(|input| input.scale));
        let instructions: Vec<_> = program.instructions().iter().map(|of| entry(of, &mut lists.numbers)).collect();
        entries.extend([network.joints().len(), joints, network.past(), memory, program.num_inputs(), inputs]);
        entries.extend([instructions.len(), lists.here(), program.output(), numbers]);
        lists.integers.extend(instructions.as_flattened());
        memory += network.num_remembered();
    }
    header[NETWORKS] = networks.len();
    header[T_NETWORK] = lists.here();
    lists.integers.extend(entries);
}

/// The entry of an instruction, whose numbers go to the table.
fn entry(instruction: &Instruction, numbers: &mut Vec<f32>) -> [usize; INSTRUCTION_SIZE] {
    let at = numbers.len();
    match instruction {
        Instruction::Constant { values, to } => {
            numbers.extend(values);
            [NETWORK_CONSTANT, 0, to.first, to.len, 0, 0, at]
        }
        Instruction::Copy { from, to } => {
            [NETWORK_COPY, from.first, to.first, to.len, usize::from(from.len == to.len), 0, 0]
        }
        Instruction::Affine { from, to, weights } => {
            let at = write_weights(weights, from.len, to.len, numbers);
            [NETWORK_AFFINE, from.first, to.first, to.len, from.len, 0, at]
        }
        Instruction::Map { function, from, to } => {
            let name = match function {
                Function::Relu => NETWORK_RELU,
                Function::LeakyRelu(slope) => {
                    numbers.push(*slope);
                    NETWORK_LEAKY_RELU
                }
                Function::Elu(scale) => {
                    numbers.push(*scale);
                    NETWORK_ELU
                }
                Function::Tanh => NETWORK_TANH,
                Function::Sigmoid => NETWORK_SIGMOID,
                Function::Softsign => NETWORK_SOFTSIGN,
                Function::Abs => NETWORK_ABS,
                Function::Neg => NETWORK_NEG,
            };
            [name, from.first, to.first, to.len, 0, 0, at]
        }
        Instruction::Combine { operation, a, b, to } => {
            let name = match operation {
                Operation::Add => NETWORK_ADD,
                Operation::Sub => NETWORK_SUB,
                Operation::Mul => NETWORK_MUL,
                Operation::Div => NETWORK_DIV,
            };
            [name, a.first, to.first, to.len, 0, b.first, 0]
        }
        Instruction::Recall { memory, to } => [NETWORK_RECALL, 0, to.first, to.len, *memory, 0, 0],
        Instruction::Cell { gates, hidden, cell, to } => {
            [NETWORK_CELL, gates.first, to.first, to.len, *hidden, *cell, 0]
        }
    }
}

/// Writes the weights of a layer, row-major `[inputs + 1, outputs]` with the bias last: for
/// [`OUTPUTS`] outputs at a time the bias, then a row of each input; zeros in the place of outputs
/// that there are not. Returns where they begin.
fn write_weights(weights: &[f32], inputs: usize, outputs: usize, numbers: &mut Vec<f32>) -> usize {
    numbers.resize(numbers.len().next_multiple_of(ALIGNMENT), 0.0);
    let at = numbers.len();
    for first in (0..outputs).step_by(OUTPUTS) {
        for input in std::iter::once(inputs).chain(0..inputs) {
            let row = &weights[input * outputs..(input + 1) * outputs];
            numbers.extend((first..first + OUTPUTS).map(|output| row.get(output).copied().unwrap_or(0.0)));
        }
    }
    at
}
