//! The update: for every mini-batch the gradients of both networks part by part, their sums, and a
//! step of Adam.

use std::ops::Range;

use polypod_lanes::{Kernel, SimdDispatch};

use crate::adam::{Rates, Step};
use crate::bodies::Bodies;
use crate::device::{DeviceBatch, DeviceFailure, DeviceSums, UpdateDevice};
use crate::gaussian::{Distributions, Gaussian, RANGE, Surrogate};
use crate::joints::JointTile;
use crate::learner::{Learner, Team, with_tile};
use crate::lines::{Line, lines_of};
use crate::matrix::Matrix;
use crate::moments::Moments;
use crate::network::{Mirror, Net, NetworkName, Row, mirrored};
use crate::peers::{Message, lines, term};
use crate::rollout::{Part, parts_of, share};
use crate::settings::{LearnerError, Robot, Settings, Symmetry};
use crate::tree::{NUMBERS, SumLines, Term, Tree};

/// Means over the mini-batches of an update.
#[derive(Clone, Copy, Debug, Default)]
pub struct Losses {
    /// Loss of the critic's values.
    pub value: f64,
    /// Surrogate loss.
    pub surrogate: f64,
    /// Entropy of the policy.
    pub entropy: f64,
    /// Learning rate after the update.
    pub learning_rate: f64,
}

/// Lines that a task sums and steps.
const CHUNK: usize = 256;
/// Largest number of workers that each get the gradients of all others at once; more workers first
/// sum a piece each. With two workers both ways send the same number of bytes, and the first way
/// sends them at once.
const MOST_GATHERED: usize = 2;
/// Bytes of the figures that come with gradients.
const LOSS_BYTES: usize = size_of::<LossSums>();
/// Least divisor of a norm.
const EPSILON: f64 = 1e-6;
/// Factor or divisor of the learning rate where the divergence is far from the wanted one.
const RATE_STEP: f64 = 1.5;
/// Range of the adaptive learning rate.
const RATES: [f64; 2] = [1e-5, 1e-2];

/// Gradients of a part's samples of a mini-batch for a network.
#[derive(Clone, Debug, Default)]
struct Gradient {
    lines: Vec<Line>,
    loss: f64,
    /// Divergence from the policy that collected the samples, summed over samples that are no
    /// mirror images.
    divergence: f64,
    /// Number of samples that are no mirror images.
    samples: usize,
    /// The part's share of the mean entropy, where robots have different actions.
    entropy: f64,
}

/// Inputs that all parts share in a mini-batch.
struct MiniBatch<'a> {
    settings: &'a Settings,
    matrix: Matrix,
    mirrors: &'a [Mirror],
    epoch: usize,
    batch: usize,
    /// One over the number of samples, mirror images included.
    weight: f32,
    /// Weight of an image's mirror loss. Half of the rows are images, up to chance.
    mirror_weight: f32,
    /// Number of samples.
    samples: usize,
    policy: &'a Policy,
}

/// The policy before a step, and the advantages of its actions.
struct Policy {
    new: Distributions,
    /// Divergence of each distribution.
    divergence_of_deviations: Vec<f32>,
    /// Mean and one over the deviation of the advantages, of each robot.
    advantages: Vec<(f32, f32)>,
}

impl Policy {
    /// A robot's distribution, and its divergence.
    fn of(&self, robot: usize) -> (&Gaussian, f32) {
        (self.new.of(robot), self.divergence_of_deviations[self.new.index(robot)])
    }

    /// Entropy, where all robots have the same.
    fn entropy(&self) -> Option<f64> {
        self.new.only().map(|only| f64::from(only.entropy()))
    }
}

/// A sample, and its mirror where its image is meant.
type Sample<'a> = (usize, Option<&'a Mirror>);

