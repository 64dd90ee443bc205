//! A network with what learns it: its normaliser and its optimiser's moments.

use crate::lines::{Line, WIDTH, lines_of};
use crate::matrix::{BLOCK, Matrix};
use crate::normalizer::Normalizer;
use crate::perceptron::{Perceptron, Tile};
use crate::settings::Network;

/// One of the two networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Which {
    /// The policy's mean.
    Actor,
    /// The value function.
    Critic,
}

/// A network's numbers in torch's order: the actor's deviations, then weight `[outputs, inputs]` and bias of each layer.
#[derive(Clone, Debug, Default)]
pub struct NetworkState {
    /// What is learnt.
    pub weights: Vec<Vec<f32>>,
    /// Adam's mean of the gradients.
    pub first: Vec<Vec<f32>>,
    /// Adam's mean of their squares.
    pub second: Vec<Vec<f32>>,
    /// Adam's steps.
    pub steps: u64,
}

pub(crate) struct Net {
    pub(crate) perceptron: Perceptron,
    pub(crate) normalizer: Option<Normalizer>,
    pub(crate) first: Vec<Line>,
    pub(crate) second: Vec<Line>,
    pub(crate) gradient: Vec<Line>,
    pub(crate) steps: u64,
}

/// Left and right exchanged.
#[derive(Clone, Debug, Default)]
pub(crate) struct Mirror {
    pub(crate) observation: Vec<(usize, f32)>,
    pub(crate) action: Vec<(usize, f32)>,
}

/// Writes the mirror image of some numbers.
pub(crate) fn mirrored(from: &[Line], mirror: &[(usize, f32)], to: &mut [Line]) {
    for (i, &(index, sign)) in mirror.iter().enumerate() {
        to[i / WIDTH].0[i % WIDTH] = from[index / WIDTH].0[index % WIDTH] * sign;
    }
}

impl Net {
    pub(crate) fn new(num_obs: usize, network: &Network, outputs: usize, extra: usize) -> Self {
        let sizes: Vec<usize> =
            [num_obs].into_iter().chain(network.hidden_dims.iter().copied()).chain([outputs]).collect();
        let perceptron = Perceptron::new(&sizes, network.activation, extra);
        let zeros = vec![Line::ZERO; perceptron.weights().len()];
        let normalizer = network.obs_normalization.then(|| Normalizer::new(num_obs));
        Self { perceptron, normalizer, first: zeros.clone(), second: zeros.clone(), gradient: zeros, steps: 0 }
    }

    /// Fills a tile with observations, each mirrored first where it comes with a mirror; returns the tile's rows.
    pub(crate) fn fill<'a>(
        &self,
        samples: impl ExactSizeIterator<Item = (&'a [Line], Option<&'a Mirror>)>,
        tile: &mut Tile,
    ) -> usize {
        let (rows, lines) = (samples.len().next_multiple_of(BLOCK), lines_of(self.perceptron.num_inputs()));
        tile.input.resize(rows * lines, Line::ZERO);
        let mut image = vec![Line::ZERO; lines];
        let mut next = 0;
        for (row, (observation, mirror)) in samples.enumerate() {
            let observation = match mirror {
                None => observation,
                Some(mirror) => {
                    mirrored(observation, &mirror.observation, &mut image);
                    &image
                }
            };
            for (panel, line) in observation.iter().enumerate() {
                tile.input[panel * rows + row] = match &self.normalizer {
                    None => *line,
                    Some(normalizer) => normalizer.apply(panel, line),
                };
            }
            next = row + 1;
        }
        for panel in 0..lines {
            tile.input[panel * rows + next..(panel + 1) * rows].fill(Line::ZERO);
        }
        rows
    }

    /// Calls `each` with the place of each observation, and the lines of the network's output for it.
    pub(crate) fn evaluate(
        &self,
        matrix: Matrix,
        observations: &[Line],
        tile: &mut Tile,
        mut each: impl FnMut(usize, &[Line]),
    ) {
        let (lines, size) = (lines_of(self.perceptron.num_inputs()), self.perceptron.rows_of_tile());
        let mut output = Vec::new();
        for (k, chunk) in observations.chunks(size * lines).enumerate() {
            let samples = chunk.chunks_exact(lines);
            let count = samples.len();
            let rows = self.fill(samples.map(|observation| (observation, None)), tile);
            self.perceptron.forward(matrix, rows, tile);
            for row in 0..count {
                output.clear();
                output.extend(tile.output().iter().skip(row).step_by(rows));
                each(k * size + row, &output);
            }
        }
    }

    pub(crate) fn state(&self) -> NetworkState {
        NetworkState {
            weights: self.perceptron.export(self.perceptron.weights()),
            first: self.perceptron.export(&self.first),
            second: self.perceptron.export(&self.second),
            steps: self.steps,
        }
    }

    /// Takes over a state; false where its sizes differ, which changes nothing.
    pub(crate) fn set_state(&mut self, state: &NetworkState) -> bool {
        let mut lines = [self.perceptron.weights().to_vec(), self.first.clone(), self.second.clone()];
        let from = [&state.weights, &state.first, &state.second];
        if !lines.iter_mut().zip(from).all(|(lines, from)| self.perceptron.import(from, lines)) {
            return false;
        }
        let [weights, first, second] = lines;
        self.perceptron.weights_mut().copy_from_slice(&weights);
        (self.first, self.second, self.steps) = (first, second, state.steps);
        self.perceptron.transpose();
        true
    }
}
