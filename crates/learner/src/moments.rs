//! Means and variances of samples that come part by part.

use serde::{Deserialize, Serialize};

/// Number, mean and squared deviations of samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Moments {
    pub(crate) count: f64,
    pub(crate) mean: f64,
    /// Sum of the squared deviations from the mean.
    pub(crate) squares: f64,
}

impl Moments {
    /// Moments of some samples, by two passes.
    pub(crate) fn of(samples: impl Iterator<Item = f32> + Clone) -> Self {
        let (mut count, mut sum) = (0.0, 0.0);
        for x in samples.clone() {
            count += 1.0;
            sum += f64::from(x);
        }
        if count == 0.0 {
            return Self::default();
        }
        let mean = sum / count;
        let mut squares = 0.0;
        for x in samples {
            squares += (f64::from(x) - mean) * (f64::from(x) - mean);
        }
        Self { count, mean, squares }
    }

    /// Moments of both (Chan, Golub and LeVeque).
    pub(crate) fn merge(self, other: Self) -> Self {
        let count = self.count + other.count;
        if count == 0.0 {
            return self;
        }
        let delta = other.mean - self.mean;
        Self {
            count,
            mean: self.mean + delta * other.count / count,
            squares: self.squares + other.squares + delta * delta * self.count * other.count / count,
        }
    }

    /// Scale to mean 0 and deviation 1: the mean, and one over the deviation of this variance.
    pub(crate) fn scale(&self, variance: f64) -> (f32, f32) {
        const EPSILON: f64 = 1e-8;
        (self.mean as f32, (1.0 / (variance.max(0.0).sqrt() + EPSILON)) as f32)
    }

    /// Mean squared deviation.
    pub(crate) fn variance(&self) -> f64 {
        self.squares / self.count
    }

    /// Variance with one sample fewer in the divisor: an estimate of the samples' source.
    pub(crate) fn unbiased_variance(&self) -> f64 {
        self.squares / (self.count - 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_give_what_all_samples_give() {
        let samples: Vec<f32> = (0..1000).map(|i| (i * 7919 % 1000) as f32 * 0.01 + 100.0).collect();
        let all = Moments::of(samples.iter().copied());
        let parts = samples.chunks(37).map(|part| Moments::of(part.iter().copied()));
        let merged = parts.fold(Moments::default(), Moments::merge);
        assert!((all.mean - merged.mean).abs() < 1e-12 * all.mean);
        assert!((all.variance() - merged.variance()).abs() < 1e-10 * all.variance());
    }
}
