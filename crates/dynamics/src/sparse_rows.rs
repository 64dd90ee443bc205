//! Constraint rows `Z = H^-T J^T`, three at a time, and what they have to do with the sparse
//! velocity `y = H u`.
//!
//! A row is zero off the path from its link to the base. Nearly all paths are one block of joints,
//! whose part is held with the rows; the parts of further blocks lie elsewhere.
//!
//! From one constraint to the next only the base's part of the velocity passes, mostly: it is added
//! last when read and first when written, so that little waits for it.

use super::articulation::Topology;
use super::blocks::{BLOCK, PathPart};
use super::factor::Factor;
use super::lanes::Real;

/// Joint parts of three rows in one block: `[joint][row]`.
pub(super) type JointRows<S> = [[S; 3]; BLOCK];

/// Pairs of three rows, the earlier one first.
const PRODUCTS: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)];

/// Three rows, of a contact, or with `UNITS` of a block's joints: then the numbers below the
/// diagonal of `own` are zero, and left out.
#[derive(Clone, Debug)]
pub(super) struct SparseRows<S, const UNITS: bool = false> {
    /// The path of the joints they act on, in the topology.
    pub(super) path: usize,
    /// The number of blocks on it, and the first one; 0 if there is none.
    parts: usize,
    block: usize,
    pub(super) base: [[S; 6]; 3],
    /// Joint part of the rows in the first block.
    pub(super) own: JointRows<S>,
}

/// The rows of a block's joints.
pub(super) type UnitRows<S> = SparseRows<S, true>;

impl<S: Real, const UNITS: bool> SparseRows<S, UNITS> {
    pub(super) fn zero() -> Self {
        let z = S::zero();
        Self { path: 0, parts: 0, block: 0, base: [[z; 6]; 3], own: [[z; 3]; BLOCK] }
    }

    /// Whether a row has a part of a joint of the block. Loops ask inside, since only those over
    /// all rows are unrolled.
    #[inline(always)]
    const fn has(joint: usize, row: usize) -> bool {
        !UNITS || row >= joint
    }

    /// Takes a path; the numbers must follow.
    #[inline(always)]
    pub(super) fn set_path(&mut self, topology: &Topology, path: usize) {
        let parts = topology.path(path);
        (self.path, self.parts) = (path, parts.len());
        self.block = parts.first().map_or(0, |part| part.joints.block);
    }