impl MiniBatch<'_> {
    /// Calls `f` with the samples of a part in tiles. A network of joints gets the samples of a
    /// body one after the other.
    fn for_each_tile(&self, part: &Part, net: &Net, bodies: &Bodies, mut f: impl FnMut(&[Sample])) {
        let samples = part.mini_batch(self.batch, self.settings.options.algorithm.num_mini_batches);
        for pass in 0..self.settings.options.symmetry.rows_per_sample() {
            let sample = |&sample: &u32| {
                let sample = sample as usize;
                let is_image = match self.settings.options.symmetry {
                    Symmetry::None => false,
                    Symmetry::Both => pass == 1,
                    Symmetry::Alternate => (sample + self.epoch) % 2 == 1,
                };
                (sample, is_image.then(|| &self.mirrors[part.robot_of[sample % part.len()]]))
            };
            let mut samples: Vec<Sample> = samples.iter().map(sample).collect();
            if net.joints().is_some() {
                samples.sort_by_key(|(sample, mirror)| (bodies.of_samples[*sample], mirror.is_some()));
            }
            samples.chunks(net.rows_of_tile()).for_each(&mut f);
        }
    }

    /// Input rows of a network in a tile.
    fn rows<'a>(&self, part: &'a Part, bodies: &Bodies, samples: &[Sample<'a>]) -> Vec<Row<'a>> {
        let lines = lines_of(self.settings.num_obs);
        let row = |&(sample, mirror): &Sample<'a>| Row {
            observation: &part.observations[sample * lines..][..lines],
            mirror,
            robot: part.robot_of[sample % part.len()],
            body: bodies.of_samples.get(sample).copied().unwrap_or(0),
        };
        samples.iter().map(row).collect()
    }

    /// A tile's share of the mean entropy, where each body has a separate distribution; its
    /// derivatives are noted in the tile.
    fn entropy_of_bodies(&self, samples: &[Sample], joints: &mut JointTile) -> f64 {
        let mut counts = vec![0usize; joints.bodies().len()];
        for (row, (_, mirror)) in samples.iter().enumerate() {
            // mirror images in addition to the samples have the samples' entropy
            if mirror.is_none() || self.settings.options.symmetry == Symmetry::Alternate {
                counts[joints.body_of(row)] += 1;
            }
        }
        let mut entropy = 0.0;
        for (body, count) in counts.into_iter().enumerate() {
            let share = count as f64 / self.samples as f64;
            let (gaussian, deviation) = joints.distribution(body);
            gaussian.add_entropy(self.settings.options.algorithm.entropy_coef * share as f32, deviation);
            entropy += share * f64::from(gaussian.entropy());
        }
        entropy
    }

    /// A part's share of the mean entropy, where robots have different actions; its derivatives are
    /// added to those of the deviations.
    fn entropy_of(&self, part: &Part, deviation: &mut [Line]) -> f64 {
        let algorithm = &self.settings.options.algorithm;
        let mut counts = vec![0usize; self.policy.new.gaussians.len()];
        for &sample in part.mini_batch(self.batch, algorithm.num_mini_batches) {
            counts[self.policy.new.index(part.robot_of[sample as usize % part.len()])] += 1;
        }
        let shares = counts.into_iter().map(|count| count as f64 / self.samples as f64);
        self.policy.new.gaussians.iter().zip(shares).fold(0.0, |entropy, (gaussian, share)| {
            gaussian.add_entropy(algorithm.entropy_coef * share as f32, deviation);
            entropy + share * f64::from(gaussian.entropy())
        })
    }

    /// Begins a part's derivatives of the deviations, which are zero, with those of the entropy.
    /// Returns the part's share of the mean entropy, where robots have different actions.
    fn begin_deviations(&self, part: &Part, deviation: &mut [Line]) -> f64 {
        match self.policy.new.only() {
            None if !self.policy.new.are_of_bodies() => return self.entropy_of(part, deviation),
            Some(only) if part.envs.start == 0 => {
                only.add_entropy(self.settings.options.algorithm.entropy_coef, deviation);
            }
            _ => {}
        }
        0.0
    }

    /// The part's gradient of the surrogate loss.
    fn actor_gradient(&self, net: &Net, part: &Part, gradient: &mut Gradient) {
        let (lines, bodies, are_of_bodies) =
            (lines_of(self.settings.num_actions), &part.bodies[0], self.policy.new.are_of_bodies());
        let first_deviation = net.first_deviation();
        let mut images = vec![Line::ZERO; 2 * lines];
        let (mut mean, mut slopes) = (vec![Line::ZERO; lines], vec![Line::ZERO; lines]);
        with_tile(|tile| {
            self.for_each_tile(part, net, bodies, |samples| {
                let rows = net.fill(&self.rows(part, bodies, samples), bodies, tile);
                net.forward(self.matrix, rows, tile);
                if are_of_bodies {
                    tile.joints.compare(&bodies.old);
                    gradient.entropy += self.entropy_of_bodies(samples, &mut tile.joints);
                }
                tile.delta.resize(rows * lines, Line::ZERO);
                tile.delta.fill(Line::ZERO);
                for (row, &(sample, mirror)) in samples.iter().enumerate() {
                    let at = sample * lines;
                    let (mut action, mut old_mean) = (&part.actions[at..][..lines], &part.means[at..][..lines]);
                    if let Some(mirror) = mirror {
                        let (first, second) = images.split_at_mut(lines);
                        mirrored(action, &mirror.action, first);
                        mirrored(old_mean, &mirror.action, second);
                        (action, old_mean) = (first, second);
                    }
                    for (panel, line) in mean.iter_mut().enumerate() {
                        *line = net.output(tile)[panel * rows + row];
                    }
                    let robot = part.robot_of[sample % part.len()];
                    let (new, deviation, of_deviations) = match are_of_bodies {
                        true => {
                            let body = tile.joints.body_of(row);
                            let of_deviations = tile.joints.divergence(body);
                            let (new, deviation) = tile.joints.distribution(body);
                            (new, deviation, of_deviations)
                        }
                        false => {
                            let (new, of_deviations) = self.policy.of(robot);
                            (new, &mut gradient.lines[first_deviation..], of_deviations)
                        }
                    };
                    if mirror.is_none() {
                        gradient.divergence += f64::from(new.divergence(&mean, old_mean, of_deviations));
                        gradient.samples += 1;
                    }
                    let is_pulled = self.mirror_weight > 0.0 && mirror.is_some();
                    if is_pulled {
                        new.mirror_slopes(&mean, old_mean, new.pull_of_images(self.mirror_weight), &mut slopes);
                    }
                    let (about, scale) = self.policy.advantages[robot];
                    let surrogate = Surrogate {
                        clip: self.settings.options.algorithm.clip_param,
                        advantage: (part.advantages[sample] - about) * scale,
                        old_log_prob: part.log_probs[sample],
                        weight: self.weight,
                    };
                    gradient.loss += f64::from(new.surrogate(action, &mut mean, deviation, &surrogate));
                    if is_pulled {
                        for (mean, slopes) in mean.iter_mut().zip(&slopes) {
                            mean.0.iter_mut().zip(&slopes.0).for_each(|(mean, slope)| *mean += slope);
                        }
                    }
                    for (panel, line) in mean.iter().enumerate() {
                        tile.delta[panel * rows + row] = *line;
                    }
                }
                net.backward(self.matrix, rows, tile, &mut gradient.lines);
            });
        });
    }

    /// The part's gradient of the value loss.
    fn critic_gradient(&self, net: &Net, part: &Part, gradient: &mut Gradient) {
        let (algorithm, bodies) = (&self.settings.options.algorithm, &part.bodies[1]);
        with_tile(|tile| {
            self.for_each_tile(part, net, bodies, |samples| {
                let rows = net.fill(&self.rows(part, bodies, samples), bodies, tile);
                net.forward(self.matrix, rows, tile);
                tile.delta.resize(rows, Line::ZERO);
                tile.delta.fill(Line::ZERO);
                for (row, &(sample, _)) in samples.iter().enumerate() {
                    let (value, target, old) = (net.output(tile)[row].0[0], part.returns[sample], part.values[sample]);
                    let free = (value - target) * (value - target);
                    let (mut loss, mut slope) = (free, 2.0 * (value - target));
                    if algorithm.use_clipped_value_loss {
                        let near = old + (value - old).clamp(-algorithm.clip_param, algorithm.clip_param);
                        let clipped = (near - target) * (near - target);
                        if clipped > free {
                            // within the limits, the two differ by rounding alone
                            let is_within = (value - old).abs() <= algorithm.clip_param;
                            (loss, slope) = (clipped, if is_within { slope } else { 0.0 });
                        }
                    }
                    gradient.loss += f64::from(loss);
                    tile.delta[row].0[0] = algorithm.value_loss_coef * slope * self.weight;
                }
                net.backward(self.matrix, rows, tile, &mut gradient.lines);
            });
        });
    }
}

