//! Actuator networks: efforts from the joints' position errors and velocities, evaluated for the
//! robots of a pack side by side.
//!
//! A [`NetworkProgram`] is a list of instructions over features. Every feature is a number per
//! joint of the network and per lane. All sums run in the order of the inputs, one fused
//! multiply-add after the other, so the bits depend on nothing but a robot's own numbers.

use super::articulation::Topology;
use super::elementary::{exp, tanh_positive};
use super::kernels::Kernels;
use super::lanes::{Kernel, Lanes, Real};
use super::settings::StepSettings;
use super::state::{Drive, State, Workspace};

use super::actuators::select_targets;

/// Some features in a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Span {
    /// Index of the first value.
    pub first: usize,
    /// Number of values.
    pub len: usize,
}

impl Span {
    fn end(self) -> Option<usize> {
        self.first.checked_add(self.len)
    }
}

/// A function of one number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Function {
    /// `max(x, 0)`.
    Relu,
    /// `x` above zero, else this times `x`.
    LeakyRelu(f32),
    /// `x` above zero, else this times `e^x - 1`.
    Elu(f32),
    /// Hyperbolic tangent.
    Tanh,
    /// `1 / (1 + e^-x)`.
    Sigmoid,
    /// `x / (1 + |x|)`.
    Softsign,
    /// `|x|`.
    Abs,
    /// `-x`.
    Neg,
}

/// A function of two numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operation {
    /// Sum.
    Add,
    /// Difference.
    Sub,
    /// Product.
    Mul,
    /// Quotient.
    Div,
}

/// A step of a [`NetworkProgram`]. It overwrites its outputs.
#[derive(Clone, Debug, PartialEq)]
pub enum Instruction {
    /// Writes the same numbers for every joint.
    Constant {
        /// `[to]`.
        values: Vec<f32>,
        /// Features that are written.
        to: Span,
    },
    /// Copies features, of which a single one fills all of `to`.
    Copy {
        /// Features that are copied.
        from: Span,
        /// Features that are written.
        to: Span,
    },
    /// `to = weights from + bias`.
    Affine {
        /// Inputs.
        from: Span,
        /// Outputs.
        to: Span,
        /// Row-major `[inputs + 1, outputs]`; the last row is the bias.
        weights: Vec<f32>,
    },
    /// A function of every feature.
    Map {
        /// Function of one number.
        function: Function,
        /// Inputs.
        from: Span,
        /// Outputs, of the same number.
        to: Span,
    },
    /// A function of every pair of features.
    Combine {
        /// Operation on two numbers.
        operation: Operation,
        /// First argument.
        a: Span,
        /// Second argument.
        b: Span,
        /// Outputs, of the same number.
        to: Span,
    },
    /// Reads what the network remembers.
    Recall {
        /// The first number among those that are remembered for a joint.
        memory: usize,
        /// Features that are written.
        to: Span,
    },
    /// The cell of an LSTM: `c' = forget c + input candidate` and `h' = output tanh(c')`.
    Cell {
        /// Input, output, forget gate and candidate before their activations, `[4 * to]`.
        gates: Span,
        /// Place of `h` in the memory.
        hidden: usize,
        /// Place of `c` in the memory.
        cell: usize,
        /// `h'`.
        to: Span,
    },
}

/// Computation of a network for a joint, from its inputs to one output.
#[derive(Clone, Debug, PartialEq)]
pub struct NetworkProgram {
    inputs: usize,
    features: usize,
    memory: usize,
    output: usize,
    instructions: Vec<Instruction>,
}

impl NetworkProgram {
    /// A program that begins with its `inputs` in the first ones of `features`, remembers `memory`
    /// numbers of each joint from one physics step to the next, and leaves its result in feature
    /// `output`. None where an instruction reaches beyond these.
    pub fn new(
        inputs: usize,
        features: usize,
        memory: usize,
        output: usize,
        instructions: Vec<Instruction>,
    ) -> Option<Self> {
        let has = |span: &Span| span.end().is_some_and(|end| end <= features);
        let holds = |from: usize, len: usize| from.checked_add(len).is_some_and(|end| end <= memory);
        let fits = |instruction: &Instruction| match instruction {
            Instruction::Constant { values, to } => has(to) && values.len() == to.len,
            Instruction::Copy { from, to } => has(from) && has(to) && (from.len == to.len || from.len == 1),
            Instruction::Affine { from, to, weights } => {
                has(from) && has(to) && from.end() <= Some(to.first) && weights.len() == (from.len + 1) * to.len
            }
            Instruction::Map { from, to, .. } => has(from) && has(to) && from.len == to.len,
            Instruction::Combine { a, b, to, .. } => has(a) && has(b) && has(to) && a.len == to.len && b.len == to.len,
            Instruction::Recall { memory, to } => has(to) && holds(*memory, to.len),
            Instruction::Cell { gates, hidden, cell, to } => {
                has(gates) && has(to) && gates.len == 4 * to.len && holds(*hidden, to.len) && holds(*cell, to.len)
            }
        };
        let fits = inputs <= features && output < features && instructions.iter().all(fits);
        fits.then_some(Self { inputs, features, memory, output, instructions })
    }

