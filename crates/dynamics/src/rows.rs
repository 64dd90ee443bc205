//! The rows of contacts and joint bounds, from which [`solver`](super::solver) finds their
//! impulses.
//!
//! A constraint row `J` is kept as `Z = H^-T J^T`, which is zero off the path from its link to the
//! base, so that `J M^-1 J^T = Z^T Z` and a sweep works on the sparse velocity `y = H u` (see
//! [`factor`](super::factor)): a row's velocity is `Z . y`, and an impulse `l` changes `y` by `Z
//! l`.

use super::articulation::{PairTopology, Topology};
use super::blocks::{BLOCK, PathPart};
use super::factor::Factor;
use super::lanes::Real;
use super::math::{Vec3, cross, dot, scale, sub};
use super::settings::SolverSettings;
use super::sparse_rows::{JointRows, SparseRows, UnitRows};
use super::spin_rows::SpinRows;
use super::state::LinkState;

/// Target speed of an absent contact, m/s. A robot that runs away may be faster: a lane that is not
/// `near` is kept from pushing by its mask.
pub(super) const NO_TARGET: f64 = -1e6;

/// A contact: its normal and two tangents.
#[derive(Clone, Debug)]
pub(super) struct ContactRows<S: Real> {
    /// Place of its impulse in [`State::impulse`](super::state::State::impulse).
    pub(super) contact: usize,
    /// The lanes in which it takes part in the step; in all others it has no impulse, whatever the
    /// velocities.
    pub(super) near: S::Mask,
    pub(super) rows: SparseRows<S>,
    /// Couplings of the rows with each other: normal-tangent 1, normal-tangent 2, tangent 1-tangent
    /// 2.
    pub(super) coupling: [S; 3],
    pub(super) inverse: [S; 3],
    /// Velocity along each tangent by a unit impulse along it.
    pub(super) across: [S; 2],
    /// While the point sticks, what a change of the normal impulse takes from the impulses along
    /// the tangents, and what a velocity along tangent 1 adds to that along tangent 2.
    pub(super) sticking: [S; 3],
    /// The inverse of the first of `inverse`.
    pub(super) diagonal: S,
    /// Yield of the contact to an impulse along its normal, m/s per N s.
    pub(super) softness: S,
    /// Mass of a sliding step: the inverse of the tangential block's largest eigenvalue.
    pub(super) slide: S,
    /// Least allowed separation speed, m/s.
    pub(super) target: S,
    pub(super) impulse: [S; 3],
    /// Change of the normal impulse in the last visit of a jammed contact, N s.
    pub(super) last_change: S,
    /// Speed at which a penetration is pushed out, m/s, or the target where there is none.
    pub(super) push: S,
    pub(super) push_impulse: S,
    /// Whether it takes part in a lane that is still swept over.
    pub(super) active: bool,
}

/// The bounds of one joint. `limits` and `has_friction` are always set. The other numbers are set
/// where its block takes part, and those of limits where any joint of the block is near one.
#[derive(Clone, Copy, Debug)]
pub(super) struct BoundRow<S: Real> {
    /// The lanes in which the joint is near a limit; in all others limits have no impulse, whatever
    /// the velocities.
    pub(super) near: S::Mask,
    /// Whether there are any such lanes.
    pub(super) limits: bool,
    /// Whether the joint has dry friction in any lane.
    pub(super) has_friction: bool,
    pub(super) diagonal: S,
    pub(super) inverse: S,
    pub(super) lowest: S,
    pub(super) highest: S,
    pub(super) limit_impulse: S,
    /// Limit impulse of the motion that pushes joints back that are past a limit.
    pub(super) push_impulse: S,
    pub(super) friction_impulse: S,
    pub(super) max_friction: S,
}

impl<S: Real> BoundRow<S> {
    /// A joint that is free.
    #[inline(always)]
    pub(super) fn free() -> Self {
        let (z, big) = (S::zero(), S::splat(-NO_TARGET));
        Self {
            near: z.lt(z),
            limits: false,
            has_friction: false,
            diagonal: z,
            inverse: z,
            lowest: -big,
            highest: big,
            limit_impulse: z,
            push_impulse: z,
            friction_impulse: z,
            max_friction: z,
        }
    }