/// Figures that come with gradients; see [`Total`].
type LossSums = [f64; NUMBERS];

/// A mini-batch's gradients of both networks, summed over the parts of all workers.
struct Total {
    /// Surrogate loss, value loss, divergence, each summed over the samples; samples that are no
    /// images; mean entropy of the samples, where robots have different actions.
    sums: LossSums,
    /// Squared norm of each network's gradient.
    squares: [f64; 2],
}

/// Where the mini-batches of an update are computed.
enum Place<'a> {
    /// On the threads of the team, with memory for the gradients of each part.
    Host(Vec<[Gradient; 2]>),
    /// On a device, with the deviations and the numbers of steps of its networks.
    Device { device: &'a mut dyn UpdateDevice, deviations: Vec<Line>, steps: [u64; 2] },
}

/// Why an update ended early.
enum Interruption {
    Peer(LearnerError),
    Device(DeviceFailure),
}

impl From<LearnerError> for Interruption {
    fn from(error: LearnerError) -> Self {
        Self::Peer(error)
    }
}

impl From<DeviceFailure> for Interruption {
    fn from(failure: DeviceFailure) -> Self {
        Self::Device(failure)
    }
}

impl Learner {
    /// Learns from the samples of the iteration, beginning with a learning rate. Where the device
    /// fails, the CPU makes the update.
    ///
    /// # Errors
    /// Another worker is gone.
    pub fn update(&mut self, team: &impl Team, learning_rate: f64) -> Result<Losses, LearnerError> {
        let on_device = match self.device.take() {
            Some(mut device) => match self.learn_on(&mut *device, team, learning_rate) {
                Ok(losses) => {
                    self.device = Some(device);
                    Some(losses)
                }
                Err(Interruption::Peer(error)) => return Err(error),
                Err(Interruption::Device(failure)) => {
                    self.device_failure = Some(failure);
                    None
                }
            },
            None => None,
        };
        let losses = match on_device {
            Some(losses) => losses,
            None => self.learn_here(team, learning_rate)?,
        };
        self.update_normalizers(team)?;
        Ok(losses)
    }

