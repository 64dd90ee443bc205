//! The joint-space mass matrix and its sparse factorisation.
//!
//! Rows of the mass matrix of a tree are zero except at a joint's ancestors, and eliminating joints from the leaves
//! towards the base keeps it so (Featherstone 2008, section 6.5, "LTDL"). Legs do not fill each other in. The base's six
//! rows are one dense block that is eliminated last.
//!
//! The diagonal is split evenly, `M = L^T D L = H^T H` with `H = D^1/2 L`: a constraint row and what its impulse changes are
//! then the same numbers (see [`contact`](super::contact)), and kinetic energy is half the square of `H u`.

use super::articulation::{Parameters, Topology};
use super::lanes::Real;
use super::state::Workspace;

/// `M = L^T D L = H^T H`, with `L` unit lower triangular and zero off the ancestors.
#[derive(Clone, Debug)]
pub struct Factor<S> {
    /// `M[j][j]`, before factorisation, `[joints]`.
    pub diagonal: Vec<S>,
    /// `D[j]^1/2` and its inverse, `[joints]`.
    pub root: Vec<[S; 2]>,
    /// Couplings with ancestor joints: `M[j][i]`, then `L[j][i]`, at `row(j) + p`.
    pub couplings: Vec<S>,
    /// Couplings with the base: `M[j][0..6]`, then `L[j][0..6]`, `[joints]`.
    pub base_couplings: Vec<[S; 6]>,
    /// The base block; after factorisation the unit lower factor `G` of `G D G^T`.
    pub base: [[S; 6]; 6],
    /// `D^1/2` of the base block and its inverse; zero for a fixed base.
    pub base_root: [[S; 2]; 6],
}

impl<S: Real> Factor<S> {
    /// Memory for a topology.
    pub fn new(topology: &Topology) -> Self {
        let z = S::zero();
        Self {
            diagonal: vec![z; topology.num_joints()],
            root: vec![[z; 2]; topology.num_joints()],
            couplings: vec![z; topology.num_couplings()],
            base_couplings: vec![[z; 6]; topology.num_joints()],
            base: [[z; 6]; 6],
            base_root: [[z; 2]; 6],
        }
    }

    /// Turns the mass matrix held in place into its factors.
    #[inline(always)]
    pub fn factorise(&mut self, topology: &Topology) {
        for k in (0..topology.num_joints()).rev() {
            let root = self.diagonal[k].sqrt();
            let inverse_root = S::one() / root;
            let inverse = inverse_root * inverse_root;
            self.root[k] = [root, inverse_root];
            let row = topology.row(k);
            let ancestors = topology.ancestors(k);
            for (p, &i) in ancestors.iter().enumerate() {
                let a = self.couplings[row + p] * inverse;
                self.diagonal[i] = a.neg_mul_add(self.couplings[row + p], self.diagonal[i]);
                let row_i = topology.row(i);
                for q in p + 1..ancestors.len() {
                    let at = row_i + q - p - 1;
                    self.couplings[at] = a.neg_mul_add(self.couplings[row + q], self.couplings[at]);
                }
                for r in 0..6 {
                    self.base_couplings[i][r] = a.neg_mul_add(self.base_couplings[k][r], self.base_couplings[i][r]);
                }
            }
            for p in 0..ancestors.len() {
                self.couplings[row + p] = self.couplings[row + p] * inverse;
            }
            let original = self.base_couplings[k];
            for r in 0..6 {
                let a = original[r] * inverse;
                self.base_couplings[k][r] = a;
                for c in 0..=r {
                    self.base[r][c] = a.neg_mul_add(original[c], self.base[r][c]);
                }
            }
        }
        if !topology.floating {
            return;
        }
        for k in 0..6 {
            let root = self.base[k][k].sqrt();
            let inverse_root = S::one() / root;
            let inverse = inverse_root * inverse_root;
            self.base_root[k] = [root, inverse_root];
            for r in k + 1..6 {
                let a = self.base[r][k] * inverse;
                for c in k + 1..=r {
                    self.base[r][c] = a.neg_mul_add(self.base[c][k], self.base[r][c]);
                }
            }
            for r in k + 1..6 {
                self.base[r][k] = self.base[r][k] * inverse;
            }
        }
    }

    /// `G^-1 b`: the base's part of the half solve.
    #[inline(always)]
    pub fn base_forward(&self, b: &mut [S; 6]) {
        for k in 0..5 {
            for r in k + 1..6 {
                b[r] = self.base[r][k].neg_mul_add(b[k], b[r]);
            }
        }
    }

