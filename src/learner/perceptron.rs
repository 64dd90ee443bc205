//! A multi-layer perceptron: its weights by panels, its way forward and its way back over a tile of samples.

use crate::activation::Activation;
use crate::lines::{Line, WIDTH, lines_of};
use crate::matrix::{BLOCK, End, Matrix, Product, WeightGradient};

/// Where a layer's weights are.
#[derive(Clone, Debug)]
struct Layer {
    inputs: usize,
    outputs: usize,
    /// Inputs, rounded up to a multiple of [`BLOCK`]; the weights of the others are zero, and stay so.
    inner: usize,
    /// Its first line among the weights.
    first: usize,
    /// Its first line among the transposed weights.
    first_transposed: usize,
}

impl Layer {
    fn panels(&self) -> usize {
        lines_of(self.outputs)
    }

    fn lines(&self) -> usize {
        self.panels() * (self.inner + 1)
    }

    /// Outputs, rounded up: the inner dimension on the way back.
    fn inner_transposed(&self) -> usize {
        self.outputs.next_multiple_of(BLOCK)
    }

    fn lines_transposed(&self) -> usize {
        lines_of(self.inputs) * self.inner_transposed()
    }
}

/// Weights of a perceptron, and some numbers more that are learnt with them.
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

/// Activations of a tile, and what the loss says of them.
#[derive(Default)]
pub(crate) struct Tile {
    /// Panels `[inputs / 16][rows]`.
    pub(crate) input: Vec<Line>,
    outputs: Vec<Vec<Line>>,
    /// Panels `[outputs / 16][rows]`: the loss' derivative with respect to the last layer.
    pub(crate) delta: Vec<Line>,
    next: Vec<Line>,
}

impl Tile {
    /// What the last layer gave, panels `[outputs / 16][rows]`.
    pub(crate) fn output(&self) -> &[Line] {
        self.outputs.last().map_or(&[], |output| output)
    }
}

/// Bytes of a tile's activations that stay in the second-level cache beside the weights of a common network.
const TILE_BYTES: usize = 512 << 10;
const MOST_ROWS: usize = 128;
const LEAST_ROWS: usize = 32;

impl Perceptron {
    /// All weights zero; `sizes` are those of the input, the hidden layers and the output. `extra` further numbers are learnt.
    pub(crate) fn new(sizes: &[usize], activation: Activation, extra: usize) -> Self {
        let (mut layers, mut first, mut first_transposed) = (Vec::new(), 0, 0);
        for pair in sizes.windows(2) {
            let (inputs, outputs) = (pair[0], pair[1]);
            let layer = Layer { inputs, outputs, inner: inputs.next_multiple_of(BLOCK), first, first_transposed };
            first += layer.lines();
            if !layers.is_empty() {
                first_transposed += layer.lines_transposed();
            }
            layers.push(layer);
        }
        let weights = vec![Line::ZERO; first + lines_of(extra)];
        Self { layers, activation, weights, transposed: vec![Line::ZERO; first_transposed], extra }
    }

    /// Rows of a tile. They depend on the sizes alone, and so do the sums.
    pub(crate) fn rows_of_tile(&self) -> usize {
        let lines: usize = self.layers.iter().map(|layer| lines_of(layer.inputs) + 2 * layer.panels()).sum();
        let rows = TILE_BYTES / (lines * size_of::<Line>()).max(1);
        (rows / BLOCK * BLOCK).clamp(LEAST_ROWS, MOST_ROWS)
    }

    pub(crate) fn num_inputs(&self) -> usize {
        self.layers.first().map_or(0, |layer| layer.inputs)
    }

    /// All that is learnt.
    pub(crate) fn weights(&self) -> &[Line] {
        &self.weights
    }

    pub(crate) fn weights_mut(&mut self) -> &mut [Line] {
        &mut self.weights
    }

