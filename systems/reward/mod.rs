//! Rewards: the weighted sum of the terms of each robot's own reward set.

mod contact_terms;
mod motion_terms;

use bevy_ecs::prelude::*;

use super::Autoreset;
use super::terms::{CompiledTask, Registry};
use super::view::{RobotView, ViewParam};
use crate::batch::Batch;
use crate::components::{Episode, EpisodeSums};
use crate::rows::{Workers, read_rows, write_rows};

/// `reward = sum of weight * value * step_dt`, summed per term for the logs, as are the tracking errors.
///
/// A robot only computes the terms of its own set. An env whose state broke gets 0, as does one that is only reset in
/// this step.
pub(super) fn compute_rewards(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    autoreset: Res<Autoreset>,
    views: ViewParam,
    episodes: Query<&'static Episode>,
    mut batch: ResMut<Batch>,
    mut sums: Query<&'static mut EpisodeSums>,
) {
    let views = views.views(task.step_dt);
    let rows = (read_rows(&episodes), write_rows(&mut sums), &mut batch.rewards[..]);
    workers.for_each_chunk(rows, views.len(), |first, n, (episodes, sums, rewards)| {
        for i in 0..n {
            let episode = &episodes[i];
            let resetting = *autoreset == Autoreset::NextStep && episode.needs_reset && !episode.done();
            if episode.invalid || resetting {
                rewards[i] = 0.0;
                continue;
            }
            let view = RobotView { terminated: episode.terminated, ..views.get(first + i) };
            let terms = &task.rewards[usize::from(views.tags[first + i].0)];
            let sums = &mut sums[i];
            sums.add_errors(&view);
            let mut total = 0.0;
            for (term, sum) in terms.iter().zip(sums.terms.iter_mut()) {
                let value = term.weight * (term.value)(&view, workers.entry()) * task.step_dt;
                *sum += value;
                total += value;
            }
            sums.reward += total;
            rewards[i] = total;
        }
    });
}

/// All built-in reward terms, under Isaac Lab's names.
pub(super) fn register(registry: &mut Registry) {
    motion_terms::register(registry);
    contact_terms::register(registry);
}

/// Sum of squares.
#[inline(always)]
fn sum_of_squares(x: &[f32]) -> f32 {
    x.iter().fold(0.0, |sum: f32, &x| x.mul_add(x, sum))
}

/// Euclidean norm.
#[inline(always)]
fn norm(x: &[f32]) -> f32 {
    sum_of_squares(x).sqrt()
}

/// `e^x`, relative error below 3e-7: range reduction and a polynomial (the single-precision coefficients of the Cephes
/// library), with IEEE operations only, so that the bits are the same on every machine.
#[inline(always)]
fn exp(x: f32) -> f32 {
    if x < -87.0 {
        return 0.0;
    }
    let x = x.min(88.0);
    let k = (x * std::f32::consts::LOG2_E).round_ties_even();
    let r = (-k).mul_add(-2.121_944_4e-4, (-k).mul_add(0.693_359_4, x));
    let series = [1.987_569_2e-4, 1.398_199_9e-3, 8.333_452e-3, 4.166_579_6e-2, 0.166_666_66, 0.5];
    let p = series.iter().fold(0.0f32, |p, &c: &f32| p.mul_add(r, c));
    let y = p.mul_add(r * r, r) + 1.0;
    y * f32::from_bits(((k as i32 + 127) as u32) << 23)
}

/// Hyperbolic tangent of a non-negative number.
#[inline(always)]
fn tanh_positive(x: f32) -> f32 {
    let e = exp(-2.0 * x);
    (1.0 - e) / (1.0 + e)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponential_and_tangent_are_accurate() {
        for i in -8000..8000 {
            let x = i as f32 * 0.01;
            let exact = f64::from(x).exp();
            assert!((f64::from(exp(x)) - exact).abs() <= 4e-7 * exact + 1e-37, "{x}: {} {exact}", exp(x));
            let x = x.abs();
            assert!((f64::from(tanh_positive(x)) - f64::from(x).tanh()).abs() < 2e-7, "{x}");
        }
    }
}
