//! Contacts and joint bounds as velocity constraints: which take part in a step, and what they ask for.

use super::articulation::{ContactKind, Topology};
use super::blocks::BLOCK;
use super::kinematics::forward_kinematics;
use super::lanes::Real;
use super::math::{
    Mat3, Spatial, Vec3, add, add_scaled, cross, dot, mul_vec, mul_vec_transposed, normalised, quat_to_mat, scale,
    splat,
};
use super::parameters::BodyNumbers;
use super::rows::{BoundRow, ContactWork, NEVER};
use super::state::{Report, State, Workspace};
use super::terrain::{Near, Terrain};

/// Gauss-Seidel sweeps per physics step that are usual. What more of them would change is a fraction of what a shorter physics step
/// would (`polypod accuracy`).
pub const SWEEPS: usize = 4;

/// How contacts and joint bounds are solved.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactSettings {
    /// Gauss-Seidel sweeps per physics step: fewer where they change little, more where links are jammed.
    pub iterations: usize,
    /// Share of a penetration that one physics step removes.
    pub correction: f64,
    /// Largest speed at which a penetration is pushed out, m/s.
    pub max_depenetration_velocity: f64,
    /// Approach speed from which restitution acts, m/s.
    pub bounce_threshold: f64,
    /// What robots stand on; nothing without.
    pub ground: Option<Plane>,
}

/// A plane that bodies stay above: points `x` with `normal . x = offset`, world axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Unit vector that points away from the ground.
    pub normal: [f64; 3],
    /// Distance from the world's origin along the normal, m.
    pub offset: f64,
}

impl Plane {
    /// A level plane.
    pub fn level(height: f64) -> Self {
        Self { normal: [0.0, 0.0, 1.0], offset: height }
    }

