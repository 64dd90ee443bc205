//! Sweeps over joint bounds: dry friction, position limits and velocity limits.

use crate::articulation::Topology;
use crate::blocks::BLOCK;
use crate::lanes::Real;
use crate::rows::{BoundBlock, BoundRow, ContactWork};
use crate::settings::SolverSettings;
use crate::sparse_rows::JointRows;

/// One sweep over the joints' limits and dry friction, in the lanes that are `active`.
#[inline(always)]
pub(super) fn sweep_bounds<S: Real>(topology: &Topology, active: S::Mask, work: &mut ContactWork<S>) {
    let ContactWork { bounds, bound_further, stride, base: y_base, joints, .. } = work;
    let mut base = *y_base;
    for (block, further) in bounds.iter_mut().zip(bound_further.chunks_exact(*stride)) {
        if block.active {
            solve_bounds(topology, active, block, further, &mut base, joints);
        }
    }
    *y_base = base;
}

/// Brings the velocities of a block's joints into their bounds, one after the other.
#[inline(always)]
fn solve_bounds<S: Real>(
    topology: &Topology,
    active: S::Mask,
    block: &mut BoundBlock<S>,
    further: &[JointRows<S>],
    y_base: &mut [S; 6],
    y_joint: &mut [[S; BLOCK]],
) {
    let mut w = block.rows.velocities(topology, further, y_base, y_joint);
    // the operations of dry friction do not depend on whether a neighbour's lane is near a limit
    let [pass01, pass02, pass12] = block.friction_coupling;
    let mut stopping = [S::zero(); 3];
    for i in 0..3 {
        stopping[i] = block.joints[i].stopping_impulse(w[i]);
    }
    let mut change = [S::zero(); 3];
    for i in 0..3 {
        let row = &mut block.joints[i];
        change[i] = row.apply_friction(stopping[i], active);
        if block.limits {
            if row.limits {
                change[i] = change[i] + row.apply_limit(row.diagonal.mul_add(change[i], w[i]), active);
            }
            block.pass_on(i, change[i], &mut w);
        }
        if i == 0 {
            stopping[1] = change[0].neg_mul_add(pass01, stopping[1]);
            stopping[2] = change[0].neg_mul_add(pass02, stopping[2]);
        } else if i == 1 {
            stopping[2] = change[1].neg_mul_add(pass12, stopping[2]);
        }
    }
    block.rows.apply(topology, further, &change, y_base, y_joint);
}

/// Sweeps over joint limits alone until none changes a velocity, in the lanes that are `active`.
/// `pushing` selects the motion that pushes joints back in place of the velocity.
#[inline(always)]
pub(super) fn settle_limits<S: Real>(
    topology: &Topology,
    solver: &SolverSettings,
    active: S::Mask,
    pushing: bool,
    work: &mut ContactWork<S>,
) {
    let mut sweeps = S::repeat(solver.limit_sweeps, active);
    while let Some(active) = sweeps.next() {
        let most = sweep_limits(topology, active, pushing, work);
        sweeps.keep(S::splat(solver.limit_tolerance).lt(most));
    }
}

/// One sweep over joint limits alone, for `pushing` as in [`settle_limits`]. Returns the largest
/// change of a velocity, rad/s or m/s.
#[inline(always)]
pub(super) fn sweep_limits<S: Real>(
    topology: &Topology,
    active: S::Mask,
    pushing: bool,
    work: &mut ContactWork<S>,
) -> S {
    let ContactWork { bounds, bound_further, stride, base, joints, .. } = work;
    let mut most = S::zero();
    for (block, further) in bounds.iter_mut().zip(bound_further.chunks_exact(*stride)) {
        if block.limits {
            let mut w = block.rows.velocities(topology, further, base, joints);
            let mut change = [S::zero(); 3];
            for i in 0..3 {
                let row = &mut block.joints[i];
                change[i] = if pushing { row.apply_push(w[i], active) } else { row.apply_limit(w[i], active) };
                most = most.max((change[i] * row.diagonal).abs());
                block.pass_on(i, change[i], &mut w);
            }
            block.rows.apply(topology, further, &change, base, joints);
        }
    }
    most
}

impl<S: Real> BoundBlock<S> {
    /// Adds to the velocities of later rows what an impulse on row `i` changes in them.
    #[inline(always)]
    fn pass_on(&self, i: usize, change: S, w: &mut [S; 3]) {
        if i == 0 {
            w[1] = self.coupling[0].mul_add(change, w[1]);
            w[2] = self.coupling[1].mul_add(change, w[2]);
        } else if i == 1 {
            w[2] = self.coupling[2].mul_add(change, w[2]);
        }
    }
}

impl<S: Real> BoundRow<S> {
    /// Impulse of dry friction that would bring the velocity `w` to zero.
    #[inline(always)]
    fn stopping_impulse(&self, w: S) -> S {
        w.neg_mul_add(self.inverse, self.friction_impulse)
    }

    /// Sets the impulse of dry friction, as near to `stopping` as its bound lets it. Returns the
    /// change.
    #[inline(always)]
    fn apply_friction(&mut self, stopping: S, active: S::Mask) -> S {
        let old = self.friction_impulse;
        let friction = stopping.clamp(-self.max_friction, self.max_friction);
        self.friction_impulse = S::select(active, friction, old);
        self.friction_impulse - old
    }

    /// Sets the impulse of the limit, which brings the velocity `w` into its bounds. Returns the
    /// change.
    #[inline(always)]
    fn apply_limit(&mut self, w: S, active: S::Mask) -> S {
        let (lowest, highest) = (self.lowest.min(S::zero()), self.highest.max(S::zero()));
        let active = S::and(active, self.near);
        let limit = S::select(active, self.bounding(w, self.limit_impulse, lowest, highest), self.limit_impulse);
        let change = limit - self.limit_impulse;
        self.limit_impulse = limit;
        change
    }

    /// Sets the impulse of the motion that pushes joints back. Returns the change.
    #[inline(always)]
    fn apply_push(&mut self, w: S, active: S::Mask) -> S {
        let limit = self.bounding(w, self.push_impulse, self.lowest, self.highest);
        let limit = S::select(S::and(active, self.near), limit, self.push_impulse);
        let change = limit - self.push_impulse;
        self.push_impulse = limit;
        change
    }

    /// Impulse that brings a velocity into its bounds; with `impulse` the velocity is `w`.
    #[inline(always)]
    fn bounding(&self, w: S, impulse: S, lowest: S, highest: S) -> S {
        // the velocity this row would see without its own impulse, and the nearest allowed one
        let without = self.diagonal.neg_mul_add(impulse, w);
        (without.clamp(lowest, highest) - without) * self.inverse
    }
}
