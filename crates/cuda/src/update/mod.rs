//! The native learner's update on a device: what [`UpdateDevice`] asks, as launches of the kernels
//! of `device/learn.cu`.
//!
//! Samples, weights and activations are in one piece of the device's memory. The host sends the
//! rollout once for each update, and a few numbers of the policy for each mini-batch; it reads the
//! sums of the losses, the norms of the gradients and the deviations.

mod card;
mod jobs;

use polypod_learner::{
    Activation, DeviceBatch, DeviceFailure, DeviceLayer, DeviceNetwork, DeviceSums, DeviceUpdate, Line, Rates,
    Symmetry, UpdateDevice, WIDTH,
};

use crate::device::DeviceError;
pub use card::UpdateCard;
use jobs::{CHUNK, DEPTH, FIGURES, THREADS, TILE};
pub use jobs::{Chains, Inputs, Launch, Part, Plain, Product, Rows, Step, Surrogate, Total, Value, WeightGradient};

/// Arrays begin at multiples of this, bytes.
const ALIGNMENT: u64 = 256;

/// Memory and kernels of a device.
pub trait Machine: Send + Sync {
    /// Name of the device.
    fn name(&self) -> &str;

    /// Makes room for that many bytes, and gives back the room of an earlier call; returns its
    /// address.
    ///
    /// # Errors
    /// Too little memory, or a device that is lost.
    fn reserve(&mut self, bytes: u64) -> Result<u64, DeviceError>;

    /// Copies numbers to an address.
    ///
    /// # Errors
    /// A device that is lost.
    fn write<T: Plain>(&mut self, to: u64, from: &[T]) -> Result<(), DeviceError>;

    /// Copies numbers from an address, after all work before.
    ///
    /// # Errors
    /// A device that is lost.
    fn read<T: Plain>(&mut self, from: u64, to: &mut [T]) -> Result<(), DeviceError>;

    /// Begins a kernel after all work before.
    ///
    /// # Errors
    /// A device that is lost.
    fn launch(&mut self, launch: &Launch) -> Result<(), DeviceError>;
}

/// Updates on a machine.
pub struct Update<M> {
    machine: M,
    /// Room that the machine has, bytes, and its address.
    room: (u64, u64),
    plan: Plan,
}

impl<M: Machine> Update<M> {
    /// Updates on a machine.
    pub fn new(machine: M) -> Self {
        Self { machine, room: (0, 0), plan: Plan::default() }
    }
}

/// Sizes of an update, and the addresses of its arrays.
#[derive(Debug, Default)]
struct Plan {
    num_obs: usize,
    num_actions: usize,
    parts: usize,
    samples: usize,
    robots: usize,
    passes: usize,
    symmetry: i32,
    clip: f32,
    is_clipped: bool,
    value_coefficient: f32,
    deviations: [f32; 2],
    /// The parts in each mini-batch, and their rows.
    batches: Vec<(Vec<Part>, usize)>,
    networks: Vec<Network>,
    /// Addresses.
    at: Places,
}

/// A network's sizes and addresses.
#[derive(Debug, Default)]
struct Network {
    layers: Vec<DeviceLayer>,
    activation: i32,
    inputs: usize,
    has_columns: bool,
    has_statistics: bool,
    lines: usize,
    first_deviation: usize,
    num_deviations: usize,
    columns: u64,
    statistics: [u64; 2],
    /// Weights, and Adam's two moments.
    numbers: [u64; 3],
    gradients: u64,
    total: u64,
    squares: u64,
    input: u64,
    outputs: Vec<u64>,
    deltas: [u64; 2],
}

/// Addresses of the arrays that belong to no network.
#[derive(Debug, Default)]
struct Places {
    observations: u64,
    actions: u64,
    means: u64,
    log_probs: u64,
    advantages: u64,
    returns: u64,
    values: u64,
    order: u64,
    robot_of: u64,
    /// Index and sign of the images of observations and of actions.
    mirrors: [[u64; 2]; 2],
    parts: u64,
    complete: u64,
    sample: u64,
    robot: u64,
    inverse: u64,
    scalars: u64,
    start: u64,
    terms: u64,
    surrogate: u64,
    divergence: u64,
    value: u64,
    /// Figures of the parts; the squares of both networks follow.
    figures: u64,
}