    /// Makes the steps of an update on the threads of the team.
    fn learn_here(&mut self, team: &impl Team, learning_rate: f64) -> Result<Losses, LearnerError> {
        let empty = |net: &Net| Gradient { lines: vec![Line::ZERO; net.gradient.len()], ..Gradient::default() };
        let gradients = self.parts.iter().map(|_| [empty(&self.actor), empty(&self.critic)]).collect();
        self.learn(&mut Place::Host(gradients), team, learning_rate).map_err(|interruption| match interruption {
            Interruption::Peer(error) => error,
            Interruption::Device(failure) => LearnerError::new("device", failure.0),
        })
    }

    /// Makes the steps of an update on a device, and takes over the networks at its end.
    fn learn_on(
        &mut self,
        device: &mut dyn UpdateDevice,
        team: &impl Team,
        learning_rate: f64,
    ) -> Result<Losses, Interruption> {
        let update = self.device_update().ok_or_else(|| DeviceFailure("the networks are no perceptrons".into()))?;
        device.begin(&update)?;
        let (deviations, steps) = (self.actor.deviations().to_vec(), [self.actor.steps, self.critic.steps]);
        let mut place = Place::Device { device, deviations, steps };
        let losses = self.learn(&mut place, team, learning_rate)?;
        if let Place::Device { device, steps, .. } = place {
            let networks = device.networks()?;
            for ((net, numbers), steps) in [&mut self.actor, &mut self.critic].into_iter().zip(networks).zip(steps) {
                net.take_numbers(numbers, steps);
            }
        }
        Ok(losses)
    }

