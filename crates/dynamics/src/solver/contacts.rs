//! Regular sweeps over the contacts: normals and friction.

use crate::articulation::Topology;
use crate::blocks::BLOCK;
use crate::lanes::Real;
use crate::parameters::Parameters;
use crate::rows::{ContactRows, ContactWork};
use crate::sparse_rows::JointRows;

/// One regular sweep over the contacts, in the lanes that are `active`.
#[inline(always)]
pub(super) fn sweep_contacts<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
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
            solve_contact(topology, &friction, active, row, further, &mut base, y_joint);
        }
    }
    *y_base = base;
}

/// Static and dynamic coefficient of a contact; `friction` is that of the whole robot, which links
/// of one robot have among themselves.
#[inline(always)]
pub(super) fn sliding_friction<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
    contact: usize,
    friction: [S; 2],
) -> [S; 2] {
    if !topology.has_surfaces || contact >= topology.contacts.len() {
        return friction;
    }
    let factor = parameters.contact_friction[contact][0];
    [friction[0] * factor, friction[1] * factor]
}

/// Brings the velocity of one contact to its target and its impulse into the friction cone.
#[inline(always)]
fn solve_contact<S: Real>(
    topology: &Topology,
    friction: &[S; 2],
    active: S::Mask,
    row: &mut ContactRows<S>,
    further: &[JointRows<S>],
    y_base: &mut [S; 6],
    y_joint: &mut [[S; BLOCK]],
) {
    // a visit waits for the velocity that the last visit left: what does not depend on it is
    // computed first
    let z = S::zero();
    let active = S::and(active, row.near);
    let old = row.impulse;
    let at_rest = row.softness.mul_add(old[0], -row.target).neg_mul_add(row.inverse[0], old[0]);
    let w = row.rows.velocities(topology, further, y_base, y_joint);
    let normal = w[0].neg_mul_add(row.inverse[0], at_rest).max(z);
    let normal = S::select(active, normal, old[0]);
    let dn = normal - old[0];
    // the point sticks if the impulse that stops it is inside the disc of the static coefficient
    let [pass1, pass2, cross] = row.sticking;
    let t1 = dn.neg_mul_add(pass1, w[1].neg_mul_add(row.inverse[1], old[1]));
    let t2 = dn.neg_mul_add(pass2, w[1].mul_add(cross, w[2].neg_mul_add(row.inverse[2], old[2])));
    let hold = friction[0] * normal;
    let presses = z.lt(normal);
    let slides = (hold * hold).lt(t1.mul_add(t1, t2 * t2));
    // else it slides: an impulse against the velocity, of one mass in all directions, in the disc
    // of the dynamic coefficient
    let (w1, w2) = (row.coupling[0].mul_add(dn, w[1]), row.coupling[1].mul_add(dn, w[2]));
    let [s1, s2] = sliding(row.slide, [w1, w2], [old[1], old[2]], friction[1] * normal);
    let tangential = [S::select(slides, s1, t1), S::select(slides, s2, t2)];
    let new = [
        normal,
        S::select(active, S::select(presses, tangential[0], z), old[1]),
        S::select(active, S::select(presses, tangential[1], z), old[2]),
    ];
    row.impulse = new;
    row.rows.apply(topology, further, &[dn, new[1] - old[1], new[2] - old[2]], y_base, y_joint);
}

/// Impulses along the tangents of a point that slides at the velocities `w`: against them, in a
/// disc of radius `bound`. `mass` is [`ContactRows::slide`].
#[inline(always)]
pub(super) fn sliding<S: Real>(mass: S, w: [S; 2], impulse: [S; 2], bound: S) -> [S; 2] {
    let (s1, s2) = (w[0].neg_mul_add(mass, impulse[0]), w[1].neg_mul_add(mass, impulse[1]));
    let square = s1.mul_add(s1, s2.mul_add(s2, S::splat(1e-20)));
    // neither the root nor the quotient waits for the other
    let shrink = (bound / square * square.sqrt()).min(S::one());
    [s1 * shrink, s2 * shrink]
}
