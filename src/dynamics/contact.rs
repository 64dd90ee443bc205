//! Contacts and joint bounds as velocity constraints; [`solver`](super::solver) satisfies them.
//!
//! A constraint row `J` is kept as `Z = L^-T J^T`, which is zero off the path from its link to the base, so that
//! `J M^-1 J^T = Z^T D^-1 Z` and a sweep works on the sparse velocity `y = L u` (see [`factor`](super::factor)).

use super::articulation::{ContactKind, PairTopology, Parameters, Topology};
use super::factor::Factor;
use super::kinematics::forward_kinematics;
use super::lanes::Real;
use super::math::{
    Mat3, Spatial, Vec3, add, add_scaled, cross, dot, mul_vec, mul_vec_transposed, quat_to_mat, scale, sub,
};
use super::state::{LinkState, State, Workspace};
use super::terrain::Terrain;

/// How contacts and joint bounds are solved.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactSettings {
    /// Gauss-Seidel sweeps per physics step.
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
            iterations: 8,
            correction: 0.2,
            max_depenetration_velocity: 1.0,
            bounce_threshold: 0.5,
            ground: Some(Plane::level(0.0)),
        }
    }
}

/// A candidate takes part in a physics step when it is nearer to the ground than this, m.
const CONTACT_MARGIN: f64 = 0.02;
/// A joint bound takes part when the joint could come nearer to it than this in two physics steps, rad or m.
const BOUND_MARGIN: f64 = 0.05;
/// ... or, since a contact may throw a joint against its stop within one step, than its velocity limit leads in a step,
/// but no more than this, rad or m.
const LARGEST_BOUND_MARGIN: f64 = 0.25;
/// ... or when it moves faster than this share of its velocity limit.
const SPEED_MARGIN: f64 = 0.7;
/// Compliance of contacts along their normals as a share of the whole robot's. It bounds the impulses of contacts that
/// cannot be satisfied (a fixed base with its feet in the ground) and lets a standing robot sink by less than a micrometre.
const SOFTNESS: f64 = 1e-3;
/// The same between links of one robot. These may press where no joint gives way, which a robot that floats never does
/// against the ground; the links themselves are ten times as compliant.
const PAIR_SOFTNESS: f64 = 0.01;
/// What is inside each other by less than this is left so, m or rad; most steps then have nothing to push out.
const SLOP: f64 = 1e-5;
/// Target speed that keeps an absent contact from ever pushing, m/s.
pub(super) const NEVER: f64 = -1e6;

#[derive(Clone, Debug)]
pub(super) struct ContactRows<S> {
    /// Which impulse it has.
    pub(super) contact: usize,
    pub(super) base: [[S; 6]; 3],
    pub(super) base_scaled: [[S; 6]; 3],
    /// Couplings of the rows with each other: normal-tangent 1, normal-tangent 2, tangent 1-tangent 2.
    pub(super) coupling: [S; 3],
    pub(super) inverse: [S; 3],
    /// How far the contact gives way to an impulse along its normal, m/s per N s.
    pub(super) softness: S,
    /// Mass of a sliding step: the inverse of the tangential block's largest eigenvalue.
    pub(super) slide: S,
    /// Least allowed separation speed, m/s.
    pub(super) target: S,
    pub(super) impulse: [S; 3],
    /// The same for the motion that pushes penetrations out.
    pub(super) push: S,
    pub(super) push_impulse: S,
}

#[derive(Clone, Debug)]
pub(super) struct BoundRow<S> {
    pub(super) joint: usize,
    /// Whether any lane is near a limit.
    pub(super) limits: bool,
    pub(super) base: [S; 6],
    pub(super) base_scaled: [S; 6],
    pub(super) diagonal: S,
    pub(super) inverse: S,
    pub(super) lowest: S,
    pub(super) highest: S,
    pub(super) limit_impulse: S,
    /// The same for the motion that pushes joints back that are past a limit.
    pub(super) push_impulse: S,
    pub(super) friction_impulse: S,
    pub(super) max_friction: S,
}