    /// Makes the steps of an update.
    fn learn(&mut self, place: &mut Place, team: &impl Team, learning_rate: f64) -> Result<Losses, Interruption> {
        let algorithm = self.settings.options.algorithm.clone();
        let mut losses = Losses { learning_rate, ..Losses::default() };
        let mini_batches = algorithm.num_mini_batches;
        for epoch in 0..algorithm.num_learning_epochs {
            for batch in 0..mini_batches {
                let samples = self.samples_of(batch);
                let rows = samples * self.settings.options.symmetry.rows_per_sample();
                let (entropy, total) = match place {
                    Place::Host(gradients) => {
                        let entropy = self.compute_gradients(team, (epoch, batch), rows, gradients);
                        (entropy, self.sum_gradients(team, gradients)?)
                    }
                    Place::Device { device, deviations, .. } => {
                        self.gradients_on(&mut **device, deviations, (epoch, batch), rows)?
                    }
                };
                let Total { sums: [surrogate, value, divergence, seen, of_samples], squares } = total;
                losses.surrogate += surrogate / rows as f64;
                losses.value += value / rows as f64;
                losses.entropy += entropy.unwrap_or(of_samples);
                if let Some(desired) = algorithm.desired_kl {
                    // a mirror image's divergence also contains the policy's lack of symmetry
                    if seen > 0.0 {
                        losses.learning_rate = adapted(losses.learning_rate, divergence / seen, desired);
                    }
                }
                match place {
                    Place::Host(_) => self.step_networks(team, squares, losses.learning_rate),
                    Place::Device { device, deviations, steps } => {
                        steps.iter_mut().for_each(|step| *step += 1);
                        *deviations = device.step(self.rates(*steps, squares, losses.learning_rate))?;
                    }
                }
            }
        }
        let updates = (algorithm.num_learning_epochs * mini_batches) as f64;
        losses.surrogate /= updates;
        losses.value /= updates;
        losses.entropy /= updates;
        Ok(losses)
    }

    /// Number of samples of a mini-batch, of all workers.
    fn samples_of(&self, batch: usize) -> usize {
        let Settings { num_envs, options, .. } = &self.settings;
        let of_part = |envs: Range<usize>| {
            share(envs.len() * options.num_steps_per_env, batch, options.algorithm.num_mini_batches).len()
        };
        parts_of(*num_envs).map(of_part).sum()
    }

    /// Fills `gradients` of each part and network for a mini-batch; returns the entropy, where all
    /// robots have the same.
    fn compute_gradients(
        &self,
        team: &impl Team,
        (epoch, batch): (usize, usize),
        rows: usize,
        gradients: &mut [[Gradient; 2]],
    ) -> Option<f64> {
        let policy = self.policy(self.actor.deviations(), batch);
        let shared = self.mini_batch((epoch, batch), rows, &policy);
        let mut tasks = Vec::with_capacity(2 * self.parts.len());
        for (part, [actor, critic]) in self.parts.iter().zip(gradients) {
            tasks.push((part, &self.actor, actor, true));
            tasks.push((part, &self.critic, critic, false));
        }
        team.for_each(tasks, |(part, net, gradient, is_actor)| {
            gradient.lines.fill(Line::ZERO);
            (gradient.loss, gradient.divergence, gradient.entropy, gradient.samples) = (0.0, 0.0, 0.0, 0);
            if is_actor {
                let deviation = &mut gradient.lines[net.first_deviation()..];
                gradient.entropy = shared.begin_deviations(part, deviation);
                shared.actor_gradient(net, part, gradient);
            } else {
                shared.critic_gradient(net, part, gradient);
            }
        });
        policy.entropy()
    }

    /// The policy whose gradients are computed, as all parts see it.
    fn policy(&self, deviations: &[Line], batch: usize) -> Policy {
        let new = Distributions::new(deviations, &self.settings);
        let pairs = new.gaussians.iter().zip(&self.old.gaussians);
        let divergence_of_deviations = pairs.map(|(new, old)| new.divergence_of_deviations(old)).collect();
        let advantages = match self.mini_batch_scale.get(batch) {
            Some(&scale) => vec![scale; self.mirrors.len()],
            None => self.advantage_scale.clone(),
        };
        Policy { new, divergence_of_deviations, advantages }
    }

    fn mini_batch<'a>(&'a self, (epoch, batch): (usize, usize), rows: usize, policy: &'a Policy) -> MiniBatch<'a> {
        MiniBatch {
            settings: &self.settings,
            matrix: self.matrix,
            mirrors: &self.mirrors,
            epoch,
            batch,
            weight: 1.0 / rows as f32,
            mirror_weight: self.settings.options.algorithm.mirror_loss_coef * 2.0 / rows as f32,
            samples: rows / self.settings.options.symmetry.rows_per_sample(),
            policy,
        }
    }

