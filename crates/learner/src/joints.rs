//! A network of joints, like `polypod.networks.urma.JointNetwork`, forward and back over a tile of
//! samples.
//!
//! Numbers of a body (codes, shares of the attention, keys, deviations) are computed once for all
//! of its samples in a tile.

use crate::activation::Activation;
use crate::attention::{
    AddBodies, Attention, Derivatives, Exponentials, Gather, GatherBack, Run, Sines, SinesBack, Softmax, SoftmaxBack,
    SumOverSamples,
};
use crate::bodies::{Bodies, Body};
use crate::gaussian::Gaussian;
use crate::layer::{Layer, Room, Sort, by_lines, have_sizes_of, in_order};
use crate::lines::{Line, WIDTH, lines_of};
use crate::matrix::{BLOCK, End, Matrix, Product, WeightGradient};
use crate::moments::Moments;
use crate::network::Row;
use crate::normalizer::Normalizer;
use crate::rollout::Part;
use crate::settings::{Joints, Network, Robot, Settings};

/// Least magnitude of a description's number whose logarithm differs from that of zero.
const LOG_FLOOR: f32 = 0.01;
/// Deviation within a robot, in deviations over all joints, below which joints count as uniform.
const RELATIVE_FLOOR: f32 = 0.1;
/// Range of the actions' deviations.
const STD_RANGE: [f32; 2] = [0.01, 2.0];
/// Scale of an action's inner product over the numbers of a code.
const KEY_SCALE: f32 = 2.0;
/// Scale of the reflex.
const REFLEX_SCALE: f32 = 0.1;
/// Attention to joints that a head does not look at, before the softmax.
const OUTSIDE: f32 = -1e4;
/// Number of samples of a tile: they and their bodies fit in a second-level cache of 2 MB.
const ROWS: usize = 32;

/// Layers that turn the body's state into the outputs.
#[derive(Clone, Debug)]
enum Head {
    /// An action of each joint, and its deviation.
    Actions { request: Layer, reflex: Box<[Layer; 2]>, deviation: Layer },
    /// Numbers about the whole body.
    Outputs(Layer),
}

/// Places of a robot's inputs in its observation: columns and factors.
#[derive(Clone, Debug, Default)]
struct Plan {
    /// `[slots][states]`
    states: Vec<(usize, f32)>,
    general: Vec<(usize, f32)>,
}

/// Weights of a network of joints.
#[derive(Clone, Debug)]
pub(crate) struct JointNetwork {
    columns: Joints,
    slots: usize,
    activation: Activation,
    /// Plans of each robot: of its samples, and of their mirror images.
    plans: Vec<[Plan; 2]>,
    describe: [Layer; 2],
    state: Layer,
    state_by_description: Layer,
    value: Layer,
    code: Layer,
    attention: Layer,
    focus: Layer,
    body: Vec<Layer>,
    head: Head,
    weights: Vec<Line>,
    transposed: Vec<Line>,
}

/// Activations of a tile, and the loss' derivatives. Rows of joints are those of the tile's bodies,
/// one after the other; rows of places are `[most][rows]`, a place for each joint of each sample.
#[derive(Default)]
pub(crate) struct JointTile {
    /// One for each body of the tile.
    runs: Vec<Run>,
    run_of_row: Vec<usize>,
    /// Number of each body, and whether it is a mirror image.
    bodies: Vec<(usize, bool)>,
    /// Slot of each joint of the bodies.
    slots: Vec<usize>,
    rows: usize,
    most: usize,
    /// Joints of the bodies, rounded up to a multiple of [`BLOCK`].
    num_joints: usize,
    features: Vec<Line>,
    /// Features divided by their number.
    scaled: Vec<Line>,
    relative: Vec<Line>,
    described: [Vec<Line>; 2],
    by: Vec<Line>,
    phases: Vec<Line>,
    codes: Vec<Line>,
    shares: Vec<Line>,
    focused: Vec<Line>,
    deviations: Vec<Line>,
    /// Keys of each body, panels `[lines of a key][joints]`, joints rounded up to a multiple of
    /// [`BLOCK`].
    keys: Vec<Vec<Line>>,
    /// Keys of each body, panels `[lines of its joints][numbers of a key]`.
    keys_transposed: Vec<Vec<Line>>,
    states: Vec<Line>,
    state: Vec<Line>,
    values: Vec<Line>,
    /// Input of the body's layers, and the output of each of them.
    hidden: Vec<Vec<Line>>,
    request: Vec<Line>,
    reads: Vec<Line>,
    reflex: [Vec<Line>; 2],
    output: Vec<Line>,
    distributions: Vec<Gaussian>,
    divergences: Vec<f32>,
    /// Derivatives of the deviations, `[bodies][lines of an action]`.
    of_deviations: Vec<Line>,
    of_logarithms: Vec<Line>,
    of_reads: Vec<Line>,
    of_reflex: [Vec<Line>; 2],
    of_request: Vec<Line>,
    of_keys: Vec<Line>,
    of_hidden: Vec<Line>,
    next: Vec<Line>,
    of_state: Vec<Line>,
    of_sum: Vec<Line>,
    of_values: Vec<Line>,
    of_shares: Vec<Line>,
    of_by: Vec<Line>,
    of_codes: [Vec<Line>; 2],
    of_described: [Vec<Line>; 3],
}