/// Places of arrays, one after the other.
struct Room(u64);

impl Room {
    fn place<T>(&mut self, count: usize) -> u64 {
        let at = self.0;
        self.0 += ((count * size_of::<T>()) as u64).next_multiple_of(ALIGNMENT);
        at
    }
}

/// Sizes are counted in integers of 32 bits, as `check` makes sure.
fn whole(x: usize) -> i32 {
    i32::try_from(x).unwrap_or(i32::MAX)
}

fn lines_of(numbers: usize) -> usize {
    numbers.div_ceil(WIDTH)
}

fn blocks_of(count: usize, size: usize) -> i32 {
    whole(count.div_ceil(size))
}

fn activation(activation: Activation) -> i32 {
    match activation {
        Activation::Elu => 1,
        Activation::Relu => 2,
        Activation::Tanh => 3,
    }
}

/// The address of a number after the first one of an array.
fn after<T>(start: u64, count: usize) -> u64 {
    start + (count * size_of::<T>()) as u64
}

impl Network {
    fn new(of: &DeviceNetwork) -> Self {
        Self {
            layers: of.layers.clone(),
            activation: activation(of.activation),
            inputs: of.inputs,
            has_columns: of.columns.is_some(),
            has_statistics: of.statistics.is_some(),
            lines: of.numbers[0].len(),
            first_deviation: of.first_deviation * WIDTH,
            num_deviations: of.num_deviations,
            ..Self::default()
        }
    }

    /// Numbers of a row of inputs of a layer.
    fn pitch_of_input(&self, layer: usize) -> usize {
        WIDTH * layer.checked_sub(1).map_or(lines_of(self.inputs), |below| self.layers[below].panels)
    }

    /// Numbers of a row of a layer's outputs.
    fn pitch(&self, layer: usize) -> usize {
        WIDTH * self.layers[layer].panels
    }

    /// Inputs of a layer in the device's memory.
    fn input_of(&self, layer: usize) -> u64 {
        layer.checked_sub(1).map_or(self.input, |below| self.outputs[below])
    }

    fn numbers(&self) -> usize {
        self.lines * WIDTH
    }

    fn chunks(&self) -> usize {
        self.numbers().div_ceil(CHUNK)
    }

    fn place(&mut self, room: &mut Room, parts: usize, rows: usize) {
        let inputs = lines_of(self.inputs);
        self.columns = if self.has_columns { room.place::<i32>(self.inputs) } else { 0 };
        let mut statistic = || if self.has_statistics { room.place::<Line>(inputs) } else { 0 };
        self.statistics = [statistic(), statistic()];
        self.numbers = std::array::from_fn(|_| room.place::<Line>(self.lines));
        self.total = room.place::<Line>(self.lines);
        self.gradients = room.place::<Line>(self.lines * parts);
        self.input = room.place::<Line>(rows * inputs);
        self.outputs = self.layers.iter().map(|layer| room.place::<Line>(rows * layer.panels)).collect();
        let widest = self.layers.iter().map(|layer| layer.panels).max().unwrap_or(0);
        self.deltas = std::array::from_fn(|_| room.place::<Line>(rows * widest));
    }
}

impl Plan {
    fn new(update: &DeviceUpdate) -> Self {
        let passes = if update.symmetry == Symmetry::Both { 2 } else { 1 };
        let batch = |samples: &Vec<std::ops::Range<usize>>| {
            let (mut row, mut order, mut env) = (0, 0, 0);
            let mut parts = Vec::with_capacity(samples.len());
            for (samples, part) in samples.iter().zip(&update.parts) {
                let rows = samples.len().next_multiple_of(DEPTH);
                parts.push(Part {
                    first_row: whole(row),
                    rows: whole(rows),
                    samples: whole(samples.len()),
                    first_order: whole(order + samples.start),
                    first_sample: whole(order),
                    first_env: whole(env),
                    envs: whole(part.robot_of.len()),
                });
                row += passes * rows;
                order += part.order.len();
                env += part.robot_of.len();
            }
            (parts, row)
        };
        Self {
            num_obs: update.num_obs,
            num_actions: update.num_actions,
            parts: update.parts.len(),
            samples: update.parts.iter().map(|part| part.order.len()).sum(),
            robots: update.num_robots,
            passes,
            symmetry: match update.symmetry {
                Symmetry::None => 0,
                Symmetry::Both => 1,
                Symmetry::Alternate => 2,
            },
            clip: update.clip_param,
            is_clipped: update.use_clipped_value_loss,
            value_coefficient: update.value_loss_coef,
            deviations: update.deviations,
            batches: update.batches.iter().map(batch).collect(),
            networks: update.networks.iter().map(Network::new).collect(),
            at: Places::default(),
        }
    }