    /// The normal and two tangents, world axes; a level plane's tangents are x and y.
    fn frame(&self) -> [[f64; 3]; 3] {
        let n = self.normal;
        if n == [0.0, 0.0, 1.0] {
            return [n, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        }
        let along = if n[0].abs() < 0.9 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
        let t = add_scaled(&along, &n, -dot(&along, &n));
        let t = scale(&t, 1.0 / dot(&t, &t).sqrt());
        [n, t, cross(&n, &t)]
    }
}

impl Default for ContactSettings {
    fn default() -> Self {
        Self {
            iterations: SWEEPS,
            correction: 0.2,
            max_depenetration_velocity: 1.0,
            bounce_threshold: 0.5,
            ground: Some(Plane::level(0.0)),
        }
    }
}

/// Candidates further from the ground than this are not looked at, m.
const CONTACT_MARGIN: f64 = 0.02;
/// A candidate takes part in a physics step when it is nearer to the ground than this, m, and what it comes nearer by in the
/// step, at its present speed or without constraints.
const CONTACT_REACH: f64 = 0.004;
/// The gap of a candidate that no ground is near, m.
const FAR: f64 = 1e9;
/// A joint bound takes part when the joint could come nearer to it than this in two physics steps, rad or m.
const BOUND_MARGIN: f64 = 0.05;
/// ... or, since a contact may throw a joint against its stop within one step, than its velocity limit leads in a step,
/// but no more than this, rad or m.
const LARGEST_BOUND_MARGIN: f64 = 0.25;
/// ... or when it moves faster than this share of its velocity limit.
const SPEED_MARGIN: f64 = 0.7;
/// What is inside each other by less than this is left so, m; most steps then have nothing to push out.
const SLOP: f64 = 1e-4;
/// And joints past a limit by less than this, rad or m.
const BOUND_SLOP: f64 = 1e-5;

/// Normal and tangents of a plane, the same in every lane.
#[inline(always)]
fn splat_frame<S: Real>(plane: &Plane) -> [Vec3<S>; 3] {
    let frame = plane.frame();
    [splat(&frame[0]), splat(&frame[1]), splat(&frame[2])]
}

/// The lowest point of a candidate, in link axes about the link's origin; `up` is the world's up in link axes.
#[inline(always)]
fn candidate_point<S: Real, B: BodyNumbers<S>>(
    parameters: B,
    contact: usize,
    kind: ContactKind,
    up: &Vec3<S>,
) -> Vec3<S> {
    let centre = &parameters.contact_position(contact);
    match kind {
        ContactKind::Point => *centre,
        ContactKind::Rim { across, turn } => {
            let e = [splat(&across[0]), splat(&across[1])];
            let (c, s) = (-dot(&e[0], up), -dot(&e[1], up));
            let length = c.mul_add(c, s * s).sqrt();
            // an upright cylinder has no lowest rim point: take fixed ones
            let upright = length.lt(S::splat(1e-3));
            let inverse = S::one() / length;
            let (c, s) = (S::select(upright, S::one(), c * inverse), S::select(upright, S::zero(), s * inverse));
            let (tc, ts) = (S::splat(turn[0]), S::splat(turn[1]));
            let (c, s) = (c.mul_add(tc, -(s * ts)), s.mul_add(tc, c * ts));
            let rim = parameters.contact_rim(contact);
            add_scaled(&add_scaled(centre, &e[0], c * rim), &e[1], s * rim)
        }
    }
}

/// The lowest point of a candidate (see [`candidate_point`]) and its distance from the ground, m.
#[inline(always)]
fn candidate<S: Real, B: BodyNumbers<S>>(
    parameters: B,
    contact: usize,
    kind: ContactKind,
    up: &Vec3<S>,
    origin_height: S,
) -> (Vec3<S>, S) {
    let local = candidate_point(parameters, contact, kind, up);
    (local, origin_height + dot(up, &local) - parameters.contact_radius(contact))
}

/// Distance of each contact candidate from the ground, m, `[contacts]` in the topology's order; negative inside the
/// ground, and empty where there is none. For tools and tests: a step finds its contacts itself.
pub fn candidate_gaps<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    settings: &ContactSettings,
    state: &State<S>,
    work: &mut Workspace<S>,
) -> Vec<S> {
    let Some(plane) = &settings.ground else {
        return Vec::new();
    };
    let (positions, velocities) = (&state.joint_position, &state.joint_velocity);
    forward_kinematics(topology, parameters, positions, velocities, &Spatial::zero(), work);
    let normal = splat(&plane.normal);
    let ground = dot(&normal, &state.position) - S::splat(plane.offset);
    let normal = mul_vec_transposed(&quat_to_mat(&state.rotation), &normal);
    let gaps = topology.contacts.iter().enumerate().map(|(c, contact)| {
        let at = &work.links[contact.link];
        let up = mul_vec_transposed(&at.rotation, &normal);
        candidate(parameters, c, contact.kind, &up, ground + dot(&normal, &at.position)).1
    });
    gaps.collect()
}