/// Makes `count` lines of zeros.
fn clear(lines: &mut Vec<Line>, count: usize) {
    lines.clear();
    lines.resize(count, Line::ZERO);
}

impl JointNetwork {
    /// A network with zeros. Without `outputs` it gives actions of joints.
    pub(crate) fn new(joints: &Joints, network: &Network, outputs: Option<usize>, settings: &Settings) -> Self {
        let (dim, heads, general) = (joints.joint_dim, joints.num_heads, joints.general.len());
        let (numbers, of_value) = (joints.descriptions.len(), (dim / 4).max(1));
        let mut room = Room::default();
        let mut layer = |inputs: Vec<usize>, outputs: Vec<usize>, has_bias: bool, goes_back: bool| {
            Layer::new(inputs, outputs, Sort { has_bias, goes_back }, &mut room)
        };
        let describe =
            [layer(in_order(3 * numbers), in_order(dim), true, false), layer(in_order(dim), in_order(dim), true, true)];
        let state = layer(in_order(joints.states.len()), in_order(dim), true, false);
        let state_by_description = layer(in_order(dim), in_order(dim), false, true);
        let value = layer(in_order(dim), in_order(of_value), true, true);
        let code = layer(in_order(numbers), in_order(dim), true, false);
        let attention = layer(in_order(dim), in_order(heads), true, true);
        let focus = layer(in_order(dim), in_order(heads), false, true);
        let mut inputs = by_lines(heads, of_value);
        let gathered = heads * lines_of(of_value) * WIDTH;
        inputs.extend(gathered..gathered + general);
        let mut body = Vec::new();
        for &size in &network.hidden_dims {
            body.push(layer(std::mem::replace(&mut inputs, in_order(size)), in_order(size), true, true));
        }
        let head = match outputs {
            None => Head::Actions {
                request: layer(inputs, by_lines(2, dim), true, true),
                reflex: Box::new([
                    layer(in_order(dim), in_order(dim), true, true),
                    layer(in_order(dim), in_order(1), true, true),
                ]),
                deviation: layer(in_order(3 * numbers), in_order(1), true, false),
            },
            Some(outputs) => Head::Outputs(layer(inputs, in_order(outputs), true, true)),
        };
        let plan = |mirror: &dyn Fn(usize) -> (usize, f32)| {
            let source = |column: usize, factor: f32| {
                let (index, sign) = mirror(column);
                (index, sign * factor)
            };
            let slots = 0..settings.num_actions;
            let of_slot = |slot: usize| {
                let scales = joints.states.iter().zip(&joints.scales);
                scales.map(move |(columns, &scale)| source(columns[slot], scale)).collect::<Vec<_>>()
            };
            Plan {
                states: slots.flat_map(of_slot).collect(),
                general: joints.general.iter().map(|&column| source(column, 1.0)).collect(),
            }
        };
        let plans = |robot: &Robot| {
            let image = match robot.observation_mirror.is_empty() {
                true => Plan::default(),
                false => plan(&|column| robot.observation_mirror[column]),
            };
            [plan(&|column| (column, 1.0)), image]
        };
        Self {
            columns: joints.clone(),
            slots: settings.num_actions,
            activation: network.activation,
            plans: settings.robots.iter().map(plans).collect(),
            describe,
            state,
            state_by_description,
            value,
            code,
            attention,
            focus,
            body,
            head,
            weights: vec![Line::ZERO; room.weights],
            transposed: vec![Line::ZERO; room.transposed],
        }
    }

    /// Statistics before the first sample: of states, of a description's numbers, of their
    /// logarithms, of the rest.
    pub(crate) fn normalizers(&self) -> Vec<Normalizer> {
        self.sizes_of_statistics().map(Normalizer::new).to_vec()
    }

    fn sizes_of_statistics(&self) -> [usize; 4] {
        let Joints { states, descriptions, general, .. } = &self.columns;
        [states.len(), descriptions.len(), descriptions.len(), general.len()]
    }

    /// Samples of a tile.
    pub(crate) fn rows_of_tile(&self) -> usize {
        ROWS
    }