    /// Places all arrays from an address on; returns the bytes that they take.
    fn place(&mut self, start: u64) -> u64 {
        let mut room = Room(start);
        let rows = self.batches.iter().map(|(_, rows)| *rows).max().unwrap_or(0);
        let (samples, width) = (self.samples, lines_of(self.num_actions));
        let images = if self.symmetry == 0 { 0 } else { self.robots };
        let envs: i32 = self.batches.first().and_then(|(parts, _)| parts.last()).map_or(0, |of| of.first_env + of.envs);
        self.at = Places {
            observations: room.place::<Line>(samples * lines_of(self.num_obs)),
            actions: room.place::<Line>(samples * width),
            means: room.place::<Line>(samples * width),
            log_probs: room.place::<f32>(samples),
            advantages: room.place::<f32>(samples),
            returns: room.place::<f32>(samples),
            values: room.place::<f32>(samples),
            order: room.place::<u32>(samples),
            robot_of: room.place::<i32>(usize::try_from(envs).unwrap_or(0)),
            mirrors: [self.num_obs, self.num_actions]
                .map(|numbers| [(), ()].map(|()| room.place::<i32>(images * numbers))),
            parts: room.place::<Part>(self.batches.len() * self.parts),
            complete: room.place::<i32>(self.parts),
            sample: room.place::<i32>(rows),
            robot: room.place::<i32>(rows),
            inverse: room.place::<Line>(self.robots * width),
            scalars: room.place::<[f32; 5]>(self.robots),
            start: room.place::<Line>(self.parts * width),
            terms: room.place::<Line>(rows * width),
            surrogate: room.place::<f32>(rows),
            divergence: room.place::<f32>(rows),
            value: room.place::<f32>(rows),
            figures: 0,
        };
        // the host reads this part of a mini-batch at once
        let chunks: usize = self.networks.iter().map(Network::chunks).sum();
        self.at.figures = room.place::<f64>(self.parts * FIGURES + chunks * WIDTH);
        let mut squares = after::<f64>(self.at.figures, self.parts * FIGURES);
        for network in &mut self.networks {
            network.squares = squares;
            squares = after::<f64>(squares, network.chunks() * WIDTH);
            network.place(&mut room, self.parts, rows);
        }
        room.0 - start
    }

    /// The address of the parts of a mini-batch.
    fn parts_at(&self, batch: usize) -> u64 {
        after::<Part>(self.at.parts, batch * self.parts)
    }

    /// A job of each network that has a layer in its turn.
    fn of_two<T: Default>(&self, job: impl Fn(&Network) -> Option<T>) -> [T; 2] {
        std::array::from_fn(|net| self.networks.get(net).and_then(&job).unwrap_or_default())
    }

    fn inputs(&self, rows: usize) -> Launch {
        let [index, sign] = self.at.mirrors[0];
        Launch::Inputs(self.of_two(|network| {
            Some(Inputs {
                observations: self.at.observations,
                sample: self.at.sample,
                robot: self.at.robot,
                index,
                sign,
                columns: network.columns,
                mean: network.statistics[0],
                inverse: network.statistics[1],
                input: network.input,
                blocks: blocks_of(rows, THREADS / WIDTH),
                rows: whole(rows),
                numbers: whole(self.num_obs),
                inputs: whole(network.inputs),
                pitch: whole(network.pitch_of_input(0)),
            })
        }))
    }

    fn forward(&self, layer: usize, rows: usize) -> Launch {
        Launch::Product(self.of_two(|network| {
            let of = network.layers.get(layer)?;
            let pitch = network.pitch(layer);
            Some(Product {
                a: network.input_of(layer),
                weights: after::<Line>(network.numbers[0], of.first),
                y: 0,
                out: network.outputs[layer],
                blocks: blocks_of(rows, TILE).saturating_mul(blocks_of(pitch, TILE)),
                rows: whole(rows),
                inner: whole(of.inner),
                pitch_a: whole(network.pitch_of_input(layer)),
                pitch: whole(pitch),
                lines: whole(of.inner + 1),
                back: 0,
                activation: if layer + 1 < network.layers.len() { network.activation } else { 0 },
            })
        }))
    }