/// Scratch memory of the contact solver.
#[derive(Clone, Debug)]
pub struct ContactWork<S> {
    /// Ground contacts, then pairs of the robot's own links.
    pub(super) contacts: Vec<ContactRows<S>>,
    pub(super) bounds: Vec<BoundRow<S>>,
    /// Number of joints that rows have room for.
    pub(super) stride: usize,
    /// The fastest push that a contact or bound asks for; not positive in lanes where nothing is to be pushed out.
    pub(super) violation: S,
    /// Compliance of the whole robot, one over its mass, 1/kg.
    pub(super) compliance: S,
    /// Normal and tangents of the ground contacts on terrain, in base axes; empty on a plane.
    pub(super) ground_frames: Vec<[Vec3<S>; 3]>,
    /// Normal and tangents of the pairs among `contacts`, in base axes.
    pub(super) pair_frames: Vec<[Vec3<S>; 3]>,
    /// Joint parts of the contact rows, plain and divided by `D`: `[contact * stride + p]`, `p` along the path.
    pub(super) contact_joint: Vec<[S; 3]>,
    pub(super) contact_joint_scaled: Vec<[S; 3]>,
    pub(super) bound_joint: Vec<S>,
    pub(super) bound_joint_scaled: Vec<S>,
    /// The sparse velocity `y`.
    pub base: [S; 6],
    /// See `base`.
    pub joints: Vec<S>,
    /// The sparse velocity that moves the bodies: with what pushes penetrations out.
    pub moved_base: [S; 6],
    /// See `moved_base`.
    pub moved_joints: Vec<S>,
}

impl<S: Real> ContactWork<S> {
    /// Memory for a topology.
    pub fn new(topology: &Topology) -> Self {
        let z = S::zero();
        let stride = topology.max_contact_path();
        let (contacts, joints) = (topology.num_impulses(), topology.num_joints());
        Self {
            contacts: Vec::with_capacity(contacts),
            bounds: Vec::with_capacity(joints),
            stride,
            violation: z,
            compliance: z,
            ground_frames: Vec::with_capacity(topology.contacts.len()),
            pair_frames: Vec::with_capacity(contacts - topology.contacts.len()),
            contact_joint: vec![[z; 3]; contacts * stride],
            contact_joint_scaled: vec![[z; 3]; contacts * stride],
            bound_joint: vec![z; joints * stride],
            bound_joint_scaled: vec![z; joints * stride],
            base: [z; 6],
            joints: vec![z; joints],
            moved_base: [z; 6],
            moved_joints: vec![z; joints],
        }
    }
}

/// The lowest point of a candidate, in link axes about the link's origin; `up` is the world's up in link axes.
#[inline(always)]
fn candidate_point<S: Real>(parameters: &Parameters<S>, contact: usize, kind: ContactKind, up: &Vec3<S>) -> Vec3<S> {
    let centre = &parameters.contact_position[contact];
    match kind {
        ContactKind::Point => *centre,
        ContactKind::Rim { across, turn } => {
            let e = across.map(|u| u.map(S::splat));
            let (c, s) = (-dot(&e[0], up), -dot(&e[1], up));
            let length = c.mul_add(c, s * s).sqrt();
            // an upright cylinder has no lowest rim point: take fixed ones
            let upright = length.lt(S::splat(1e-3));
            let inverse = S::one() / length;
            let (c, s) = (S::select(upright, S::one(), c * inverse), S::select(upright, S::zero(), s * inverse));
            let (tc, ts) = (S::splat(turn[0]), S::splat(turn[1]));
            let (c, s) = (c.mul_add(tc, -(s * ts)), s.mul_add(tc, c * ts));
            let rim = parameters.contact_rim[contact];
            add_scaled(&add_scaled(centre, &e[0], c * rim), &e[1], s * rim)
        }
    }
}