    /// All learnt weights.
    pub(crate) fn weights(&self) -> &[Line] {
        &self.weights
    }

    pub(crate) fn weights_mut(&mut self) -> &mut [Line] {
        &mut self.weights
    }

    /// Layers in the order of torch's parameters.
    fn layers(&self) -> impl Iterator<Item = &Layer> {
        let Self { describe, state, state_by_description, value, code, attention, focus, body, head, .. } = self;
        let joints = [state, state_by_description, value, code, attention, focus];
        let head: Vec<&Layer> = match head {
            Head::Actions { request, reflex, deviation } => vec![request, &reflex[0], &reflex[1], deviation],
            Head::Outputs(decoder) => vec![decoder],
        };
        describe.iter().chain(joints).chain(body).chain(head)
    }

    /// The transposed weights follow the weights.
    pub(crate) fn transpose(&mut self) {
        let mut transposed = std::mem::take(&mut self.transposed);
        self.layers().for_each(|layer| layer.transpose(&self.weights, &mut transposed));
        self.transposed = transposed;
    }

    /// Lines in the order of torch's parameters.
    pub(crate) fn export(&self, lines: &[Line]) -> Vec<Vec<f32>> {
        let mut all = Vec::new();
        self.layers().for_each(|layer| layer.export(lines, &mut all));
        all
    }

    /// The reverse of [`JointNetwork::export`]; false where the sizes differ.
    pub(crate) fn import(&self, from: &[Vec<f32>], lines: &mut [Line]) -> bool {
        let mut arrays = from.iter();
        have_sizes_of(from, &self.export(lines)) && self.layers().all(|layer| layer.import(&mut arrays, lines))
    }

    /// Columns of an observation that describe joints.
    pub(crate) fn described_columns(&self) -> impl Iterator<Item = usize> {
        self.columns.descriptions.iter().flatten().copied()
    }

    /// Whether joints are compared with that of the slot.
    fn is_compared(&self, slot: usize) -> bool {
        self.columns.leg_heads.is_none() || self.columns.legs[slot]
    }

    /// Calls `change` with each joint and head of a tile that are not paired: heads of legs serve
    /// joints of legs alone, and other heads the other joints.
    fn for_each_unseen(&self, t: &JointTile, mut change: impl FnMut(usize, usize)) {
        let Some(leg_heads) = self.columns.leg_heads else { return };
        for run in &t.runs {
            for (joint, &slot) in t.slots[run.start..][..run.joints].iter().enumerate() {
                let heads = if self.columns.legs[slot] { leg_heads..self.columns.num_heads } else { 0..leg_heads };
                heads.for_each(|head| change(run.start + joint, head));
            }
        }
    }

    /// The body that an observation describes.
    pub(crate) fn describe(&self, normalizers: &[Normalizer], at: impl Fn(usize) -> f32) -> Body {
        let descriptions = &self.columns.descriptions;
        let count = descriptions.len();
        let has_joint = |&slot: &usize| descriptions.iter().any(|columns| at(columns[slot]) != 0.0);
        let slots: Vec<usize> = (0..self.slots).filter(has_joint).collect();
        let normalized = |which: usize, i: usize, x: f32| normalizers.get(which).map_or(x, |of| of.apply_to(i, x));
        let lines = [lines_of(3 * count), lines_of(count)];
        let num_compared = slots.iter().filter(|&&slot| self.is_compared(slot)).count().max(1) as f32;
        let mut features = vec![Line::ZERO; slots.len() * lines[0]];
        let mut relative = vec![Line::ZERO; slots.len() * lines[1]];
        for (i, columns) in descriptions.iter().enumerate() {
            let absolute: Vec<f32> = slots.iter().map(|&slot| normalized(1, i, at(columns[slot]))).collect();
            let compared = || absolute.iter().zip(&slots).filter(|&(_, &slot)| self.is_compared(slot)).map(|(x, _)| x);
            let mean = compared().sum::<f32>() / num_compared;
            let squares: f32 = compared().map(|x| (x - mean) * (x - mean)).sum();
            let spread = (squares / num_compared).sqrt() + RELATIVE_FLOOR;
            for (joint, &slot) in slots.iter().enumerate() {
                let logarithm = libm::logf(at(columns[slot]).abs() + LOG_FLOOR);
                let difference = (absolute[joint] - mean) / spread;
                let numbers = [absolute[joint], normalized(2, i, logarithm), difference];
                for (kind, x) in numbers.into_iter().enumerate() {
                    let place = kind * count + i;
                    features[joint * lines[0] + place / WIDTH].0[place % WIDTH] = x;
                }
                relative[joint * lines[1] + i / WIDTH].0[i % WIDTH] = difference;
            }
        }
        Body { slots, features, relative }
    }