/// Finds the contacts near the ground and builds their rows. Without constraints the base would have the velocity `free_base`, about
/// its own origin and axes.
#[inline(always)]
pub fn build_contacts<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    settings: &ContactSettings,
    terrain: Option<&Terrain<S>>,
    dt: S,
    state: &State<S>,
    free_base: &Spatial<S>,
    work: &mut Workspace<S>,
) {
    let Workspace { base_rotation, links, dynamics, factor, velocity_base, contact: rows, .. } = work;
    let margin = S::splat(CONTACT_MARGIN);
    // the links' velocities have all of the base's but this
    let base = Spatial { ang: [S::zero(); 3], lin: [velocity_base[3], velocity_base[4], velocity_base[5]] };
    // composite by now: the whole robot's
    rows.clear(dynamics[0].inertia.mass);
    let Some(plane) = &settings.ground else {
        return;
    };
    let world = splat_frame(plane);
    let ground = dot(&world[0], &state.position) - S::splat(plane.offset);
    // normal and tangents in base axes
    let frame = [
        mul_vec_transposed(base_rotation, &world[0]),
        mul_vec_transposed(base_rotation, &world[1]),
        mul_vec_transposed(base_rotation, &world[2]),
    ];
    let inverse_dt = S::one() / dt;
    for (link, at) in links.iter().enumerate() {
        let candidates = topology.contacts_of(link);
        if candidates.is_empty() {
            continue;
        }
        let origin_height = ground + dot(&frame[0], &at.position);
        let up = mul_vec_transposed(&at.rotation, &frame[0]);
        let [cx, cy, cz, hx, hy, hz] = parameters.link_box(link);
        let (centre, half) = ([cx, cy, cz], [hx, hy, hz]);
        let mut highest = margin;
        if let Some(terrain) = terrain {
            let [x, y, _] = world_place(&frame, &state.position, &add(&at.position, &mul_vec(&at.rotation, &centre)));
            let bound = terrain.bound(Near::Link, x, y, dot(&half, &half).sqrt() + margin);
            highest = margin + bound - S::splat(plane.offset);
        }
        let below = half[0].mul_add(up[0].abs(), half[1].mul_add(up[1].abs(), half[2] * up[2].abs()));
        // what a lane is told by here it must be told by in every pack, whether its neighbours look closer or not
        let link_near = (origin_height + dot(&up, &centre) - below).lt(highest);
        if !S::any(link_near) {
            continue;
        }
        for c in candidates {
            // whichever way its rim points
            let reach = parameters.contact_radius(c) + parameters.contact_rim(c);
            let lowest = origin_height + dot(&up, &parameters.contact_position(c)) - reach;
            let mut may_touch = S::and(link_near, lowest.lt(highest));
            if !S::any(may_touch) {
                continue;
            }
            let (local, mut gap) = candidate(parameters, c, topology.contacts[c].kind, &up, origin_height);
            may_touch = S::and(may_touch, gap.lt(highest));
            if !S::any(may_touch) {
                continue;
            }
            let (centre, radius) = (add(&at.position, &mul_vec(&at.rotation, &local)), parameters.contact_radius(c));
            let surface;
            let mut axes_here = &frame;
            if let Some(terrain) = terrain {
                let place = world_place(&frame, &state.position, &centre);
                let bound = terrain.bound(Near::Candidate, place[0], place[1], radius + margin);
                may_touch = S::and(may_touch, gap.lt(margin + bound - S::splat(plane.offset)));
                if !S::any(may_touch) {
                    continue;
                }
                (gap, surface) = on_terrain(terrain, &frame, &place, radius);
                // the plane of a steep cell, which goes on beyond it, may be nearer than any ground
                gap = S::select(may_touch, gap, S::splat(FAR));
                if !S::any(gap.lt(margin)) {
                    continue;
                }
                axes_here = &surface;
            }
            let now = dot(&axes_here[0], &at.velocity.plus(&base).at(&centre));
            let free = dot(&axes_here[0], &at.free_velocity.plus(free_base).at(&centre));
            let near = S::and(may_touch, gap.lt(reach_in_step(CONTACT_REACH, now, free, dt).min(margin)));
            if !S::any(near) {
                continue;
            }
            rows.build_ground(topology, factor, links, axes_here, c, &centre, radius);
            if terrain.is_some() {
                rows.ground_frames.push(*axes_here);
            }
            let target = separation(gap, settings, inverse_dt);
            let zero = S::zero();
            let mut bounce = S::splat(NEVER);
            let elastic = zero.lt(parameters.restitution());
            if S::any(elastic) {
                let (row, further) = rows.next();
                let approach = row.first_velocity(topology, further, &rows.base, &rows.joints);
                let bounces = S::and(approach.lt(S::splat(-settings.bounce_threshold)), gap.lt(-(approach * dt)));
                bounce = S::select(S::and(elastic, bounces), -(approach * parameters.restitution()), bounce);
            }
            rows.add(near, target, bounce, &state.impulse[c]);
        }
    }
}

/// A place about the base's origin, in base axes, in the world instead; `level` are the world's z, x and y in base axes.
#[inline(always)]
fn world_place<S: Real>(level: &[Vec3<S>; 3], position: &Vec3<S>, place: &Vec3<S>) -> Vec3<S> {
    add(position, &[dot(&level[1], place), dot(&level[2], place), dot(&level[0], place)])
}