    /// Where the further numbers begin.
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
        for layer in self.layers.iter().skip(1) {
            let inner = layer.inner_transposed();
            let to = &mut self.transposed[layer.first_transposed..][..layer.lines_transposed()];
            let from = &self.weights[layer.first..][..layer.lines()];
            for (panel, lines) in to.chunks_exact_mut(inner).enumerate() {
                let columns = WIDTH.min(layer.inner - panel * WIDTH);
                for (output, line) in lines.iter_mut().enumerate().take(layer.outputs) {
                    let from = &from[output / WIDTH * (layer.inner + 1) + panel * WIDTH..][..columns];
                    for (x, from) in line.0.iter_mut().zip(from) {
                        *x = from.0[output % WIDTH];
                    }
                }
            }
        }
    }

    /// Computes the outputs of `rows` rows, a multiple of [`BLOCK`], from the tile's input.
    pub(crate) fn forward(&self, matrix: Matrix, rows: usize, tile: &mut Tile) {
        tile.outputs.resize_with(self.layers.len(), Vec::new);
        for (l, layer) in self.layers.iter().enumerate() {
            let (before, after) = tile.outputs.split_at_mut(l);
            let (a, out) = (before.last().unwrap_or(&tile.input), &mut after[0]);
            out.resize(layer.panels() * rows, Line::ZERO);
            let is_hidden = l + 1 < self.layers.len();
            (matrix.product)(Product {
                rows,
                inner: layer.inner,
                a,
                b: &self.weights[layer.first..][..layer.lines()],
                out,
                end: End::Bias(is_hidden.then_some(self.activation)),
            });
        }
    }

    /// Adds the derivatives of the weights from the tile's `delta`, which is overwritten.
    pub(crate) fn backward(&self, matrix: Matrix, rows: usize, tile: &mut Tile, gradient: &mut [Line]) {
        for (l, layer) in self.layers.iter().enumerate().rev() {
            let input = if l == 0 { &tile.input } else { &tile.outputs[l - 1] };
            (matrix.weight_gradient)(WeightGradient {
                rows,
                inner: layer.inner,
                input,
                delta: &tile.delta,
                gradient: &mut gradient[layer.first..][..layer.lines()],
            });
            if l == 0 {
                break;
            }
            tile.next.resize(lines_of(layer.inputs) * rows, Line::ZERO);
            (matrix.product)(Product {
                rows,
                inner: layer.inner_transposed(),
                a: &tile.delta,
                b: &self.transposed[layer.first_transposed..][..layer.lines_transposed()],
                out: &mut tile.next,
                end: End::Derivative(self.activation, input),
            });
            std::mem::swap(&mut tile.delta, &mut tile.next);
        }
    }

    /// Lines in the order of torch's parameters: the further numbers, then weight `[outputs, inputs]` and bias of each layer.
    pub(crate) fn export(&self, lines: &[Line]) -> Vec<Vec<f32>> {
        let mut all = Vec::new();
        if self.extra > 0 {
            all.push(lines[self.first_extra()..].iter().flat_map(|line| line.0).take(self.extra).collect());
        }
        for layer in &self.layers {
            let of = &lines[layer.first..][..layer.lines()];
            let at = |output: usize, row: usize| of[output / WIDTH * (layer.inner + 1) + row].0[output % WIDTH];
            let weight = (0..layer.outputs).flat_map(|output| (0..layer.inputs).map(move |input| (output, input)));
            all.push(weight.map(|(output, input)| at(output, input)).collect());
            all.push((0..layer.outputs).map(|output| at(output, layer.inner)).collect());
        }
        all
    }

    /// The reverse of [`Perceptron::export`]; false where the sizes differ.
    pub(crate) fn import(&self, from: &[Vec<f32>], lines: &mut [Line]) -> bool {
        let sizes = self.export(lines);
        if from.len() != sizes.len() || from.iter().zip(&sizes).any(|(from, size)| from.len() != size.len()) {
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
        for layer in &self.layers {
            let of = &mut lines[layer.first..][..layer.lines()];
            let (Some(weight), Some(bias)) = (from.next(), from.next()) else { return false };
            for output in 0..layer.outputs {
                let panel = output / WIDTH * (layer.inner + 1);
                for input in 0..layer.inputs {
                    of[panel + input].0[output % WIDTH] = weight[output * layer.inputs + input];
                }
                of[panel + layer.inner].0[output % WIDTH] = bias[output];
            }
        }
        true
    }
}