/// `L^-T J^T` along a path, in place: `joint[p]` belongs to `path[p]`.
#[inline(always)]
fn half_solve_path<S: Real, const N: usize>(
    topology: &Topology,
    factor: &Factor<S>,
    path: &[usize],
    joint: &mut [[S; N]],
    base: &mut [[S; 6]; N],
) {
    for p in 0..path.len() {
        let k = path[p];
        let x = joint[p];
        let row = topology.row(k);
        for q in p + 1..path.len() {
            let l = factor.couplings[row + q - p - 1];
            for d in 0..N {
                joint[q][d] = l.neg_mul_add(x[d], joint[q][d]);
            }
        }
        for d in 0..N {
            for r in 0..6 {
                base[d][r] = factor.base_couplings[k][r].neg_mul_add(x[d], base[d][r]);
            }
        }
    }
    if topology.floating {
        for row in base.iter_mut() {
            factor.base_forward(row);
        }
    }
}

/// The lowest point of a candidate (see [`candidate_point`]) and its distance from the ground, m.
#[inline(always)]
fn candidate<S: Real>(
    parameters: &Parameters<S>,
    contact: usize,
    kind: ContactKind,
    up: &Vec3<S>,
    origin_height: S,
) -> (Vec3<S>, S) {
    let local = candidate_point(parameters, contact, kind, up);
    (local, origin_height + dot(up, &local) - parameters.contact_radius[contact])
}

#[inline(always)]
pub(super) fn dot6<S: Real>(a: &[S; 6], b: &[S; 6]) -> S {
    // two chains, for latency
    let even = a[0].mul_add(b[0], a[2].mul_add(b[2], a[4] * b[4]));
    let odd = a[1].mul_add(b[1], a[3].mul_add(b[3], a[5] * b[5]));
    even + odd
}

/// Distance of each contact candidate from the ground, m, `[contacts]` in the topology's order; negative inside the
/// ground, and empty where there is none. For tools and tests: a step finds its contacts itself.
pub fn candidate_gaps<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
    settings: &ContactSettings,
    state: &State<S>,
    work: &mut Workspace<S>,
) -> Vec<S> {
    let Some(plane) = &settings.ground else {
        return Vec::new();
    };
    let (positions, velocities) = (&state.joint_position, &state.joint_velocity);
    forward_kinematics(topology, parameters, positions, velocities, &Spatial::zero(), work);
    let normal = plane.normal.map(S::splat);
    let ground = dot(&normal, &state.position) - S::splat(plane.offset);
    let normal = mul_vec_transposed(&quat_to_mat(&state.rotation), &normal);
    let gaps = topology.contacts.iter().enumerate().map(|(c, contact)| {
        let at = &work.links[contact.link];
        let up = mul_vec_transposed(&at.rotation, &normal);
        candidate(parameters, c, contact.kind, &up, ground + dot(&normal, &at.position)).1
    });
    gaps.collect()
}