    /// Computes the gradients of a mini-batch on a device; returns what
    /// [`Learner::compute_gradients`] and [`Learner::sum_gradients`] return.
    fn gradients_on(
        &self,
        device: &mut dyn UpdateDevice,
        deviations: &[Line],
        (epoch, batch): (usize, usize),
        rows: usize,
    ) -> Result<(Option<f64>, Total), Interruption> {
        let policy = self.policy(deviations, batch);
        let shared = self.mini_batch((epoch, batch), rows, &policy);
        let lines = lines_of(self.settings.num_actions);
        let mut start = vec![Line::ZERO; self.parts.len() * lines];
        let entropies: Vec<f64> = self
            .parts
            .iter()
            .zip(start.chunks_mut(lines))
            .map(|(part, of)| shared.begin_deviations(part, of))
            .collect();
        let (mut inverse, mut of_robots) = (Vec::new(), Vec::new());
        for (robot, (mean, scale)) in policy.advantages.iter().enumerate() {
            let (new, divergence) = policy.of(robot);
            inverse.extend_from_slice(&new.inverse);
            of_robots.push([new.constant, divergence, *mean, *scale, new.pull_of_images(shared.mirror_weight)]);
        }
        let batch = DeviceBatch { epoch, batch, weight: shared.weight, inverse, of_robots, start };
        let DeviceSums { parts, squares } = device.gradients(&batch)?;
        let figures = |([surrogate, value, divergence, seen], entropy): ([f64; 4], f64)| {
            vec![[surrogate, value, divergence, seen, entropy]]
        };
        let figures: Vec<_> = parts.into_iter().zip(entropies).map(figures).collect();
        let sums = self.shares.sum(&*self.peers, &figures)?.first().copied().unwrap_or_default();
        let squares = squares.map(|chunks| chunks.iter().map(|lanes| lanes.iter().sum::<f64>()).sum());
        Ok((policy.entropy(), Total { sums, squares }))
    }

    /// Sums the parts' gradients of all workers into the networks' own, and what comes with them.
    fn sum_gradients(&mut self, team: &impl Team, parts: &[[Gradient; 2]]) -> Result<Total, LearnerError> {
        let figures = |[actor, critic]: &[Gradient; 2]| -> Vec<LossSums> {
            vec![[actor.loss, critic.loss, actor.divergence, actor.samples as f64, actor.entropy]]
        };
        let dispatch = self.dispatch;
        let lengths = [self.actor.gradient.len(), self.critic.gradient.len()];
        let leaves_of = |which: usize, range: Range<usize>| -> Vec<&[Line]> {
            parts[range].iter().map(|of| of[which].lines.as_slice()).collect()
        };
        if let (true, [(_, tree)]) = (self.shares.is_alone(), &self.shares.nodes[..]) {
            let all = |which: usize| leaves_of(which, 0..parts.len());
            let totals = [(&mut self.actor, 0), (&mut self.critic, 1)];
            let totals = totals.map(|(net, which)| (all(which), &mut net.gradient[..]));
            let squares = sum_lines(team, dispatch, tree, totals);
            let figures: Vec<_> = parts.iter().map(figures).collect();
            let sums = self.shares.sum(&*self.peers, &figures)?.first().copied().unwrap_or_default();
            return Ok(Total { sums, squares });
        }
        let mut nodes: Vec<(Vec<Line>, LossSums)> = Vec::new();
        for (range, tree) in &self.shares.nodes {
            let mut total = vec![Line::ZERO; lengths[0] + lengths[1]];
            let (actor, critic) = total.split_at_mut(lengths[0]);
            let totals = [(leaves_of(0, range.clone()), actor), (leaves_of(1, range.clone()), critic)];
            sum_lines(team, dispatch, tree, totals);
            let of_parts = parts[range.clone()].iter().map(|of| figures(of)[0]);
            nodes.push((total, tree.fold(of_parts, Term::add).unwrap_or_default()));
        }
        let (all, sums) =
            if self.shares.worker.count <= MOST_GATHERED { self.gather(&nodes)? } else { self.reduce(&nodes)? };
        let leaf = |range: Range<usize>| all.iter().map(|node| &node[range.clone()]).collect::<Vec<_>>();
        let leaves = [leaf(0..lengths[0]), leaf(lengths[0]..lengths[0] + lengths[1])];
        // a range that is already summed is one leaf
        let one = Tree::of_parts(1);
        let tree = if all.len() == 1 { &one } else { &self.shares.top };
        let [actor, critic] = leaves;
        let totals = [(actor, &mut self.actor.gradient[..]), (critic, &mut self.critic.gradient[..])];
        Ok(Total { sums, squares: sum_lines(team, dispatch, tree, totals) })
    }

