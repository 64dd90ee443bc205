//! Warm-started Gauss-Seidel sweeps over contacts and joint bounds.

use super::articulation::{Parameters, Topology};
use super::contact::{BoundRow, ContactRows, ContactSettings, ContactWork, NEVER, dot6};
use super::lanes::Real;

/// Sweeps that push penetrations out.
const PUSH_SWEEPS: usize = 4;
/// Further rounds over the joint limits alone after either.
const LAST_ROUNDS: usize = 8;

/// Applies the warm start and runs the sweeps; afterwards `y` in the workspace satisfies the constraints, and
/// `moved_base` and `moved_joints` also push out what is inside each other.
///
/// The push moves the bodies and is then forgotten: it adds to no velocity, force or friction. (Were it part of them, it would
/// win energy; and where links are jammed friction would resist it, the more the harder it pushes.)
#[inline(always)]
pub fn solve<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
    settings: &ContactSettings,
    work: &mut ContactWork<S>,
) {
    let ContactWork { contacts, contact_joint_scaled, stride, base, joints, .. } = work;
    for (c, row) in contacts.iter().enumerate() {
        let path = topology.contact_path(row.contact);
        apply(row, &contact_joint_scaled[c * *stride..], path, &row.impulse, base, joints);
    }
    for _ in 0..settings.iterations {
        sweep_bounds(topology, work);
        sweep_contacts(topology, parameters, work);
    }
    // contacts come after dry friction, or feet would creep; limits have the last word: a contact that gives way is soft
    // ground, a limit that does is a broken leg
    for _ in 0..LAST_ROUNDS {
        sweep_limits(topology, false, work);
    }
    work.moved_base = work.base;
    work.moved_joints.copy_from_slice(&work.joints);
    if !S::any(S::zero().lt(work.violation)) {
        return;
    }
    for row in &mut work.bounds {
        row.limit_impulse = S::zero();
    }
    for _ in 0..PUSH_SWEEPS {
        push_contacts(topology, work);
        sweep_limits(topology, true, work);
    }
    for _ in 0..LAST_ROUNDS {
        sweep_limits(topology, true, work);
    }
    std::mem::swap(&mut work.base, &mut work.moved_base);
    std::mem::swap(&mut work.joints, &mut work.moved_joints);
}

/// One sweep over the contacts, normals and friction.
#[inline(always)]
fn sweep_contacts<S: Real>(topology: &Topology, parameters: &Parameters<S>, work: &mut ContactWork<S>) {
    let depth = work.stride;
    let ContactWork { contacts, contact_joint, contact_joint_scaled, base: y_base, joints: y_joint, .. } = work;
    for (c, row) in contacts.iter_mut().enumerate() {
        let path = topology.contact_path(row.contact);
        let joint = &contact_joint[c * depth..];
        let mut w = [dot6(&row.base[0], y_base), dot6(&row.base[1], y_base), dot6(&row.base[2], y_base)];
        for (p, &j) in path.iter().enumerate() {
            for d in 0..3 {
                w[d] = joint[p][d].mul_add(y_joint[j], w[d]);
            }
        }
        let old = row.impulse;
        let missing = row.softness.mul_add(old[0], w[0] - row.target);
        let normal = missing.neg_mul_add(row.inverse[0], old[0]).max(S::zero());
        let dn = normal - old[0];
        let (w1, w2) = (row.coupling[0].mul_add(dn, w[1]), row.coupling[1].mul_add(dn, w[2]));
        // sticks if the impulse that stops the point is inside the disc of the static coefficient
        let t1 = w1.neg_mul_add(row.inverse[1], old[1]);
        let t2 = row.coupling[2].mul_add(t1 - old[1], w2).neg_mul_add(row.inverse[2], old[2]);
        let hold = parameters.static_friction * normal;
        let slides = (hold * hold).lt(t1.mul_add(t1, t2 * t2));
        // else slides, against the velocity: the same mass in all directions, then onto the dynamic one's disc
        let (s1, s2) = (w1.neg_mul_add(row.slide, old[1]), w2.neg_mul_add(row.slide, old[2]));
        let length = s1.mul_add(s1, s2.mul_add(s2, S::splat(1e-20))).sqrt();
        let shrink = (parameters.dynamic_friction * normal / length).min(S::one());
        let new = [normal, S::select(slides, s1 * shrink, t1), S::select(slides, s2 * shrink, t2)];
        let change = [dn, new[1] - old[1], new[2] - old[2]];
        row.impulse = new;
        apply(row, &contact_joint_scaled[c * depth..], path, &change, y_base, y_joint);
    }
}