/// Gap of a sphere at `place` above terrain, and normal and tangents there in base axes. For `level` see [`world_place`].
#[inline(always)]
fn on_terrain<S: Real>(terrain: &Terrain<S>, level: &[Vec3<S>; 3], place: &Vec3<S>, radius: S) -> (S, [Vec3<S>; 3]) {
    let (gap, n) = terrain.gap(place, radius);
    // the x axis, laid onto the surface; the normal points up a little at least, so that it is never along x
    let along = [n[0].neg_mul_add(n[0], S::one()), -(n[0] * n[1]), -(n[0] * n[2])];
    let tangent = scale(&along, S::one() / along[0].sqrt());
    let (normal, tangent) = (to_base(level, &n), to_base(level, &tangent));
    (gap, [normal, tangent, cross(&normal, &tangent)])
}

/// A vector in world axes, whose z, x and y are `level` in base axes.
#[inline(always)]
fn to_base<S: Real>(level: &[Vec3<S>; 3], v: &Vec3<S>) -> Vec3<S> {
    add_scaled(&add_scaled(&scale(&level[0], v[2]), &level[1], v[0]), &level[2], v[1])
}

/// How far apart two things may be that can touch in a step, m: `least`, and what they come nearer by. `now` and `free` are the speeds
/// at which they part at present and without constraints; limits may hold what would be free, and then the former tells more.
#[inline(always)]
pub(super) fn reach_in_step<S: Real>(least: f64, now: S, free: S, dt: S) -> S {
    now.min(free).min(S::zero()).neg_mul_add(dt, S::splat(least))
}

/// Least allowed separation speed at a gap: one that is open may close, a penetration is pushed out.
#[inline(always)]
pub(super) fn separation<S: Real>(gap: S, settings: &ContactSettings, inverse_dt: S) -> S {
    let push = push_speed(-gap, SLOP, settings, inverse_dt);
    S::select(gap.lt(S::zero()), push, -(gap * inverse_dt))
}

/// The speed at which a violation of this depth is pushed out, of which `slop` is left.
#[inline(always)]
fn push_speed<S: Real>(depth: S, slop: f64, settings: &ContactSettings, inverse_dt: S) -> S {
    let beyond = (depth - S::splat(slop)).max(S::zero());
    (beyond * S::splat(settings.correction) * inverse_dt).min(S::splat(settings.max_depenetration_velocity))
}

/// Builds the rows of every joint near a position limit, near its velocity limit, or with Coulomb friction, and of those in its
/// block.
///
/// `free` is the joints' velocity without constraints, `[blocks]`.
#[inline(always)]
pub fn build_bounds<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    settings: &ContactSettings,
    dt: S,
    state: &State<S>,
    free: &[[S; BLOCK]],
    work: &mut Workspace<S>,
) {
    let Workspace { factor, contact: work, .. } = work;
    let ContactWork { bounds, bound_further, stride, violation, .. } = work;
    let inverse_dt = S::one() / dt;
    let blocks = bounds.iter_mut().zip(topology.blocks()).zip(bound_further.chunks_exact_mut(*stride));
    for (b, ((block, shape), further)) in blocks.enumerate() {
        (block.limits, block.active) = (false, false);
        for place in 0..shape.len {
            let (j, row) = (shape.joints[place], &mut block.joints[place]);
            row.near = near_bounds(parameters, dt, state, j, free[b][place]);
            row.limits = S::any(row.near);
            row.rubs = S::any(S::zero().lt(parameters.joint_friction(j)));
            block.limits |= row.limits;
            block.active |= row.takes_part();
        }
        if !block.active {
            continue;
        }
        for place in 0..shape.len {
            let (j, row) = (shape.joints[place], &mut block.joints[place]);
            row.max_friction = parameters.joint_friction(j) * dt;
            // of both together as much as friction can
            row.friction_impulse = state.bound_impulse[j].clamp(-row.max_friction, row.max_friction);
            if block.limits {
                joint_limits(parameters, settings, inverse_dt, state, j, row, violation);
            }
        }
        for place in shape.len..BLOCK {
            block.joints[place] = BoundRow::free();
        }
        block.rows.set_path(topology, shape.joints[shape.len - 1] + 1);
        block.rows.half_solve_units(topology, factor, further);
        let product = block.rows.products(topology, further);
        for place in 0..BLOCK {
            block.joints[place].diagonal = product[place];
            block.joints[place].inverse = S::one() / product[place];
        }
        let (second, third) = (block.joints[1].inverse, block.joints[2].inverse);
        block.coupling = [product[3], product[4], product[5]];
        block.rubbing = [product[3] * second, product[4] * third, product[5] * third];
    }
}