/// Finds the contacts near the ground and builds their rows.
#[inline(always)]
pub fn build_contacts<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
    settings: &ContactSettings,
    terrain: Option<&Terrain<S>>,
    dt: S,
    state: &mut State<S>,
    work: &mut Workspace<S>,
) {
    let Workspace { base_rotation, links, axes, inertia, factor, contact: rows, .. } = work;
    let margin = S::splat(CONTACT_MARGIN);
    rows.contacts.clear();
    rows.violation = S::zero();
    rows.ground_frames.clear();
    rows.pair_frames.clear();
    // composite by now: the whole robot's
    rows.compliance = S::one() / inertia[0].mass;
    let Some(plane) = &settings.ground else {
        state.impulse[..topology.contacts.len()].fill([S::zero(); 3]);
        return;
    };
    let world = plane.frame().map(|axis| axis.map(S::splat));
    let ground = dot(&world[0], &state.position) - S::splat(plane.offset);
    // normal and tangents in base axes
    let frame = world.map(|axis| mul_vec_transposed(base_rotation, &axis));
    let inverse_dt = S::one() / dt;
    for (link, at) in links.iter().enumerate() {
        let candidates = topology.contacts_of(link);
        if candidates.is_empty() {
            continue;
        }
        let origin_height = ground + dot(&frame[0], &at.position);
        let mut highest = margin;
        if let Some(terrain) = terrain {
            let [x, y] = [1, 2].map(|i| state.position[i - 1] + dot(&frame[i], &at.position));
            let reach = parameters.contact_reach[link] + margin;
            highest = margin + terrain.bound(x, y, reach) - S::splat(plane.offset);
        }
        if !S::any((origin_height - parameters.contact_reach[link]).lt(highest)) {
            for c in candidates {
                state.impulse[c] = [S::zero(); 3];
            }
            continue;
        }
        let up = mul_vec_transposed(&at.rotation, &frame[0]);
        for c in candidates {
            let (local, mut gap) = candidate(parameters, c, topology.contacts[c].kind, &up, origin_height);
            let mut axes_here = frame;
            if let Some(terrain) = terrain {
                if !S::any(gap.lt(highest)) {
                    state.impulse[c] = [S::zero(); 3];
                    continue;
                }
                let centre = add(&at.position, &mul_vec(&at.rotation, &local));
                (gap, axes_here) = on_terrain(terrain, &frame, &state.position, &centre, parameters.contact_radius[c]);
            }
            let near = gap.lt(margin);
            if !S::any(near) {
                state.impulse[c] = [S::zero(); 3];
                continue;
            }
            let row =
                contact_rows(topology, factor, axes, at, &axes_here, c, &local, parameters.contact_radius[c], rows);
            if terrain.is_some() {
                rows.ground_frames.push(axes_here);
            }
            let target = separation(gap, settings, inverse_dt);
            let zero = S::zero();
            let mut bounce = S::splat(NEVER);
            if S::any(zero.lt(parameters.restitution)) {
                let joint = &rows.contact_joint[rows.contacts.len() * rows.stride..];
                let approach = row.normal_velocity(topology.path(link), joint, &rows.base, &rows.joints);
                let bounces = S::and(approach.lt(S::splat(-settings.bounce_threshold)), gap.lt(-(approach * dt)));
                bounce = S::select(bounces, -(approach * parameters.restitution), bounce);
            }
            rows.push(row, near, target, bounce, &state.impulse[c]);
        }
    }
}