    /// Number of inputs.
    pub fn num_inputs(&self) -> usize {
        self.inputs
    }

    /// Number of features of a joint, the inputs included.
    pub fn num_features(&self) -> usize {
        self.features
    }

    /// The feature that is the result.
    pub fn output(&self) -> usize {
        self.output
    }

    /// Its steps, in their order.
    pub fn instructions(&self) -> &[Instruction] {
        &self.instructions
    }
}

/// One input of a network.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NetworkInput {
    /// Whether it is the joint's velocity, rad/s; else it is target less position, rad.
    pub is_velocity: bool,
    /// Age of the number, physics steps.
    pub age: usize,
    /// Factor on the input.
    pub scale: f32,
}

impl std::fmt::Display for NetworkInput {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}[{}]", if self.is_velocity { "vel" } else { "pos_error" }, self.age)
    }
}

/// A network, and the joints that it drives, one by one.
#[derive(Clone, Debug, PartialEq)]
pub struct ActuatorNetwork {
    joints: Vec<usize>,
    inputs: Vec<NetworkInput>,
    effort_scale: f32,
    /// Physics steps that are looked back.
    past: usize,
    program: NetworkProgram,
}

impl ActuatorNetwork {
    /// A network for some joints. Its output times `effort_scale` is the effort, N m. None without
    /// joints, and where the program takes another number of inputs.
    pub fn new(
        joints: Vec<usize>,
        inputs: Vec<NetworkInput>,
        effort_scale: f32,
        program: NetworkProgram,
    ) -> Option<Self> {
        let past = inputs.iter().map(|input| input.age).max().unwrap_or(0);
        (inputs.len() == program.inputs && !joints.is_empty()).then_some(Self {
            joints,
            inputs,
            effort_scale,
            past,
            program,
        })
    }

    /// The joints that it drives, physical order.
    pub fn joints(&self) -> &[usize] {
        &self.joints
    }

    /// Inputs of its program, for each joint.
    pub fn inputs(&self) -> &[NetworkInput] {
        &self.inputs
    }

    /// Factor of the program's result, which gives N m.
    pub fn effort_scale(&self) -> f32 {
        self.effort_scale
    }

    /// Physics steps that it looks back.
    pub fn past(&self) -> usize {
        self.past
    }

    /// Computation of a joint.
    pub fn program(&self) -> &NetworkProgram {
        &self.program
    }

    /// Numbers that it remembers from one physics step to the next, for all its joints: past errors
    /// and velocities, then those of the program. They are zero when an episode begins.
    pub fn num_remembered(&self) -> usize {
        (2 * self.past + self.program.memory) * self.joints.len()
    }

    /// Numbers that all networks of a robot remember.
    pub fn num_remembered_by(networks: &[Self]) -> usize {
        networks.iter().map(Self::num_remembered).sum()
    }

    /// Numbers that [`NetworkStep::features`] must hold: those of a block of joints.
    fn num_features(&self) -> usize {
        self.program.features * JOINTS
    }
}

/// Evaluates networks at the beginning of a physics step.
pub struct NetworkStep<'a, S: Real> {
    /// Topology that the lanes share.
    pub topology: &'a Topology,
    /// Settings of the physics steps.
    pub settings: &'a StepSettings,
    /// Networks of the morphology, each for some of its joints.
    pub networks: &'a [ActuatorNetwork],
    /// Physics step within the control step.
    pub substep: usize,
    /// Positions and velocities of the robots.
    pub state: &'a State<S>,
    /// Has the targets, and is given the networks' efforts as feed-forward. An effort that is not
    /// finite leaves no finite force on the base, so that the state breaks.
    pub drive: &'a mut Drive<S>,
    /// Memory of the networks, one after the other: [`ActuatorNetwork::num_remembered`] each.
    pub memory: &'a mut [S],
    /// Scratch memory, which grows.
    pub features: &'a mut Vec<S>,
    /// Scratch memory of the step.
    pub work: &'a mut Workspace<S>,
}

