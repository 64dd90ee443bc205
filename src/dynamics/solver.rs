//! Warm-started Gauss-Seidel sweeps over contacts and joint bounds.

use super::articulation::{Parameters, Topology};
use super::contact::{BoundRow, ContactRows, ContactSettings, ContactWork, NEVER, dot6};
use super::factor::Factor;
use super::lanes::Real;

/// Sweeps that push penetrations out.
const PUSH_SWEEPS: usize = 4;
/// Further rounds over the joint limits alone after either.
const LAST_ROUNDS: usize = 8;
/// Sweeps come in turns, as many as it takes until contacts are settled, but no more than this: where a light leg is jammed
/// between a joint limit and the ground, sweep after sweep hands it little of what the base weighs.
const MOST_TURNS: usize = 8;
/// A contact is settled when another sweep would change its velocity by less than this, m/s: less would spend on every footfall
/// what only jams need.
const SETTLED: f64 = 0.3;

/// Applies the warm start and runs the sweeps; afterwards `y` in the workspace satisfies the constraints, and
/// `moved_base` and `moved_joints` also push out what is inside each other if anything [`pushes`](ContactWork::pushes).
///
/// The push moves the bodies and is then forgotten: it adds to no velocity, force or friction. (Were it part of them, it would
/// win energy; and where links are jammed friction would resist it, the more the harder it pushes.)
#[inline(always)]
pub fn solve<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
    settings: &ContactSettings,
    factor: &Factor<S>,
    work: &mut ContactWork<S>,
) {
    warm_start(topology, factor, work);
    let mut active = S::zero().lt(S::one());
    for _ in 0..MOST_TURNS {
        for _ in 0..settings.iterations {
            sweep_bounds(topology, active, work);
            sweep_contacts(topology, parameters, active, work);
        }
        // contacts come after dry friction, or feet would creep; limits have the last word: a contact that gives way is soft
        // ground, a limit that does is a broken leg
        for _ in 0..LAST_ROUNDS {
            sweep_limits(topology, active, work);
        }
        active = S::and(active, unsettled(topology, work));
        if !S::any(active) {
            break;
        }
    }
    if work.pushes() {
        work.moved_base = work.base;
        work.moved_joints.copy_from_slice(&work.joints);
        push(topology, work);
    }
}

/// Starts from the last step's impulses, all scaled by the share that comes nearest to the solution: after an impact
/// little of them fits.
///
/// The solution has the least kinetic energy of the change of velocity that keeps the rows' targets (Gauss's principle); along
/// the ray of the old impulses that is a parabola.
#[inline(always)]
fn warm_start<S: Real>(topology: &Topology, factor: &Factor<S>, work: &mut ContactWork<S>) {
    let z = S::zero();
    // on the way, the change of the velocity by the whole impulses is kept where the moved velocity will be
    work.moved_base = [z; 6];
    work.moved_joints.fill(z);
    let ContactWork {
        contacts,
        contact_joint_scaled,
        bounds,
        bound_joint_scaled,
        stride,
        moved_base,
        moved_joints,
        ..
    } = work;
    let (mut targets, mut energy) = (z, S::splat(1e-20));
    for (c, row) in contacts.iter().enumerate() {
        let path = topology.contact_path(row.contact);
        apply(row, &contact_joint_scaled[c * *stride..], path, &row.impulse, moved_base, moved_joints);
        let normal = row.impulse[0];
        targets = row.target.mul_add(normal, targets);
        energy = (row.softness * normal).mul_add(normal, energy);
    }
    for (b, row) in bounds.iter().enumerate() {
        if row.limits {
            let (joint, impulse) = (&bound_joint_scaled[b * *stride..], row.limit_impulse);
            apply_limit(topology, row, joint, impulse, moved_base, moved_joints);
            let target = S::select(z.lt(impulse), row.lowest.min(z), row.highest.max(z));
            targets = target.mul_add(impulse, targets);
        }
    }
    let mut gain = targets;
    for j in 0..topology.num_joints() {
        weigh(work.moved_joints[j], work.joints[j], factor.inverse_diagonal[j], &mut gain, &mut energy);
    }
    if topology.floating {
        for r in 0..6 {
            weigh(work.moved_base[r], work.base[r], factor.base_inverse_diagonal[r], &mut gain, &mut energy);
        }
    }
    let share = (gain / energy).clamp(z, S::one());
    for j in 0..topology.num_joints() {
        work.joints[j] = share.mul_add(work.moved_joints[j], work.joints[j]);
    }
    for r in 0..6 {
        work.base[r] = share.mul_add(work.moved_base[r], work.base[r]);
    }
    for row in &mut work.contacts {
        row.impulse = row.impulse.map(|x| x * share);
    }
    for row in &mut work.bounds {
        row.limit_impulse = row.limit_impulse * share;
    }
}

/// Adds the share of one entry of `y` to what the change gains and to its energy (twice).
#[inline(always)]
fn weigh<S: Real>(change: S, y: S, inverse_mass: S, gain: &mut S, energy: &mut S) {
    let momentum = change / inverse_mass;
    *gain = momentum.neg_mul_add(y, *gain);
    *energy = momentum.mul_add(change, *energy);
}