/// Gap of a sphere above terrain, and normal and tangents there in base axes. `level` are the world's z, x and y in base axes,
/// `centre` the sphere's place about the base's origin.
#[inline(always)]
fn on_terrain<S: Real>(
    terrain: &Terrain<S>,
    level: &[Vec3<S>; 3],
    position: &Vec3<S>,
    centre: &Vec3<S>,
    radius: S,
) -> (S, [Vec3<S>; 3]) {
    let [z, x, y] = [0, 1, 2].map(|i| dot(&level[i], centre));
    let (height, n) = terrain.below(position[0] + x, position[1] + y);
    let gap = (position[2] + z - height).mul_add(n[2], -radius);
    // the x axis, laid onto the surface; slopes are bounded, so that it is never the normal
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

/// Least allowed separation speed at a gap: one that is open may close, a penetration is pushed out.
#[inline(always)]
pub(super) fn separation<S: Real>(gap: S, settings: &ContactSettings, inverse_dt: S) -> S {
    let push = push_speed(-gap, settings, inverse_dt);
    S::select(gap.lt(S::zero()), push, -(gap * inverse_dt))
}

/// The speed at which a violation of this depth is pushed out.
#[inline(always)]
fn push_speed<S: Real>(depth: S, settings: &ContactSettings, inverse_dt: S) -> S {
    let beyond = (depth - S::splat(SLOP)).max(S::zero());
    (beyond * S::splat(settings.correction) * inverse_dt).min(S::splat(settings.max_depenetration_velocity))
}

#[inline(always)]
fn contact_rows<S: Real>(
    topology: &Topology,
    factor: &Factor<S>,
    axes: &[Spatial<S>],
    at: &LinkState<S>,
    frame: &[Vec3<S>; 3],
    contact: usize,
    local: &Vec3<S>,
    radius: S,
    rows: &mut ContactWork<S>,
) -> ContactRows<S> {
    let path = topology.path(topology.contacts[contact].link);
    let start = rows.contacts.len() * rows.stride;
    let joint = &mut rows.contact_joint[start..start + path.len()];
    let centre = add(&at.position, &mul_vec(&at.rotation, local));
    let point = sub(&centre, &scale(&frame[0], radius));
    let mut base = [[S::zero(); 6]; 3];
    for (d, direction) in frame.iter().enumerate() {
        let moment = cross(&point, direction);
        if topology.floating {
            base[d] = [moment[0], moment[1], moment[2], direction[0], direction[1], direction[2]];
        }
        for (p, &j) in path.iter().enumerate() {
            joint[p][d] = dot(&axes[j].ang, &moment) + dot(&axes[j].lin, direction);
        }
    }
    half_solve_path(topology, factor, path, joint, &mut base);
    rows.finish(topology, factor, contact, base)
}

impl<S: Real> ContactWork<S> {
    /// Builds the rows of a pair of links that touch at a point: equal and opposite forces along the axes of `frame`.
    #[inline(always)]
    pub(super) fn pair_rows(
        &mut self,
        topology: &Topology,
        factor: &Factor<S>,
        axes: &[Spatial<S>],
        pair: &PairTopology,
        impulse: usize,
        frame: &[Vec3<S>; 3],
        point: &Vec3<S>,
    ) -> ContactRows<S> {
        let PairTopology { path, side, ancestors, .. } = pair;
        let start = self.contacts.len() * self.stride;
        let joint = &mut self.contact_joint[start..start + path.len()];
        for (d, direction) in frame.iter().enumerate() {
            let moment = cross(point, direction);
            for (p, &j) in path.iter().enumerate() {
                // what carries both links feels nothing
                joint[p][d] = (dot(&axes[j].ang, &moment) + dot(&axes[j].lin, direction)) * S::splat(side[p]);
            }
        }
        let mut base = [[S::zero(); 6]; 3];
        for p in 0..path.len() {
            let (x, row) = (joint[p], topology.row(path[p]));
            for (i, &q) in ancestors[p].iter().enumerate() {
                let l = factor.couplings[row + i];
                for d in 0..3 {
                    joint[q][d] = l.neg_mul_add(x[d], joint[q][d]);
                }
            }
            for d in 0..3 {
                for r in 0..6 {
                    base[d][r] = factor.base_couplings[path[p]][r].neg_mul_add(x[d], base[d][r]);
                }
            }
        }
        if topology.floating {
            for row in base.iter_mut() {
                factor.base_forward(row);
            }
        }
        self.pair_frames.push(*frame);
        self.finish(topology, factor, impulse, base)
    }

    /// Adds a contact that takes part in the lanes where it is `near`: it separates at least at the speeds `target`, which may
    /// push out, and `bounce`.
    #[inline(always)]
    pub(super) fn push(&mut self, row: ContactRows<S>, near: S::Mask, target: S, bounce: S, warm_start: &[S; 3]) {
        let keep = |x: S| S::select(near, x, S::zero());
        self.violation = self.violation.max(keep(target));
        self.contacts.push(ContactRows {
            target: S::select(near, target.min(S::zero()).max(bounce), S::splat(NEVER)),
            push: S::select(near, target, S::splat(NEVER)),
            impulse: warm_start.map(keep),
            ..row
        });
    }

    /// Whether anything is inside another in any lane, or past a limit, and to be pushed out.
    #[inline(always)]
    pub(super) fn pushes(&self) -> bool {
        S::any(S::zero().lt(self.violation))
    }

    /// Scales half-solved rows by `D^-1` and finds their couplings.
    #[inline(always)]
    fn finish(&mut self, topology: &Topology, factor: &Factor<S>, contact: usize, base: [[S; 6]; 3]) -> ContactRows<S> {
        let (z, one) = (S::zero(), S::one());
        let path = topology.contact_path(contact);
        let start = self.contacts.len() * self.stride;
        let joint = &self.contact_joint[start..start + path.len()];
        let scaled = &mut self.contact_joint_scaled[start..start + path.len()];
        let mut base_scaled = [[z; 6]; 3];
        if topology.floating {
            for d in 0..3 {
                for r in 0..6 {
                    base_scaled[d][r] = base[d][r] * factor.base_inverse_diagonal[r];
                }
            }
        }
        for (p, &j) in path.iter().enumerate() {
            for d in 0..3 {
                scaled[p][d] = joint[p][d] * factor.inverse_diagonal[j];
            }
        }
        let mut product = [[z; 3]; 3];
        for (a, b) in [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)] {
            let mut sum = dot6(&base[a], &base_scaled[b]);
            for p in 0..path.len() {
                sum = joint[p][a].mul_add(scaled[p][b], sum);
            }
            product[a][b] = sum;
        }
        // a robot that floats gives way everywhere at least as its whole mass would; what is fixed to the world may not
        // give way at all: keep the division finite
        let least = self.compliance * S::splat(0.5);
        let share = if topology.pair_of(contact).is_some() { PAIR_SOFTNESS } else { SOFTNESS };
        let softness = self.compliance * S::splat(share);
        let coupling = [product[0][1], product[0][2], product[1][2]];
        let diagonal = [product[0][0], product[1][1], product[2][2]];
        let half = S::splat(0.5);
        let difference = (diagonal[1] - diagonal[2]) * half;
        let radius = difference.mul_add(difference, coupling[2] * coupling[2]).sqrt();
        ContactRows {
            contact,
            coupling,
            softness,
            inverse: [one / (diagonal[0] + softness), one / diagonal[1].max(least), one / diagonal[2].max(least)],
            slide: one / (diagonal[1] + diagonal[2]).mul_add(half, radius).max(least),
            base,
            base_scaled,
            target: z,
            impulse: [z; 3],
            push: z,
            push_impulse: z,
        }
    }
}

