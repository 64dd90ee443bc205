//! Gaps between two things: whether they can touch in a step, and how fast they may or must part.

use super::lanes::Real;
use super::settings::ContactSettings;

/// Largest gap that may close in a step, m: `least`, and what the two come nearer by.
///
/// `now` and `free` are the speeds at which they part at present and without constraints, m/s. The
/// faster approach counts: a joint limit may hold back what would be free.
#[inline(always)]
pub(super) fn reach_in_step<S: Real>(least: f64, now: S, free: S, dt: S) -> S {
    now.min(free).min(S::zero()).neg_mul_add(dt, S::splat(least))
}

/// Least allowed separation speed at a gap, m/s: an open gap may close, a penetration is pushed
/// out.
#[inline(always)]
pub(super) fn separation<S: Real>(gap: S, settings: &ContactSettings, inverse_dt: S) -> S {
    let push = push_speed(-gap, settings.solver.penetration_slop, settings, inverse_dt);
    S::select(gap.lt(S::zero()), push, -(gap * inverse_dt))
}

/// Speed at which a violation of some depth is pushed out, m/s. A depth of `slop` is left.
#[inline(always)]
pub(super) fn push_speed<S: Real>(depth: S, slop: f64, settings: &ContactSettings, inverse_dt: S) -> S {
    let beyond = (depth - S::splat(slop)).max(S::zero());
    (beyond * S::splat(settings.correction) * inverse_dt).min(S::splat(settings.max_depenetration_velocity))
}
