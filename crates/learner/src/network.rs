//! A network with its training state: statistics and the optimiser's moments.

use crate::bodies::Bodies;
use crate::device::DeviceNetwork;
use crate::gaussian::Gaussian;
use crate::joints::JointNetwork;
use crate::lines::{Line, WIDTH, lines_of};
use crate::matrix::{BLOCK, Matrix};
use crate::moments::Moments;
use crate::normalizer::Normalizer;
use crate::perceptron::{Perceptron, Tile};
use crate::rollout::Part;
use crate::settings::{Robot, Settings};

/// One of the two networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NetworkName {
    /// The policy's mean.
    Actor,
    /// The value function.
    Critic,
}

/// A network's numbers in torch's order: a perceptron's deviations of the actions, then weight
/// `[outputs, inputs]` and bias of each layer.
#[derive(Clone, Debug, Default)]
pub struct NetworkState {
    /// Weights of the network.
    pub weights: Vec<Vec<f32>>,
    /// Adam's mean of the gradients.
    pub first: Vec<Vec<f32>>,
    /// Adam's mean of their squares.
    pub second: Vec<Vec<f32>>,
    /// Number of steps that Adam has taken.
    pub steps: u64,
}

/// A kind of network.
pub(crate) enum Model {
    Perceptron(Perceptron),
    Joints(Box<JointNetwork>),
}

pub(crate) struct Net {
    pub(crate) model: Model,
    /// The numbers of a row that a perceptron reads; None: all of them.
    columns: Option<Vec<usize>>,
    /// Statistics of a perceptron's observations, or the four of a network of joints; empty without
    /// normalisation.
    pub(crate) normalizers: Vec<Normalizer>,
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

impl Mirror {
    /// Images of observations and actions, for a device.
    pub(crate) fn on_device(&self) -> [&[(usize, f32)]; 2] {
        [&self.observation, &self.action]
    }
}

/// Input row of a network.
#[derive(Clone, Copy)]
pub(crate) struct Row<'a> {
    pub(crate) observation: &'a [Line],
    /// Mirror, for the row's mirror image.
    pub(crate) mirror: Option<&'a Mirror>,
    pub(crate) robot: usize,
    /// Number of the body among a part's; 0 for a perceptron.
    pub(crate) body: usize,
}

/// Writes the mirror image of some numbers.
pub(crate) fn mirrored(from: &[Line], mirror: &[(usize, f32)], to: &mut [Line]) {
    for (i, &(index, sign)) in mirror.iter().enumerate() {
        to[i / WIDTH].0[i % WIDTH] = from[index / WIDTH].0[index % WIDTH] * sign;
    }
}

impl Net {
    /// The actor or the critic of some settings, with zeros.
    pub(crate) fn new(name: NetworkName, settings: &Settings) -> Self {
        let (network, outputs, extra) = match name {
            NetworkName::Actor => (&settings.options.actor, settings.num_actions, settings.num_actions),
            NetworkName::Critic => (&settings.options.critic, 1, 0),
        };
        let (mut columns, inputs) = (None, network.columns.len());
        let model = match &network.joints {
            Some(joints) => {
                let outputs = (name == NetworkName::Critic).then_some(outputs);
                Model::Joints(Box::new(JointNetwork::new(joints, network, outputs, settings)))
            }
            None => {
                let is_whole = inputs == 0 || network.columns.iter().copied().eq(0..settings.num_obs);
                columns = (!is_whole).then(|| network.columns.clone());
                let first = [if is_whole { settings.num_obs } else { inputs }];
                let sizes: Vec<usize> =
                    first.into_iter().chain(network.hidden_dims.iter().copied()).chain([outputs]).collect();
                Model::Perceptron(Perceptron::new(&sizes, network.activation, extra))
            }
        };
        let normalizers = match &model {
            _ if !network.obs_normalization => Vec::new(),
            Model::Perceptron(perceptron) => vec![Normalizer::new(perceptron.num_inputs())],
            Model::Joints(joints) => joints.normalizers(),
        };
        let zeros = vec![Line::ZERO; model.weights().len()];
        Self { model, columns, normalizers, first: zeros.clone(), second: zeros.clone(), gradient: zeros, steps: 0 }
    }

    /// The network of joints, if it is one.
    pub(crate) fn joints(&self) -> Option<&JointNetwork> {
        match &self.model {
            Model::Joints(joints) => Some(joints),
            Model::Perceptron(_) => None,
        }
    }

