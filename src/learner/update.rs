//! The update: for every mini-batch the gradients of both networks part by part, their sums, and a step of Adam.

use polypod_dynamics::lanes::Kernel;

use crate::adam::{Rates, Step, Sum};
use crate::gaussian::{Gaussian, Surrogate};
use crate::learner::{Learner, Team, with_tile};
use crate::lines::{Line, lines_of};
use crate::matrix::Matrix;
use crate::moments::Moments;
use crate::network::{Mirror, Net, mirrored};
use crate::rollout::Part;
use crate::settings::{Settings, Symmetry};

/// Means over the mini-batches of an update.
#[derive(Clone, Copy, Debug, Default)]
pub struct Losses {
    /// Value loss.
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
/// What a norm is divided by at least.
const EPSILON: f64 = 1e-6;
/// The learning rate is multiplied or divided by this where the divergence is far from the one that is wanted.
const RATE_STEP: f64 = 1.5;
/// Learning rates that the adaptive schedule keeps to.
const RATES: [f64; 2] = [1e-5, 1e-2];

/// What a part's samples of a mini-batch give for a network.
#[derive(Clone, Debug, Default)]
struct Gradient {
    lines: Vec<Line>,
    loss: f64,
    /// Divergence from the policy that collected the samples, summed over those that are no images.
    divergence: f64,
    /// Samples that are no images.
    samples: usize,
}

/// What all parts share in a mini-batch.
struct MiniBatch<'a> {
    settings: &'a Settings,
    matrix: Matrix,
    mirrors: &'a [Mirror],
    epoch: usize,
    batch: usize,
    /// One over the number of samples, mirror images included.
    weight: f32,
    new: &'a Gaussian,
    divergence_of_deviations: f32,
    /// Mean and one over the deviation of the advantages, of each robot.
    advantages: &'a [(f32, f32)],
}

/// A sample, and its mirror where its image is meant.
type Sample<'a> = (usize, Option<&'a Mirror>);

impl MiniBatch<'_> {
    /// Calls `f` with the samples of a part in tiles of at most `size`.
    fn for_each_tile(&self, part: &Part, size: usize, mut f: impl FnMut(&[Sample])) {
        let samples = part.mini_batch(self.batch, self.settings.options.algorithm.num_mini_batches);
        let mut tile = Vec::with_capacity(size);
        for pass in 0..self.settings.options.symmetry.rows_per_sample() {
            for chunk in samples.chunks(size) {
                tile.clear();
                tile.extend(chunk.iter().map(|&sample| {
                    let sample = sample as usize;
                    let is_image = match self.settings.options.symmetry {
                        Symmetry::None => false,
                        Symmetry::Both => pass == 1,
                        Symmetry::Alternate => (sample + self.epoch) % 2 == 1,
                    };
                    (sample, is_image.then(|| &self.mirrors[part.robot_of[sample % part.len()]]))
                }));
                f(&tile);
            }
        }
    }

    /// The part's gradient of the surrogate loss and the entropy.
    fn actor_gradient(&self, net: &Net, part: &Part, gradient: &mut Gradient) {
        let lines = [lines_of(self.settings.num_obs), lines_of(self.settings.num_actions)];
        let first_extra = net.perceptron.first_extra();
        let mut images = vec![Line::ZERO; 2 * lines[1]];
        let mut mean = vec![Line::ZERO; lines[1]];
        with_tile(|tile| {
            self.for_each_tile(part, net.perceptron.rows_of_tile(), |samples| {
                let observation = |sample: usize| &part.observations[sample * lines[0]..][..lines[0]];
                let rows = net.fill(samples.iter().map(|&(sample, mirror)| (observation(sample), mirror)), tile);
                net.perceptron.forward(self.matrix, rows, tile);
                tile.delta.resize(rows * lines[1], Line::ZERO);
                tile.delta.fill(Line::ZERO);
                for (row, &(sample, mirror)) in samples.iter().enumerate() {
                    let at = sample * lines[1];
                    let (mut action, mut old_mean) = (&part.actions[at..][..lines[1]], &part.means[at..][..lines[1]]);
                    if let Some(mirror) = mirror {
                        let (first, second) = images.split_at_mut(lines[1]);
                        mirrored(action, &mirror.action, first);
                        mirrored(old_mean, &mirror.action, second);
                        (action, old_mean) = (first, second);
                    }
                    for (panel, line) in mean.iter_mut().enumerate() {
                        *line = tile.output()[panel * rows + row];
                    }
                    if mirror.is_none() {
                        gradient.divergence +=
                            f64::from(self.new.divergence(&mean, old_mean, self.divergence_of_deviations));
                        gradient.samples += 1;
                    }
                    let (about, scale) = self.advantages[part.robot_of[sample % part.len()]];
                    let surrogate = Surrogate {
                        clip: self.settings.options.algorithm.clip_param,
                        advantage: (part.advantages[sample] - about) * scale,
                        old_log_prob: part.log_probs[sample],
                        weight: self.weight,
                    };
                    let deviation = &mut gradient.lines[first_extra..];
                    gradient.loss += f64::from(self.new.surrogate(action, &mut mean, deviation, &surrogate));
                    for (panel, line) in mean.iter().enumerate() {
                        tile.delta[panel * rows + row] = *line;
                    }
                }
                net.perceptron.backward(self.matrix, rows, tile, &mut gradient.lines);
            });
        });
    }

    /// The part's gradient of the value loss.
    fn critic_gradient(&self, net: &Net, part: &Part, gradient: &mut Gradient) {
        let lines = lines_of(self.settings.num_obs);
        let algorithm = &self.settings.options.algorithm;
        with_tile(|tile| {
            self.for_each_tile(part, net.perceptron.rows_of_tile(), |samples| {
                let observation = |sample: usize| &part.observations[sample * lines..][..lines];
                let rows = net.fill(samples.iter().map(|&(sample, mirror)| (observation(sample), mirror)), tile);
                net.perceptron.forward(self.matrix, rows, tile);
                tile.delta.resize(rows, Line::ZERO);
                tile.delta.fill(Line::ZERO);
                for (row, &(sample, _)) in samples.iter().enumerate() {
                    let (value, target, old) = (tile.output()[row].0[0], part.returns[sample], part.values[sample]);
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
                net.perceptron.backward(self.matrix, rows, tile, &mut gradient.lines);
            });
        });
    }
}