    /// Impulse of the limit and of dry friction together, N m s.
    #[inline(always)]
    pub(super) fn impulse(&self) -> S {
        if self.limits { self.limit_impulse + self.friction_impulse } else { self.friction_impulse }
    }

    /// Whether it may hold the joint, in any lane.
    #[inline(always)]
    pub(super) fn takes_part(&self) -> bool {
        self.limits | self.has_friction
    }
}

/// The bounds of a block's joints.
///
/// The topology decides which joints share a block, not the present state: the order of operations
/// in a lane must not depend on its neighbours.
#[derive(Clone, Debug)]
pub(super) struct BoundBlock<S: Real> {
    /// Whether any lane is near a limit of any joint.
    pub(super) limits: bool,
    /// Whether a limit is near or a joint has dry friction in any lane that is still swept over.
    /// Other blocks take no part.
    pub(super) active: bool,
    pub(super) rows: UnitRows<S>,
    /// Couplings of the rows with each other: 0-1, 0-2, 1-2.
    pub(super) coupling: [S; 3],
    /// Change of a later row's friction impulse per change of an earlier row's while neither
    /// slides: 0-1, 0-2, 1-2.
    pub(super) friction_coupling: [S; 3],
    pub(super) joints: [BoundRow<S>; BLOCK],
}

/// Scratch memory of the contact solver.
#[derive(Clone, Debug)]
pub struct ContactWork<S: Real> {
    /// Ground contacts, then pairs of the robot's own links: the first `num_contacts`, and room for
    /// more.
    pub(super) contacts: Vec<ContactRows<S>>,
    pub(super) num_contacts: usize,
    /// Torsional and rolling friction of the ground contacts, in their order: the first
    /// `num_spins`, and room for more.
    pub(super) spins: Vec<SpinRows<S>>,
    pub(super) num_spins: usize,
    /// `[blocks]`.
    pub(super) bounds: Vec<BoundBlock<S>>,
    /// Number of blocks after the first that rows have room for.
    pub(super) stride: usize,
    /// Fastest push that a contact or bound asks for; not positive in lanes without a penetration.
    pub(super) violation: S,
    /// Compliance of the whole robot, one over its mass, 1/kg.
    pub(super) compliance: S,
    /// Normal and tangents of the ground contacts on terrain, in base axes; empty on a plane.
    pub(super) ground_frames: Vec<[Vec3<S>; 3]>,
    /// Normal and tangents of the pairs among `contacts`, in base axes.
    pub(super) pair_frames: Vec<[Vec3<S>; 3]>,
    /// Joint parts of the contact rows in the blocks after the first: `[contact * stride + p]`, `p`
    /// along the path.
    pub(super) contact_further: Vec<JointRows<S>>,
    /// Joint parts of the rows of torsional and rolling friction, in the same layout.
    pub(super) spin_further: Vec<JointRows<S>>,
    /// Joint parts of the rows of the joint bounds, in the same layout.
    pub(super) bound_further: Vec<JointRows<S>>,
    /// The sparse velocity `y`.
    pub base: [S; 6],
    /// See `base`; `[blocks]`.
    pub joints: Vec<[S; BLOCK]>,
    /// The sparse velocity that moves the bodies: with what pushes penetrations out.
    pub moved_base: [S; 6],
    /// See `moved_base`.
    pub moved_joints: Vec<[S; BLOCK]>,
}

impl<S: Real> ContactWork<S> {
    /// Memory for a topology.
    pub fn new(topology: &Topology) -> Self {
        let z = S::zero();
        // at least one: it is the size of chunks
        let stride = topology.max_path().saturating_sub(1).max(1);
        let (contacts, blocks) = (topology.num_contacts(), topology.blocks().len());
        let free = BoundBlock {
            limits: false,
            active: false,
            rows: UnitRows::zero(),
            coupling: [z; 3],
            friction_coupling: [z; 3],
            joints: [BoundRow::free(); BLOCK],
        };
        // a robot may have no joints, but every row reads the velocity of a block
        let velocities = vec![[z; BLOCK]; blocks.max(1)];
        Self {
            // filled where contacts are first found; the memory of the others stays untouched
            contacts: Vec::with_capacity(contacts),
            num_contacts: 0,
            spins: Vec::with_capacity(topology.num_spins()),
            num_spins: 0,
            bounds: vec![free; blocks],
            stride,
            violation: z,
            compliance: z,
            ground_frames: Vec::with_capacity(topology.contacts.len()),
            pair_frames: Vec::with_capacity(contacts - topology.contacts.len()),
            contact_further: vec![[[z; 3]; BLOCK]; contacts * stride],
            spin_further: vec![[[z; 3]; BLOCK]; topology.num_spins() * stride],
            bound_further: vec![[[z; 3]; BLOCK]; blocks * stride],
            base: [z; 6],
            joints: velocities.clone(),
            moved_base: [z; 6],
            moved_joints: velocities,
        }
    }