    fn surrogate(&self, rows: usize, weight: f32) -> Launch {
        let (network, [index, sign]) = (&self.networks[0], self.at.mirrors[1]);
        Launch::Surrogate(Surrogate {
            output: network.outputs.last().copied().unwrap_or(0),
            delta: network.deltas[0],
            sample: self.at.sample,
            robot: self.at.robot,
            actions: self.at.actions,
            means: self.at.means,
            log_probs: self.at.log_probs,
            advantages: self.at.advantages,
            index,
            sign,
            inverse: self.at.inverse,
            scalars: self.at.scalars,
            terms: self.at.terms,
            loss: self.at.surrogate,
            divergence: self.at.divergence,
            blocks: blocks_of(rows, THREADS),
            rows: whole(rows),
            numbers: whole(self.num_actions),
            width: whole(lines_of(self.num_actions) * WIDTH),
            clip: self.clip,
            weight,
        })
    }

    fn value(&self, rows: usize, weight: f32) -> Launch {
        let network = &self.networks[1];
        Launch::Value(Value {
            output: network.outputs.last().copied().unwrap_or(0),
            delta: network.deltas[0],
            sample: self.at.sample,
            returns: self.at.returns,
            values: self.at.values,
            loss: self.at.value,
            blocks: blocks_of(rows, THREADS),
            rows: whole(rows),
            is_clipped: i32::from(self.is_clipped),
            clip: self.clip,
            coefficient: self.value_coefficient,
            weight,
        })
    }

    fn chains(&self, batch: usize) -> Launch {
        let network = &self.networks[0];
        Launch::Chains(Chains {
            part: self.parts_at(batch),
            robot: self.at.robot,
            terms: self.at.terms,
            surrogate: self.at.surrogate,
            value: self.at.value,
            divergence: self.at.divergence,
            start: self.at.start,
            gradient: after::<f32>(network.gradients, network.first_deviation),
            figures: self.at.figures,
            part_numbers: i64::from(whole(network.numbers())),
            blocks: whole(self.parts),
            passes: whole(self.passes),
            width: whole(lines_of(self.num_actions) * WIDTH),
        })
    }

    /// The layer that a network is at after some steps on the way back, and the place of the
    /// derivatives of its outputs.
    fn layer_back(network: &Network, step: usize) -> Option<(usize, [u64; 2])> {
        let layer = network.layers.len().checked_sub(step + 1)?;
        Some((layer, [network.deltas[step % 2], network.deltas[1 - step % 2]]))
    }

    fn weights_back(&self, batch: usize, step: usize) -> Launch {
        Launch::WeightGradient(self.of_two(|network| {
            let (layer, [delta, _]) = Self::layer_back(network, step)?;
            let (of, pitch) = (network.layers[layer], network.pitch(layer));
            let tiles = blocks_of(of.inner, TILE).saturating_mul(blocks_of(pitch, TILE));
            Some(WeightGradient {
                input: network.input_of(layer),
                delta,
                part: self.parts_at(batch),
                gradient: after::<Line>(network.gradients, of.first),
                part_numbers: i64::from(whole(network.numbers())),
                blocks: tiles.saturating_mul(whole(self.parts)),
                passes: whole(self.passes),
                inner: whole(of.inner),
                pitch_input: whole(network.pitch_of_input(layer)),
                pitch: whole(pitch),
            })
        }))
    }

    fn back(&self, step: usize, rows: usize) -> Launch {
        Launch::Product(self.of_two(|network| {
            let (layer, [delta, next]) = Self::layer_back(network, step).filter(|(layer, _)| *layer > 0)?;
            let (of, pitch) = (network.layers[layer], network.pitch_of_input(layer));
            Some(Product {
                a: delta,
                weights: after::<Line>(network.numbers[0], of.first),
                y: network.input_of(layer),
                out: next,
                blocks: blocks_of(rows, TILE).saturating_mul(blocks_of(pitch, TILE)),
                rows: whole(rows),
                inner: whole(of.inner_back),
                pitch_a: whole(network.pitch(layer)),
                pitch: whole(pitch),
                lines: whole(of.inner + 1),
                back: 1,
                activation: network.activation,
            })
        }))
    }