impl<L: Kernels> NetworkStep<'_, L> {
    /// Evaluates them on the lanes' instruction set.
    ///
    /// # Panics
    /// If the memory is shorter than what the networks remember.
    pub fn run(self) {
        L::network_step(self);
    }
}

impl<L: Lanes> NetworkStep<'_, L> {
    /// Evaluates them in code that is compiled where this is called.
    pub(super) fn compute(self) {
        L::vectorize(self);
    }
}

impl<S: Real> Kernel<S> for NetworkStep<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { topology, settings, networks, substep, state, drive, mut memory, features, work } = self;
        select_targets(topology, settings, drive, substep, work);
        let mut broken = S::zero();
        for network in networks {
            let (mine, rest) = memory.split_at_mut(network.num_remembered());
            memory = rest;
            features.resize(features.len().max(network.num_features()), S::zero());
            drive_joints(network, state, &work.target, mine, features, &mut drive.feedforward, &mut broken);
        }
        // zero times infinity is not zero, nor is anything of NaN
        drive.base_force[0] = drive.base_force[0] + broken;
    }
}

/// Joints that are computed together: their features stay in the first-level cache, and their sums
/// in registers.
const JOINTS: usize = 4;
/// Outputs of a layer that are computed together.
const OUTPUTS: usize = 4;

/// Writes the efforts of a network's joints, and adds what is not a number to `broken` in lanes
/// where an effort is not finite.
#[inline(always)]
fn drive_joints<S: Real>(
    network: &ActuatorNetwork,
    state: &State<S>,
    target: &[S],
    memory: &mut [S],
    features: &mut [S],
    effort: &mut [S],
    broken: &mut S,
) {
    let ActuatorNetwork { joints, past, .. } = network;
    let count = joints.len();
    let mut block = 0;
    while block + JOINTS <= count {
        drive_block::<S, JOINTS>(network, block, state, target, memory, features, effort, broken);
        block += JOINTS;
    }
    while block < count {
        drive_block::<S, 1>(network, block, state, target, memory, features, effort, broken);
        block += 1;
    }
    if *past > 0 {
        let (errors, rest) = memory.split_at_mut(past * count);
        let velocities = &mut rest[..past * count];
        for remembered in [&mut *errors, &mut *velocities] {
            for at in (count..remembered.len()).rev() {
                remembered[at] = remembered[at - count];
            }
        }
        for (k, &j) in joints.iter().enumerate() {
            errors[k] = target[j] - state.joint_position[j];
            velocities[k] = state.joint_velocity[j];
        }
    }
}

/// Torques of the `C` joints from joint `block` of the network on. Features are `[features, C]`.
#[inline(always)]
fn drive_block<S: Real, const C: usize>(
    network: &ActuatorNetwork,
    block: usize,
    state: &State<S>,
    target: &[S],
    memory: &mut [S],
    features: &mut [S],
    effort: &mut [S],
    broken: &mut S,
) {
    let ActuatorNetwork { joints, inputs, effort_scale, past, program } = network;
    let count = joints.len();
    let (history, own) = memory.split_at_mut(2 * past * count);
    let (errors, velocities) = history.split_at(past * count);
    let joints = &joints[block..block + C];
    for (input, to) in inputs.iter().zip(features.chunks_exact_mut(C)) {
        let scale = S::broadcast(input.scale);
        let remembered = if input.is_velocity { velocities } else { errors };
        for (k, (&j, to)) in joints.iter().zip(to).enumerate() {
            let x = match input.age {
                0 if input.is_velocity => state.joint_velocity[j],
                0 => target[j] - state.joint_position[j],
                age => remembered[(age - 1) * count + block + k],
            };
            *to = x * scale;
        }
    }
    for instruction in &program.instructions {
        evaluate::<S, C>(instruction, count, block, features, own);
    }
    let scale = S::broadcast(*effort_scale);
    for (&j, &result) in joints.iter().zip(&features[program.output * C..]) {
        effort[j] = result * scale;
        *broken = effort[j].mul_add(S::zero(), *broken);
    }
}