    /// Gathers the subtrees of all workers, and the sums of their figures: for few workers, all of
    /// which get everything.
    fn gather(&self, nodes: &[(Vec<Line>, LossSums)]) -> Result<(Vec<Vec<Line>>, LossSums), LearnerError> {
        let mut message = Message::default();
        for (total, figures) in nodes {
            message.numbers(figures);
            message.lines(total);
        }
        let bytes = size_of_val(&nodes[0].0[..]);
        let all = self.shares.gather(&*self.peers, message, LOSS_BYTES + bytes)?;
        let sums = self.shares.top.fold(all.iter().map(|node| term(&node[..LOSS_BYTES])), Term::add);
        Ok((all.iter().map(|node| lines(&node[LOSS_BYTES..])).collect(), sums.unwrap_or_default()))
    }

    /// Reduces the subtrees of all workers, and their figures: each worker sums a piece, and sends
    /// it to the others.
    fn reduce(&self, nodes: &[(Vec<Line>, LossSums)]) -> Result<(Vec<Vec<Line>>, LossSums), LearnerError> {
        let (count, length) = (self.shares.worker.count, nodes[0].0.len());
        let piece = length.div_ceil(count);
        let range = |worker: usize| (worker * piece).min(length)..((worker + 1) * piece).min(length);
        let size = LOSS_BYTES + piece * size_of::<Line>();
        let write = |worker: usize, message: &mut Message| {
            for (total, figures) in nodes {
                message.numbers(figures);
                message.lines(&total[range(worker)]);
                message.lines(&vec![Line::ZERO; piece - range(worker).len()]);
            }
        };
        let mine = self.shares.exchange(&*self.peers, write, size)?;
        let sums = self.shares.top.fold(mine.iter().map(|node| term(&node[..LOSS_BYTES])), Term::add);
        let leaves: Vec<Vec<Line>> = mine.iter().map(|node| lines(&node[LOSS_BYTES..])).collect();
        let mut total = vec![Line::ZERO; piece];
        let leaves = leaves.iter().map(Vec::as_slice).collect();
        self.dispatch.vectorize(SumLines { tree: &self.shares.top, leaves, total: &mut total });
        let mut message = Message::default();
        message.lines(&total);
        let mut all = lines(&self.peers.gather(&message.into_bytes())?);
        all.truncate(length);
        Ok((vec![all], sums.unwrap_or_default()))
    }

    /// Rates of the networks' steps of these numbers, which limit the norms of the gradients, given
    /// their squares.
    fn rates(&self, steps: [u64; 2], squares: [f64; 2], learning_rate: f64) -> [Rates; 2] {
        let limit = self.settings.options.algorithm.max_grad_norm;
        let clip = |squares: f64| (limit / (squares.sqrt() + EPSILON)).min(1.0);
        std::array::from_fn(|net| Rates::new(learning_rate, steps[net], clip(squares[net])))
    }

