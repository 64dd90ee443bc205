//! The optimiser Adam with torch's defaults, over lines.

use polypod_lanes::Kernel;

use crate::lines::{Line, WIDTH};

const BETA: [f64; 2] = [0.9, 0.999];
const EPSILON: f32 = 1e-8;

/// One step of some weights.
pub(crate) struct Step<'a> {
    pub(crate) weights: &'a mut [Line],
    pub(crate) first: &'a mut [Line],
    pub(crate) second: &'a mut [Line],
    pub(crate) gradient: &'a [Line],
    pub(crate) rates: Rates,
}

/// Rates that all weights of a network share in a step.
#[derive(Clone, Copy)]
pub(crate) struct Rates {
    /// Factor on the gradient, so that its norm is not too large.
    clip: f32,
    /// Learning rate over the first moment's bias.
    rate: f32,
    /// Root of the second moment's bias.
    root: f32,
}

impl Rates {
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
        let [keep, keep_squares] = BETA.map(|beta| beta as f32);
        let [take, take_squares] = BETA.map(|beta| (1.0 - beta) as f32);
        let moments = self.first.iter_mut().zip(self.second);
        for ((weights, gradient), (first, second)) in self.weights.iter_mut().zip(self.gradient).zip(moments) {
            for i in 0..WIDTH {
                let g = gradient.0[i] * clip;
                first.0[i] = first.0[i] * keep + g * take;
                second.0[i] = second.0[i] * keep_squares + g * g * take_squares;
                let step = first.0[i] / (second.0[i].sqrt() / root + EPSILON);
                weights.0[i] -= rate * step;
            }
        }
    }
}