impl Learner {
    /// Learns from the samples of the iteration, beginning with a learning rate.
    pub fn update(&mut self, team: &impl Team, learning_rate: f64) -> Losses {
        let algorithm = self.settings.options.algorithm.clone();
        let mut losses = Losses { learning_rate, ..Losses::default() };
        let empty = |net: &Net| Gradient { lines: vec![Line::ZERO; net.gradient.len()], ..Gradient::default() };
        let mut gradients: Vec<[Gradient; 2]> =
            self.parts.iter().map(|_| [empty(&self.actor), empty(&self.critic)]).collect();
        let mini_batches = algorithm.num_mini_batches;
        for epoch in 0..algorithm.num_learning_epochs {
            for batch in 0..mini_batches {
                let samples: usize = self.parts.iter().map(|part| part.mini_batch(batch, mini_batches).len()).sum();
                let rows = samples * self.settings.options.symmetry.rows_per_sample();
                let entropy = self.compute_gradients(team, (epoch, batch), rows, &mut gradients);
                let sum = |f: fn(&[Gradient; 2]) -> f64| gradients.iter().map(f).sum::<f64>();
                losses.surrogate += sum(|[actor, _]| actor.loss) / rows as f64;
                losses.value += sum(|[_, critic]| critic.loss) / rows as f64;
                losses.entropy += entropy;
                if let Some(desired) = algorithm.desired_kl {
                    // an image's divergence also has what the policy lacks in symmetry
                    let samples: usize = gradients.iter().map(|[actor, _]| actor.samples).sum();
                    if samples > 0 {
                        let divergence = sum(|[actor, _]| actor.divergence) / samples as f64;
                        losses.learning_rate = adapted(losses.learning_rate, divergence, desired);
                    }
                }
                self.step_networks(team, &gradients, losses.learning_rate);
            }
        }
        let updates = (algorithm.num_learning_epochs * mini_batches) as f64;
        losses.surrogate /= updates;
        losses.value /= updates;
        losses.entropy /= updates;
        self.update_normalizers(team);
        losses
    }

    /// Fills `gradients` of each part and network, of a mini-batch with so many rows; returns the entropy.
    fn compute_gradients(
        &self,
        team: &impl Team,
        (epoch, batch): (usize, usize),
        rows: usize,
        gradients: &mut [[Gradient; 2]],
    ) -> f64 {
        let algorithm = &self.settings.options.algorithm;
        let new = Gaussian::new(self.actor.perceptron.extra(), self.settings.num_actions);
        let advantages = if algorithm.normalize_advantage_per_mini_batch {
            self.scale_of_mini_batch(batch)
        } else {
            self.advantage_scale.clone()
        };
        let shared = MiniBatch {
            settings: &self.settings,
            matrix: self.matrix,
            mirrors: &self.mirrors,
            epoch,
            batch,
            weight: 1.0 / rows as f32,
            new: &new,
            divergence_of_deviations: new.divergence_of_deviations(&self.old),
            advantages: &advantages,
        };
        let mut tasks = Vec::with_capacity(2 * self.parts.len());
        for (place, (part, [actor, critic])) in self.parts.iter().zip(gradients).enumerate() {
            tasks.push((place, part, &self.actor, actor, true));
            tasks.push((place, part, &self.critic, critic, false));
        }
        team.for_each(tasks, |(place, part, net, gradient, is_actor)| {
            gradient.lines.fill(Line::ZERO);
            (gradient.loss, gradient.divergence, gradient.samples) = (0.0, 0.0, 0);
            if is_actor {
                if place == 0 {
                    new.add_entropy(algorithm.entropy_coef, &mut gradient.lines[net.perceptron.first_extra()..]);
                }
                shared.actor_gradient(net, part, gradient);
            } else {
                shared.critic_gradient(net, part, gradient);
            }
        });
        f64::from(new.entropy())
    }

