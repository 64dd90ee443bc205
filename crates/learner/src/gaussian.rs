//! The policy's distribution: independent normal numbers with learnt deviations that do not depend
//! on the observation.

use polypod_lanes::elementary::exp;

use crate::lines::{Line, WIDTH, lines_of};
use crate::settings::Settings;

/// Range of the policy's deviations, as in rsl_rl's `GaussianDistribution`. Each step of the
/// optimiser ends within it.
pub(crate) const RANGE: [f32; 2] = [1e-6, 1e6];
const HALF_LOG_TWO_PI: f32 = 0.918_938_5;

/// Distribution of a robot's actions: deviations, and values that are computed from them once.
#[derive(Clone, Debug)]
pub(crate) struct Gaussian {
    /// The actions that the robot has.
    actions: Vec<usize>,
    num_actions: usize,
    /// `[lines of an action]`, 0 beyond the actions and where the robot has none.
    pub(crate) deviation: Vec<Line>,
    pub(crate) inverse: Vec<Line>,
    /// Part of the log-density that is the same in any state: minus the sum of the deviations'
    /// logarithms, minus that of `sqrt(2 pi)`.
    pub(crate) constant: f32,
}

/// Hyperparameters of the surrogate loss, and the sample's part of it.
pub(crate) struct Surrogate {
    pub(crate) clip: f32,
    pub(crate) advantage: f32,
    pub(crate) old_log_prob: f32,
    /// Factor on the loss' derivative: one over the number of samples.
    pub(crate) weight: f32,
}

impl Gaussian {
    /// A distribution with `deviation` `[lines of an action]`, limited to [`RANGE`], over a robot's
    /// actions, in order.
    pub(crate) fn new(deviation: &[Line], num_actions: usize, actions: Vec<usize>) -> Self {
        let mut this = Self {
            actions,
            num_actions,
            deviation: vec![Line::ZERO; lines_of(num_actions)],
            inverse: vec![Line::ZERO; lines_of(num_actions)],
            constant: 0.0,
        };
        for &i in &this.actions {
            let sigma = deviation[i / WIDTH].0[i % WIDTH].clamp(RANGE[0], RANGE[1]);
            this.deviation[i / WIDTH].0[i % WIDTH] = sigma;
            this.inverse[i / WIDTH].0[i % WIDTH] = 1.0 / sigma;
            this.constant -= libm::logf(sigma) + HALF_LOG_TWO_PI;
        }
        this
    }

    /// Differential entropy.
    pub(crate) fn entropy(&self) -> f32 {
        0.5 * self.actions.len() as f32 - self.constant
    }

    /// Sets the means of actions that the robot lacks to zero.
    pub(crate) fn clear_absent(&self, mean: &mut [Line]) {
        if self.actions.len() < self.num_actions {
            for (i, mean) in mean.iter_mut().flat_map(|line| &mut line.0).enumerate() {
                if self.actions.binary_search(&i).is_err() {
                    *mean = 0.0;
                }
            }
        }
    }

    /// Logarithm of the density of an action.
    pub(crate) fn log_prob(&self, action: &[Line], mean: &[Line]) -> f32 {
        let mut sum = 0.0;
        for ((action, mean), inverse) in action.iter().zip(mean).zip(&self.inverse) {
            let mut squares = Line::ZERO;
            for i in 0..WIDTH {
                let z = (action.0[i] - mean.0[i]) * inverse.0[i];
                squares.0[i] = z * z;
            }
            sum += squares.sum();
        }
        self.constant - 0.5 * sum
    }

    /// The clipped surrogate loss of an action under this distribution, and its derivatives: those
    /// of the mean are written to `mean`, which holds it; those of the deviations are added to
    /// `deviation`.
    #[inline(always)]
    pub(crate) fn surrogate(
        &self,
        action: &[Line],
        mean: &mut [Line],
        deviation: &mut [Line],
        sample: &Surrogate,
    ) -> f32 {
        let ratio = exp(self.log_prob(action, mean) - sample.old_log_prob);
        let free = -sample.advantage * ratio;
        let clipped = -sample.advantage * ratio.clamp(1.0 - sample.clip, 1.0 + sample.clip);
        // where the clipped loss is the greater one, it does not depend on the policy
        let slope = if free >= clipped { free * sample.weight } else { 0.0 };
        for (((action, mean), inverse), deviation) in action.iter().zip(mean).zip(&self.inverse).zip(deviation) {
            for i in 0..WIDTH {
                let z = (action.0[i] - mean.0[i]) * inverse.0[i];
                mean.0[i] = slope * z * inverse.0[i];
                deviation.0[i] += slope * (z * z - 1.0) * inverse.0[i];
            }
        }
        free.max(clipped)
    }