    /// `G^-T b`.
    #[inline(always)]
    pub fn base_backward(&self, b: &mut [S; 6]) {
        for k in (0..6).rev() {
            for r in k + 1..6 {
                b[k] = self.base[r][k].neg_mul_add(b[r], b[k]);
            }
        }
    }

    /// `H^-T b`, from the leaves to the base: the half solve of a generalised force.
    #[inline(always)]
    pub fn half_solve(&self, topology: &Topology, base: &mut [S; 6], joints: &mut [S]) {
        for k in (0..topology.num_joints()).rev() {
            let x = joints[k];
            let row = topology.row(k);
            for (p, &i) in topology.ancestors(k).iter().enumerate() {
                joints[i] = self.couplings[row + p].neg_mul_add(x, joints[i]);
            }
            for r in 0..6 {
                base[r] = self.base_couplings[k][r].neg_mul_add(x, base[r]);
            }
        }
        if topology.floating {
            self.base_forward(base);
        }
        for (x, root) in joints.iter_mut().zip(&self.root) {
            *x = *x * root[1];
        }
        for (x, root) in base.iter_mut().zip(&self.base_root) {
            *x = *x * root[1];
        }
    }

    /// `H u`: a velocity in the coordinates in which constraint rows are sparse.
    #[inline(always)]
    pub fn to_sparse(&self, topology: &Topology, base: &mut [S; 6], joints: &mut [S]) {
        // leaves first: a joint's new value uses its ancestors' old ones
        for k in (0..topology.num_joints()).rev() {
            let row = topology.row(k);
            let mut x = joints[k];
            for (p, &i) in topology.ancestors(k).iter().enumerate() {
                x = self.couplings[row + p].mul_add(joints[i], x);
            }
            for r in 0..6 {
                x = self.base_couplings[k][r].mul_add(base[r], x);
            }
            joints[k] = x * self.root[k][0];
        }
        if topology.floating {
            // G^T b, row k uses only later entries
            for k in 0..5 {
                for r in k + 1..6 {
                    base[k] = self.base[r][k].mul_add(base[r], base[k]);
                }
            }
        }
        for (x, root) in base.iter_mut().zip(&self.base_root) {
            *x = *x * root[0];
        }
    }

    /// `H^-1 y`: the inverse of [`to_sparse`](Self::to_sparse).
    #[inline(always)]
    pub fn from_sparse(&self, topology: &Topology, base: &mut [S; 6], joints: &mut [S]) {
        for (x, root) in base.iter_mut().zip(&self.base_root) {
            *x = *x * root[1];
        }
        if topology.floating {
            self.base_backward(base);
        }
        for k in 0..topology.num_joints() {
            let row = topology.row(k);
            let mut x = joints[k] * self.root[k][1];
            for (p, &i) in topology.ancestors(k).iter().enumerate() {
                x = self.couplings[row + p].neg_mul_add(joints[i], x);
            }
            for r in 0..6 {
                x = self.base_couplings[k][r].neg_mul_add(base[r], x);
            }
            joints[k] = x;
        }
    }
}

/// Writes the mass matrix into the workspace's factor by the composite-rigid-body algorithm (Featherstone 2008, table
/// 6.2), plus `armature` on the joints' diagonal. Link inertias must be composite.
#[inline(always)]
pub fn mass_matrix<S: Real>(topology: &Topology, parameters: &Parameters<S>, work: &mut Workspace<S>) {
    for k in 0..topology.num_joints() {
        let axis = work.axes[k];
        let force = work.inertia[k + 1].apply(&axis);
        work.factor.diagonal[k] = axis.dot(&force) + parameters.armature[k];
        let row = topology.row(k);
        for (p, &i) in topology.ancestors(k).iter().enumerate() {
            work.factor.couplings[row + p] = work.axes[i].dot(&force);
        }
        work.factor.base_couplings[k] = if topology.floating { force.to_array() } else { [S::zero(); 6] };
    }
    let total = &work.inertia[0];
    let (m, h, i) = (total.mass, &total.moment, &total.inertia);
    let z = S::zero();
    work.factor.base = [
        [i[0], i[3], i[4], z, -h[2], h[1]],
        [i[3], i[1], i[5], h[2], z, -h[0]],
        [i[4], i[5], i[2], -h[1], h[0], z],
        [z, h[2], -h[1], m, z, z],
        [-h[2], z, h[0], z, m, z],
        [h[1], -h[0], z, z, z, m],
    ];
}