    /// Forgets all rows; `total_mass` in kg.
    #[inline(always)]
    pub(super) fn clear(&mut self, total_mass: S) {
        (self.num_contacts, self.num_spins) = (0, 0);
        self.violation = S::zero();
        self.ground_frames.clear();
        self.pair_frames.clear();
        self.compliance = S::one() / total_mass;
    }

    /// The contacts that take part.
    #[inline(always)]
    pub(super) fn contacts(&self) -> &[ContactRows<S>] {
        &self.contacts[..self.num_contacts]
    }

    /// The rows about to be added, and their further joint parts.
    #[inline(always)]
    pub(super) fn next(&self) -> (&SparseRows<S>, &[JointRows<S>]) {
        (&self.contacts[self.num_contacts].rows, &self.contact_further[self.num_contacts * self.stride..])
    }

    /// Room for another contact: its rows and their further joint parts.
    #[inline(always)]
    fn next_mut(&mut self) -> (&mut ContactRows<S>, &mut [JointRows<S>]) {
        if self.num_contacts == self.contacts.len() {
            self.contacts.push(ContactRows::zero());
        }
        (&mut self.contacts[self.num_contacts], &mut self.contact_further[self.num_contacts * self.stride..])
    }

    /// Builds the rows of a point of a link that touches the ground, `centre` less `radius` along
    /// the normal.
    #[inline(always)]
    pub(super) fn build_ground(
        &mut self,
        topology: &Topology,
        solver: &SolverSettings,
        factor: &Factor<S>,
        links: &[LinkState<S>],
        frame: &[Vec3<S>; 3],
        contact: usize,
        centre: &Vec3<S>,
        radius: S,
    ) {
        let link = topology.contacts[contact].link;
        let point = sub(centre, &scale(&frame[0], radius));
        let (ContactRows { contact: which, rows, .. }, further) = self.next_mut();
        *which = contact;
        for d in 0..3 {
            let [mx, my, mz] = cross(&point, &frame[d]);
            let [x, y, z] = frame[d];
            rows.base[d] = [mx, my, mz, x, y, z];
        }
        build_rows(topology, factor, links, link, rows, further);
        self.finish(topology, solver, solver.ground_compliance);
    }

    /// Builds the rows of a pair of links that touch at a point: equal and opposite forces along
    /// the axes of `frame`.
    #[inline(always)]
    pub(super) fn build_pair(
        &mut self,
        topology: &Topology,
        solver: &SolverSettings,
        factor: &Factor<S>,
        links: &[LinkState<S>],
        pair: &PairTopology,
        impulse: usize,
        frame: &[Vec3<S>; 3],
        point: &Vec3<S>,
    ) {
        let (ContactRows { contact: which, rows, .. }, further) = self.next_mut();
        *which = impulse;
        rows.set_path(topology, pair.path);
        for d in 0..3 {
            let [mx, my, mz] = cross(point, &frame[d]);
            let [x, y, z] = frame[d];
            rows.base[d] = [mx, my, mz, x, y, z];
        }
        let parts = topology.path(pair.path).iter().zip(topology.sides(pair));
        for ((part, side), out) in parts.zip(std::iter::once(&mut rows.own).chain(further.iter_mut())) {
            *out = joint_rows(topology, links, part, &rows.base);
            for (row, &side) in out.iter_mut().zip(side) {
                for x in row {
                    // a link that carries both feels nothing
                    *x = *x * S::splat(side);
                }
            }
        }
        rows.base = [[S::zero(); 6]; 3];
        rows.half_solve(topology, factor, further);
        self.pair_frames.push(*frame);
        self.finish(topology, solver, solver.pair_compliance);
    }