    /// The blocks of the path after the first, with the rows' parts of them.
    #[inline(always)]
    fn further<'a>(
        &self,
        topology: &'a Topology,
        further: &'a [JointRows<S>],
    ) -> impl Iterator<Item = (&'a PathPart, &'a JointRows<S>)> {
        let parts = if self.parts > 1 { &topology.path(self.path)[1..] } else { &[] };
        parts.iter().zip(further)
    }

    /// Velocities of the rows.
    #[inline(always)]
    pub(super) fn velocities(
        &self,
        topology: &Topology,
        further: &[JointRows<S>],
        y_base: &[S; 6],
        y_joint: &[[S; BLOCK]],
    ) -> [S; 3] {
        let y = &y_joint[self.block];
        let mut even = [S::zero(); 3];
        for d in 0..3 {
            even[d] = self.own[0][d] * y[0];
        }
        for s in 1..BLOCK {
            for d in 0..3 {
                if Self::has(s, d) {
                    even[d] = self.own[s][d].mul_add(y[s], even[d]);
                }
            }
        }
        for (part, z) in self.further(topology, further) {
            let y = &y_joint[part.joints.block];
            for s in 0..BLOCK {
                for d in 0..3 {
                    even[d] = z[s][d].mul_add(y[s], even[d]);
                }
            }
        }
        // two chains, for latency
        let mut odd = [S::zero(); 3];
        for d in 0..3 {
            even[d] = self.base[d][0].mul_add(y_base[0], even[d]);
            odd[d] = self.base[d][1] * y_base[1];
        }
        for d in 0..3 {
            even[d] = self.base[d][2].mul_add(y_base[2], even[d]);
        }
        for d in 0..3 {
            odd[d] = self.base[d][3].mul_add(y_base[3], odd[d]);
        }
        for d in 0..3 {
            even[d] = self.base[d][4].mul_add(y_base[4], even[d]);
        }
        for d in 0..3 {
            odd[d] = self.base[d][5].mul_add(y_base[5], odd[d]);
        }
        [even[0] + odd[0], even[1] + odd[1], even[2] + odd[2]]
    }

    /// Adds what impulses of the rows change to the velocity.
    #[inline(always)]
    pub(super) fn apply(
        &self,
        topology: &Topology,
        further: &[JointRows<S>],
        impulse: &[S; 3],
        y_base: &mut [S; 6],
        y_joint: &mut [[S; BLOCK]],
    ) {
        for r in 0..6 {
            let y = self.base[0][r].mul_add(impulse[0], y_base[r]);
            let y = self.base[1][r].mul_add(impulse[1], y);
            y_base[r] = self.base[2][r].mul_add(impulse[2], y);
        }
        let y = &mut y_joint[self.block];
        for s in 0..BLOCK {
            for d in 0..3 {
                if Self::has(s, d) {
                    y[s] = self.own[s][d].mul_add(impulse[d], y[s]);
                }
            }
        }
        for (part, z) in self.further(topology, further) {
            add_joints(z, impulse, &mut y_joint[part.joints.block]);
        }
    }

    /// [`PRODUCTS`] of the rows.
    #[inline(always)]
    pub(super) fn products(&self, topology: &Topology, further: &[JointRows<S>]) -> [S; 6] {
        let z = S::zero();
        let mut product = [z; 6];
        for s in 0..BLOCK {
            for (i, (a, b)) in PRODUCTS.into_iter().enumerate() {
                if Self::has(s, a) {
                    product[i] = self.own[s][a].mul_add(self.own[s][b], product[i]);
                }
            }
        }
        for (_, part) in self.further(topology, further) {
            for x in part {
                for (i, (a, b)) in PRODUCTS.into_iter().enumerate() {
                    product[i] = x[a].mul_add(x[b], product[i]);
                }
            }
        }
        let base = &self.base;
        [
            dot6_onto(&base[0], &base[0], product[0]),
            dot6_onto(&base[1], &base[1], product[1]),
            dot6_onto(&base[2], &base[2], product[2]),
            dot6_onto(&base[0], &base[1], product[3]),
            dot6_onto(&base[0], &base[2], product[4]),
            dot6_onto(&base[1], &base[2], product[5]),
        ]
    }

    /// Eliminates the blocks of a path after the first among themselves.
    #[inline(always)]
    fn half_solve_further(
        &mut self,
        topology: &Topology,
        factor: &Factor<S>,
        rest: &[PathPart],
        further: &mut [JointRows<S>],
    ) {
        for (p, part) in rest.iter().enumerate() {
            let x = eliminate_inner(factor, part, &further[p]);
            pass_on(topology, factor, part, &x, further);
            further[p] = x;
        }
    }

    /// Change of the base's part by the elimination of the joints, from which `D^-1/2 G^-1`
    /// follows; and `D^-1/2` of the blocks after the first. A first block that is not given is done
    /// with.
    #[inline(always)]
    fn solve_base(
        &mut self,
        topology: &Topology,
        factor: &Factor<S>,
        first: Option<&PathPart>,
        rest: &[PathPart],
        further: &mut [JointRows<S>],
    ) {
        if topology.floating {
            for d in 0..3 {
                // a copy, which stays in registers
                let mut row = self.base[d];
                if let Some(part) = first {
                    eliminate_base(factor, part, &self.own, d, &mut row);
                }
                for (part, x) in rest.iter().zip(further.iter()) {
                    eliminate_base(factor, part, x, d, &mut row);
                }
                factor.base_forward(&mut row);
                for r in 0..6 {
                    self.base[d][r] = row[r] * factor.base_root[r][1];
                }
            }
        }
        for (part, x) in rest.iter().zip(further) {
            scale(factor, part, x);
        }
    }
}

impl<S: Real> SparseRows<S> {
    /// Velocity of the first row.
    #[inline(always)]
    pub(super) fn first_velocity(
        &self,
        topology: &Topology,
        further: &[JointRows<S>],
        y_base: &[S; 6],
        y_joint: &[[S; BLOCK]],
    ) -> S {
        let y = &y_joint[self.block];
        let mut w = self.own[2][0].mul_add(y[2], self.own[1][0].mul_add(y[1], self.own[0][0] * y[0]));
        for (part, z) in self.further(topology, further) {
            let y = &y_joint[part.joints.block];
            for s in 0..BLOCK {
                w = z[s][0].mul_add(y[s], w);
            }
        }
        dot6_onto(&self.base[0], y_base, w)
    }

    /// Adds what an impulse of the first row changes to the velocity.
    #[inline(always)]
    pub(super) fn apply_first(
        &self,
        topology: &Topology,
        further: &[JointRows<S>],
        impulse: S,
        y_base: &mut [S; 6],
        y_joint: &mut [[S; BLOCK]],
    ) {
        for r in 0..6 {
            y_base[r] = self.base[0][r].mul_add(impulse, y_base[r]);
        }
        let y = &mut y_joint[self.block];
        for s in 0..BLOCK {
            y[s] = self.own[s][0].mul_add(impulse, y[s]);
        }
        for (part, z) in self.further(topology, further) {
            let y = &mut y_joint[part.joints.block];
            for s in 0..BLOCK {
                y[s] = z[s][0].mul_add(impulse, y[s]);
            }
        }
    }

    /// `H^-T J^T` in place.
    #[inline(always)]
    pub(super) fn half_solve(&mut self, topology: &Topology, factor: &Factor<S>, further: &mut [JointRows<S>]) {
        let path = topology.path(self.path);
        if let Some((part, rest)) = path.split_first() {
            self.own = eliminate_inner(factor, part, &self.own);
            if !rest.is_empty() {
                pass_on(topology, factor, part, &self.own, further);
            }
            self.half_solve_further(topology, factor, rest, further);
            self.solve_base(topology, factor, Some(part), rest, further);
            scale(factor, part, &mut self.own);
        } else {
            self.solve_base(topology, factor, None, path, further);
        }
    }
}

