//! Warm-started Gauss-Seidel sweeps over contacts and joint bounds.

use super::articulation::Topology;
use super::blocks::BLOCK;
use super::contact::{ContactSettings, SWEEPS};
use super::lanes::Real;
use super::parameters::BodyNumbers;
use super::rows::{BoundBlock, BoundRow, ContactRows, ContactWork};
use super::sparse_rows::JointRows;

/// Sweeps that push penetrations out, at most.
const PUSH_SWEEPS: usize = 4;
/// They end where one changes no velocity by more than this, m/s or rad/s.
const PUSHED: f64 = 0.001;
/// Further rounds over the joint limits alone after either, ...
const LAST_ROUNDS: usize = 8;
/// ... until one changes no velocity by more than this, rad/s.
const LIMITED: f64 = 1e-4;
/// Sweeps come in turns, as many as it takes until contacts are settled, but no more than this: where a light leg is jammed
/// between a joint limit and the ground, sweep after sweep hands it little of what the base weighs. Turns after the first have
/// no more than [`TURN`] sweeps.
const MOST_TURNS: usize = 15;
/// The first turn ends early where a sweep changes little: by less than what such a change of the whole robot's speed would be, m/s
/// (in kinetic energy; a leg that weighs a hundredth may change ten times as much).
const CALM: f64 = 0.0005;
/// Sweeps of the first turn after which this is looked at.
const STRETCH: usize = 2;
/// Sweeps of a turn after the first, at most.
const TURN: usize = 4;
/// A contact is settled when another sweep would change its velocity by less than this, m/s: less would spend on every footfall
/// what only jams need.
const SETTLED: f64 = 0.3;
/// Where it is pushed out faster than `DEEP`, it is settled when that would be less than `SETTLED_DEEP`, both m/s: a link that lies
/// between the ground and the base and gives way a little in every step sinks.
const DEEP: f64 = 0.04;
/// See [`DEEP`].
const SETTLED_DEEP: f64 = 0.03;

/// Applies the warm start and runs the sweeps; afterwards `y` in the workspace satisfies the constraints, and
/// `moved_base` and `moved_joints` also push out what is inside each other if anything [`pushes`](ContactWork::pushes).
///
/// The push moves the bodies and is then forgotten: it adds to no velocity, force or friction. (Were it part of them, it would
/// win energy; and where links are jammed friction would resist it, the more the harder it pushes.)
#[inline(always)]
pub fn solve<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    settings: &ContactSettings,
    work: &mut ContactWork<S>,
) {
    warm_start(topology, work);
    let mut active = S::zero().lt(S::one());
    first_turn(topology, parameters, settings, active, work);
    for turn in 0..MOST_TURNS {
        if turn > 0 {
            for _ in 0..settings.iterations.min(TURN) {
                sweep_bounds(topology, active, work);
                sweep_contacts(topology, parameters, active, true, work);
            }
        }
        // contacts come after dry friction, or feet would creep; limits have the last word: a contact that gives way is soft
        // ground, a limit that does is a broken leg
        last_rounds(topology, active, false, work);
        active = S::and(active, unsettled(topology, work));
        if !S::any(active) {
            break;
        }
        wake(active, work);
    }
    if work.pushes() {
        work.moved_base = work.base;
        work.moved_joints.copy_from_slice(&work.joints);
        push(topology, work);
    }
}

/// Sweeps until they change little, or as many as are asked for.
#[inline(always)]
fn first_turn<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    settings: &ContactSettings,
    all: S::Mask,
    work: &mut ContactWork<S>,
) {
    let mut active = all;
    for sweep in 1..=settings.iterations {
        // who asks for more wants them all: a load that many points share is settled by many small changes
        let looks = settings.iterations <= SWEEPS && sweep % STRETCH == 0 && sweep < settings.iterations;
        if looks {
            // where the moved velocity will be
            work.moved_base = work.base;
            work.moved_joints.copy_from_slice(&work.joints);
        }
        sweep_bounds(topology, active, work);
        sweep_contacts(topology, parameters, active, false, work);
        if looks {
            active = S::and(active, stirred(work));
            if !S::any(active) {
                break;
            }
            wake(active, work);
        }
    }
}

/// The lanes in which the velocity differs from the one kept aside by more than `CALM`.
#[inline(always)]
fn stirred<S: Real>(work: &ContactWork<S>) -> S::Mask {
    let mut energy = S::zero();
    let now = work.joints.as_flattened().iter().chain(&work.base);
    for (&now, &before) in now.zip(work.moved_joints.as_flattened().iter().chain(&work.moved_base)) {
        let change = now - before;
        energy = change.mul_add(change, energy);
    }
    S::splat(CALM * CALM).lt(energy * work.compliance)
}

