//! A layer of a network: its weights, forward and back.

use crate::activation::Activation;
use crate::device::DeviceLayer;
use crate::lines::{Line, WIDTH, lines_of};
use crate::matrix::{BLOCK, End, Matrix, Product, WeightGradient};

/// Lines that the layers of a network use so far.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Room {
    pub(crate) weights: usize,
    pub(crate) transposed: usize,
}

/// Whether a layer has a bias, and whether a layer below it learns.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sort {
    pub(crate) has_bias: bool,
    pub(crate) goes_back: bool,
}

/// Place of a layer's weights.
///
/// Its inputs and outputs may leave gaps, so that parts of them begin with a line. The weights of
/// gaps are zero, and stay so.
#[derive(Clone, Debug)]
pub(crate) struct Layer {
    /// Place of each input.
    inputs: Vec<usize>,
    /// Place of each output.
    outputs: Vec<usize>,
    /// Places of inputs, rounded up to a multiple of [`BLOCK`].
    inner: usize,
    sort: Sort,
    /// First line of the layer among the weights.
    first: usize,
    /// First line of the layer among the transposed weights.
    first_transposed: usize,
}

/// Places up to the last one that is taken.
fn width(places: &[usize]) -> usize {
    places.iter().max().map_or(0, |last| last + 1)
}

/// The first `count` places.
pub(crate) fn in_order(count: usize) -> Vec<usize> {
    (0..count).collect()
}

/// Places of `parts` parts of `count` numbers each, which begin with a line.
pub(crate) fn by_lines(parts: usize, count: usize) -> Vec<usize> {
    (0..parts).flat_map(|part| (0..count).map(move |i| part * lines_of(count) * WIDTH + i)).collect()
}

impl Layer {
    /// A layer with its inputs and outputs at these places, after the layers in the room.
    pub(crate) fn new(inputs: Vec<usize>, outputs: Vec<usize>, sort: Sort, room: &mut Room) -> Self {
        let inner = width(&inputs).next_multiple_of(BLOCK);
        let this = Self { inputs, outputs, inner, sort, first: room.weights, first_transposed: room.transposed };
        room.weights += this.lines();
        room.transposed += this.lines_transposed();
        this
    }

    /// Number of inputs.
    pub(crate) fn num_inputs(&self) -> usize {
        self.inputs.len()
    }

    /// Lines of a row of outputs.
    pub(crate) fn panels(&self) -> usize {
        lines_of(width(&self.outputs))
    }

    /// Lines of a row of inputs.
    pub(crate) fn input_panels(&self) -> usize {
        lines_of(width(&self.inputs))
    }

    /// Its place, for a device.
    pub(crate) fn on_device(&self) -> DeviceLayer {
        DeviceLayer { first: self.first, inner: self.inner, panels: self.panels(), inner_back: self.inner_transposed() }
    }

    fn lines(&self) -> usize {
        self.panels() * (self.inner + 1)
    }

    /// Outputs, rounded up: the inner dimension on the way back.
    fn inner_transposed(&self) -> usize {
        width(&self.outputs).next_multiple_of(BLOCK)
    }

    fn lines_transposed(&self) -> usize {
        if self.sort.goes_back { self.input_panels() * self.inner_transposed() } else { 0 }
    }

