//! The start of the sweeps: the impulses of the last physics step, as far as they fit.

use crate::articulation::Topology;
use crate::blocks::BLOCK;
use crate::lanes::Real;
use crate::rows::ContactWork;

/// Keeps the share finite where there are no impulses, kg m^2/s^2.
const MIN_ENERGY: f64 = 1e-20;

/// Applies the impulses of the last physics step, all scaled by one share in `[0, 1]`: the share
/// that comes nearest to the solution. At rest it is one, after an impact nearly zero.
///
/// The solution keeps the rows' targets with the least kinetic energy of the change of velocity
/// (Gauss's principle). Along the ray of the old impulses this energy is a parabola.
#[inline(always)]
pub(super) fn warm_start<S: Real>(topology: &Topology, work: &mut ContactWork<S>) {
    let z = S::zero();
    // the change of the velocity by the whole impulses, in memory that the moved velocity takes
    // over later
    work.moved_base = [z; 6];
    work.moved_joints.fill([z; BLOCK]);
    let ContactWork {
        contacts,
        num_contacts,
        contact_further,
        spins,
        num_spins,
        spin_further,
        bounds,
        bound_further,
        stride,
        moved_base,
        moved_joints,
        ..
    } = work;
    let (mut targets, mut energy) = (z, S::splat(MIN_ENERGY));
    for (row, further) in contacts[..*num_contacts].iter().zip(contact_further.chunks_exact(*stride)) {
        row.rows.apply(topology, further, &row.impulse, moved_base, moved_joints);
        let normal = row.impulse[0];
        targets = row.target.mul_add(normal, targets);
        energy = (row.softness * normal).mul_add(normal, energy);
    }
    for (spin, further) in spins[..*num_spins].iter().zip(spin_further.chunks_exact(*stride)) {
        spin.apply(topology, further, &spin.impulse, moved_base, moved_joints);
    }
    for (block, further) in bounds.iter().zip(bound_further.chunks_exact(*stride)) {
        if block.active {
            let [first, second, third] = &block.joints;
            let impulse = [first.impulse(), second.impulse(), third.impulse()];
            block.rows.apply(topology, further, &impulse, moved_base, moved_joints);
            if block.limits {
                for row in &block.joints {
                    let target = S::select(z.lt(row.limit_impulse), row.lowest.min(z), row.highest.max(z));
                    targets = target.mul_add(row.limit_impulse, targets);
                }
            }
        }
    }
    let mut gain = targets;
    let changes = work.moved_joints.as_flattened().iter().chain(&work.moved_base);
    for (&change, &y) in changes.zip(work.joints.as_flattened().iter().chain(&work.base)) {
        gain = change.neg_mul_add(y, gain);
        energy = change.mul_add(change, energy);
    }
    let share = (gain / energy).clamp(z, S::one());
    for (y, &change) in work.joints.as_flattened_mut().iter_mut().zip(work.moved_joints.as_flattened()) {
        *y = share.mul_add(change, *y);
    }
    for (y, &change) in work.base.iter_mut().zip(&work.moved_base) {
        *y = share.mul_add(change, *y);
    }
    for row in &mut work.contacts[..work.num_contacts] {
        for x in &mut row.impulse {
            *x = *x * share;
        }
    }
    for spin in &mut work.spins[..work.num_spins] {
        for x in &mut spin.impulse {
            *x = *x * share;
        }
    }
    for block in &mut work.bounds {
        if block.active {
            for row in &mut block.joints {
                row.friction_impulse = row.friction_impulse * share;
                if block.limits {
                    row.limit_impulse = row.limit_impulse * share;
                }
            }
        }
    }
}
