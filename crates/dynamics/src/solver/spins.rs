//! Sweeps over torsional and rolling friction.
//!
//! The two and sliding friction have separate bounds: an interval about the normal, a disc about
//! the tangents. MuJoCo's elliptic cone shares the normal impulse among them; what sticks, as a
//! foot that carries weight does, is held in both.

use crate::articulation::{ContactFriction, Topology};
use crate::blocks::BLOCK;
use crate::lanes::Real;
use crate::parameters::Parameters;
use crate::rows::{ContactRows, ContactWork};
use crate::sparse_rows::JointRows;
use crate::spin_rows::SpinRows;

use super::contacts::sliding;

/// One sweep over torsional and rolling friction, in the lanes that are `active`; nothing where
/// neither acts.
#[inline(always)]
pub(super) fn sweep_spins<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
    active: S::Mask,
    work: &mut ContactWork<S>,
) {
    if work.num_spins == 0 {
        return;
    }
    let ContactWork { contacts, spins, num_spins, spin_further, stride, base: y_base, joints: y_joint, .. } = work;
    let friction = [parameters.torsional_friction, parameters.rolling_friction];
    let mut base = *y_base;
    // ground contacts come before pairs
    let spins = contacts.iter().zip(&mut spins[..*num_spins]);
    for ((row, spin), further) in spins.zip(spin_further.chunks_exact(*stride)) {
        if row.active {
            let friction = spin_friction(topology, parameters, row.contact, friction);
            solve_spin(topology, &friction, active, row, spin, further, &mut base, y_joint);
        }
    }
    *y_base = base;
}

/// Torsional and rolling coefficient of a ground contact, m: the larger of its surface's and
/// `friction`, that of robot and ground.
#[inline(always)]
fn spin_friction<S: Real>(topology: &Topology, parameters: &Parameters<S>, contact: usize, friction: [S; 2]) -> [S; 2] {
    if !topology.has_surfaces {
        return friction;
    }
    let [_, torsional, rolling] = parameters.contact_friction[contact];
    [friction[0].max(torsional), friction[1].max(rolling)]
}

/// Stops the turning of one contact as far as the bounds let it.
#[inline(always)]
fn solve_spin<S: Real>(
    topology: &Topology,
    friction: &[S; 2],
    active: S::Mask,
    row: &ContactRows<S>,
    spin: &mut SpinRows<S>,
    further: &[JointRows<S>],
    y_base: &mut [S; 6],
    y_joint: &mut [[S; BLOCK]],
) {
    let active = S::and(active, row.near);
    let (old, normal) = (spin.impulse, row.impulse[0]);
    let bound = friction[0] * normal;
    let mut new = old;
    if topology.friction == ContactFriction::Rolling {
        let w = spin.rows.velocities(topology, further, y_base, y_joint);
        new[0] = w[0].neg_mul_add(spin.inverse[0], old[0]).clamp(-bound, bound);
        let change = new[0] - old[0];
        let (w1, w2) = (spin.coupling[0].mul_add(change, w[1]), spin.coupling[1].mul_add(change, w[2]));
        // the link rolls no further if the impulses that stop it are inside the disc
        let t1 = w1.neg_mul_add(spin.inverse[1], old[1]);
        let t2 = spin.coupling[2].mul_add(t1 - old[1], w2).neg_mul_add(spin.inverse[2], old[2]);
        let bound = friction[1] * normal;
        let rolls = (bound * bound).lt(t1.mul_add(t1, t2 * t2));
        let [s1, s2] = sliding(spin.roll, [w1, w2], [old[1], old[2]], bound);
        (new[1], new[2]) = (S::select(rolls, s1, t1), S::select(rolls, s2, t2));
    } else {
        let w = spin.rows.first_velocity(topology, further, y_base, y_joint);
        new[0] = w.neg_mul_add(spin.inverse[0], old[0]).clamp(-bound, bound);
    }
    for d in 0..3 {
        new[d] = S::select(active, new[d], old[d]);
    }
    spin.impulse = new;
    spin.apply(topology, further, &[new[0] - old[0], new[1] - old[1], new[2] - old[2]], y_base, y_joint);
}