impl<S: Real> UnitRows<S> {
    /// `H^-T J^T` of three unit vectors, one for each joint of the block where the path begins.
    #[inline(always)]
    pub(super) fn half_solve_units(&mut self, topology: &Topology, factor: &Factor<S>, further: &mut [JointRows<S>]) {
        let (z, one) = (S::zero(), S::one());
        let Some((part, rest)) = topology.path(self.path).split_first() else {
            return;
        };
        let [l10, l20, l21] = factor.blocks[part.joints.block].inner;
        let (x01, x12) = (-l10, -l21);
        let x02 = l10.neg_mul_add(x12, -l20);
        if !rest.is_empty() {
            further[..rest.len()].fill([[z; 3]; BLOCK]);
            pass_on(topology, factor, part, &[[one, x01, x02], [z, one, x12], [z, z, one]], further);
        }
        self.half_solve_further(topology, factor, rest, further);
        let [b0, b1, b2] = &factor.blocks[part.joints.block].base;
        for r in 0..6 {
            self.base[0][r] = -b0[r];
            self.base[1][r] = x01.neg_mul_add(b0[r], -b1[r]);
            self.base[2][r] = x02.neg_mul_add(b0[r], x12.neg_mul_add(b1[r], -b2[r]));
        }
        self.solve_base(topology, factor, None, rest, further);
        let root = &factor.root.as_chunks::<BLOCK>().0[part.joints.block];
        let [r0, r1, r2] = [root[0][1], root[1][1], root[2][1]];
        self.own[0] = [r0, x01 * r0, x02 * r0];
        (self.own[1][1], self.own[1][2], self.own[2][2]) = (r1, x12 * r1, r2);
    }
}

/// `a . b + c`.
#[inline(always)]
fn dot6_onto<S: Real>(a: &[S; 6], b: &[S; 6], c: S) -> S {
    // two chains, for latency
    let even = a[4].mul_add(b[4], a[2].mul_add(b[2], a[0].mul_add(b[0], c)));
    let odd = a[5].mul_add(b[5], a[3].mul_add(b[3], a[1] * b[1]));
    even + odd
}

#[inline(always)]
fn add_joints<S: Real>(z: &JointRows<S>, impulse: &[S; 3], y: &mut [S; BLOCK]) {
    for s in 0..BLOCK {
        let x = z[s][0].mul_add(impulse[0], y[s]);
        let x = z[s][1].mul_add(impulse[1], x);
        y[s] = z[s][2].mul_add(impulse[2], x);
    }
}

/// Eliminates a block's joints among themselves.
#[inline(always)]
fn eliminate_inner<S: Real>(factor: &Factor<S>, part: &PathPart, rows: &JointRows<S>) -> JointRows<S> {
    let [l10, l20, l21] = factor.blocks[part.joints.block].inner;
    let mut x = *rows;
    for d in 0..3 {
        x[1][d] = l21.neg_mul_add(x[2][d], x[1][d]);
        x[0][d] = l10.neg_mul_add(x[1][d], l20.neg_mul_add(x[2][d], x[0][d]));
    }
    x
}

/// Change of the base's part of one of three rows by the elimination of a block's joints.
#[inline(always)]
fn eliminate_base<S: Real>(factor: &Factor<S>, part: &PathPart, x: &JointRows<S>, row: usize, base: &mut [S; 6]) {
    let own = &factor.blocks[part.joints.block].base;
    for s in (0..BLOCK).rev() {
        for r in 0..6 {
            base[r] = own[s][r].neg_mul_add(x[s][row], base[r]);
        }
    }
}

/// Change of the parts of the path that carry a block by the elimination of its joints; none of
/// them is the path's first.
#[inline(always)]
fn pass_on<S: Real>(
    topology: &Topology,
    factor: &Factor<S>,
    part: &PathPart,
    x: &JointRows<S>,
    further: &mut [JointRows<S>],
) {
    let first = topology.blocks()[part.joints.block].first_coupling;
    for (l, &carrier) in factor.couplings[first..].iter().zip(topology.carriers_in_path(part)) {
        let on = &mut further[carrier - 1];
        for s in 0..BLOCK {
            for t in 0..BLOCK {
                for d in 0..3 {
                    on[t][d] = l[s][t].neg_mul_add(x[s][d], on[t][d]);
                }
            }
        }
    }
}

/// `D^-1/2` of a block's joints.
#[inline(always)]
fn scale<S: Real>(factor: &Factor<S>, part: &PathPart, x: &mut JointRows<S>) {
    let root = &factor.root.as_chunks::<BLOCK>().0[part.joints.block];
    for s in 0..BLOCK {
        for d in 0..3 {
            x[s][d] = x[s][d] * root[s][1];
        }
    }
}
