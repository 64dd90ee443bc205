//! Scaling of observations to mean 0 and deviation 1, as in rsl_rl's `EmpiricalNormalization`.

use crate::lines::{Line, WIDTH, lines_of};
use crate::moments::Moments;

/// Addend of a deviation before it divides.
const EPSILON: f32 = 1e-2;

/// Running statistics of the observations.
#[derive(Clone, Debug)]
pub struct Normalizer {
    /// Mean of each number, `[num_obs]`.
    pub mean: Vec<f32>,
    /// Variance of each number, `[num_obs]`.
    pub variance: Vec<f32>,
    /// Samples so far.
    pub count: u64,
    mean_lines: Vec<Line>,
    inverse_lines: Vec<Line>,
}

impl Normalizer {
    /// Statistics before the first sample: mean 0 and deviation 1.
    pub(crate) fn new(num_obs: usize) -> Self {
        Self::from_parts(vec![0.0; num_obs], vec![1.0; num_obs], 0)
    }

    /// Statistics with these values, `[num_obs]` each.
    pub fn from_parts(mean: Vec<f32>, variance: Vec<f32>, count: u64) -> Self {
        let lines = vec![Line::ZERO; lines_of(mean.len())];
        let mut this = Self { mean, variance, count, mean_lines: lines.clone(), inverse_lines: lines };
        this.prepare();
        this
    }

    fn prepare(&mut self) {
        for (i, (&mean, &variance)) in self.mean.iter().zip(&self.variance).enumerate() {
            self.mean_lines[i / WIDTH].0[i % WIDTH] = mean;
            self.inverse_lines[i / WIDTH].0[i % WIDTH] = 1.0 / (variance.sqrt() + EPSILON);
        }
    }

    /// Mean of each number, and one over its deviation, `[lines of an observation]`.
    pub(crate) fn lines(&self) -> [&[Line]; 2] {
        [&self.mean_lines, &self.inverse_lines]
    }

    /// Line `index` of an observation, normalised.
    #[inline(always)]
    pub(crate) fn apply(&self, index: usize, line: &Line) -> Line {
        let (mean, inverse) = (&self.mean_lines[index].0, &self.inverse_lines[index].0);
        let mut out = Line::ZERO;
        for i in 0..WIDTH {
            out.0[i] = (line.0[i] - mean[i]) * inverse[i];
        }
        out
    }

    /// A number of an observation, normalised.
    pub(crate) fn apply_to(&self, index: usize, x: f32) -> f32 {
        let (line, lane) = (index / WIDTH, index % WIDTH);
        (x - self.mean_lines[line].0[lane]) * self.inverse_lines[line].0[lane]
    }

    /// Takes in the moments of an iteration's samples, `[num_obs]`. `added` is the number of
    /// samples; a number that some lack is missing in the same share of them at all times. A number
    /// that all samples lack keeps its statistics.
    ///
    /// Missing entries are 0 in observations and stay 0: a number that some samples lack, as
    /// `is_padded` says, is divided by the root of its mean square, and nothing is subtracted from
    /// it.
    pub(crate) fn update(&mut self, samples: &[Moments], added: u64, is_padded: &[bool]) {
        self.count += added;
        let rate = added as f64 / self.count.max(1) as f64;
        let numbers = samples.iter().zip(is_padded).zip(self.mean.iter_mut().zip(&mut self.variance));
        for ((of, is_padded), (mean, variance)) in numbers.filter(|((of, _), _)| of.count > 0.0) {
            if *is_padded {
                *mean = 0.0;
                let spread = of.variance() + of.mean * of.mean - f64::from(*variance);
                *variance = (f64::from(*variance) + rate * spread) as f32;
                continue;
            }
            let delta = of.mean - f64::from(*mean);
            let new_mean = f64::from(*mean) + rate * delta;
            let spread = of.variance() - f64::from(*variance) + delta * (of.mean - new_mean);
            *mean = new_mean as f32;
            // rounding may make the variance of a constant number negative
            *variance = (f64::from(*variance) + rate * spread).max(0.0) as f32;
        }
        self.prepare();
    }
}