/// `memory` is that of the program, `[numbers, count]`, and holds the block's joints from `block`
/// on.
#[inline(always)]
fn evaluate<S: Real, const C: usize>(
    instruction: &Instruction,
    count: usize,
    block: usize,
    features: &mut [S],
    memory: &mut [S],
) {
    let all = |span: &Span| span.first * C..(span.first + span.len) * C;
    match instruction {
        Instruction::Constant { values, to } => {
            for (&value, to) in values.iter().zip(features[all(to)].chunks_exact_mut(C)) {
                to.fill(S::broadcast(value));
            }
        }
        Instruction::Copy { from, to } if from.len == to.len => features.copy_within(all(from), to.first * C),
        Instruction::Copy { from, to } => {
            for at in to.first..to.first + to.len {
                features.copy_within(all(from), at * C);
            }
        }
        Instruction::Affine { from, to, weights } => {
            let (inputs, outputs) = features.split_at_mut(to.first * C);
            affine::<S, C>(weights, to.len, &inputs[all(from)], outputs);
        }
        Instruction::Map { function, from, to } => map(*function, features, from.first * C, all(to)),
        Instruction::Combine { operation, a, b, to } => {
            let (a, b) = (a.first * C, b.first * C);
            for (i, at) in all(to).enumerate() {
                let (x, y) = (features[a + i], features[b + i]);
                features[at] = match operation {
                    Operation::Add => x + y,
                    Operation::Sub => x - y,
                    Operation::Mul => x * y,
                    Operation::Div => x / y,
                };
            }
        }
        Instruction::Recall { memory: at, to } => {
            for (number, to) in features[all(to)].chunks_exact_mut(C).enumerate() {
                to.copy_from_slice(&memory[(at + number) * count + block..][..C]);
            }
        }
        Instruction::Cell { gates, hidden, cell, to } => {
            for unit in 0..to.len {
                for k in 0..C {
                    let gate = |which: usize| features[(gates.first + which * to.len + unit) * C + k];
                    let (input, output, forget, candidate) = (gate(0), gate(1), gate(2), gate(3));
                    let c = &mut memory[(cell + unit) * count + block + k];
                    *c = sigmoid(forget).mul_add(*c, sigmoid(input) * tanh(candidate));
                    let h = sigmoid(output) * tanh(*c);
                    memory[(hidden + unit) * count + block + k] = h;
                    features[(to.first + unit) * C + k] = h;
                }
            }
        }
    }
}

/// `outputs = weights inputs + bias`; `inputs` and `outputs` are `[features, C]`.
#[inline(always)]
fn affine<S: Real, const C: usize>(weights: &[f32], rows: usize, inputs: &[S], outputs: &mut [S]) {
    let mut row = 0;
    while row + OUTPUTS <= rows {
        affine_rows::<S, OUTPUTS, C>(weights, rows, inputs, outputs, row);
        row += OUTPUTS;
    }
    while row < rows {
        affine_rows::<S, 1, C>(weights, rows, inputs, outputs, row);
        row += 1;
    }
}

#[inline(always)]
fn affine_rows<S: Real, const R: usize, const C: usize>(
    weights: &[f32],
    rows: usize,
    inputs: &[S],
    outputs: &mut [S],
    row: usize,
) {
    let (weights, bias) = weights.split_at(weights.len() - rows);
    let mut sums = [[S::zero(); C]; R];
    for (r, sums) in sums.iter_mut().enumerate() {
        *sums = [S::broadcast(bias[row + r]); C];
    }
    for (weights, inputs) in weights.chunks_exact(rows).zip(inputs.chunks_exact(C)) {
        let weights: &[f32] = &weights[row..row + R];
        for r in 0..R {
            let weight = S::broadcast(weights[r]);
            for c in 0..C {
                sums[r][c] = weight.mul_add(inputs[c], sums[r][c]);
            }
        }
    }
    for (sums, to) in sums.iter().zip(outputs[row * C..].chunks_exact_mut(C)) {
        to.copy_from_slice(sums);
    }
}

#[inline(always)]
fn map<S: Real>(function: Function, features: &mut [S], from: usize, to: std::ops::Range<usize>) {
    let (z, one) = (S::zero(), S::one());
    // one loop each: the function is chosen once
    macro_rules! each {
        ($x:ident => $y:expr) => {
            for (i, at) in to.enumerate() {
                let $x = features[from + i];
                features[at] = $y;
            }
        };
    }
    match function {
        Function::Relu => each!(x => S::select(x.lt(z), z, x)),
        Function::LeakyRelu(slope) => {
            let slope = S::broadcast(slope);
            each!(x => S::select(x.lt(z), slope * x, x));
        }
        Function::Elu(scale) => {
            let scale = S::broadcast(scale);
            each!(x => S::select(x.lt(z), scale * (exp(x) - one), x));
        }
        Function::Tanh => each!(x => tanh(x)),
        Function::Sigmoid => each!(x => sigmoid(x)),
        Function::Softsign => each!(x => x / (one + x.abs())),
        Function::Abs => each!(x => x.abs()),
        Function::Neg => each!(x => -x),
    }
}