    /// Fills a tile; returns its rows. Samples of one body follow one another.
    pub(crate) fn fill(
        &self,
        normalizers: &[Normalizer],
        samples: &[Row],
        bodies: &Bodies,
        tile: &mut JointTile,
    ) -> usize {
        let rows = samples.len().next_multiple_of(BLOCK);
        tile.rows = rows;
        tile.find_runs(samples, bodies);
        self.fill_bodies(bodies, tile);
        let (states, general) = (self.columns.states.len(), self.columns.general.len());
        let (places, panels) = (rows * tile.most, lines_of(states));
        clear(&mut tile.states, panels * places);
        tile.hidden.resize_with(self.body.len() + 1, Vec::new);
        let gathered = self.gathered_panels();
        clear(&mut tile.hidden[0], (gathered + lines_of(general)) * rows);
        let normalized = |which: usize, i: usize, line: &Line| match normalizers.get(which) {
            Some(normalizer) => normalizer.apply(i, line),
            None => *line,
        };
        for (row, sample) in samples.iter().enumerate() {
            let run = &tile.runs[tile.run_of_row[row]];
            let plan = &self.plans[sample.robot][usize::from(sample.mirror.is_some())];
            let read = |sources: &[(usize, f32)]| {
                let mut line = Line::ZERO;
                for (x, &(column, factor)) in line.0.iter_mut().zip(sources) {
                    *x = sample.observation[column / WIDTH].0[column % WIDTH] * factor;
                }
                line
            };
            for (joint, &slot) in tile.slots[run.start..][..run.joints].iter().enumerate() {
                let sources = plan.states[slot * states..][..states].chunks(WIDTH);
                for (panel, sources) in sources.enumerate() {
                    tile.states[panel * places + joint * rows + row] = normalized(0, panel, &read(sources));
                }
            }
            for (panel, sources) in plan.general.chunks(WIDTH).enumerate() {
                tile.hidden[0][(gathered + panel) * rows + row] = normalized(3, panel, &read(sources));
            }
        }
        rows
    }

    /// Fills in the numbers of a tile's bodies.
    fn fill_bodies(&self, bodies: &Bodies, tile: &mut JointTile) {
        let (n, count) = (tile.num_joints, self.columns.descriptions.len());
        let lines = [lines_of(3 * count), lines_of(count)];
        clear(&mut tile.features, lines[0] * n);
        clear(&mut tile.scaled, lines[0] * n);
        clear(&mut tile.relative, lines[1] * n);
        let share = 1.0 / (3 * count) as f32;
        for (run, &(number, is_image)) in tile.runs.iter().zip(&tile.bodies) {
            let body = bodies.get(number, is_image);
            for joint in 0..run.joints {
                let row = run.start + joint;
                for (panel, line) in body.features[joint * lines[0]..][..lines[0]].iter().enumerate() {
                    tile.features[panel * n + row] = *line;
                    tile.scaled[panel * n + row] = Line(line.0.map(|x| x * share));
                }
                for (panel, line) in body.relative[joint * lines[1]..][..lines[1]].iter().enumerate() {
                    tile.relative[panel * n + row] = *line;
                }
            }
        }
    }

    /// Panels that the heads gather.
    fn gathered_panels(&self) -> usize {
        self.columns.num_heads * self.value.panels()
    }

