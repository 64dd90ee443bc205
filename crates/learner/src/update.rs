//! The update: for every mini-batch the gradients of both networks part by part, their sums, and a
//! step of Adam.

use std::ops::Range;

use polypod_lanes::{Kernel, SimdDispatch};

use crate::adam::{Rates, Step};
use crate::bodies::Bodies;
use crate::gaussian::{Distributions, RANGE, Surrogate};
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
    /// Number of samples.
    samples: usize,
    new: &'a Distributions,
    /// Divergence of each distribution.
    divergence_of_deviations: &'a [f32],
    /// Mean and one over the deviation of the advantages, of each robot.
    advantages: &'a [(f32, f32)],
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
        let mut counts = vec![0usize; self.new.gaussians.len()];
        for &sample in part.mini_batch(self.batch, algorithm.num_mini_batches) {
            counts[self.new.index(part.robot_of[sample as usize % part.len()])] += 1;
        }
        let shares = counts.into_iter().map(|count| count as f64 / self.samples as f64);
        self.new.gaussians.iter().zip(shares).fold(0.0, |entropy, (gaussian, share)| {
            gaussian.add_entropy(algorithm.entropy_coef * share as f32, deviation);
            entropy + share * f64::from(gaussian.entropy())
        })
    }

    /// The part's gradient of the surrogate loss.
    fn actor_gradient(&self, net: &Net, part: &Part, gradient: &mut Gradient) {
        let (lines, bodies, are_of_bodies) =
            (lines_of(self.settings.num_actions), &part.bodies[0], self.new.are_of_bodies());
        let first_deviation = net.first_deviation();
        let mut images = vec![Line::ZERO; 2 * lines];
        let mut mean = vec![Line::ZERO; lines];
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
                        false => (
                            self.new.of(robot),
                            &mut gradient.lines[first_deviation..],
                            self.divergence_of_deviations[self.new.index(robot)],
                        ),
                    };
                    if mirror.is_none() {
                        gradient.divergence += f64::from(new.divergence(&mean, old_mean, of_deviations));
                        gradient.samples += 1;
                    }
                    let (about, scale) = self.advantages[robot];
                    let surrogate = Surrogate {
                        clip: self.settings.options.algorithm.clip_param,
                        advantage: (part.advantages[sample] - about) * scale,
                        old_log_prob: part.log_probs[sample],
                        weight: self.weight,
                    };
                    gradient.loss += f64::from(new.surrogate(action, &mut mean, deviation, &surrogate));
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

impl Learner {
    /// Learns from the samples of the iteration, beginning with a learning rate.
    ///
    /// # Errors
    /// Another worker is gone.
    pub fn update(&mut self, team: &impl Team, learning_rate: f64) -> Result<Losses, LearnerError> {
        let algorithm = self.settings.options.algorithm.clone();
        let mut losses = Losses { learning_rate, ..Losses::default() };
        let empty = |net: &Net| Gradient { lines: vec![Line::ZERO; net.gradient.len()], ..Gradient::default() };
        let mut gradients: Vec<[Gradient; 2]> =
            self.parts.iter().map(|_| [empty(&self.actor), empty(&self.critic)]).collect();
        let mini_batches = algorithm.num_mini_batches;
        for epoch in 0..algorithm.num_learning_epochs {
            for batch in 0..mini_batches {
                let samples = self.samples_of(batch);
                let rows = samples * self.settings.options.symmetry.rows_per_sample();
                let entropy = self.compute_gradients(team, (epoch, batch), rows, &mut gradients);
                let Total { sums: [surrogate, value, divergence, seen, of_samples], squares } =
                    self.sum_gradients(team, &gradients)?;
                losses.surrogate += surrogate / rows as f64;
                losses.value += value / rows as f64;
                losses.entropy += entropy.unwrap_or(of_samples);
                if let Some(desired) = algorithm.desired_kl {
                    // a mirror image's divergence also contains the policy's lack of symmetry
                    if seen > 0.0 {
                        losses.learning_rate = adapted(losses.learning_rate, divergence / seen, desired);
                    }
                }
                self.step_networks(team, squares, losses.learning_rate);
            }
        }
        let updates = (algorithm.num_learning_epochs * mini_batches) as f64;
        losses.surrogate /= updates;
        losses.value /= updates;
        losses.entropy /= updates;
        self.update_normalizers(team)?;
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
        let algorithm = &self.settings.options.algorithm;
        let new = Distributions::new(self.actor.deviations(), &self.settings);
        let pairs = new.gaussians.iter().zip(&self.old.gaussians);
        let divergence_of_deviations: Vec<f32> = pairs.map(|(new, old)| new.divergence_of_deviations(old)).collect();
        let advantages = match self.mini_batch_scale.get(batch) {
            Some(&scale) => vec![scale; self.mirrors.len()],
            None => self.advantage_scale.clone(),
        };
        let shared = MiniBatch {
            settings: &self.settings,
            matrix: self.matrix,
            mirrors: &self.mirrors,
            epoch,
            batch,
            weight: 1.0 / rows as f32,
            samples: rows / self.settings.options.symmetry.rows_per_sample(),
            new: &new,
            divergence_of_deviations: &divergence_of_deviations,
            advantages: &advantages,
        };
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
                match new.only() {
                    None if !new.are_of_bodies() => gradient.entropy = shared.entropy_of(part, deviation),
                    Some(only) if part.envs.start == 0 => only.add_entropy(algorithm.entropy_coef, deviation),
                    _ => {}
                }
                shared.actor_gradient(net, part, gradient);
            } else {
                shared.critic_gradient(net, part, gradient);
            }
        });
        new.only().map(|only| f64::from(only.entropy()))
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

    /// Limits the norms of the gradients, given their squares, and takes a step with each network.
    fn step_networks(&mut self, team: &impl Team, squares: [f64; 2], learning_rate: f64) {
        let dispatch = self.dispatch;
        let limit = self.settings.options.algorithm.max_grad_norm;
        let mut tasks = Vec::new();
        for (net, squares) in [&mut self.actor, &mut self.critic].into_iter().zip(squares) {
            let norm = squares.sqrt();
            net.steps += 1;
            let rates = Rates::new(learning_rate, net.steps, (limit / (norm + EPSILON)).min(1.0));
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