/// Wakes the contacts and bounds that take part in one of these lanes: others have no impulse in them, now or later.
#[inline(always)]
fn wake<S: Real>(active: S::Mask, work: &mut ContactWork<S>) {
    for row in &mut work.contacts[..work.num_contacts] {
        row.awake = S::any(S::and(active, row.near));
    }
    for block in &mut work.bounds {
        block.active = false;
        for row in &block.joints {
            if row.limits {
                block.active |= S::any(S::and(active, row.near));
            }
            if row.rubs {
                block.active |= S::any(S::and(active, S::zero().lt(row.max_friction)));
            }
        }
    }
}

/// Starts from the last step's impulses, all scaled by the share that comes nearest to the solution: after an impact
/// little of them fits.
///
/// The solution has the least kinetic energy of the change of velocity that keeps the rows' targets (Gauss's principle); along
/// the ray of the old impulses that is a parabola.
#[inline(always)]
fn warm_start<S: Real>(topology: &Topology, work: &mut ContactWork<S>) {
    let z = S::zero();
    // on the way, the change of the velocity by the whole impulses is kept where the moved velocity will be
    work.moved_base = [z; 6];
    work.moved_joints.fill([z; BLOCK]);
    let ContactWork {
        contacts,
        num_contacts,
        contact_further,
        bounds,
        bound_further,
        stride,
        moved_base,
        moved_joints,
        ..
    } = work;
    let (mut targets, mut energy) = (z, S::splat(1e-20));
    for (row, further) in contacts[..*num_contacts].iter().zip(contact_further.chunks_exact(*stride)) {
        row.rows.apply(topology, further, &row.impulse, moved_base, moved_joints);
        let normal = row.impulse[0];
        targets = row.target.mul_add(normal, targets);
        energy = (row.softness * normal).mul_add(normal, energy);
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

/// The lanes in which some contact is not settled.
#[inline(always)]
fn unsettled<S: Real>(topology: &Topology, work: &ContactWork<S>) -> S::Mask {
    let mut beyond = S::zero();
    for (row, further) in work.contacts().iter().zip(work.contact_further.chunks_exact(work.stride)) {
        let w = row.rows.first_velocity(topology, further, &work.base, &work.joints);
        let old = row.impulse[0];
        let missing = row.softness.mul_add(old, w - row.target);
        let normal = missing.neg_mul_add(row.inverse[0], old).max(S::zero());
        let enough = S::select(S::splat(DEEP).lt(row.push), S::splat(SETTLED_DEEP), S::splat(SETTLED));
        let beyond_here = (normal - old).abs().mul_add(row.diagonal, -enough);
        beyond = S::select(row.near, beyond.max(beyond_here), beyond);
    }
    S::zero().lt(beyond)
}

/// Pushes out what is inside each other, and joints back that are past a limit: moves `moved_base` and `moved_joints`.
#[inline(always)]
fn push<S: Real>(topology: &Topology, work: &mut ContactWork<S>) {
    // the sweeps work on `base` and `joints`
    std::mem::swap(&mut work.base, &mut work.moved_base);
    std::mem::swap(&mut work.joints, &mut work.moved_joints);
    // what its neighbours' lanes need must change nothing in a lane that has nothing to push out
    let pushes = S::zero().lt(work.violation);
    let mut active = pushes;
    wake(active, work);
    for _ in 0..PUSH_SWEEPS {
        let most = push_contacts(topology, active, work).max(sweep_limits(topology, active, true, work));
        active = S::and(active, S::splat(PUSHED).lt(most));
        if !S::any(active) {
            break;
        }
    }
    last_rounds(topology, pushes, true, work);
    std::mem::swap(&mut work.base, &mut work.moved_base);
    std::mem::swap(&mut work.joints, &mut work.moved_joints);
}

/// One sweep over the contacts, normals and friction, in the lanes that are `active`, which are `jammed` after the first turn.
#[inline(always)]
fn sweep_contacts<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    active: S::Mask,
    jammed: bool,
    work: &mut ContactWork<S>,
) {
    let ContactWork { contacts, num_contacts, contact_further, stride, base: y_base, joints: y_joint, .. } = work;
    let friction = [parameters.static_friction(), parameters.dynamic_friction()];
    // a copy, which stays in registers from one visit to the next
    let mut base = *y_base;
    for (row, further) in contacts[..*num_contacts].iter_mut().zip(contact_further.chunks_exact(*stride)) {
        if !row.awake {
            continue;
        }
        if jammed {
            visit_jammed(topology, &friction, active, row, further, &mut base, y_joint);
        } else {
            visit_contact(topology, &friction, active, row, further, &mut base, y_joint);
        }
    }
    *y_base = base;
}

/// Brings the velocity of one contact to its target and its impulse into the friction cone.
#[inline(always)]
fn visit_contact<S: Real>(
    topology: &Topology,
    friction: &[S; 2],
    active: S::Mask,
    row: &mut ContactRows<S>,
    further: &[JointRows<S>],
    y_base: &mut [S; 6],
    y_joint: &mut [[S; BLOCK]],
) {
    // each visit waits for the velocity that the last one left: what does not depend on it is found beside
    let z = S::zero();
    let active = S::and(active, row.near);
    let old = row.impulse;
    let at_rest = row.softness.mul_add(old[0], -row.target).neg_mul_add(row.inverse[0], old[0]);
    let w = row.rows.velocities(topology, further, y_base, y_joint);
    let normal = w[0].neg_mul_add(row.inverse[0], at_rest).max(z);
    let normal = S::select(active, normal, old[0]);
    let dn = normal - old[0];
    // sticks if the impulse that stops the point is inside the disc of the static coefficient
    let [pass1, pass2, cross] = row.sticking;
    let t1 = dn.neg_mul_add(pass1, w[1].neg_mul_add(row.inverse[1], old[1]));
    let t2 = dn.neg_mul_add(pass2, w[1].mul_add(cross, w[2].neg_mul_add(row.inverse[2], old[2])));
    let hold = friction[0] * normal;
    let presses = z.lt(normal);
    let slides = (hold * hold).lt(t1.mul_add(t1, t2 * t2));
    // else slides, against the velocity: the same mass in all directions, then onto the dynamic one's disc
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

/// Impulses along the tangents of a point that slides at velocities `w`: against them, within a disc of radius `bound`. `mass` is that
/// of a sliding step.
#[inline(always)]
fn sliding<S: Real>(mass: S, w: [S; 2], impulse: [S; 2], bound: S) -> [S; 2] {
    let (s1, s2) = (w[0].neg_mul_add(mass, impulse[0]), w[1].neg_mul_add(mass, impulse[1]));
    let square = s1.mul_add(s1, s2.mul_add(s2, S::splat(1e-20)));
    // neither the root nor the quotient waits for the other
    let shrink = (bound / square * square.sqrt()).min(S::one());
    [s1 * shrink, s2 * shrink]
}

/// [`visit_contact`] where contacts have not settled: a normal impulse and its friction may undo each other, so that sweeps go back and
/// forth between two states. The point is pushed up, friction that grows with it lifts it further, and next it is not pushed at
/// all.
///
/// Friction that is at its bound follows the normal impulse at once. A normal impulse that turns back goes half of its way, and the
/// point then sticks no better than it slides, since between two bounds it would go back and forth too.
#[inline(always)]
fn visit_jammed<S: Real>(
    topology: &Topology,
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
    let at_bound = S::and((bound * S::splat(0.98)).lt(square), square.lt(bound * S::splat(1.02)));
    let slid = S::and(z.lt(old[0]), at_bound);
    let per_normal = one / old[0].max(S::splat(1e-9));
    let follow = [S::select(slid, old[1] * per_normal, z), S::select(slid, old[2] * per_normal, z)];
    let [c01, c02, c12] = row.coupling;
    let diagonal = c01.mul_add(follow[0], c02.mul_add(follow[1], row.diagonal));
    // friction may drive the point into the ground faster than the normal impulse lifts it
    let diagonal = diagonal.max(row.diagonal * S::splat(0.2));
    let missing = row.softness.mul_add(old[0], w[0] - row.target);
    let change = (old[0] - missing / diagonal).max(z) - old[0];
    let turned = (change * row.last_change).lt(z);
    let dn = S::select(turned, change * S::splat(0.5), change);
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

/// One sweep over the contacts' normals, for the motion that pushes penetrations out, in the lanes that are `active`; by how much it
/// changed a velocity at most.
#[inline(always)]
fn push_contacts<S: Real>(topology: &Topology, active: S::Mask, work: &mut ContactWork<S>) -> S {
    let ContactWork { contacts, num_contacts, contact_further, stride, base: y_base, joints: y_joint, .. } = work;
    let mut most = S::zero();
    for (row, further) in contacts[..*num_contacts].iter_mut().zip(contact_further.chunks_exact(*stride)) {
        if !row.awake {
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

/// One sweep over the joints' limits and dry friction, in the lanes that are `active`.
#[inline(always)]
fn sweep_bounds<S: Real>(topology: &Topology, active: S::Mask, work: &mut ContactWork<S>) {
    let ContactWork { bounds, bound_further, stride, base: y_base, joints, .. } = work;
    let mut base = *y_base;
    for (block, further) in bounds.iter_mut().zip(bound_further.chunks_exact(*stride)) {
        if block.active {
            visit_bounds(topology, active, block, further, &mut base, joints);
        }
    }
    *y_base = base;
}

/// Brings the velocities of a block's joints into their bounds, one after the other.
#[inline(always)]
fn visit_bounds<S: Real>(
    topology: &Topology,
    active: S::Mask,
    block: &mut BoundBlock<S>,
    further: &[JointRows<S>],
    y_base: &mut [S; 6],
    y_joint: &mut [[S; BLOCK]],
) {
    let mut w = block.rows.velocities(topology, further, y_base, y_joint);
    // dry friction is found in the same way whether a neighbour's lane is near a limit or not
    let [pass01, pass02, pass12] = block.rubbing;
    let mut stopping = [S::zero(); 3];
    for i in 0..3 {
        stopping[i] = block.joints[i].stopping(w[i]);
    }
    let mut change = [S::zero(); 3];
    for i in 0..3 {
        let row = &mut block.joints[i];
        change[i] = row.rub(stopping[i], active);
        if block.limits {
            if row.limits {
                change[i] = change[i] + row.limit(row.diagonal.mul_add(change[i], w[i]), active);
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

/// Further rounds over the joints' limits alone, in the lanes that are `active`, for the velocity or the motion that pushes joints back.
#[inline(always)]
fn last_rounds<S: Real>(topology: &Topology, mut active: S::Mask, pushing: bool, work: &mut ContactWork<S>) {
    for _ in 0..LAST_ROUNDS {
        let most = sweep_limits(topology, active, pushing, work);
        active = S::and(active, S::splat(LIMITED).lt(most));
        if !S::any(active) {
            break;
        }
    }
}

/// One sweep over the joints' limits alone, likewise; by how much it changed a velocity at most.
#[inline(always)]
fn sweep_limits<S: Real>(topology: &Topology, active: S::Mask, pushing: bool, work: &mut ContactWork<S>) -> S {
    let ContactWork { bounds, bound_further, stride, base, joints, .. } = work;
    let mut most = S::zero();
    for (block, further) in bounds.iter_mut().zip(bound_further.chunks_exact(*stride)) {
        if block.limits {
            let mut w = block.rows.velocities(topology, further, base, joints);
            let mut change = [S::zero(); 3];
            for i in 0..3 {
                let row = &mut block.joints[i];
                change[i] = if pushing { row.push(w[i], active) } else { row.limit(w[i], active) };
                most = most.max((change[i] * row.diagonal).abs());
                block.pass_on(i, change[i], &mut w);
            }
            block.rows.apply(topology, further, &change, base, joints);
        }
    }
    most
}

impl<S: Real> BoundBlock<S> {
    /// What an impulse on row `i` changes in the velocities of the rows after it.
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
    /// That of the limit and of dry friction together.
    #[inline(always)]
    pub(super) fn impulse(&self) -> S {
        if self.limits { self.limit_impulse + self.friction_impulse } else { self.friction_impulse }
    }

    /// The impulse of dry friction that would bring a velocity to zero.
    #[inline(always)]
    fn stopping(&self, w: S) -> S {
        w.neg_mul_add(self.inverse, self.friction_impulse)
    }

    /// Comes as near to that impulse as dry friction can: the change of its impulse.
    #[inline(always)]
    fn rub(&mut self, stopping: S, active: S::Mask) -> S {
        let old = self.friction_impulse;
        let friction = stopping.clamp(-self.max_friction, self.max_friction);
        self.friction_impulse = S::select(active, friction, old);
        self.friction_impulse - old
    }

    /// Brings a velocity into its bounds: the change of the impulse.
    #[inline(always)]
    fn limit(&mut self, w: S, active: S::Mask) -> S {
        let (lowest, highest) = (self.lowest.min(S::zero()), self.highest.max(S::zero()));
        let active = S::and(active, self.near);
        let limit = S::select(active, self.bounding(w, self.limit_impulse, lowest, highest), self.limit_impulse);
        let change = limit - self.limit_impulse;
        self.limit_impulse = limit;
        change
    }

    /// The same for the motion that pushes joints back.
    #[inline(always)]
    fn push(&mut self, w: S, active: S::Mask) -> S {
        let limit = self.bounding(w, self.push_impulse, self.lowest, self.highest);
        let limit = S::select(S::and(active, self.near), limit, self.push_impulse);
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