    fn attention_of<'a>(
        &self,
        tile_runs: &'a [Run],
        [rows, most, num_joints]: [usize; 3],
        shares: &'a [Line],
    ) -> Attention<'a> {
        let (heads, lines) = (self.columns.num_heads, self.value.panels());
        Attention { runs: tile_runs, rows, most, heads, lines, shares, num_joints }
    }

    /// Computes the outputs of a tile, and the distributions of the actions of its bodies.
    pub(crate) fn forward(&self, matrix: Matrix, tile: &mut JointTile) {
        let (t, weights, act) = (tile, &self.weights[..], Some(self.activation));
        let (rows, most, n) = (t.rows, t.most, t.num_joints);
        self.describe[0].forward(matrix, weights, n, &t.features, &mut t.described[0], act);
        let (first, second) = t.described.split_at_mut(1);
        self.describe[1].forward(matrix, weights, n, &first[0], &mut second[0], act);
        let described = &t.described[1];
        self.state_by_description.forward(matrix, weights, n, described, &mut t.by, None);
        self.code.forward(matrix, weights, n, &t.relative, &mut t.phases, None);
        t.codes.resize(t.phases.len(), Line::ZERO);
        matrix.run(Sines { phases: &t.phases, codes: &mut t.codes });
        self.attention.forward(matrix, weights, n, described, &mut t.shares, None);
        self.focus.forward(matrix, weights, n, &t.codes, &mut t.focused, None);
        let (mut focused, mut shares) = (std::mem::take(&mut t.focused), std::mem::take(&mut t.shares));
        let place = |joint: usize, head: usize| (head / WIDTH * n + joint, head % WIDTH);
        self.for_each_unseen(t, |joint, head| {
            let (line, lane) = place(joint, head);
            focused[line].0[lane] += OUTSIDE;
        });
        matrix.run(Softmax { runs: &t.runs, num_joints: n, added: &focused, shares: &mut shares });
        // a head whose joints a robot lacks gathers zeros
        self.for_each_unseen(t, |joint, head| {
            let (line, lane) = place(joint, head);
            shares[line].0[lane] = 0.0;
        });
        (t.focused, t.shares) = (focused, shares);

        self.state.forward(matrix, weights, rows * most, &t.states, &mut t.state, None);
        let (by, activation, num_joints) = (&t.by, self.activation, n);
        matrix.run(AddBodies { runs: &t.runs, rows, most, by, num_joints, activation, state: &mut t.state });
        self.value.forward(matrix, weights, rows * most, &t.state, &mut t.values, None);
        let attention = self.attention_of(&t.runs, [rows, most, n], &t.shares);
        matrix.run(Gather { attention, values: &t.values, out: &mut t.hidden[0] });
        for (l, layer) in self.body.iter().enumerate() {
            let (before, after) = t.hidden.split_at_mut(l + 1);
            layer.forward(matrix, weights, rows, &before[l], &mut after[0], act);
        }
        let last = &t.hidden[self.body.len()];
        match &self.head {
            Head::Outputs(decoder) => decoder.forward(matrix, weights, rows, last, &mut t.output, None),
            Head::Actions { request, reflex, deviation } => {
                request.forward(matrix, weights, rows, last, &mut t.request, None);
                reflex[0].forward(matrix, weights, rows * most, &t.state, &mut t.reflex[0], act);
                let (first, second) = t.reflex.split_at_mut(1);
                reflex[1].forward(matrix, weights, rows * most, &first[0], &mut second[0], None);
                deviation.forward(matrix, weights, n, &t.scaled, &mut t.deviations, None);
                matrix.run(Exponentials(&mut t.deviations));
                self.act(matrix, t);
            }
        }
    }

    /// Computes the actions from the requests, and makes the distributions.
    fn act(&self, matrix: Matrix, t: &mut JointTile) {
        let (rows, lines) = (t.rows, lines_of(self.slots));
        t.make_keys(self.columns.joint_dim);
        clear(&mut t.reads, lines_of(t.most) * rows);
        clear(&mut t.output, lines * rows);
        t.distributions.clear();
        for (run, keys) in t.runs.iter().zip(&t.keys_transposed) {
            (matrix.product)(Product {
                rows,
                range: run.first..run.first + run.count,
                inner: t.request.len() / rows * WIDTH,
                a: &t.request,
                b: keys,
                out: &mut t.reads[..lines_of(run.joints) * rows],
                end: End::Plain,
            });
            let slots = &t.slots[run.start..][..run.joints];
            let mut deviation = vec![Line::ZERO; lines];
            for (joint, &slot) in slots.iter().enumerate() {
                for row in run.first..run.first + run.count {
                    let read = t.reads[joint / WIDTH * rows + row].0[joint % WIDTH];
                    let reflex = t.reflex[1][joint * rows + row].0[0];
                    t.output[slot / WIDTH * rows + row].0[slot % WIDTH] = read + REFLEX_SCALE * reflex;
                }
                let own = t.deviations[run.start + joint].0[0];
                deviation[slot / WIDTH].0[slot % WIDTH] = own.clamp(STD_RANGE[0], STD_RANGE[1]);
            }
            t.distributions.push(Gaussian::new(&deviation, self.slots, slots.to_vec()));
        }
        clear(&mut t.of_deviations, lines * t.runs.len());
    }

    /// Adds the derivatives of the weights from those of the outputs, and from the noted
    /// derivatives of the deviations.
    pub(crate) fn backward(&self, matrix: Matrix, delta: &[Line], tile: &mut JointTile, gradient: &mut [Line]) {
        let (t, back, activation) = (tile, &self.transposed[..], self.activation);
        let (rows, most, n) = (t.rows, t.most, t.num_joints);
        let (places, lines) = (rows * most, self.state.panels());
        clear(&mut t.of_described[0], lines * n);
        clear(&mut t.of_codes[0], lines * n);
        let last = self.body.len();
        match &self.head {
            Head::Outputs(decoder) => {
                let (hidden, panels) = (&t.hidden[last], decoder.input_panels());
                decoder.add_gradient(matrix, rows, hidden, delta, gradient);
                let end = End::Derivative(activation, hidden);
                decoder.back(matrix, back, rows, delta, panels, &mut t.of_hidden, end);
            }
            Head::Actions { request, reflex, deviation } => {
                self.read_back(matrix, delta, t);
                let [of_hidden, of_reflex] = &mut t.of_reflex;
                reflex[1].add_gradient(matrix, places, &t.reflex[0], of_reflex, gradient);
                let end = End::Derivative(activation, &t.reflex[0]);
                reflex[1].back(matrix, back, places, of_reflex, lines, of_hidden, end);
                reflex[0].add_gradient(matrix, places, &t.state, of_hidden, gradient);
                reflex[0].back(matrix, back, places, of_hidden, lines, &mut t.of_state, End::Plain);
                let (hidden, panels) = (&t.hidden[last], request.input_panels());
                request.add_gradient(matrix, rows, hidden, &t.of_request, gradient);
                let end = End::Derivative(activation, hidden);
                request.back(matrix, back, rows, &t.of_request, panels, &mut t.of_hidden, end);
                deviation.add_gradient(matrix, n, &t.scaled, &t.of_logarithms, gradient);
            }
        }
        for (l, layer) in self.body.iter().enumerate().rev() {
            layer.add_gradient(matrix, rows, &t.hidden[l], &t.of_hidden, gradient);
            let (panels, end) = match l {
                0 => (self.gathered_panels(), End::Plain),
                _ => (layer.input_panels(), End::Derivative(activation, &t.hidden[l])),
            };
            layer.back(matrix, back, rows, &t.of_hidden, panels, &mut t.next, end);
            std::mem::swap(&mut t.of_hidden, &mut t.next);
        }
        clear(&mut t.of_values, self.value.panels() * places);
        clear(&mut t.of_shares, self.attention.panels() * n);
        matrix.run(GatherBack {
            attention: self.attention_of(&t.runs, [rows, most, n], &t.shares),
            values: &t.values,
            delta: &t.of_hidden,
            of_values: &mut t.of_values,
            of_shares: &mut t.of_shares,
        });
        self.value.add_gradient(matrix, places, &t.state, &t.of_values, gradient);
        let end = match self.head {
            Head::Actions { .. } => End::AddDerivative(activation, &t.state, &t.of_state),
            Head::Outputs(_) => End::Derivative(activation, &t.state),
        };
        self.value.back(matrix, back, places, &t.of_values, lines, &mut t.of_sum, end);
        self.state.add_gradient(matrix, places, &t.states, &t.of_sum, gradient);
        clear(&mut t.of_by, lines * n);
        matrix.run(SumOverSamples { runs: &t.runs, rows, most, delta: &t.of_sum, num_joints: n, out: &mut t.of_by });
        matrix.run(SoftmaxBack { runs: &t.runs, num_joints: n, shares: &t.shares, delta: &mut t.of_shares });
        self.bodies_back(matrix, t, gradient);
    }

    /// Splits the derivatives of actions and deviations into those of reads, reflexes, requests,
    /// keys and logarithms of deviations.
    fn read_back(&self, matrix: Matrix, delta: &[Line], t: &mut JointTile) {
        let (rows, n, lines) = (t.rows, t.num_joints, lines_of(self.slots));
        let inner = t.request.len() / rows * WIDTH;
        clear(&mut t.of_reads, lines_of(t.most) * rows);
        clear(&mut t.of_reflex[1], rows * t.most);
        clear(&mut t.of_logarithms, n);
        clear(&mut t.of_request, t.request.len());
        let scale = KEY_SCALE / self.columns.joint_dim as f32;
        for (body, run) in t.runs.iter().enumerate() {
            let range = run.first..run.first + run.count;
            for (joint, &slot) in t.slots[run.start..][..run.joints].iter().enumerate() {
                for row in range.clone() {
                    let x = delta[slot / WIDTH * rows + row].0[slot % WIDTH];
                    t.of_reads[joint / WIDTH * rows + row].0[joint % WIDTH] = x;
                    t.of_reflex[1][joint * rows + row].0[0] = REFLEX_SCALE * x;
                }
                let (row, of) = (run.start + joint, t.of_deviations[body * lines + slot / WIDTH].0[slot % WIDTH]);
                let own = t.deviations[row].0[0];
                let is_free = (STD_RANGE[0]..=STD_RANGE[1]).contains(&own);
                t.of_logarithms[row].0[0] = if is_free { of * own } else { 0.0 };
            }
            let panels = lines_of(run.joints);
            (matrix.product)(Product {
                rows,
                range: range.clone(),
                inner: run.joints.next_multiple_of(BLOCK),
                a: &t.of_reads,
                b: &t.keys[body],
                out: &mut t.of_request,
                end: End::Plain,
            });
            clear(&mut t.of_keys, panels * (inner + 1));
            (matrix.weight_gradient)(WeightGradient {
                rows,
                range,
                inner,
                input: &t.request,
                delta: &t.of_reads[..panels * rows],
                gradient: &mut t.of_keys,
            });
            let codes = t.of_codes[0].len() / n * WIDTH;
            for joint in 0..run.joints {
                let (row, of_joint) = (run.start + joint, &t.of_keys[joint / WIDTH * (inner + 1)..][..inner]);
                for (k, line) in of_joint.iter().enumerate() {
                    let (to, k) = match k < codes {
                        true => (&mut t.of_codes[0], k),
                        false => (&mut t.of_described[0], k - codes),
                    };
                    to[k / WIDTH * n + row].0[k % WIDTH] = scale * line.0[joint % WIDTH];
                }
            }
        }
    }

    /// Back-propagation through the numbers of bodies.
    fn bodies_back(&self, matrix: Matrix, t: &mut JointTile, gradient: &mut [Line]) {
        let (back, activation, n, lines) = (&self.transposed[..], self.activation, t.num_joints, self.state.panels());
        let described = &t.described[1];
        let [from_keys, from_attention, of_described] = &mut t.of_described;
        let [codes_from_keys, of_phases] = &mut t.of_codes;
        self.attention.add_gradient(matrix, n, described, &t.of_shares, gradient);
        self.attention.back(matrix, back, n, &t.of_shares, lines, from_attention, End::Add(from_keys));
        self.focus.add_gradient(matrix, n, &t.codes, &t.of_shares, gradient);
        self.focus.back(matrix, back, n, &t.of_shares, lines, of_phases, End::Add(codes_from_keys));
        matrix.run(SinesBack { phases: &t.phases, delta: of_phases });
        self.code.add_gradient(matrix, n, &t.relative, of_phases, gradient);
        self.state_by_description.add_gradient(matrix, n, described, &t.of_by, gradient);
        self.state_by_description.back(matrix, back, n, &t.of_by, lines, of_described, End::Add(from_attention));
        matrix.run(Derivatives { activation, y: described, delta: of_described });
        self.describe[1].add_gradient(matrix, n, &t.described[0], of_described, gradient);
        let end = End::Derivative(activation, &t.described[0]);
        self.describe[1].back(matrix, back, n, of_described, lines, from_keys, end);
        self.describe[0].add_gradient(matrix, n, &t.features, from_keys, gradient);
    }

    /// Moments of the inputs in a part's samples, for each of [`JointNetwork::normalizers`], one
    /// after the other; statistics of joints count real joints alone.
    pub(crate) fn moments(
        &self,
        part: &Part,
        bodies: &Bodies,
        normalizers: &[Normalizer],
        num_obs: usize,
    ) -> Vec<Moments> {
        let about: Vec<f64> = normalizers.iter().flat_map(|of| &of.mean).map(|&x| f64::from(x)).collect();
        let mut sums = vec![[0.0f64; 3]; about.len()];
        let mut add = |place: usize, count: f64, x: f32| {
            let x = f64::from(x) - about[place];
            let sum = &mut sums[place];
            (sum[0], sum[1], sum[2]) = (sum[0] + count, sum[1] + count * x, sum[2] + count * x * x);
        };
        let [states, numbers, _, _] = self.sizes_of_statistics();
        let mut seen: Vec<(usize, usize)> = vec![(0, 0); bodies.len()];
        let lines = lines_of(num_obs);
        for (sample, &body) in bodies.of_samples.iter().enumerate() {
            let observation = &part.observations[sample * lines..][..lines];
            let plan = &self.plans[part.robot_of[sample % part.len()]][0];
            let at = |&(column, factor): &(usize, f32)| observation[column / WIDTH].0[column % WIDTH] * factor;
            for &slot in &bodies.get(body, false).slots {
                let sources = &plan.states[slot * states..][..states];
                sources.iter().enumerate().for_each(|(i, source)| add(i, 1.0, at(source)));
            }
            let first = states + 2 * numbers;
            plan.general.iter().enumerate().for_each(|(i, source)| add(first + i, 1.0, at(source)));
            seen[body] = (seen[body].0 + 1, sample);
        }
        for (body, (count, sample)) in seen.into_iter().enumerate().filter(|(_, (count, _))| *count > 0) {
            let observation = &part.observations[sample * lines..][..lines];
            for (i, columns) in self.columns.descriptions.iter().enumerate() {
                for column in bodies.get(body, false).slots.iter().map(|&slot| columns[slot]) {
                    let x = observation[column / WIDTH].0[column % WIDTH];
                    add(states + i, count as f64, x);
                    add(states + numbers + i, count as f64, libm::logf(x.abs() + LOG_FLOOR));
                }
            }
        }
        let moments = |([count, sum, squares], about): ([f64; 3], f64)| match count > 0.0 {
            true => Moments { count, mean: about + sum / count, squares: (squares - sum * sum / count).max(0.0) },
            false => Moments::default(),
        };
        sums.into_iter().zip(about).map(moments).collect()
    }
}