impl<S: Real> ContactRows<S> {
    /// The velocity along the normal; `joint` are the rows' joint parts.
    #[inline(always)]
    pub(super) fn normal_velocity(&self, path: &[usize], joint: &[[S; 3]], base: &[S; 6], joints: &[S]) -> S {
        let mut sum = dot6(&self.base[0], base);
        for (p, &j) in path.iter().enumerate() {
            sum = joint[p][0].mul_add(joints[j], sum);
        }
        sum
    }
}

/// Builds a row for every joint near a position limit, near its velocity limit, or with Coulomb friction.
///
/// `velocity` is the joints' velocity at the start of the step, `free` the one without constraints.
#[inline(always)]
pub fn build_bounds<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
    settings: &ContactSettings,
    dt: S,
    state: &State<S>,
    free: &[S],
    work: &mut Workspace<S>,
) {
    let Workspace { factor, contact: rows, .. } = work;
    let z = S::zero();
    let depth = rows.stride;
    let inverse_dt = S::one() / dt;
    let big = S::splat(-NEVER);
    rows.bounds.clear();
    for j in 0..topology.num_joints() {
        let (q, v) = (state.joint_position[j], free[j]);
        let (lower, upper, fastest) = (parameters.lower[j], parameters.upper[j], parameters.velocity_limit[j]);
        let thrown = (fastest * dt).clamp(S::splat(BOUND_MARGIN), S::splat(LARGEST_BOUND_MARGIN));
        let reach = (v.abs().max(state.joint_velocity[j].abs())).mul_add(dt + dt, thrown);
        let near = S::or(
            S::or((q - reach).lt(lower), upper.lt(q + reach)),
            (fastest * S::splat(SPEED_MARGIN)).lt(v.abs().max(state.joint_velocity[j].abs())),
        );
        let limits = S::any(near);
        let rubs = z.lt(parameters.joint_friction[j]);
        if !limits && !S::any(rubs) {
            continue;
        }
        let path = topology.path(j + 1);
        let start = rows.bounds.len() * depth;
        let mut joint = [[z; 1]; MAX_DEPTH];
        joint[0] = [S::one()];
        let mut base = [[z; 6]; 1];
        half_solve_path(topology, factor, path, &mut joint[..path.len()], &mut base);
        let base = base[0];
        let mut base_scaled = [z; 6];
        if topology.floating {
            base_scaled = std::array::from_fn(|r| base[r] * factor.base_inverse_diagonal[r]);
        }
        let mut diagonal = dot6(&base, &base_scaled);
        for (p, &k) in path.iter().enumerate() {
            let scaled = joint[p][0] * factor.inverse_diagonal[k];
            rows.bound_joint[start + p] = joint[p][0];
            rows.bound_joint_scaled[start + p] = scaled;
            diagonal = joint[p][0].mul_add(scaled, diagonal);
        }
        // a violated limit is pushed back at a bounded speed; one ahead may be reached but not crossed
        let (low, high) = (q - lower, upper - q);
        let (up, down) = (push_speed(-low, settings, inverse_dt), push_speed(-high, settings, inverse_dt));
        let lowest = S::select(low.lt(z), up, -(low * inverse_dt)).max(-fastest);
        let highest = S::select(high.lt(z), -down, high * inverse_dt).min(fastest);
        rows.violation = rows.violation.max(S::select(near, up.max(down), z));
        rows.bounds.push(BoundRow {
            joint: j,
            limits,
            base,
            base_scaled,
            diagonal,
            inverse: S::one() / diagonal,
            lowest: S::select(near, lowest, -big),
            highest: S::select(near, highest, big),
            limit_impulse: S::select(near, state.limit_impulse[j], z),
            push_impulse: z,
            friction_impulse: z,
            max_friction: parameters.joint_friction[j] * dt,
        });
    }
}