    /// Takes a step with each network, given the squared norms of the gradients.
    fn step_networks(&mut self, team: &impl Team, squares: [f64; 2], learning_rate: f64) {
        let dispatch = self.dispatch;
        for net in [&mut self.actor, &mut self.critic] {
            net.steps += 1;
        }
        let rates = self.rates([self.actor.steps, self.critic.steps], squares, learning_rate);
        let mut tasks = Vec::new();
        for (net, rates) in [&mut self.actor, &mut self.critic].into_iter().zip(rates) {
            let weights = net.model.weights_mut().chunks_mut(CHUNK);
            let moments = net.first.chunks_mut(CHUNK).zip(net.second.chunks_mut(CHUNK));
            for ((weights, gradient), (first, second)) in weights.zip(net.gradient.chunks(CHUNK)).zip(moments) {
                tasks.push(Step { weights, first, second, gradient, rates });
            }
        }
        team.for_each(tasks, |step| dispatch.vectorize(step));
        // Adam has no bounds: a small deviation with a large rate would become negative
        self.actor.model.limit_deviations(RANGE);
        team.for_each(vec![&mut self.actor, &mut self.critic], |net| net.model.transpose());
    }

    /// Takes the observations of the iteration into the networks' statistics.
    fn update_normalizers(&mut self, team: &impl Team) -> Result<(), LearnerError> {
        let num_obs = self.settings.num_obs;
        for name in [NetworkName::Actor, NetworkName::Critic] {
            let mut moments = vec![None; self.parts.len()];
            let net = if name == NetworkName::Actor { &mut self.actor } else { &mut self.critic };
            let shared = &*net;
            team.for_each(self.parts.iter().zip(&mut moments).collect(), |(part, moments)| {
                *moments = shared.moments(part, name, num_obs);
            });
            let moments: Vec<Vec<Moments>> = moments.into_iter().flatten().collect();
            if !moments.is_empty() {
                net.update_normalizers(&self.shares.sum(&*self.peers, &moments)?);
            }
        }
        let about = self.actor.means(num_obs).or_else(|| self.critic.means(num_obs));
        let Some(about) = about else { return Ok(()) };
        let mut moments = vec![Vec::new(); self.parts.len()];
        let (dispatch, robots) = (self.dispatch, &self.settings.robots);
        let samples = self.settings.num_envs * self.settings.options.num_steps_per_env;
        team.for_each(self.parts.iter().zip(&mut moments).collect(), |(part, moments)| {
            *moments = dispatch.vectorize(OfObservations { part, about: &about, robots });
        });
        let all = self.shares.sum(&*self.peers, &moments)?;
        for net in [&mut self.actor, &mut self.critic] {
            if net.joints().is_none() {
                net.update_normalizer(&all, samples as u64, robots);
            }
        }
        Ok(())
    }
}

/// Sums the leaves of each network into its total, in the order of the tree; returns the squared
/// norms.
fn sum_lines(
    team: &impl Team,
    dispatch: SimdDispatch,
    tree: &Tree,
    totals: [(Vec<&[Line]>, &mut [Line]); 2],
) -> [f64; 2] {
    let mut squares = totals.each_ref().map(|(_, total)| vec![0.0; total.len().div_ceil(CHUNK)]);
    let mut tasks = Vec::new();
    for ((leaves, total), squares) in totals.into_iter().zip(&mut squares) {
        for (k, (total, square)) in total.chunks_mut(CHUNK).zip(squares).enumerate() {
            let range = k * CHUNK..k * CHUNK + total.len();
            let leaves = leaves.iter().map(|leaf| &leaf[range.clone()]).collect();
            tasks.push((SumLines { tree, leaves, total }, square));
        }
    }
    team.for_each(tasks, |(sum, square)| *square = dispatch.vectorize(sum));
    squares.map(|squares| squares.iter().sum())
}

/// [`Part::observation_moments`], compiled for the instruction set.
struct OfObservations<'a> {
    part: &'a Part,
    about: &'a [f32],
    robots: &'a [Robot],
}

impl Kernel<f32> for OfObservations<'_> {
    type Output = Vec<Moments>;
    #[inline(always)]
    fn run(self) -> Vec<Moments> {
        self.part.observation_moments(self.about, self.robots)
    }
}

/// The learning rate that follows from a divergence. The first mini-batch is evaluated by the
/// policy that collected the samples: its divergence is exactly zero, and changes nothing.
fn adapted(rate: f64, divergence: f64, desired: f64) -> f64 {
    if divergence > desired * 2.0 {
        (rate / RATE_STEP).max(RATES[0])
    } else if divergence < desired / 2.0 && divergence > 0.0 {
        (rate * RATE_STEP).min(RATES[1])
    } else {
        rate
    }
}