#[inline(always)]
fn sigmoid<S: Real>(x: S) -> S {
    S::one() / (S::one() + exp(-x))
}

#[inline(always)]
fn tanh<S: Real>(x: S) -> S {
    let y = tanh_positive(x.abs());
    S::select(x.lt(S::zero()), -y, y)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::Portable;

    fn span(first: usize, len: usize) -> Span {
        Span { first, len }
    }

    #[test]
    fn blocks_give_the_sums_of_single_numbers() {
        let (inputs, rows) = (7, 6);
        let weights: Vec<f32> = (0..(inputs + 1) * rows).map(|i| ((i * 37 % 19) as f32 - 9.0) / 7.0).collect();
        let x: Vec<f32> = (0..inputs * JOINTS).map(|i| ((i * 53 % 23) as f32 - 11.0) / 5.0).collect();
        let lanes: Vec<Portable> = x.iter().map(|&x| Portable::broadcast(x)).collect();
        let mut found = vec![Portable::zero(); rows * JOINTS];
        affine::<_, JOINTS>(&weights, rows, &lanes, &mut found);
        for joint in 0..JOINTS {
            let alone: Vec<f32> = x.iter().skip(joint).step_by(JOINTS).copied().collect();
            let mut single = vec![0.0; rows];
            affine::<f32, 1>(&weights, rows, &alone, &mut single);
            for row in 0..rows {
                let mut sum = weights[inputs * rows + row];
                for k in 0..inputs {
                    sum = weights[k * rows + row].mul_add(alone[k], sum);
                }
                assert_eq!(found[row * JOINTS + joint].lane_f32(3).to_bits(), sum.to_bits(), "{row} {joint}");
                assert_eq!(single[row].to_bits(), sum.to_bits(), "{row} {joint}");
            }
        }
    }

    #[test]
    fn functions_are_what_their_names_say() {
        let exact: [(Function, fn(f64) -> f64); 8] = [
            (Function::Relu, |x| x.max(0.0)),
            (Function::LeakyRelu(0.25), |x| if x < 0.0 { 0.25 * x } else { x }),
            (Function::Elu(0.5), |x| if x < 0.0 { 0.5 * x.exp_m1() } else { x }),
            (Function::Tanh, f64::tanh),
            (Function::Sigmoid, |x| 1.0 / (1.0 + (-x).exp())),
            (Function::Softsign, |x| x / (1.0 + x.abs())),
            (Function::Abs, f64::abs),
            (Function::Neg, |x| -x),
        ];
        for (function, exact) in exact {
            for i in -1200..=1200 {
                let x = i as f32 * 0.1;
                let mut features = [x, 0.0];
                map(function, &mut features, 0, 1..2);
                let error = (f64::from(features[1]) - exact(f64::from(x))).abs();
                assert!(error < 3e-7 * (1.0 + f64::from(x).abs()), "{function:?} {x}: {features:?}");
            }
        }
    }

    #[test]
    fn instructions_beyond_the_features_are_refused() {
        let one = |instruction| NetworkProgram::new(2, 6, 2, 5, vec![instruction]);
        assert!(one(Instruction::Copy { from: span(0, 2), to: span(4, 2) }).is_some());
        assert!(one(Instruction::Copy { from: span(0, 2), to: span(5, 2) }).is_none());
        assert!(one(Instruction::Constant { values: vec![1.0], to: span(2, 2) }).is_none());
        assert!(one(Instruction::Affine { from: span(0, 2), to: span(2, 1), weights: vec![0.0; 3] }).is_some());
        assert!(one(Instruction::Affine { from: span(0, 2), to: span(1, 1), weights: vec![0.0; 3] }).is_none());
        assert!(one(Instruction::Affine { from: span(0, 2), to: span(2, 1), weights: vec![0.0; 2] }).is_none());
        assert!(one(Instruction::Recall { memory: 1, to: span(2, 2) }).is_none());
        assert!(one(Instruction::Recall { memory: usize::MAX, to: span(2, 1) }).is_none());
        assert!(one(Instruction::Cell { gates: span(0, 4), hidden: 0, cell: 1, to: span(4, 1) }).is_some());
        assert!(one(Instruction::Cell { gates: span(0, 4), hidden: 0, cell: 2, to: span(4, 1) }).is_none());
        assert!(NetworkProgram::new(2, 6, 0, 6, Vec::new()).is_none());
        assert!(NetworkProgram::new(7, 6, 0, 0, Vec::new()).is_none());
    }
}
