//! Scaling of rewards, so that no robot drowns the others in a shared learner.
//!
//! Each robot's rewards are divided by the running deviation of that robot's discounted return.

use crate::moments::Moments;

/// Least deviation: the first ones would be zero.
pub(crate) const EPSILON: f64 = 1e-8;

/// Running statistics of the discounted returns of each robot.
#[derive(Clone, Debug)]
pub struct RewardScale {
    /// Samples so far, `[robots]`.
    pub count: Vec<f64>,
    /// Mean of the discounted returns, `[robots]`.
    pub mean: Vec<f64>,
    /// Variance of the discounted returns, `[robots]`.
    pub variance: Vec<f64>,
}

impl RewardScale {
    /// Statistics before the first reward.
    pub(crate) fn new(robots: usize) -> Self {
        Self { count: vec![EPSILON; robots], mean: vec![0.0; robots], variance: vec![1.0; robots] }
    }

    /// Takes in the returns of one step and returns the factor for a robot's rewards of that step.
    pub(crate) fn update(&mut self, robot: usize, step: Moments) -> f32 {
        if step.count > 0.0 {
            let (count, mean) = (self.count[robot], self.mean[robot]);
            let before = Moments { count, mean, squares: self.variance[robot] * count };
            let both = before.merge(step);
            (self.count[robot], self.mean[robot]) = (both.count, both.mean);
            self.variance[robot] = both.variance();
        }
        (1.0 / (self.variance[robot] + EPSILON).sqrt()) as f32
    }
}
