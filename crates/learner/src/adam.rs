//! The optimiser Adam with torch's defaults, over lines.

use polypod_lanes::Kernel;

use crate::lines::{Line, WIDTH};

const BETA: [f64; 2] = [0.9, 0.999];

/// One step of some weights.
pub(crate) struct Step<'a> {
    pub(crate) weights: &'a mut [Line],
    pub(crate) first: &'a mut [Line],
    pub(crate) second: &'a mut [Line],
    pub(crate) gradient: &'a [Line],
    pub(crate) rates: Rates,
}

/// Rates that all weights of a network share in a step.
#[derive(Clone, Copy, Debug)]
pub struct Rates {
    /// Factor on the gradient, so that its norm is not too large.
    pub clip: f32,
    /// Learning rate over the first moment's bias.
    pub rate: f32,
    /// Root of the second moment's bias.
    pub root: f32,
}

impl Rates {
    /// Share of the means of gradients and of their squares that a step keeps.
    pub const KEEP: [f32; 2] = [BETA[0] as f32, BETA[1] as f32];
    /// Share that a step takes from the new gradient.
    pub const TAKE: [f32; 2] = [(1.0 - BETA[0]) as f32, (1.0 - BETA[1]) as f32];
    /// Addend of the root of the mean square before it divides.
    pub const EPSILON: f32 = 1e-8;

    /// Rates of a network's step number `step`, counted from 1.
    pub(crate) fn new(learning_rate: f64, step: u64, clip: f64) -> Self {
        let bias = BETA.map(|beta| 1.0 - libm::pow(beta, step as f64));
        Self { clip: clip as f32, rate: (learning_rate / bias[0]) as f32, root: bias[1].sqrt() as f32 }
    }
}

impl Kernel<f32> for Step<'_> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Rates { clip, rate, root } = self.rates;
        let ([keep, keep_squares], [take, take_squares]) = (Rates::KEEP, Rates::TAKE);
        let moments = self.first.iter_mut().zip(self.second);
        for ((weights, gradient), (first, second)) in self.weights.iter_mut().zip(self.gradient).zip(moments) {
            for i in 0..WIDTH {
                let g = gradient.0[i] * clip;
                first.0[i] = first.0[i] * keep + g * take;
                second.0[i] = second.0[i] * keep_squares + g * g * take_squares;
                let step = first.0[i] / (second.0[i].sqrt() / root + Rates::EPSILON);
                weights.0[i] -= rate * step;
            }
        }
    }
}
