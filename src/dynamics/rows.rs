//! The rows of contacts and joint bounds, from which [`solver`](super::solver) finds their impulses.
//!
//! A constraint row `J` is kept as `Z = H^-T J^T`, which is zero off the path from its link to the base, so that
//! `J M^-1 J^T = Z^T Z` and a sweep works on the sparse velocity `y = H u` (see [`factor`](super::factor)): a row's velocity is
//! `Z . y`, and an impulse `l` changes `y` by `Z l`.

use super::articulation::{PairTopology, Topology};
use super::blocks::{BLOCK, PathPart};
use super::factor::Factor;
use super::lanes::Real;
use super::math::{Spatial, Vec3, cross, dot, scale, sub};
use super::sparse_velocity::{JointRows, dot6_onto, first_velocity};

/// Compliance of contacts along their normals as a share of the whole robot's. It bounds the impulses of contacts that
/// cannot be satisfied (a fixed base with its feet in the ground) and lets a standing robot sink by less than a micrometre.
const SOFTNESS: f64 = 1e-3;
/// The same between links of one robot. These may press where no joint gives way, which a robot that floats never does
/// against the ground; the links themselves are ten times as compliant.
const PAIR_SOFTNESS: f64 = 0.01;
/// Target speed that keeps an absent contact from ever pushing, m/s.
pub(super) const NEVER: f64 = -1e6;

/// A contact: its normal and two tangents.
#[derive(Clone, Debug)]
pub(super) struct ContactRows<S> {
    /// Which impulse it has.
    pub(super) contact: usize,
    /// The path of the joints it acts on, in the topology.
    pub(super) path: usize,
    pub(super) base: [[S; 6]; 3],
    /// Couplings of the rows with each other: normal-tangent 1, normal-tangent 2, tangent 1-tangent 2.
    pub(super) coupling: [S; 3],
    pub(super) inverse: [S; 3],
    /// The inverse of the first of them.
    pub(super) diagonal: S,
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
    /// Whether sweeps look at it.
    pub(super) awake: bool,
}

