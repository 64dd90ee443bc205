//! The joint-space mass matrix and its sparse factorisation.
//!
//! Rows of the mass matrix of a tree are zero except at a joint's ancestors, and eliminating joints from the leaves
//! towards the base keeps it so (Featherstone 2008, section 6.5, "LTDL"). Legs do not fill each other in. The base's six
//! rows are one dense block that is eliminated last.
//!
//! The diagonal is split evenly, `M = L^T D L = H^T H` with `H = D^1/2 L`: a constraint row and what its impulse changes are
//! then the same numbers (see [`contact`](super::contact)), and kinetic energy is half the square of `H u`.

use super::articulation::Topology;
use super::lanes::Real;
use super::math::{Spatial, SpatialInertia};

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

    /// The mass matrix's row of a joint, from the composite inertia of what it moves.
    #[inline(always)]
    pub fn set_joint(
        &mut self,
        topology: &Topology,
        k: usize,
        inertia: &SpatialInertia<S>,
        axes: &[Spatial<S>],
        armature: S,
    ) {
        let force = inertia.apply(&axes[k]);
        self.diagonal[k] = axes[k].dot(&force) + armature;
        for (x, &i) in self.couplings[topology.row(k)..].iter_mut().zip(topology.ancestors(k)) {
            *x = axes[i].dot(&force);
        }
        self.base_couplings[k] = if topology.floating { force.to_array() } else { [S::zero(); 6] };
    }

    /// The mass matrix's base block, from the composite inertia of the whole robot.
    #[inline(always)]
    pub fn set_base(&mut self, total: &SpatialInertia<S>) {
        let (m, h, i) = (total.mass, &total.moment, &total.inertia);
        let z = S::zero();
        self.base = [
            [i[0], i[3], i[4], z, -h[2], h[1]],
            [i[3], i[1], i[5], h[2], z, -h[0]],
            [i[4], i[5], i[2], -h[1], h[0], z],
            [z, h[2], -h[1], m, z, z],
            [-h[2], z, h[0], z, m, z],
            [h[1], -h[0], z, z, z, m],
        ];
    }

    /// Turns the mass matrix held in place into its factors.
    #[inline(always)]
    pub fn factorise(&mut self, topology: &Topology) {
        for k in (0..topology.num_joints()).rev() {
            let root = self.diagonal[k].sqrt();
            let inverse_root = S::one() / root;
            let inverse = inverse_root * inverse_root;
            self.root[k] = [root, inverse_root];
            let ancestors = topology.ancestors(k);
            let original = self.base_couplings[k];
            // the ancestors' rows come before
            let (before, own) = self.couplings.split_at_mut(topology.row(k));
            let own = &mut own[..ancestors.len()];
            for (p, &i) in ancestors.iter().enumerate() {
                let a = own[p] * inverse;
                self.diagonal[i] = a.neg_mul_add(own[p], self.diagonal[i]);
                let (_, rest) = own.split_at(p + 1);
                for (x, &c) in before[topology.row(i)..].iter_mut().zip(rest) {
                    *x = a.neg_mul_add(c, *x);
                }
                let base = &mut self.base_couplings[i];
                for r in 0..6 {
                    base[r] = a.neg_mul_add(original[r], base[r]);
                }
            }
            for x in own {
                *x = *x * inverse;
            }
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
            for (&l, &i) in self.couplings[topology.row(k)..].iter().zip(topology.ancestors(k)) {
                joints[i] = l.neg_mul_add(x, joints[i]);
            }
            let couplings = &self.base_couplings[k];
            for r in 0..6 {
                base[r] = couplings[r].neg_mul_add(x, base[r]);
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
            let mut x = joints[k];
            for (&l, &i) in self.couplings[topology.row(k)..].iter().zip(topology.ancestors(k)) {
                x = l.mul_add(joints[i], x);
            }
            let couplings = &self.base_couplings[k];
            for r in 0..6 {
                x = couplings[r].mul_add(base[r], x);
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
            let mut x = joints[k] * self.root[k][1];
            for (&l, &i) in self.couplings[topology.row(k)..].iter().zip(topology.ancestors(k)) {
                x = l.neg_mul_add(joints[i], x);
            }
            let couplings = &self.base_couplings[k];
            for r in 0..6 {
                x = couplings[r].neg_mul_add(base[r], x);
            }
            joints[k] = x;
        }
    }
}