    fn total(&self) -> Launch {
        Launch::Total(self.of_two(|network| {
            Some(Total {
                gradients: network.gradients,
                complete: self.at.complete,
                total: network.total,
                squares: network.squares,
                part_numbers: i64::from(whole(network.numbers())),
                blocks: whole(network.chunks()),
                parts: whole(self.parts),
                numbers: whole(network.numbers()),
            })
        }))
    }

    fn step(&self, rates: [Rates; 2]) -> Launch {
        let ([keep, keep_squares], [take, take_squares]) = (Rates::KEEP, Rates::TAKE);
        let job = |(network, rates): (&Network, Rates)| Step {
            weights: network.numbers[0],
            first: network.numbers[1],
            second: network.numbers[2],
            gradient: network.total,
            blocks: blocks_of(network.numbers(), THREADS),
            numbers: whole(network.numbers()),
            first_deviation: whole(network.first_deviation),
            end_deviation: whole(network.first_deviation + network.num_deviations),
            clip: rates.clip,
            rate: rates.rate,
            root: rates.root,
            keep,
            keep_squares,
            take,
            take_squares,
            epsilon: Rates::EPSILON,
            lowest: self.deviations[0],
            highest: self.deviations[1],
        };
        let [actor, critic] = rates;
        Launch::Step([job((&self.networks[0], actor)), job((&self.networks[1], critic))])
    }
}

/// Copies an array that lies in pieces.
fn write_all<'a, M: Machine, T: Plain + 'a>(
    machine: &mut M,
    mut to: u64,
    pieces: impl Iterator<Item = &'a [T]>,
) -> Result<(), DeviceError> {
    for piece in pieces {
        machine.write(to, piece)?;
        to = after::<T>(to, piece.len());
    }
    Ok(())
}

impl<M: Machine> Update<M> {
    fn take(&mut self, update: &DeviceUpdate) -> Result<(), DeviceError> {
        let mut plan = Plan::new(update);
        let bytes = plan.place(0);
        if bytes > self.room.0 {
            self.room = (0, 0);
            self.room = (bytes, self.machine.reserve(bytes)?);
        }
        plan.place(self.room.1);
        let (at, machine, parts) = (&plan.at, &mut self.machine, &update.parts);
        write_all(machine, at.observations, parts.iter().map(|part| part.observations))?;
        write_all(machine, at.actions, parts.iter().map(|part| part.actions))?;
        write_all(machine, at.means, parts.iter().map(|part| part.means))?;
        write_all(machine, at.log_probs, parts.iter().map(|part| part.log_probs))?;
        write_all(machine, at.advantages, parts.iter().map(|part| part.advantages))?;
        write_all(machine, at.returns, parts.iter().map(|part| part.returns))?;
        write_all(machine, at.values, parts.iter().map(|part| part.values))?;
        write_all(machine, at.order, parts.iter().map(|part| part.order))?;
        let robot_of: Vec<i32> = parts.iter().flat_map(|part| part.robot_of).map(|&robot| whole(robot)).collect();
        machine.write(at.robot_of, &robot_of)?;
        for (which, [index, sign]) in at.mirrors.into_iter().enumerate() {
            let (indices, signs): (Vec<i32>, Vec<f32>) =
                update.mirrors.iter().flat_map(|of| of[which]).map(|&(index, sign)| (whole(index), sign)).unzip();
            machine.write(index, &indices)?;
            machine.write(sign, &signs)?;
        }
        write_all(machine, at.parts, plan.batches.iter().map(|(parts, _)| &parts[..]))?;
        let complete: Vec<i32> = update.complete.iter().map(|&count| whole(count)).collect();
        machine.write(at.complete, &complete)?;
        for (network, of) in plan.networks.iter().zip(&update.networks) {
            if let Some(columns) = of.columns {
                let columns: Vec<i32> = columns.iter().map(|&column| whole(column)).collect();
                machine.write(network.columns, &columns)?;
            }
            for (to, from) in network.statistics.into_iter().zip(of.statistics.into_iter().flatten()) {
                machine.write(to, from)?;
            }
            for (to, from) in network.numbers.into_iter().zip(of.numbers) {
                machine.write(to, from)?;
            }
        }
        self.plan = plan;
        Ok(())
    }