impl JointTile {
    /// The outputs, panels `[outputs / 16][rows]`.
    pub(crate) fn output(&self) -> &[Line] {
        &self.output
    }

    /// The body of a row: its place among the bodies of the tile.
    pub(crate) fn body_of(&self, row: usize) -> usize {
        self.run_of_row[row]
    }

    /// The bodies of the tile: their numbers, and whether they are mirror images.
    pub(crate) fn bodies(&self) -> &[(usize, bool)] {
        &self.bodies
    }

    /// Distribution of the actions of a body of the tile, and the derivatives that are noted of its
    /// deviations.
    pub(crate) fn distribution(&mut self, body: usize) -> (&Gaussian, &mut [Line]) {
        let lines = self.of_deviations.len() / self.distributions.len().max(1);
        (&self.distributions[body], &mut self.of_deviations[body * lines..][..lines])
    }

    /// Distribution of the actions of a body of the tile, of an actor.
    pub(crate) fn gaussian(&self, body: usize) -> Option<&Gaussian> {
        self.distributions.get(body)
    }

    /// Divergence of a body's deviations from those that its actions were drawn with.
    pub(crate) fn divergence(&self, body: usize) -> f32 {
        self.divergences[body]
    }

    /// Compares the deviations with those that the actions were drawn with.
    pub(crate) fn compare(&mut self, old: &[Option<Gaussian>]) {
        self.divergences.clear();
        for (new, &(number, is_image)) in self.distributions.iter().zip(&self.bodies) {
            let old = if is_image { None } else { old[number].as_ref() };
            self.divergences.push(old.map_or(0.0, |old| new.divergence_of_deviations(old)));
        }
    }