    /// Its numbers, for a device; None for a network of joints.
    pub(crate) fn on_device(&self) -> Option<DeviceNetwork<'_>> {
        let Model::Perceptron(perceptron) = &self.model else { return None };
        let (layers, activation) = perceptron.on_device();
        Some(DeviceNetwork {
            layers,
            activation,
            inputs: perceptron.num_inputs(),
            columns: self.columns.as_deref(),
            statistics: self.normalizers.first().map(Normalizer::lines),
            numbers: [perceptron.weights(), &self.first, &self.second],
            first_deviation: perceptron.first_extra(),
            num_deviations: perceptron.num_extra(),
        })
    }

    /// Takes over weights and moments after some steps.
    pub(crate) fn take_numbers(&mut self, [weights, first, second]: [Vec<Line>; 3], steps: u64) {
        self.model.weights_mut().copy_from_slice(&weights);
        (self.first, self.second, self.steps) = (first, second, steps);
        self.model.transpose();
    }

    /// Deviations of the actions that are learnt as numbers; empty for a network of joints.
    pub(crate) fn deviations(&self) -> &[Line] {
        match &self.model {
            Model::Perceptron(perceptron) => perceptron.extra(),
            Model::Joints(_) => &[],
        }
    }

    /// Index of the first derivative of [`Net::deviations`].
    pub(crate) fn first_deviation(&self) -> usize {
        match &self.model {
            Model::Perceptron(perceptron) => perceptron.first_extra(),
            Model::Joints(_) => self.gradient.len(),
        }
    }

    /// Samples of a tile.
    pub(crate) fn rows_of_tile(&self) -> usize {
        match &self.model {
            Model::Perceptron(perceptron) => perceptron.rows_of_tile(),
            Model::Joints(joints) => joints.rows_of_tile(),
        }
    }

    /// Fills a tile with observations, each mirrored first where it comes with a mirror; returns
    /// the tile's rows.
    pub(crate) fn fill(&self, samples: &[Row], bodies: &Bodies, tile: &mut Tile) -> usize {
        let inputs = match &self.model {
            Model::Joints(joints) => return joints.fill(&self.normalizers, samples, bodies, &mut tile.joints),
            Model::Perceptron(perceptron) => perceptron.num_inputs(),
        };
        let (rows, lines) = (samples.len().next_multiple_of(BLOCK), lines_of(inputs));
        tile.input.resize(rows * lines, Line::ZERO);
        let mut image = vec![Line::ZERO; samples.first().map_or(0, |row| row.observation.len())];
        let mut chosen = vec![Line::ZERO; lines];
        for (row, sample) in samples.iter().enumerate() {
            let mut observation = match sample.mirror {
                None => sample.observation,
                Some(mirror) => {
                    mirrored(sample.observation, &mirror.observation, &mut image);
                    &image
                }
            };
            if let Some(columns) = &self.columns {
                for (i, &column) in columns.iter().enumerate() {
                    chosen[i / WIDTH].0[i % WIDTH] = observation[column / WIDTH].0[column % WIDTH];
                }
                observation = &chosen;
            }
            for (panel, line) in observation.iter().enumerate() {
                tile.input[panel * rows + row] = match self.normalizers.first() {
                    None => *line,
                    Some(normalizer) => normalizer.apply(panel, line),
                };
            }
        }
        for panel in 0..lines {
            tile.input[panel * rows + samples.len()..(panel + 1) * rows].fill(Line::ZERO);
        }
        rows
    }

    /// Computes the outputs of a tile that is filled.
    pub(crate) fn forward(&self, matrix: Matrix, rows: usize, tile: &mut Tile) {
        match &self.model {
            Model::Perceptron(perceptron) => perceptron.forward(matrix, rows, tile),
            Model::Joints(joints) => joints.forward(matrix, &mut tile.joints),
        }
    }

    /// Outputs of a tile, panels `[outputs / 16][rows]`.
    pub(crate) fn output<'a>(&self, tile: &'a Tile) -> &'a [Line] {
        match &self.model {
            Model::Perceptron(_) => tile.output(),
            Model::Joints(_) => tile.joints.output(),
        }
    }

    /// Adds the derivatives of the weights from the tile's `delta`, which is overwritten.
    pub(crate) fn backward(&self, matrix: Matrix, rows: usize, tile: &mut Tile, gradient: &mut [Line]) {
        match &self.model {
            Model::Perceptron(perceptron) => perceptron.backward(matrix, rows, tile, gradient),
            Model::Joints(joints) => joints.backward(matrix, &tile.delta, &mut tile.joints, gradient),
        }
    }

    /// Calls `each` with the place of each observation, and the lines of the network's output for
    /// it. An actor that is a network of joints adds the distribution of the actions.
    pub(crate) fn evaluate(
        &self,
        matrix: Matrix,
        observations: &[Row],
        bodies: &Bodies,
        tile: &mut Tile,
        mut each: impl FnMut(usize, &[Line], Option<&Gaussian>),
    ) {
        let mut order: Vec<usize> = (0..observations.len()).collect();
        if self.joints().is_some() {
            order.sort_by_key(|&k| observations[k].body);
        }
        let (mut output, mut samples) = (Vec::new(), Vec::new());
        for places in order.chunks(self.rows_of_tile()) {
            samples.clear();
            samples.extend(places.iter().map(|&k| observations[k]));
            let rows = self.fill(&samples, bodies, tile);
            self.forward(matrix, rows, tile);
            for (row, &place) in places.iter().enumerate() {
                output.clear();
                output.extend(self.output(tile).iter().skip(row).step_by(rows));
                let gaussian = self.joints().and_then(|_| tile.joints.gaussian(tile.joints.body_of(row)));
                each(place, &output, gaussian);
            }
        }
    }

    /// Mean of each number of an observation so far, `[num_obs]`, as far as it is known; moments
    /// are computed about it. Networks without statistics of whole observations have none.
    pub(crate) fn means(&self, num_obs: usize) -> Option<Vec<f32>> {
        let normalizer = self.normalizers.first().filter(|_| self.joints().is_none())?;
        let Some(columns) = &self.columns else { return Some(normalizer.mean.clone()) };
        let mut means = vec![0.0; num_obs];
        columns.iter().zip(&normalizer.mean).for_each(|(&column, &mean)| means[column] = mean);
        Some(means)
    }

    /// Takes the samples of an iteration into a perceptron's statistics; see
    /// [`Normalizer::update`].
    pub(crate) fn update_normalizer(&mut self, of_numbers: &[Moments], samples: u64, robots: &[Robot]) {
        let is_padded = |column: usize| robots.iter().any(|robot| !robot.has_number(column));
        let columns: Vec<usize> = match &self.columns {
            Some(columns) => columns.clone(),
            None => (0..of_numbers.len()).collect(),
        };
        let own: Vec<Moments> = columns.iter().map(|&column| of_numbers[column]).collect();
        let is_padded: Vec<bool> = columns.into_iter().map(is_padded).collect();
        for normalizer in &mut self.normalizers {
            normalizer.update(&own, samples, &is_padded);
        }
    }

    /// Moments of a part's samples, for [`Net::update_normalizers`]; None for a network without
    /// statistics of joints.
    pub(crate) fn moments(&self, part: &Part, name: NetworkName, num_obs: usize) -> Option<Vec<Moments>> {
        let joints = self.joints().filter(|_| !self.normalizers.is_empty())?;
        Some(joints.moments(part, &part.bodies[name as usize], &self.normalizers, num_obs))
    }

    /// Takes the moments of all parts into the statistics of a network of joints.
    pub(crate) fn update_normalizers(&mut self, moments: &[Moments]) {
        let mut rest = moments;
        for normalizer in &mut self.normalizers {
            let (own, more) = rest.split_at(normalizer.mean.len().min(rest.len()));
            rest = more;
            let samples = own.first().map_or(0.0, |moments| moments.count);
            normalizer.update(own, samples as u64, &vec![false; own.len()]);
        }
    }

    pub(crate) fn state(&self) -> NetworkState {
        NetworkState {
            weights: self.model.export(self.model.weights()),
            first: self.model.export(&self.first),
            second: self.model.export(&self.second),
            steps: self.steps,
        }
    }

    /// Takes over a state; false where its sizes differ, which changes nothing.
    pub(crate) fn set_state(&mut self, state: &NetworkState) -> bool {
        let mut lines = [self.model.weights().to_vec(), self.first.clone(), self.second.clone()];
        let from = [&state.weights, &state.first, &state.second];
        if !lines.iter_mut().zip(from).all(|(lines, from)| self.model.import(from, lines)) {
            return false;
        }
        self.take_numbers(lines, state.steps);
        true
    }
}