/// The lanes in which a joint is near a position limit or its velocity limit.
#[inline(always)]
fn near_bounds<S: Real, B: BodyNumbers<S>>(parameters: B, dt: S, state: &State<S>, j: usize, free: S) -> S::Mask {
    let (q, fastest) = (state.joint_position[j], parameters.velocity_limit(j));
    let thrown = (fastest * dt).clamp(S::splat(BOUND_MARGIN), S::splat(LARGEST_BOUND_MARGIN));
    let speed = free.abs().max(state.joint_velocity[j].abs());
    let reach = speed.mul_add(dt + dt, thrown);
    let position = S::or((q - reach).lt(parameters.lower(j)), parameters.upper(j).lt(q + reach));
    S::or(position, (fastest * S::splat(SPEED_MARGIN)).lt(speed))
}

/// What the limits of a joint ask for, in the lanes that are near them.
#[inline(always)]
fn joint_limits<S: Real, B: BodyNumbers<S>>(
    parameters: B,
    settings: &ContactSettings,
    inverse_dt: S,
    state: &State<S>,
    j: usize,
    row: &mut BoundRow<S>,
    violation: &mut S,
) {
    let (z, never, near) = (S::zero(), S::splat(NEVER), row.near);
    (row.lowest, row.highest, row.limit_impulse, row.push_impulse) = (never, -never, z, z);
    if row.limits {
        let (q, fastest) = (state.joint_position[j], parameters.velocity_limit(j));
        // a violated limit is pushed back at a bounded speed; one ahead may be reached but not crossed
        let (low, high) = (q - parameters.lower(j), parameters.upper(j) - q);
        let push = |past| push_speed(past, BOUND_SLOP, settings, inverse_dt);
        let (up, down) = (push(-low), push(-high));
        let lowest = S::select(low.lt(z), up, -(low * inverse_dt)).max(-fastest);
        let highest = S::select(high.lt(z), -down, high * inverse_dt).min(fastest);
        *violation = violation.max(S::select(near, up.max(down), z));
        row.lowest = S::select(near, lowest, never);
        row.highest = S::select(near, highest, -never);
        row.limit_impulse = S::select(near, state.bound_impulse[j] - row.friction_impulse, z);
    }
}

/// The deepest chain of joints that bounds can be solved on.
pub const MAX_DEPTH: usize = 64;

/// Stores the impulses for the next warm start and sums contact forces per body in one of a control step's physics steps: the norm
/// of the normal part, of bodies that are `touched` in any lane. After the `last` one also the force in world axes, N, and what
/// there was to deal with.
#[inline(always)]
pub fn report<S: Real>(
    topology: &Topology,
    settings: &ContactSettings,
    inverse_dt: S,
    base_rotation: &Mat3<S>,
    work: &ContactWork<S>,
    state: &mut State<S>,
    substep: usize,
    last: bool,
    report: &mut Report<S>,
) {
    let z = S::zero();
    let Report { body_force, normal_force, touched, demands, .. } = report;
    let normal_force = &mut normal_force[substep];
    normal_force.fill(z);
    for (block, shape) in work.bounds.iter().zip(topology.blocks()) {
        for (row, &j) in block.joints.iter().zip(&shape.joints[..shape.len]) {
            // adding +0 turns -0 into +0, which alone could depend on a lane's neighbours
            state.bound_impulse[j] = if row.takes_part() { row.impulse() + z } else { z };
        }
    }
    for &contact in &state.pressing {
        state.impulse[contact as usize] = [z; 3];
    }
    state.pressing.clear();
    for row in work.contacts() {
        let impulse = normalised(&row.impulse);
        state.impulse[row.contact] = impulse;
        state.pressing.push(row.contact as u32);
        for &body in bodies(topology, row.contact) {
            normal_force[body] = impulse[0].mul_add(inverse_dt, normal_force[body]);
            touched[body] = true;
        }
    }
    if last {
        sum_forces(topology, settings, inverse_dt, base_rotation, work, body_force);
        note_demands(topology, work, demands);
    }
}