    /// What brings the advantages of a mini-batch to one scale.
    fn scale_of_mini_batch(&self, batch: usize) -> Vec<(f32, f32)> {
        let batches = self.settings.options.algorithm.num_mini_batches;
        let of = |part: &Part| {
            let samples = part.mini_batch(batch, batches).iter();
            Moments::of(samples.map(|&sample| part.advantages[sample as usize]))
        };
        let all = self.parts.iter().map(of).fold(Moments::default(), Moments::merge);
        vec![all.scale(all.unbiased_variance()); self.mirrors.len()]
    }

    /// Sums the parts' gradients, limits their norms, and takes a step with each network.
    fn step_networks(&mut self, team: &impl Team, gradients: &[[Gradient; 2]], learning_rate: f64) {
        let dispatch = self.dispatch;
        let limit = self.settings.options.algorithm.max_grad_norm;
        let mut squares = [&self.actor, &self.critic].map(|net| vec![0.0; net.gradient.len().div_ceil(CHUNK)]);
        let mut tasks = Vec::new();
        for (which, (net, squares)) in [&mut self.actor, &mut self.critic].into_iter().zip(&mut squares).enumerate() {
            for (k, (total, square)) in net.gradient.chunks_mut(CHUNK).zip(squares).enumerate() {
                tasks.push((which, k * CHUNK, total, square));
            }
        }
        team.for_each(tasks, |(which, first, total, square)| {
            let end = first + total.len();
            let parts = gradients.iter().map(|of| &of[which].lines[first..end]).collect();
            *square = dispatch.vectorize(Sum { parts, total });
        });

        let mut tasks = Vec::new();
        for (net, squares) in [&mut self.actor, &mut self.critic].into_iter().zip(&squares) {
            let norm = squares.iter().sum::<f64>().sqrt();
            net.steps += 1;
            let rates = Rates::new(learning_rate, net.steps, (limit / (norm + EPSILON)).min(1.0));
            let weights = net.perceptron.weights_mut().chunks_mut(CHUNK);
            let moments = net.first.chunks_mut(CHUNK).zip(net.second.chunks_mut(CHUNK));
            for ((weights, gradient), (first, second)) in weights.zip(net.gradient.chunks(CHUNK)).zip(moments) {
                tasks.push(Step { weights, first, second, gradient, rates });
            }
        }
        team.for_each(tasks, |step| dispatch.vectorize(step));
        team.for_each(vec![&mut self.actor, &mut self.critic], |net| net.perceptron.transpose());
    }

    /// Takes the observations of the iteration into the networks' statistics.
    fn update_normalizers(&mut self, team: &impl Team) {
        let nets = [&mut self.actor, &mut self.critic];
        let mut normalizers: Vec<_> = nets.into_iter().filter_map(|net| net.normalizer.as_mut()).collect();
        let Some(about) = normalizers.first().map(|normalizer| normalizer.mean.clone()) else { return };
        let mut moments = vec![Vec::new(); self.parts.len()];
        let dispatch = self.dispatch;
        team.for_each(self.parts.iter().zip(&mut moments).collect(), |(part, moments)| {
            *moments = dispatch.vectorize(OfObservations { part, about: &about });
        });
        let mut all = vec![Moments::default(); about.len()];
        for part in moments {
            for (all, of) in all.iter_mut().zip(part) {
                *all = all.merge(of);
            }
        }
        for normalizer in &mut normalizers {
            normalizer.update(&all);
        }
    }
}

/// [`Part::observation_moments`], compiled for the instruction set.
struct OfObservations<'a> {
    part: &'a Part,
    about: &'a [f32],
}

impl Kernel<f32> for OfObservations<'_> {
    type Output = Vec<Moments>;
    #[inline(always)]
    fn run(self) -> Vec<Moments> {
        self.part.observation_moments(self.about)
    }
}

/// The learning rate that follows a divergence. The first mini-batch has the policy that collected the samples: its divergence is exactly
/// zero, and changes nothing.
fn adapted(rate: f64, divergence: f64, desired: f64) -> f64 {
    if divergence > desired * 2.0 {
        (rate / RATE_STEP).max(RATES[0])
    } else if divergence < desired / 2.0 && divergence > 0.0 {
        (rate * RATE_STEP).min(RATES[1])
    } else {
        rate
    }
}
