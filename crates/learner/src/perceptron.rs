//! A multi-layer perceptron: weights by panels, forward and back over a tile of samples.

use crate::activation::Activation;
use crate::device::DeviceLayer;
use crate::joints::JointTile;
use crate::layer::{Layer, Room, Sort, have_sizes_of, in_order};
use crate::lines::{Line, WIDTH, lines_of};
use crate::matrix::{BLOCK, End, Matrix};

/// Weights of a perceptron, and further numbers that are learnt with them.
#[derive(Clone, Debug)]
pub(crate) struct Perceptron {
    layers: Vec<Layer>,
    activation: Activation,
    /// Panels `[outputs / 16][inputs, then the bias]` of each layer, then the further numbers.
    weights: Vec<Line>,
    /// Panels `[inputs / 16][outputs]` of each layer but the first.
    transposed: Vec<Line>,
    extra: usize,
}

/// Activations of a tile, and the loss' derivatives.
#[derive(Default)]
pub(crate) struct Tile {
    /// Panels `[inputs / 16][rows]`.
    pub(crate) input: Vec<Line>,
    outputs: Vec<Vec<Line>>,
    /// Panels `[outputs / 16][rows]`: the loss' derivative with respect to the last layer.
    pub(crate) delta: Vec<Line>,
    next: Vec<Line>,
    /// Working memory of a network of joints.
    pub(crate) joints: JointTile,
}

impl Tile {
    /// Output of the last layer, panels `[outputs / 16][rows]`.
    pub(crate) fn output(&self) -> &[Line] {
        self.outputs.last().map_or(&[], |output| output)
    }
}

/// Bytes of a tile's activations that fit in the second-level cache together with the weights of a
/// common network.
const TILE_BYTES: usize = 512 << 10;
const MOST_ROWS: usize = 128;
const LEAST_ROWS: usize = 32;

impl Perceptron {
    /// A perceptron with zeros; `sizes` are those of the input, the hidden layers and the output.
    /// `extra` further numbers are learnt.
    pub(crate) fn new(sizes: &[usize], activation: Activation, extra: usize) -> Self {
        let mut room = Room::default();
        let layer = |(l, pair): (usize, &[usize])| {
            let sort = Sort { has_bias: true, goes_back: l > 0 };
            Layer::new(in_order(pair[0]), in_order(pair[1]), sort, &mut room)
        };
        let layers = sizes.windows(2).enumerate().map(layer).collect();
        let weights = vec![Line::ZERO; room.weights + lines_of(extra)];
        Self { layers, activation, weights, transposed: vec![Line::ZERO; room.transposed], extra }
    }

    /// Rows of a tile. They depend on the sizes alone, and so do the sums.
    pub(crate) fn rows_of_tile(&self) -> usize {
        let lines: usize = self.layers.iter().map(|layer| layer.input_panels() + 2 * layer.panels()).sum();
        let rows = TILE_BYTES / (lines * size_of::<Line>()).max(1);
        (rows / BLOCK * BLOCK).clamp(LEAST_ROWS, MOST_ROWS)
    }

    /// Its layers and their activation, for a device.
    pub(crate) fn on_device(&self) -> (Vec<DeviceLayer>, Activation) {
        (self.layers.iter().map(Layer::on_device).collect(), self.activation)
    }

    /// Number of further numbers.
    pub(crate) fn num_extra(&self) -> usize {
        self.extra
    }

    pub(crate) fn num_inputs(&self) -> usize {
        self.layers.first().map_or(0, Layer::num_inputs)
    }

    /// All learnt numbers.
    pub(crate) fn weights(&self) -> &[Line] {
        &self.weights
    }

    pub(crate) fn weights_mut(&mut self) -> &mut [Line] {
        &mut self.weights
    }

    /// Index of the first further number.
    pub(crate) fn first_extra(&self) -> usize {
        self.weights.len() - lines_of(self.extra)
    }

    /// The further numbers.
    pub(crate) fn extra(&self) -> &[Line] {
        &self.weights[self.first_extra()..]
    }

    /// Moves each of the further numbers into a range; NaN stays NaN.
    pub(crate) fn limit_extra(&mut self, [low, high]: [f32; 2]) {
        let first = self.first_extra();
        let numbers = self.weights[first..].iter_mut().flat_map(|line| &mut line.0).take(self.extra);
        numbers.for_each(|x| *x = x.clamp(low, high));
    }

    /// The transposed weights follow the weights.
    pub(crate) fn transpose(&mut self) {
        self.layers.iter().for_each(|layer| layer.transpose(&self.weights, &mut self.transposed));
    }

    /// Computes the outputs of `rows` rows, a multiple of [`BLOCK`], from the tile's input.
    pub(crate) fn forward(&self, matrix: Matrix, rows: usize, tile: &mut Tile) {
        tile.outputs.resize_with(self.layers.len(), Vec::new);
        for (l, layer) in self.layers.iter().enumerate() {
            let (before, after) = tile.outputs.split_at_mut(l);
            let (a, out) = (before.last().unwrap_or(&tile.input), &mut after[0]);
            let is_hidden = l + 1 < self.layers.len();
            layer.forward(matrix, &self.weights, rows, a, out, is_hidden.then_some(self.activation));
        }
    }

    /// Adds the derivatives of the weights from the tile's `delta`, which is overwritten.
    pub(crate) fn backward(&self, matrix: Matrix, rows: usize, tile: &mut Tile, gradient: &mut [Line]) {
        for (l, layer) in self.layers.iter().enumerate().rev() {
            let input = if l == 0 { &tile.input } else { &tile.outputs[l - 1] };
            layer.add_gradient(matrix, rows, input, &tile.delta, gradient);
            if l == 0 {
                break;
            }
            let (panels, end) = (layer.input_panels(), End::Derivative(self.activation, input));
            layer.back(matrix, &self.transposed, rows, &tile.delta, panels, &mut tile.next, end);
            std::mem::swap(&mut tile.delta, &mut tile.next);
        }
    }

    /// Lines in the order of torch's parameters: the further numbers, then weight `[outputs,
    /// inputs]` and bias of each layer.
    pub(crate) fn export(&self, lines: &[Line]) -> Vec<Vec<f32>> {
        let mut all = Vec::new();
        if self.extra > 0 {
            all.push(lines[self.first_extra()..].iter().flat_map(|line| line.0).take(self.extra).collect());
        }
        self.layers.iter().for_each(|layer| layer.export(lines, &mut all));
        all
    }

    /// The reverse of [`Perceptron::export`]; false where the sizes differ.
    pub(crate) fn import(&self, from: &[Vec<f32>], lines: &mut [Line]) -> bool {
        if !have_sizes_of(from, &self.export(lines)) {
            return false;
        }
        let mut from = from.iter();
        if self.extra > 0
            && let Some(extra) = from.next()
        {
            for (i, &x) in extra.iter().enumerate() {
                lines[self.first_extra() + i / WIDTH].0[i % WIDTH] = x;
            }
        }
        self.layers.iter().all(|layer| layer.import(&mut from, lines))
    }
}