/// The bounds of one joint.
#[derive(Clone, Copy, Debug)]
pub(super) struct BoundRow<S> {
    /// Whether any lane is near a limit.
    pub(super) limits: bool,
    /// Whether the joint has dry friction in any lane.
    pub(super) rubs: bool,
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

impl<S: Real> BoundRow<S> {
    /// A joint that is free.
    #[inline(always)]
    pub(super) fn free() -> Self {
        let (z, big) = (S::zero(), S::splat(-NEVER));
        Self {
            limits: false,
            rubs: false,
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
}

/// The bounds of a block's joints.
///
/// Which joints share a block is the topology's matter, not that of the moment: the order of operations in a lane must not
/// depend on its neighbours.
#[derive(Clone, Debug)]
pub(super) struct BoundBlock<S> {
    /// Whether any lane is near a limit of any joint.
    pub(super) limits: bool,
    /// Whether that is so or any joint has dry friction in any lane: else the block takes no part.
    pub(super) active: bool,
    pub(super) base: [[S; 6]; BLOCK],
    /// Couplings of the rows with each other: 0-1, 0-2, 1-2.
    pub(super) coupling: [S; 3],
    pub(super) rows: [BoundRow<S>; BLOCK],
}

/// Scratch memory of the contact solver.
#[derive(Clone, Debug)]
pub struct ContactWork<S> {
    /// Ground contacts, then pairs of the robot's own links: the first `num_contacts`, and room for more.
    pub(super) contacts: Vec<ContactRows<S>>,
    pub(super) num_contacts: usize,
    /// `[blocks]`.
    pub(super) bounds: Vec<BoundBlock<S>>,
    /// Number of blocks that rows have room for.
    pub(super) stride: usize,
    /// The fastest push that a contact or bound asks for; not positive in lanes where nothing is to be pushed out.
    pub(super) violation: S,
    /// Compliance of the whole robot, one over its mass, 1/kg.
    pub(super) compliance: S,
    /// Normal and tangents of the ground contacts on terrain, in base axes; empty on a plane.
    pub(super) ground_frames: Vec<[Vec3<S>; 3]>,
    /// Normal and tangents of the pairs among `contacts`, in base axes.
    pub(super) pair_frames: Vec<[Vec3<S>; 3]>,
    /// Joint parts of the contact rows: `[contact * stride + p]`, `p` along the path.
    pub(super) contact_joint: Vec<JointRows<S>>,
    /// The same of the joint bounds.
    pub(super) bound_joint: Vec<JointRows<S>>,
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
        // at least one: a robot may have no joints
        let stride = topology.max_path().max(1);
        let (contacts, blocks) = (topology.num_impulses(), topology.blocks().len());
        let free = BoundBlock {
            limits: false,
            active: false,
            base: [[z; 6]; BLOCK],
            coupling: [z; 3],
            rows: [BoundRow::free(); BLOCK],
        };
        Self {
            contacts: Vec::new(),
            num_contacts: 0,
            bounds: vec![free; blocks],
            stride,
            violation: z,
            compliance: z,
            ground_frames: Vec::with_capacity(topology.contacts.len()),
            pair_frames: Vec::with_capacity(contacts - topology.contacts.len()),
            contact_joint: vec![[[z; 3]; BLOCK]; contacts * stride],
            bound_joint: vec![[[z; 3]; BLOCK]; blocks * stride],
            base: [z; 6],
            joints: vec![[z; BLOCK]; blocks],
            moved_base: [z; 6],
            moved_joints: vec![[z; BLOCK]; blocks],
        }
    }

    /// Forgets all rows; `total_mass` in kg.
    #[inline(always)]
    pub(super) fn clear(&mut self, total_mass: S) {
        self.num_contacts = 0;
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

    /// The rows about to be added, and their joint parts.
    #[inline(always)]
    pub(super) fn next(&self) -> (&ContactRows<S>, &[JointRows<S>]) {
        (&self.contacts[self.num_contacts], &self.contact_joint[self.num_contacts * self.stride..])
    }

    /// Room for another contact: its rows and their joint parts.
    #[inline(always)]
    fn next_mut(&mut self) -> (&mut ContactRows<S>, &mut [JointRows<S>]) {
        if self.num_contacts == self.contacts.len() {
            self.contacts.push(ContactRows::zero());
        }
        (&mut self.contacts[self.num_contacts], &mut self.contact_joint[self.num_contacts * self.stride..])
    }

    /// Builds the rows of a point of a link that touches the ground, `centre` less `radius` along the normal.
    #[inline(always)]
    pub(super) fn build_ground(
        &mut self,
        topology: &Topology,
        factor: &Factor<S>,
        axes: &[Spatial<S>],
        frame: &[Vec3<S>; 3],
        contact: usize,
        centre: &Vec3<S>,
        radius: S,
    ) {
        let link = topology.contacts[contact].link;
        let path = topology.path(link);
        let (row, joint) = self.next_mut();
        let joint = &mut joint[..path.len()];
        let point = sub(centre, &scale(&frame[0], radius));
        (row.contact, row.path) = (contact, link);
        for d in 0..3 {
            let direction = &frame[d];
            let moment = cross(&point, direction);
            row.base[d] = [moment[0], moment[1], moment[2], direction[0], direction[1], direction[2]];
        }
        let blocks = topology.blocks();
        for (part, x) in path.iter().zip(joint.iter_mut()) {
            let joints = &blocks[part.joints.block].joints;
            for s in 0..BLOCK {
                if s < part.joints.count {
                    let axis = axes[joints[s]].to_array();
                    for d in 0..3 {
                        x[s][d] = dot6_onto(&axis, &row.base[d], S::zero());
                    }
                } else {
                    x[s] = [S::zero(); 3];
                }
            }
        }
        if !topology.floating {
            row.base = [[S::zero(); 6]; 3];
        }
        half_solve_path(topology, factor, path, joint, &mut row.base);
        self.finish(topology, SOFTNESS);
    }

    /// Builds the rows of a pair of links that touch at a point: equal and opposite forces along the axes of `frame`.
    #[inline(always)]
    pub(super) fn build_pair(
        &mut self,
        topology: &Topology,
        factor: &Factor<S>,
        axes: &[Spatial<S>],
        pair: &PairTopology,
        impulse: usize,
        frame: &[Vec3<S>; 3],
        point: &Vec3<S>,
    ) {
        let path = topology.path(pair.path);
        let blocks = topology.blocks();
        let (row, joint) = self.next_mut();
        let joint = &mut joint[..path.len()];
        (row.contact, row.path) = (impulse, pair.path);
        for d in 0..3 {
            let direction = &frame[d];
            let moment = cross(point, direction);
            for ((part, side), x) in path.iter().zip(&pair.side).zip(joint.iter_mut()) {
                for s in 0..BLOCK {
                    // what carries both links feels nothing
                    x[s][d] = if s < part.joints.count {
                        let axis = &axes[blocks[part.joints.block].joints[s]];
                        (dot(&axis.ang, &moment) + dot(&axis.lin, direction)) * S::splat(side[s])
                    } else {
                        S::zero()
                    };
                }
            }
        }
        row.base = [[S::zero(); 6]; 3];
        half_solve_path(topology, factor, path, joint, &mut row.base);
        self.pair_frames.push(*frame);
        self.finish(topology, PAIR_SOFTNESS);
    }

    /// Finds the couplings of the rows about to be added; `softness` is a share of the whole robot's compliance.
    #[inline(always)]
    fn finish(&mut self, topology: &Topology, softness: f64) {
        let one = S::one();
        let softness = self.compliance * S::splat(softness);
        // a robot that floats gives way everywhere at least as its whole mass would; what is fixed to the world may not
        // give way at all: keep the division finite
        let least = self.compliance * S::splat(0.5);
        let (row, joint) = self.next_mut();
        let joint = &joint[..topology.path(row.path).len()];
        let product = products(&row.base, joint);
        let half = S::splat(0.5);
        let difference = (product[1] - product[2]) * half;
        let radius = difference.mul_add(difference, product[5] * product[5]).sqrt();
        row.coupling = [product[3], product[4], product[5]];
        row.diagonal = product[0] + softness;
        row.inverse = [one / row.diagonal, one / product[1].max(least), one / product[2].max(least)];
        row.slide = one / (product[1] + product[2]).mul_add(half, radius).max(least);
        row.softness = softness;
    }

    /// Adds the rows that were built as a contact that takes part in the lanes where it is `near`: it separates at least at the
    /// speeds `target`, which may push out, and `bounce`.
    #[inline(always)]
    pub(super) fn add(&mut self, near: S::Mask, target: S, bounce: S, warm_start: &[S; 3]) {
        let (z, never) = (S::zero(), S::splat(NEVER));
        self.violation = self.violation.max(S::select(near, target, z));
        let row = &mut self.contacts[self.num_contacts];
        row.target = S::select(near, target.min(z).max(bounce), never);
        row.push = S::select(near, target, never);
        row.push_impulse = z;
        row.awake = true;
        for d in 0..3 {
            row.impulse[d] = S::select(near, warm_start[d], z);
        }
        self.num_contacts += 1;
    }

    /// Whether anything is inside another in any lane, or past a limit, and to be pushed out.
    #[inline(always)]
    pub(super) fn pushes(&self) -> bool {
        S::any(S::zero().lt(self.violation))
    }
}

impl<S: Real> ContactRows<S> {
    #[inline(always)]
    fn zero() -> Self {
        let z = S::zero();
        Self {
            contact: 0,
            path: 0,
            base: [[z; 6]; 3],
            coupling: [z; 3],
            inverse: [z; 3],
            diagonal: z,
            softness: z,
            slide: z,
            target: z,
            impulse: [z; 3],
            push: z,
            push_impulse: z,
            awake: true,
        }
    }

    /// The velocity along the normal; `joint` are the rows' joint parts.
    #[inline(always)]
    pub(super) fn normal_velocity(
        &self,
        path: &[PathPart],
        joint: &[JointRows<S>],
        base: &[S; 6],
        joints: &[[S; BLOCK]],
    ) -> S {
        first_velocity(path, &self.base[0], joint, base, joints)
    }
}

/// `H^-T J^T` along a path, in place: `joint[p]` belongs to `path[p]`.
#[inline(always)]
fn half_solve_path<S: Real>(
    topology: &Topology,
    factor: &Factor<S>,
    path: &[PathPart],
    joint: &mut [JointRows<S>],
    base: &mut [[S; 6]; 3],
) {
    eliminate(topology, factor, path, 0, joint, base);
    solve_base(topology, factor, base);
}

/// The same of three unit vectors, one for each joint of the block where the path begins.
#[inline(always)]
pub(super) fn half_solve_units<S: Real>(
    topology: &Topology,
    factor: &Factor<S>,
    path: &[PathPart],
    joint: &mut [JointRows<S>],
    base: &mut [[S; 6]; 3],
) {
    let (z, one) = (S::zero(), S::one());
    let block = path[0].joints.block;
    let own = &factor.blocks[block];
    let root = &factor.root.as_chunks::<BLOCK>().0[block];
    let [l10, l20, l21] = own.inner;
    let (x01, x12) = (-l10, -l21);
    let x02 = l10.neg_mul_add(x12, -l20);
    let [b0, b1, b2] = &own.base;
    for r in 0..6 {
        base[0][r] = -b0[r];
        base[1][r] = x01.neg_mul_add(b0[r], -b1[r]);
        base[2][r] = x02.neg_mul_add(b0[r], x12.neg_mul_add(b1[r], -b2[r]));
    }
    if path.len() > 1 {
        joint.fill([[z; 3]; BLOCK]);
        pass_on(topology, factor, &path[0], &[[one, x01, x02], [z, one, x12], [z, z, one]], joint);
        eliminate(topology, factor, path, 1, joint, base);
    }
    let [r0, r1, r2] = [root[0][1], root[1][1], root[2][1]];
    joint[0] = [[r0, x01 * r0, x02 * r0], [z, r1, x12 * r1], [z, z, r2]];
    solve_base(topology, factor, base);
}

/// Eliminates the joints of a path from a part on, and scales them by `D^-1/2`.
#[inline(always)]
fn eliminate<S: Real>(
    topology: &Topology,
    factor: &Factor<S>,
    path: &[PathPart],
    first: usize,
    joint: &mut [JointRows<S>],
    base: &mut [[S; 6]; 3],
) {
    let roots = factor.root.as_chunks::<BLOCK>().0;
    for p in first..path.len() {
        let block = path[p].joints.block;
        let (own, root) = (&factor.blocks[block], &roots[block]);
        let [l10, l20, l21] = own.inner;
        let mut x = joint[p];
        for d in 0..3 {
            x[1][d] = l21.neg_mul_add(x[2][d], x[1][d]);
            x[0][d] = l10.neg_mul_add(x[1][d], l20.neg_mul_add(x[2][d], x[0][d]));
        }
        pass_on(topology, factor, &path[p], &x, joint);
        for d in 0..3 {
            for r in 0..6 {
                let y = own.base[2][r].neg_mul_add(x[2][d], base[d][r]);
                let y = own.base[1][r].neg_mul_add(x[1][d], y);
                base[d][r] = own.base[0][r].neg_mul_add(x[0][d], y);
            }
        }
        for s in 0..BLOCK {
            for d in 0..3 {
                joint[p][s][d] = x[s][d] * root[s][1];
            }
        }
    }
}

/// What eliminating a part of a path changes in the parts that carry it.
#[inline(always)]
fn pass_on<S: Real>(
    topology: &Topology,
    factor: &Factor<S>,
    part: &PathPart,
    x: &JointRows<S>,
    joint: &mut [JointRows<S>],
) {
    let first = topology.blocks()[part.joints.block].first_coupling;
    for (l, &carrier) in factor.couplings[first..].iter().zip(&part.carriers) {
        let on = &mut joint[carrier];
        for s in 0..BLOCK {
            for t in 0..BLOCK {
                for d in 0..3 {
                    on[t][d] = l[s][t].neg_mul_add(x[s][d], on[t][d]);
                }
            }
        }
    }
}

/// `D^-1/2 G^-1` of the base's part.
#[inline(always)]
fn solve_base<S: Real>(topology: &Topology, factor: &Factor<S>, base: &mut [[S; 6]; 3]) {
    if topology.floating {
        for row in base.iter_mut() {
            factor.base_forward(row);
            for (x, root) in row.iter_mut().zip(&factor.base_root) {
                *x = *x * root[1];
            }
        }
    }
}

/// Products of three rows: 0-0, 1-1, 2-2, 0-1, 0-2, 1-2.
#[inline(always)]
pub(super) fn products<S: Real>(base: &[[S; 6]; 3], joint: &[JointRows<S>]) -> [S; 6] {
    let mut product = [S::zero(); 6];
    for (i, (a, b)) in [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)].into_iter().enumerate() {
        product[i] = dot6_onto(&base[a], &base[b], product[i]);
    }
    for x in joint.iter().flatten() {
        for (i, (a, b)) in [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)].into_iter().enumerate() {
            product[i] = x[a].mul_add(x[b], product[i]);
        }
    }
    product
}