    /// Finds the couplings of the rows about to be added. `compliance` along the normal is a share
    /// of the whole robot's.
    #[inline(always)]
    fn finish(&mut self, topology: &Topology, solver: &SolverSettings, compliance: f64) {
        let one = S::one();
        let softness = self.compliance * S::splat(compliance);
        let least = self.compliance * S::splat(solver.min_tangent_compliance);
        let (row, further) = self.next_mut();
        let product = row.rows.products(topology, further);
        let half = S::splat(0.5);
        let difference = (product[1] - product[2]) * half;
        let radius = difference.mul_add(difference, product[5] * product[5]).sqrt();
        row.coupling = [product[3], product[4], product[5]];
        row.diagonal = product[0] + softness;
        row.across = [product[1], product[2]];
        row.inverse = [one / row.diagonal, one / product[1].max(least), one / product[2].max(least)];
        let [c01, c02, c12] = row.coupling;
        let pass1 = c01 * row.inverse[1];
        row.sticking = [pass1, c12.neg_mul_add(pass1, c02) * row.inverse[2], c12 * row.inverse[1] * row.inverse[2]];
        row.slide = one / (product[1] + product[2]).mul_add(half, radius).max(least);
        row.softness = softness;
    }

    /// Adds the rows that were built as a contact that takes part in the lanes where it is `near`:
    /// it separates at least at the speeds `target`, which may push out, and `bounce`.
    #[inline(always)]
    pub(super) fn add(&mut self, near: S::Mask, target: S, bounce: S, warm_start: &[S; 3]) {
        let (z, no_target) = (S::zero(), S::splat(NO_TARGET));
        self.violation = self.violation.max(S::select(near, target, z));
        let row = &mut self.contacts[self.num_contacts];
        row.near = near;
        row.target = S::select(near, target.min(z).max(bounce), no_target);
        row.push = S::select(near, target, no_target);
        (row.push_impulse, row.last_change) = (z, z);
        row.active = true;
        for d in 0..3 {
            row.impulse[d] = S::select(near, warm_start[d], z);
        }
        self.num_contacts += 1;
    }

    /// Whether anything is inside another in any lane, or past a limit, and to be pushed out.
    #[inline(always)]
    pub(super) fn pushes(&self) -> bool {
        S::when(S::zero().lt(self.violation)).is_some()
    }
}

impl<S: Real> ContactRows<S> {
    fn zero() -> Self {
        let z = S::zero();
        Self {
            contact: 0,
            near: z.lt(z),
            rows: SparseRows::zero(),
            coupling: [z; 3],
            inverse: [z; 3],
            across: [z; 2],
            sticking: [z; 3],
            diagonal: z,
            softness: z,
            slide: z,
            target: z,
            impulse: [z; 3],
            last_change: z,
            push: z,
            push_impulse: z,
            active: true,
        }
    }
}

/// `Z` of three rows that act on a link; their `base` holds the directions, each its moment about
/// the base's origin and its force.
#[inline(always)]
pub(super) fn build_rows<S: Real>(
    topology: &Topology,
    factor: &Factor<S>,
    links: &[LinkState<S>],
    link: usize,
    rows: &mut SparseRows<S>,
    further: &mut [JointRows<S>],
) {
    rows.set_path(topology, link);
    match topology.path(link).split_first() {
        Some((part, rest)) => {
            rows.own = joint_rows(topology, links, part, &rows.base);
            for (part, out) in rest.iter().zip(further.iter_mut()) {
                *out = joint_rows(topology, links, part, &rows.base);
            }
        }
        None => rows.own = [[S::zero(); 3]; BLOCK],
    }
    if !topology.floating {
        rows.base = [[S::zero(); 6]; 3];
    }
    rows.half_solve(topology, factor, further);
}

/// `J` of a block's joints for forces along three directions, given as their moment about the
/// base's origin and themselves.
#[inline(always)]
fn joint_rows<S: Real>(
    topology: &Topology,
    links: &[LinkState<S>],
    part: &PathPart,
    directions: &[[S; 6]; 3],
) -> JointRows<S> {
    let mut rows = [[S::zero(); 3]; BLOCK];
    let joints = &topology.blocks()[part.joints.block].joints;
    for s in 0..part.joints.count {
        let axis = &links[joints[s] + 1].axis;
        for d in 0..3 {
            let [mx, my, mz, x, y, z] = directions[d];
            rows[s][d] = dot(&axis.ang, &[mx, my, mz]) + dot(&axis.lin, &[x, y, z]);
        }
    }
    rows
}