/// The deepest chain of joints that bounds can be solved on.
pub const MAX_DEPTH: usize = 64;

/// Stores the impulses for the next warm start and sums contact forces per body: `force` in world axes, N, and the norm
/// of the normal part.
#[inline(always)]
pub fn report<S: Real>(
    topology: &Topology,
    settings: &ContactSettings,
    inverse_dt: S,
    base_rotation: &Mat3<S>,
    work: &ContactWork<S>,
    state: &mut State<S>,
    force: &mut [Vec3<S>],
    normal_force: &mut [S],
) {
    let z = S::zero();
    force.fill([z; 3]);
    normal_force.fill(z);
    let ground = settings.ground.unwrap_or(Plane::level(0.0)).frame().map(|axis| axis.map(S::splat));
    let on_ground = work.contacts.len() - work.pair_frames.len();
    state.limit_impulse.fill(z);
    for row in &work.bounds {
        // adding +0 turns -0 into +0, which alone could depend on a lane's neighbours
        state.limit_impulse[row.joint] = row.limit_impulse + z;
    }
    for (c, row) in work.contacts.iter().enumerate() {
        let impulse = row.impulse.map(|x| x + z);
        state.impulse[row.contact] = impulse;
        let f = impulse.map(|x| x * inverse_dt);
        if let Some(pair) = topology.pair_of(row.contact) {
            let frame = work.pair_frames[c - on_ground].map(|axis| mul_vec(base_rotation, &axis));
            let [first, second] = pair.colliders.map(|c| topology.colliders[c].body);
            add_force(&mut force[first], &frame, &f);
            add_force(&mut force[second], &frame, &f.map(|x| -x));
            for body in [first, second] {
                normal_force[body] = normal_force[body] + f[0];
            }
        } else {
            let body = topology.contacts[row.contact].body;
            match work.ground_frames.get(c) {
                Some(frame) => add_force(&mut force[body], &frame.map(|axis| mul_vec(base_rotation, &axis)), &f),
                None => add_force(&mut force[body], &ground, &f),
            }
            normal_force[body] = normal_force[body] + f[0];
        }
    }
}

#[inline(always)]
fn add_force<S: Real>(sum: &mut Vec3<S>, frame: &[Vec3<S>; 3], f: &[S; 3]) {
    for d in 0..3 {
        *sum = add_scaled(sum, &frame[d], f[d]);
    }
}