/// The lanes in which some contact would still change a velocity by more than `SETTLED`.
#[inline(always)]
fn unsettled<S: Real>(topology: &Topology, work: &ContactWork<S>) -> S::Mask {
    let mut most = S::zero();
    for (c, row) in work.contacts.iter().enumerate() {
        let joint = &work.contact_joint[c * work.stride..];
        let w = row.normal_velocity(topology.contact_path(row.contact), joint, &work.base, &work.joints);
        let old = row.impulse[0];
        let missing = row.softness.mul_add(old, w - row.target);
        let normal = missing.neg_mul_add(row.inverse[0], old).max(S::zero());
        most = most.max((normal - old).abs() / row.inverse[0]);
    }
    S::splat(SETTLED).lt(most)
}

/// Pushes out what is inside each other, and joints back that are past a limit: moves `moved_base` and `moved_joints`.
#[inline(always)]
fn push<S: Real>(topology: &Topology, work: &mut ContactWork<S>) {
    // the sweeps work on `base` and `joints`
    std::mem::swap(&mut work.base, &mut work.moved_base);
    std::mem::swap(&mut work.joints, &mut work.moved_joints);
    for _ in 0..PUSH_SWEEPS {
        push_contacts(topology, work);
        push_limits(topology, work);
    }
    for _ in 0..LAST_ROUNDS {
        push_limits(topology, work);
    }
    std::mem::swap(&mut work.base, &mut work.moved_base);
    std::mem::swap(&mut work.joints, &mut work.moved_joints);
}

/// One sweep over the contacts, normals and friction, in the lanes that are `active`.
#[inline(always)]
fn sweep_contacts<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
    active: S::Mask,
    work: &mut ContactWork<S>,
) {
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
        let normal = S::select(active, normal, old[0]);
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
        let keep = |d: usize, x: S| S::select(active, x, old[d]);
        let new = [normal, keep(1, S::select(slides, s1 * shrink, t1)), keep(2, S::select(slides, s2 * shrink, t2))];
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
        let w = row.normal_velocity(path, joint, y_base, y_joint);
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

/// One sweep over the joints' limits and dry friction, in the lanes that are `active`.
#[inline(always)]
fn sweep_bounds<S: Real>(topology: &Topology, active: S::Mask, work: &mut ContactWork<S>) {
    for b in 0..work.bounds.len() {
        let w = bound_velocity(topology, work, b);
        let row = &mut work.bounds[b];
        let old = row.friction_impulse;
        let friction = w.neg_mul_add(row.inverse, old).clamp(-row.max_friction, row.max_friction);
        row.friction_impulse = S::select(active, friction, old);
        let change = row.friction_impulse - old;
        let limit = row.limit(row.diagonal.mul_add(change, w), active);
        apply_bound(topology, work, b, change + limit);
    }
}

/// One sweep over the joints' limits alone, in the lanes that are `active`.
#[inline(always)]
fn sweep_limits<S: Real>(topology: &Topology, active: S::Mask, work: &mut ContactWork<S>) {
    for b in 0..work.bounds.len() {
        if work.bounds[b].limits {
            let w = bound_velocity(topology, work, b);
            let change = work.bounds[b].limit(w, active);
            apply_bound(topology, work, b, change);
        }
    }
}

/// One sweep over the joints' limits that moves joints back that are past one.
#[inline(always)]
fn push_limits<S: Real>(topology: &Topology, work: &mut ContactWork<S>) {
    let pushes = S::zero().lt(work.violation);
    for b in 0..work.bounds.len() {
        if work.bounds[b].limits {
            let w = bound_velocity(topology, work, b);
            let change = work.bounds[b].push(w, pushes);
            apply_bound(topology, work, b, change);
        }
    }
}

impl<S: Real> BoundRow<S> {
    /// Brings a velocity into its bounds: the change of the impulse.
    #[inline(always)]
    fn limit(&mut self, w: S, active: S::Mask) -> S {
        let (lowest, highest) = (self.lowest.min(S::zero()), self.highest.max(S::zero()));
        let limit = S::select(active, self.bounding(w, self.limit_impulse, lowest, highest), self.limit_impulse);
        let change = limit - self.limit_impulse;
        self.limit_impulse = limit;
        change
    }

    /// The same for the motion that pushes joints back.
    #[inline(always)]
    fn push(&mut self, w: S, pushes: S::Mask) -> S {
        let never = S::splat(NEVER);
        let (lowest, highest) = (S::select(pushes, self.lowest, never), S::select(pushes, self.highest, -never));
        let limit = self.bounding(w, self.push_impulse, lowest, highest);
        let change = limit - self.push_impulse;
        self.push_impulse = limit;
        change
    }

    /// The impulse that brings a velocity into its bounds, which it has with `impulse`.
    #[inline(always)]
    fn bounding(&self, w: S, impulse: S, lowest: S, highest: S) -> S {
        // the velocity this row would see without its own impulse, and the nearest allowed one
        let without = self.diagonal.neg_mul_add(impulse, w);
        (without.clamp(lowest, highest) - without) * self.inverse
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
    apply_limit(topology, &bounds[b], &bound_joint_scaled[b * *stride..], change, base, joints);
}

#[inline(always)]
fn apply_limit<S: Real>(
    topology: &Topology,
    row: &BoundRow<S>,
    joint_scaled: &[S],
    impulse: S,
    y_base: &mut [S; 6],
    y_joint: &mut [S],
) {
    for r in 0..6 {
        y_base[r] = row.base_scaled[r].mul_add(impulse, y_base[r]);
    }
    for (p, &j) in topology.path(row.joint + 1).iter().enumerate() {
        y_joint[j] = joint_scaled[p].mul_add(impulse, y_joint[j]);
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