    fn compute(&mut self, batch: &DeviceBatch) -> Result<DeviceSums, DeviceError> {
        let Self { machine, plan, .. } = self;
        machine.write(plan.at.inverse, &batch.inverse)?;
        machine.write(plan.at.scalars, &batch.of_robots)?;
        machine.write(plan.at.start, &batch.start)?;
        let (at, number, rows) = (&plan.at, batch.batch, plan.batches[batch.batch].1);
        machine.launch(&Launch::Rows(Rows {
            part: plan.parts_at(number),
            order: at.order,
            robot_of: at.robot_of,
            sample: at.sample,
            robot: at.robot,
            blocks: blocks_of(rows, THREADS),
            parts: whole(plan.parts),
            rows: whole(rows),
            passes: whole(plan.passes),
            symmetry: plan.symmetry,
            epoch: whole(batch.epoch),
        }))?;
        machine.launch(&plan.inputs(rows))?;
        let layers = plan.networks.iter().map(|network| network.layers.len()).max().unwrap_or(0);
        for layer in 0..layers {
            machine.launch(&plan.forward(layer, rows))?;
        }
        machine.launch(&plan.surrogate(rows, batch.weight))?;
        machine.launch(&plan.value(rows, batch.weight))?;
        machine.launch(&plan.chains(number))?;
        for step in 0..layers {
            machine.launch(&plan.weights_back(number, step))?;
            if step + 1 < layers {
                machine.launch(&plan.back(step, rows))?;
            }
        }
        machine.launch(&plan.total())?;
        let chunks: Vec<usize> = plan.networks.iter().map(Network::chunks).collect();
        let mut numbers = vec![0.0f64; plan.parts * FIGURES + chunks.iter().sum::<usize>() * WIDTH];
        machine.read(at.figures, &mut numbers)?;
        let (figures, squares) = numbers.split_at(plan.parts * FIGURES);
        let (actor, critic) = squares.split_at(chunks[0] * WIDTH);
        Ok(DeviceSums {
            parts: figures.as_chunks().0.to_vec(),
            squares: [actor, critic].map(|squares| squares.as_chunks().0.to_vec()),
        })
    }

    fn take_step(&mut self, rates: [Rates; 2]) -> Result<Vec<Line>, DeviceError> {
        self.machine.launch(&self.plan.step(rates))?;
        let actor = &self.plan.networks[0];
        let mut deviations = vec![Line::ZERO; lines_of(actor.num_deviations)];
        self.machine.read(after::<f32>(actor.numbers[0], actor.first_deviation), &mut deviations)?;
        Ok(deviations)
    }

    fn give(&mut self) -> Result<[[Vec<Line>; 3]; 2], DeviceError> {
        let mut all: [[Vec<Line>; 3]; 2] = Default::default();
        for (network, all) in self.plan.networks.iter().zip(&mut all) {
            for (&from, to) in network.numbers.iter().zip(all) {
                to.resize(network.lines, Line::ZERO);
                self.machine.read(from, to)?;
            }
        }
        Ok(all)
    }
}

/// The text of an error; the CPU goes on, so that there is no remedy to name.
fn failure(error: DeviceError) -> DeviceFailure {
    DeviceFailure(error.to_string())
}

impl<M: Machine> UpdateDevice for Update<M> {
    fn name(&self) -> &str {
        self.machine.name()
    }

    fn begin(&mut self, update: &DeviceUpdate) -> Result<(), DeviceFailure> {
        self.take(update).map_err(failure)
    }

    fn gradients(&mut self, batch: &DeviceBatch) -> Result<DeviceSums, DeviceFailure> {
        self.compute(batch).map_err(failure)
    }

    fn step(&mut self, rates: [Rates; 2]) -> Result<Vec<Line>, DeviceFailure> {
        self.take_step(rates).map_err(failure)
    }

    fn networks(&mut self) -> Result<[[Vec<Line>; 3]; 2], DeviceFailure> {
        self.give().map_err(failure)
    }
}
