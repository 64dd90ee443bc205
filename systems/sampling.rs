//! Sampling of numbers for events, with ranges of the robots or of the task.
//!
//! Logarithm and exponential are the crate libm's, which is plain Rust: the same bits on every
//! machine.

use crate::components::EnvRng;
use crate::config::{Distribution, Draw, Operation};

/// A joint's value after a draw; not below 0. `effort` is the joint's largest, N m.
pub(super) fn apply(draw: &Draw, value: f32, effort: f32, rng: &mut EnvRng) -> f32 {
    let x = number(draw, rng);
    let new = match draw.operation {
        Operation::Add => value + x,
        Operation::Scale => value * x,
        Operation::Abs => x,
        Operation::AddEffortShare if effort.is_finite() => x.mul_add(effort, value),
        Operation::AddEffortShare => value,
    };
    new.max(0.0)
}

fn number(draw: &Draw, rng: &mut EnvRng) -> f32 {
    let [a, b] = draw.distribution_params;
    match draw.distribution {
        Distribution::Uniform => rng.uniform([a as f32, b as f32]),
        Distribution::LogUniform => {
            let (low, high) = (libm::log(a), libm::log(b));
            let x = libm::exp((high - low).mul_add(f64::from(rng.unit()), low)) as f32;
            // not beyond the ends by a rounding
            x.clamp(a as f32, b as f32)
        }
        Distribution::Gaussian => b.mul_add(standard_normal(rng), a) as f32,
    }
}

/// Marsaglia's polar method.
fn standard_normal(rng: &mut EnvRng) -> f64 {
    loop {
        let [x, y] = [(); 2].map(|()| f64::from(rng.uniform([-1.0, 1.0])));
        let square = x * x + y * y;
        if square > 0.0 && square < 1.0 {
            return x * (-2.0 * libm::log(square) / square).sqrt();
        }
    }
}

/// Owner of the ranges that an event samples from.
pub(super) enum Source<T> {
    /// Each robot's own, from its config.
    Robot,
    /// The task's, for all robots.
    Task(T),
}

/// The draws of several quantities from the task's parameters, if it has any.
///
/// # Errors
/// Parameters that the distribution cannot have, or an operation or distribution without any
/// parameters.
pub(super) fn of_task<const N: usize>(
    params: [Option<[f64; 2]>; N],
    operation: Option<Operation>,
    distribution: Option<Distribution>,
) -> Result<Source<[Option<Draw>; N]>, String> {
    if params.iter().all(Option::is_none) {
        return match (operation, distribution) {
            (None, None) => Ok(Source::Robot),
            _ => {
                Err("an operation or distribution without numbers; add *_distribution_params beside it, or remove it \
                      to draw from each robot's own [randomization]"
                    .into())
            }
        };
    }
    let mut draws = [None; N];
    for (draw, params) in draws.iter_mut().zip(params) {
        if let Some(params) = params {
            *draw = Some(Draw::new(operation.unwrap_or_default(), distribution.unwrap_or_default(), params)?);
        }
    }
    Ok(Source::Task(draws))
}