/// See [`Report::demands`].
#[inline(always)]
fn note_demands<S: Real>(topology: &Topology, work: &ContactWork<S>, demands: &mut [S]) {
    let one = S::one();
    demands.fill(S::zero());
    for row in work.contacts() {
        for &body in bodies(topology, row.contact) {
            demands[body] = S::select(row.near, one, demands[body]);
        }
    }
    let (_, blocks) = demands.split_at_mut(topology.num_bodies);
    for (block, demand) in work.bounds.iter().zip(&mut *blocks) {
        for row in &block.joints {
            if row.limits {
                *demand = S::select(row.near, one, *demand);
            }
        }
    }
    blocks[work.bounds.len()] = S::select(S::zero().lt(work.violation), one, S::zero());
}

/// The bodies that a contact is between, other than the ground.
#[inline(always)]
fn bodies(topology: &Topology, contact: usize) -> &[usize] {
    match topology.pair_of(contact) {
        Some(pair) => &pair.bodies,
        None => std::slice::from_ref(&topology.contacts[contact].body),
    }
}

/// Net contact force of each body in world axes, N.
#[inline(always)]
fn sum_forces<S: Real>(
    topology: &Topology,
    settings: &ContactSettings,
    inverse_dt: S,
    base_rotation: &Mat3<S>,
    work: &ContactWork<S>,
    force: &mut [Vec3<S>],
) {
    force.fill([S::zero(); 3]);
    let ground = splat_frame(&settings.ground.unwrap_or(Plane::level(0.0)));
    let on_ground = work.contacts().len() - work.pair_frames.len();
    for (c, row) in work.contacts().iter().enumerate() {
        let f = scale(&normalised(&row.impulse), inverse_dt);
        if let Some(pair) = topology.pair_of(row.contact) {
            let frame = in_world(base_rotation, &work.pair_frames[c - on_ground]);
            let [first, second] = pair.bodies;
            add_force(&mut force[first], &frame, row.near, &f);
            add_force(&mut force[second], &frame, row.near, &scale(&f, -S::one()));
        } else {
            let body = topology.contacts[row.contact].body;
            match work.ground_frames.get(c) {
                Some(frame) => add_force(&mut force[body], &in_world(base_rotation, frame), row.near, &f),
                None => add_force(&mut force[body], &ground, row.near, &f),
            }
        }
    }
}

/// Axes in base axes, turned into world axes.
#[inline(always)]
fn in_world<S: Real>(base_rotation: &Mat3<S>, frame: &[Vec3<S>; 3]) -> [Vec3<S>; 3] {
    [mul_vec(base_rotation, &frame[0]), mul_vec(base_rotation, &frame[1]), mul_vec(base_rotation, &frame[2])]
}

/// Adds a force along axes, in the lanes that are `near`: in others the axes may be no numbers.
#[inline(always)]
fn add_force<S: Real>(sum: &mut Vec3<S>, frame: &[Vec3<S>; 3], near: S::Mask, f: &[S; 3]) {
    let mut new = *sum;
    for d in 0..3 {
        new = add_scaled(&new, &frame[d], f[d]);
    }
    for (sum, new) in sum.iter_mut().zip(new) {
        *sum = S::select(near, new, *sum);
    }
}