    /// Factor of an image's derivatives in [`Gaussian::mirror_slopes`], given the weight of its
    /// loss.
    pub(crate) fn pull_of_images(&self, weight: f32) -> f32 {
        2.0 * weight / self.actions.len().max(1) as f32
    }

    /// The derivatives of an image's mirror loss: the square of the difference between the mean and
    /// `target`, averaged over the robot's actions. The target is the mirrored mean of the policy
    /// that collected the sample.
    #[inline(always)]
    pub(crate) fn mirror_slopes(&self, mean: &[Line], target: &[Line], pull: f32, slopes: &mut [Line]) {
        for (k, inverse) in self.inverse.iter().enumerate() {
            for i in 0..WIDTH {
                // the robot has the action
                let has = inverse.0[i] > 0.0;
                slopes[k].0[i] = if has { pull * (mean[k].0[i] - target[k].0[i]) } else { 0.0 };
            }
        }
    }

    /// Kullback-Leibler divergence of this distribution from an older one, whose deviations add
    /// `of_deviations`; exactly zero if they are the same.
    #[inline(always)]
    pub(crate) fn divergence(&self, mean: &[Line], old_mean: &[Line], of_deviations: f32) -> f32 {
        let mut sum = 0.0;
        for (k, inverse) in self.inverse.iter().enumerate() {
            let mut terms = Line::ZERO;
            for i in 0..WIDTH {
                let z = (old_mean[k].0[i] - mean[k].0[i]) * inverse.0[i];
                terms.0[i] = z * z;
            }
            sum += terms.sum();
        }
        of_deviations + 0.5 * sum
    }

    /// The part of [`Gaussian::divergence`] that does not depend on the means.
    pub(crate) fn divergence_of_deviations(&self, old: &Self) -> f32 {
        let mut sum = 0.0;
        for &i in &self.actions {
            let ratio = old.deviation[i / WIDTH].0[i % WIDTH] / self.deviation[i / WIDTH].0[i % WIDTH];
            sum += 0.5 * (ratio * ratio - 1.0) - libm::logf(ratio);
        }
        sum
    }

    /// Deviations of the actions that the robot has, in order.
    pub(crate) fn deviations(&self) -> impl Iterator<Item = f32> {
        self.actions.iter().map(|&i| self.deviation[i / WIDTH].0[i % WIDTH])
    }

    /// Adds the derivative of `-coefficient * entropy` to those of the deviations.
    pub(crate) fn add_entropy(&self, coefficient: f32, deviation: &mut [Line]) {
        for (line, inverse) in deviation.iter_mut().zip(&self.inverse) {
            for i in 0..WIDTH {
                line.0[i] -= coefficient * inverse.0[i];
            }
        }
    }
}

/// The distributions of all robots, one for each set of actions that a robot has.
#[derive(Clone, Debug)]
pub(crate) struct Distributions {
    /// Distributions of each robot.
    of_robot: Vec<usize>,
    pub(crate) gaussians: Vec<Gaussian>,
}

impl Distributions {
    /// Distributions with `deviation` `[lines of an action]`; empty where each body has a separate
    /// one.
    pub(crate) fn new(deviation: &[Line], settings: &Settings) -> Self {
        if deviation.is_empty() {
            return Self { of_robot: Vec::new(), gaussians: Vec::new() };
        }
        let mut masks: Vec<&[bool]> = Vec::new();
        let mut this = Self { of_robot: Vec::new(), gaussians: Vec::new() };
        for robot in &settings.robots {
            let known = masks.iter().position(|mask| *mask == &robot.action_mask[..]);
            this.of_robot.push(known.unwrap_or(masks.len()));
            if known.is_none() {
                masks.push(&robot.action_mask);
                let actions = (0..settings.num_actions).filter(|action| robot.has_action(*action)).collect();
                this.gaussians.push(Gaussian::new(deviation, settings.num_actions, actions));
            }
        }
        this
    }

    /// Number of a robot's distribution.
    pub(crate) fn index(&self, robot: usize) -> usize {
        self.of_robot[robot]
    }

    /// Distribution of a robot.
    pub(crate) fn of(&self, robot: usize) -> &Gaussian {
        &self.gaussians[self.of_robot[robot]]
    }

    /// The common distribution, if all robots have the same actions.
    pub(crate) fn only(&self) -> Option<&Gaussian> {
        if let [only] = &self.gaussians[..] { Some(only) } else { None }
    }

    /// Whether each body has a separate distribution, which depends on its description.
    pub(crate) fn are_of_bodies(&self) -> bool {
        self.gaussians.is_empty()
    }
}