/// One sweep over the contacts' normals, for the motion that pushes penetrations out.
#[inline(always)]
fn push_contacts<S: Real>(topology: &Topology, work: &mut ContactWork<S>) {
    let depth = work.stride;
    // what its neighbours' lanes need must change nothing in a lane that has nothing to push out
    let pushes = S::zero().lt(work.violation);
    let ContactWork { contacts, contact_joint, contact_joint_scaled, base: y_base, joints: y_joint, .. } = work;
    for (c, row) in contacts.iter_mut().enumerate() {
        let path = topology.contact_path(row.contact);
        let (joint, scaled) = (&contact_joint[c * depth..], &contact_joint_scaled[c * depth..]);
        let mut w = dot6(&row.base[0], y_base);
        for (p, &j) in path.iter().enumerate() {
            w = joint[p][0].mul_add(y_joint[j], w);
        }
        let target = S::select(pushes, row.push, S::splat(NEVER));
        let missing = row.softness.mul_add(row.push_impulse, w - target);
        let push = missing.neg_mul_add(row.inverse[0], row.push_impulse).max(S::zero());
        let change = push - row.push_impulse;
        row.push_impulse = push;
        for r in 0..6 {
            y_base[r] = row.base_scaled[0][r].mul_add(change, y_base[r]);
        }
        for (p, &j) in path.iter().enumerate() {
            y_joint[j] = scaled[p][0].mul_add(change, y_joint[j]);
        }
    }
}

/// One sweep over the joints' limits and dry friction.
#[inline(always)]
fn sweep_bounds<S: Real>(topology: &Topology, work: &mut ContactWork<S>) {
    let zero = S::zero();
    for b in 0..work.bounds.len() {
        let w = bound_velocity(topology, work, b);
        let row = &mut work.bounds[b];
        let old = row.friction_impulse;
        let friction = w.neg_mul_add(row.inverse, old).clamp(-row.max_friction, row.max_friction);
        row.friction_impulse = friction;
        let w = row.diagonal.mul_add(friction - old, w);
        let change = row.limit(w, row.lowest.min(zero), row.highest.max(zero));
        apply_bound(topology, work, b, (friction - old) + change);
    }
}

/// One sweep over the joints' limits alone; `pushes` moves joints that are past a limit back.
#[inline(always)]
fn sweep_limits<S: Real>(topology: &Topology, pushes: bool, work: &mut ContactWork<S>) {
    let (zero, never) = (S::zero(), S::splat(NEVER));
    let violated = zero.lt(work.violation);
    for b in 0..work.bounds.len() {
        if !work.bounds[b].limits {
            continue;
        }
        let w = bound_velocity(topology, work, b);
        let row = &mut work.bounds[b];
        let (lowest, highest) = if pushes {
            (S::select(violated, row.lowest, never), S::select(violated, row.highest, -never))
        } else {
            (row.lowest.min(zero), row.highest.max(zero))
        };
        let change = row.limit(w, lowest, highest);
        apply_bound(topology, work, b, change);
    }
}

impl<S: Real> BoundRow<S> {
    /// Brings a velocity into its bounds: the change of the impulse.
    #[inline(always)]
    fn limit(&mut self, w: S, lowest: S, highest: S) -> S {
        // the velocity this row would see without its own impulse, and the nearest allowed one
        let without = self.diagonal.neg_mul_add(self.limit_impulse, w);
        let limit = (without.clamp(lowest, highest) - without) * self.inverse;
        let change = limit - self.limit_impulse;
        self.limit_impulse = limit;
        change
    }
}

#[inline(always)]
fn bound_velocity<S: Real>(topology: &Topology, work: &ContactWork<S>, b: usize) -> S {
    let row = &work.bounds[b];
    let joint = &work.bound_joint[b * work.stride..];
    let mut w = dot6(&row.base, &work.base);
    for (p, &j) in topology.path(row.joint + 1).iter().enumerate() {
        w = joint[p].mul_add(work.joints[j], w);
    }
    w
}

#[inline(always)]
fn apply_bound<S: Real>(topology: &Topology, work: &mut ContactWork<S>, b: usize, change: S) {
    let ContactWork { bounds, bound_joint_scaled, stride, base, joints, .. } = work;
    let row = &bounds[b];
    let scaled = &bound_joint_scaled[b * *stride..];
    for r in 0..6 {
        base[r] = row.base_scaled[r].mul_add(change, base[r]);
    }
    for (p, &j) in topology.path(row.joint + 1).iter().enumerate() {
        joints[j] = scaled[p].mul_add(change, joints[j]);
    }
}

#[inline(always)]
fn apply<S: Real>(
    row: &ContactRows<S>,
    joint_scaled: &[[S; 3]],
    path: &[usize],
    impulse: &[S; 3],
    y_base: &mut [S; 6],
    y_joint: &mut [S],
) {
    for r in 0..6 {
        let x = row.base_scaled[0][r].mul_add(impulse[0], y_base[r]);
        let x = row.base_scaled[1][r].mul_add(impulse[1], x);
        y_base[r] = row.base_scaled[2][r].mul_add(impulse[2], x);
    }
    for (p, &j) in path.iter().enumerate() {
        let x = joint_scaled[p][0].mul_add(impulse[0], y_joint[j]);
        let x = joint_scaled[p][1].mul_add(impulse[1], x);
        y_joint[j] = joint_scaled[p][2].mul_add(impulse[2], x);
    }
}