    fn find_runs(&mut self, samples: &[Row], bodies: &Bodies) {
        self.runs.clear();
        self.run_of_row.clear();
        self.bodies.clear();
        self.slots.clear();
        for (row, sample) in samples.iter().enumerate() {
            let key = (sample.body, sample.mirror.is_some());
            if self.bodies.last() == Some(&key)
                && let Some(run) = self.runs.last_mut()
            {
                run.count += 1;
            } else {
                let (start, slots) = (self.slots.len(), &bodies.get(key.0, key.1).slots);
                self.slots.extend_from_slice(slots);
                self.bodies.push(key);
                self.runs.push(Run { first: row, count: 1, start, joints: slots.len() });
            }
            self.run_of_row.push(self.runs.len() - 1);
        }
        self.most = self.runs.iter().map(|run| run.joints).max().unwrap_or(0).max(1);
        self.num_joints = self.slots.len().next_multiple_of(BLOCK).max(BLOCK);
    }

    /// Makes the keys of the joints: code and description, scaled.
    fn make_keys(&mut self, joint_dim: usize) {
        let (n, lines) = (self.num_joints, lines_of(joint_dim));
        let scale = KEY_SCALE / joint_dim as f32;
        self.keys.resize_with(self.keys.len().max(self.runs.len()), Vec::new);
        self.keys_transposed.resize_with(self.keys.len(), Vec::new);
        let of_bodies = self.keys.iter_mut().zip(&mut self.keys_transposed);
        for (run, (keys, transposed)) in self.runs.iter().zip(of_bodies) {
            let (inner, numbers) = (run.joints.next_multiple_of(BLOCK), 2 * lines * WIDTH);
            clear(keys, 2 * lines * inner);
            clear(transposed, lines_of(run.joints) * numbers);
            for joint in 0..run.joints {
                for panel in 0..2 * lines {
                    let from = if panel < lines { &self.codes } else { &self.described[1] };
                    let key = Line(from[panel % lines * n + run.start + joint].0.map(|x| scale * x));
                    keys[panel * inner + joint] = key;
                    let to = &mut transposed[joint / WIDTH * numbers + panel * WIDTH..][..WIDTH];
                    to.iter_mut().zip(key.0).for_each(|(line, x)| line.0[joint % WIDTH] = x);
                }
            }
        }
    }
}