impl Model {
    fn weights(&self) -> &[Line] {
        match self {
            Self::Perceptron(perceptron) => perceptron.weights(),
            Self::Joints(joints) => joints.weights(),
        }
    }

    pub(crate) fn weights_mut(&mut self) -> &mut [Line] {
        match self {
            Self::Perceptron(perceptron) => perceptron.weights_mut(),
            Self::Joints(joints) => joints.weights_mut(),
        }
    }

    /// The transposed weights follow the weights.
    pub(crate) fn transpose(&mut self) {
        match self {
            Self::Perceptron(perceptron) => perceptron.transpose(),
            Self::Joints(joints) => joints.transpose(),
        }
    }

    /// Moves the deviations that are learnt as numbers into a range.
    pub(crate) fn limit_deviations(&mut self, range: [f32; 2]) {
        if let Self::Perceptron(perceptron) = self {
            perceptron.limit_extra(range);
        }
    }

    fn export(&self, lines: &[Line]) -> Vec<Vec<f32>> {
        match self {
            Self::Perceptron(perceptron) => perceptron.export(lines),
            Self::Joints(joints) => joints.export(lines),
        }
    }

    fn import(&self, from: &[Vec<f32>], lines: &mut [Line]) -> bool {
        match self {
            Self::Perceptron(perceptron) => perceptron.import(from, lines),
            Self::Joints(joints) => joints.import(from, lines),
        }
    }
}
