//! The push out of penetrations and back from beyond limits: it moves bodies and leaves their
//! velocities alone.

use crate::articulation::Topology;
use crate::lanes::Real;
use crate::rows::ContactWork;
use crate::settings::SolverSettings;

use super::bounds::{settle_limits, sweep_limits};
use super::mark_active;

/// Adds to `moved_base` and `moved_joints` what pushes penetrations out and joints back from beyond
/// their limits.
#[inline(always)]
pub(super) fn push<S: Real>(topology: &Topology, solver: &SolverSettings, work: &mut ContactWork<S>) {
    // the sweeps work on `base` and `joints`
    std::mem::swap(&mut work.base, &mut work.moved_base);
    std::mem::swap(&mut work.joints, &mut work.moved_joints);
    // a lane with nothing to push out stays as it is, whatever its neighbours need
    let pushes = S::zero().lt(work.violation);
    mark_active(pushes, work);
    let mut sweeps = S::repeat(solver.push_sweeps, pushes);
    while let Some(active) = sweeps.next() {
        let most = push_contacts(topology, active, work).max(sweep_limits(topology, active, true, work));
        sweeps.keep(S::splat(solver.push_tolerance).lt(most));
    }
    settle_limits(topology, solver, pushes, true, work);
    std::mem::swap(&mut work.base, &mut work.moved_base);
    std::mem::swap(&mut work.joints, &mut work.moved_joints);
}

/// One sweep over the contacts' normals for the motion that pushes penetrations out, in the lanes
/// that are `active`. Returns the largest change of a velocity, m/s.
#[inline(always)]
fn push_contacts<S: Real>(topology: &Topology, active: S::Mask, work: &mut ContactWork<S>) -> S {
    let ContactWork { contacts, num_contacts, contact_further, stride, base: y_base, joints: y_joint, .. } = work;
    let mut most = S::zero();
    for (row, further) in contacts[..*num_contacts].iter_mut().zip(contact_further.chunks_exact(*stride)) {
        if !row.active {
            continue;
        }
        let w = row.rows.first_velocity(topology, further, y_base, y_joint);
        let missing = row.softness.mul_add(row.push_impulse, w - row.push);
        let push = missing.neg_mul_add(row.inverse[0], row.push_impulse).max(S::zero());
        let push = S::select(S::and(active, row.near), push, row.push_impulse);
        let change = push - row.push_impulse;
        most = most.max((change * row.diagonal).abs());
        row.push_impulse = push;
        row.rows.apply_first(topology, further, change, y_base, y_joint);
    }
    most
}
