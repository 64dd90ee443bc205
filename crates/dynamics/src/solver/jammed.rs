//! Contacts that regular sweeps do not settle: how they are found, and how they are solved.

use crate::articulation::Topology;
use crate::blocks::BLOCK;
use crate::lanes::Real;
use crate::parameters::Parameters;
use crate::rows::{ContactRows, ContactWork};
use crate::settings::SolverSettings;
use crate::sparse_rows::JointRows;

use super::contacts::{sliding, sliding_friction};

/// Lanes in which another sweep would change the velocity of a contact by more than the settings
/// allow.
#[inline(always)]
pub(super) fn unsettled<S: Real>(topology: &Topology, solver: &SolverSettings, work: &ContactWork<S>) -> S::Mask {
    let mut beyond = S::zero();
    for (row, further) in work.contacts().iter().zip(work.contact_further.chunks_exact(work.stride)) {
        let w = row.rows.first_velocity(topology, further, &work.base, &work.joints);
        let old = row.impulse[0];
        let missing = row.softness.mul_add(old, w - row.target);
        let normal = missing.neg_mul_add(row.inverse[0], old).max(S::zero());
        let deep = S::splat(solver.deep_push).lt(row.push);
        let enough = S::select(deep, S::splat(solver.settled_change_deep), S::splat(solver.settled_change));
        let beyond_here = (normal - old).abs().mul_add(row.diagonal, -enough);
        beyond = S::select(row.near, beyond.max(beyond_here), beyond);
    }
    S::zero().lt(beyond)
}

/// One sweep over contacts that regular sweeps have not settled, in the lanes that are `active`.
#[inline(always)]
pub(super) fn sweep_jammed<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
    solver: &SolverSettings,
    active: S::Mask,
    work: &mut ContactWork<S>,
) {
    let ContactWork { contacts, num_contacts, contact_further, stride, base: y_base, joints: y_joint, .. } = work;
    let friction = [parameters.static_friction, parameters.dynamic_friction];
    // a copy, which stays in registers from one visit to the next
    let mut base = *y_base;
    for (row, further) in contacts[..*num_contacts].iter_mut().zip(contact_further.chunks_exact(*stride)) {
        if row.active {
            let friction = sliding_friction(topology, parameters, row.contact, friction);
            solve_jammed_contact(topology, solver, &friction, active, row, further, &mut base, y_joint);
        }
    }
    *y_base = base;
}

/// Brings the velocity of one contact to its target where regular sweeps have not settled it.
///
/// A normal impulse and its friction may undo each other, so that sweeps go back and forth between
/// two states: the point is pushed up, friction that grows with the push lifts it further, and next
/// it is not pushed at all. Hence friction that is at its bound follows the normal impulse at once.
/// A normal impulse that turns back goes a share of its way. The point then sticks up to the
/// dynamic coefficient, since between two coefficients it would go back and forth too.
#[inline(always)]
fn solve_jammed_contact<S: Real>(
    topology: &Topology,
    solver: &SolverSettings,
    friction: &[S; 2],
    active: S::Mask,
    row: &mut ContactRows<S>,
    further: &[JointRows<S>],
    y_base: &mut [S; 6],
    y_joint: &mut [[S; BLOCK]],
) {
    let (z, one) = (S::zero(), S::one());
    let active = S::and(active, row.near);
    let old = row.impulse;
    let w = row.rows.velocities(topology, further, y_base, y_joint);
    let (square, bound) = (old[1].mul_add(old[1], old[2] * old[2]), friction[1] * old[0]);
    let bound = bound * bound;
    let [least, most] = solver.at_friction_bound;
    let at_bound = S::and((bound * S::splat(least)).lt(square), square.lt(bound * S::splat(most)));
    let slid = S::and(z.lt(old[0]), at_bound);
    let per_normal = one / old[0].max(S::splat(1e-9));
    let follow = [S::select(slid, old[1] * per_normal, z), S::select(slid, old[2] * per_normal, z)];
    let [c01, c02, c12] = row.coupling;
    let diagonal = c01.mul_add(follow[0], c02.mul_add(follow[1], row.diagonal));
    // friction may drive the point into the ground faster than the normal impulse lifts it
    let diagonal = diagonal.max(row.diagonal * S::splat(solver.min_following_response));
    let missing = row.softness.mul_add(old[0], w[0] - row.target);
    let change = (old[0] - missing / diagonal).max(z) - old[0];
    let turned = (change * row.last_change).lt(z);
    let dn = S::select(turned, change * S::splat(solver.turn_back_share), change);
    let normal = old[0] + dn;
    row.last_change = S::select(active, dn, row.last_change);
    let followed = [follow[0].mul_add(dn, old[1]), follow[1].mul_add(dn, old[2])];
    let w1 = follow[1].mul_add(c12, follow[0].mul_add(row.across[0], c01)).mul_add(dn, w[1]);
    let w2 = follow[0].mul_add(c12, follow[1].mul_add(row.across[1], c02)).mul_add(dn, w[2]);
    let t1 = w1.neg_mul_add(row.inverse[1], followed[0]);
    let t2 = c12.mul_add(t1 - followed[0], w2).neg_mul_add(row.inverse[2], followed[1]);
    let hold = S::select(turned, friction[1], friction[0]) * normal;
    let slides = (hold * hold).lt(t1.mul_add(t1, t2 * t2));
    let [s1, s2] = sliding(row.slide, [w1, w2], followed, friction[1] * normal);
    let new = [
        S::select(active, normal, old[0]),
        S::select(active, S::select(slides, s1, t1), old[1]),
        S::select(active, S::select(slides, s2, t2), old[2]),
    ];
    row.impulse = new;
    let change = [new[0] - old[0], new[1] - old[1], new[2] - old[2]];
    row.rows.apply(topology, further, &change, y_base, y_joint);
}