    /// Lines of the layer among those of the network: panels `[outputs / 16][inputs, then the
    /// bias]`.
    pub(crate) fn of<'a>(&self, lines: &'a [Line]) -> &'a [Line] {
        &lines[self.first..][..self.lines()]
    }

    /// The transposed weights follow the weights: panels `[inputs / 16][outputs]`.
    pub(crate) fn transpose(&self, weights: &[Line], transposed: &mut [Line]) {
        if !self.sort.goes_back {
            return;
        }
        let (from, inner, outputs) = (self.of(weights), self.inner_transposed(), width(&self.outputs));
        let to = &mut transposed[self.first_transposed..][..self.lines_transposed()];
        for (panel, lines) in to.chunks_exact_mut(inner).enumerate() {
            let columns = WIDTH.min(self.inner - panel * WIDTH);
            for (output, line) in lines.iter_mut().enumerate().take(outputs) {
                let from = &from[output / WIDTH * (self.inner + 1) + panel * WIDTH..][..columns];
                for (x, from) in line.0.iter_mut().zip(from) {
                    *x = from.0[output % WIDTH];
                }
            }
        }
    }

    /// Computes the outputs of `rows` rows, a multiple of [`BLOCK`].
    pub(crate) fn forward(
        &self,
        matrix: Matrix,
        weights: &[Line],
        rows: usize,
        input: &[Line],
        out: &mut Vec<Line>,
        activation: Option<Activation>,
    ) {
        out.resize(self.panels() * rows, Line::ZERO);
        (matrix.product)(Product {
            rows,
            range: 0..rows,
            inner: self.inner,
            a: input,
            b: self.of(weights),
            out,
            end: End::Bias(activation),
        });
    }

    /// Adds the derivatives of the weights.
    pub(crate) fn add_gradient(
        &self,
        matrix: Matrix,
        rows: usize,
        input: &[Line],
        delta: &[Line],
        gradient: &mut [Line],
    ) {
        let gradient = &mut gradient[self.first..][..self.lines()];
        (matrix.weight_gradient)(WeightGradient { rows, range: 0..rows, inner: self.inner, input, delta, gradient });
        if !self.sort.has_bias {
            gradient.chunks_exact_mut(self.inner + 1).for_each(|panel| panel[self.inner] = Line::ZERO);
        }
    }

    /// Computes the derivatives of the first `panels` panels of inputs from those of the outputs.
    pub(crate) fn back(
        &self,
        matrix: Matrix,
        transposed: &[Line],
        rows: usize,
        delta: &[Line],
        panels: usize,
        out: &mut Vec<Line>,
        end: End,
    ) {
        out.resize(panels * rows, Line::ZERO);
        let inner = self.inner_transposed();
        let b = &transposed[self.first_transposed..][..panels * inner];
        (matrix.product)(Product { rows, range: 0..rows, inner, a: delta, b, out, end });
    }

    /// Appends the layer's numbers in torch's order: weight `[outputs, inputs]`, and bias.
    pub(crate) fn export(&self, lines: &[Line], all: &mut Vec<Vec<f32>>) {
        let of = self.of(lines);
        let at = |output: usize, row: usize| of[output / WIDTH * (self.inner + 1) + row].0[output % WIDTH];
        let pairs = self.outputs.iter().flat_map(|&output| self.inputs.iter().map(move |&input| (output, input)));
        all.push(pairs.map(|(output, input)| at(output, input)).collect());
        if self.sort.has_bias {
            all.push(self.outputs.iter().map(|&output| at(output, self.inner)).collect());
        }
    }

    /// The reverse of [`Layer::export`] for arrays of the same sizes; false where there are too
    /// few.
    pub(crate) fn import<'a>(&self, from: &mut impl Iterator<Item = &'a Vec<f32>>, lines: &mut [Line]) -> bool {
        let of = &mut lines[self.first..][..self.lines()];
        let Some(weight) = from.next() else { return false };
        let bias = if self.sort.has_bias { from.next() } else { None };
        for (k, &output) in self.outputs.iter().enumerate() {
            let panel = output / WIDTH * (self.inner + 1);
            for (i, &input) in self.inputs.iter().enumerate() {
                of[panel + input].0[output % WIDTH] = weight[k * self.inputs.len() + i];
            }
            if let Some(bias) = bias {
                of[panel + self.inner].0[output % WIDTH] = bias[k];
            }
        }
        bias.is_some() == self.sort.has_bias
    }
}

/// Whether arrays have the sizes of some others.
pub(crate) fn have_sizes_of(arrays: &[Vec<f32>], others: &[Vec<f32>]) -> bool {
    arrays.len() == others.len() && arrays.iter().zip(others).all(|(array, other)| array.len() == other.len())
}
