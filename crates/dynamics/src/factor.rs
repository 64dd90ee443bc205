//! The joint-space mass matrix and its sparse factorisation.
//!
//! Rows of the mass matrix of a tree are zero except at a joint's ancestors, and eliminating joints
//! from the leaves towards the base keeps it so (Featherstone 2008, section 6.5, "LTDL"). Legs do
//! not fill each other in. Joints are held by [`blocks`](super::blocks) of three, and the base's
//! six rows are one dense block that is eliminated last.
//!
//! The diagonal is split evenly, `M = L^T D L = H^T H` with `H = D^1/2 L`: a constraint row and
//! what its impulse changes are then the same numbers (see [`rows`](super::rows)), and kinetic
//! energy is half the square of `H u`.

use super::articulation::Topology;
use super::blocks::{BLOCK, Block};
use super::lanes::Real;
use super::math::SpatialInertia;
use super::state::LinkState;

/// `M = L^T D L = H^T H`, with `L` unit lower triangular and zero off the ancestors.
#[derive(Clone, Debug)]
pub struct Factor<S> {
    /// Factors of the blocks of joints, `[blocks]`.
    pub blocks: Vec<BlockFactor<S>>,
    /// Couplings of a block with its carriers, `[joint of the block][joint of the carrier]`:
    /// `M[j][i]`, then `L[j][i]`, at `first_coupling + c`.
    pub couplings: Vec<[[S; BLOCK]; BLOCK]>,
    /// `D[j]^1/2` and its inverse, `[3 blocks]`.
    pub root: Vec<[S; 2]>,
    /// The base block; after factorisation the unit lower factor `G` of `G D G^T`.
    pub base: [[S; 6]; 6],
    /// `D^1/2` of the base block and its inverse; zero for a fixed base.
    pub base_root: [[S; 2]; 6],
}

/// The rows of a block's joints.
#[derive(Clone, Debug)]
pub struct BlockFactor<S> {
    /// `M[j][j]`, before factorisation.
    pub diagonal: [S; BLOCK],
    /// Couplings among the joints, 1-0, 2-0, 2-1: `M[j][i]`, then `L[j][i]`.
    pub inner: [S; 3],
    /// Couplings with the base: `M[j][0..6]`, then `L[j][0..6]`.
    pub base: [[S; 6]; BLOCK],
}

impl<S: Real> Factor<S> {
    /// Memory for a topology.
    pub fn new(topology: &Topology) -> Self {
        let z = S::zero();
        let blocks = topology.blocks().len();
        let empty = BlockFactor { diagonal: [S::one(); BLOCK], inner: [z; 3], base: [[z; 6]; BLOCK] };
        Self {
            blocks: vec![empty; blocks],
            couplings: vec![[[z; BLOCK]; BLOCK]; topology.num_couplings()],
            root: vec![[z; 2]; BLOCK * blocks],
            base: [[z; 6]; 6],
            base_root: [[z; 2]; 6],
        }
    }

    /// The mass matrix's row of the joint at a place of a block, from the composite `inertia` of
    /// the link it moves.
    #[inline(always)]
    pub fn set_joint(
        &mut self,
        topology: &Topology,
        block: usize,
        place: usize,
        links: &[LinkState<S>],
        inertia: &SpatialInertia<S>,
        armature: S,
    ) {
        let (shape, own) = (&topology.blocks()[block], &mut self.blocks[block]);
        let axis = &links[shape.joints[place] + 1].axis;
        let force = inertia.apply(axis);
        own.diagonal[place] = axis.dot(&force) + armature;
        for t in 0..place {
            // 1-0, 2-0, 2-1
            own.inner[place + t - 1] = links[shape.joints[t] + 1].axis.dot(&force);
        }
        for (c, carrier) in topology.carriers_of(shape).iter().enumerate() {
            let joints = &topology.blocks()[carrier.block].joints;
            for t in 0..BLOCK {
                let x = if t < carrier.count { links[joints[t] + 1].axis.dot(&force) } else { S::zero() };
                self.couplings[shape.first_coupling + c][place][t] = x;
            }
        }
        own.base[place] = if topology.floating { force.to_array() } else { [S::zero(); 6] };
    }

    /// The rows of the joints that a block does not have.
    #[inline(always)]
    pub fn set_empty_places(&mut self, shape: &Block, block: usize) {
        let z = S::zero();
        let own = &mut self.blocks[block];
        for place in shape.len..BLOCK {
            own.diagonal[place] = S::one();
            for t in 0..place {
                own.inner[place + t - 1] = z;
            }
            own.base[place] = [z; 6];
            for c in 0..shape.num_carriers {
                self.couplings[shape.first_coupling + c][place] = [z; BLOCK];
            }
        }
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
        for (b, shape) in topology.blocks().iter().enumerate().rev() {
            // carriers come before
            let (before, own) = self.blocks.split_at_mut(b);
            let (couplings_before, couplings) = self.couplings.split_at_mut(shape.first_coupling);
            let couplings = &mut couplings[..shape.num_carriers];
            let own = &mut own[0];
            let [d0, d1, d2] = own.diagonal;
            let [m10, m20, m21] = own.inner;
            let roots = &mut self.root.as_chunks_mut::<BLOCK>().0[b];
            let i2 = split(d2, &mut roots[2]);
            let (l20, l21) = (m20 * i2, m21 * i2);
            let m10 = l21.neg_mul_add(m20, m10);
            let i1 = split(l21.neg_mul_add(m21, d1), &mut roots[1]);
            let l10 = m10 * i1;
            let i0 = split(l10.neg_mul_add(m10, l20.neg_mul_add(m20, d0)), &mut roots[0]);
            own.inner = [l10, l20, l21];
            let inverse = [i0, i1, i2];
            for r in 0..6 {
                let b1 = l21.neg_mul_add(own.base[2][r], own.base[1][r]);
                let b0 = l20.neg_mul_add(own.base[2][r], own.base[0][r]);
                (own.base[0][r], own.base[1][r]) = (l10.neg_mul_add(b1, b0), b1);
            }
            for c in couplings.iter_mut() {
                for t in 0..BLOCK {
                    let c1 = l21.neg_mul_add(c[2][t], c[1][t]);
                    let c0 = l20.neg_mul_add(c[2][t], c[0][t]);
                    (c[0][t], c[1][t]) = (l10.neg_mul_add(c1, c0), c1);
                }
            }
            for (p, carrier) in topology.carriers_of(shape).iter().enumerate() {
                let Some((nearest, further)) = couplings[p..].split_first_mut() else {
                    break;
                };
                let on = &mut before[carrier.block];
                let mut l = *nearest;
                for s in 0..BLOCK {
                    for t in 0..BLOCK {
                        l[s][t] = l[s][t] * inverse[s];
                    }
                }
                for s in 0..BLOCK {
                    for t in 0..BLOCK {
                        on.diagonal[t] = l[s][t].neg_mul_add(nearest[s][t], on.diagonal[t]);
                        for u in 0..t {
                            on.inner[t + u - 1] = l[s][t].neg_mul_add(nearest[s][u], on.inner[t + u - 1]);
                        }
                        for r in 0..6 {
                            on.base[t][r] = l[s][t].neg_mul_add(own.base[s][r], on.base[t][r]);
                        }
                    }
                }
                let first = topology.blocks()[carrier.block].first_coupling;
                for (on, c) in couplings_before[first..].iter_mut().zip(further) {
                    for s in 0..BLOCK {
                        for t in 0..BLOCK {
                            for u in 0..BLOCK {
                                on[t][u] = l[s][t].neg_mul_add(c[s][u], on[t][u]);
                            }
                        }
                    }
                }
                *nearest = l;
            }
            for r in 0..6 {
                let [x0, x1, x2] = [own.base[0][r] * i0, own.base[1][r] * i1, own.base[2][r] * i2];
                // column r needs what stands from r on, not yet scaled
                for c in r..6 {
                    let y = x0.neg_mul_add(own.base[0][c], self.base[c][r]);
                    let y = x1.neg_mul_add(own.base[1][c], y);
                    self.base[c][r] = x2.neg_mul_add(own.base[2][c], y);
                }
                (own.base[0][r], own.base[1][r], own.base[2][r]) = (x0, x1, x2);
            }
        }
        if !topology.floating {
            return;
        }
        // a loop over the pivots would not be unrolled
        self.eliminate_base::<0>();
        self.eliminate_base::<1>();
        self.eliminate_base::<2>();
        self.eliminate_base::<3>();
        self.eliminate_base::<4>();
        self.eliminate_base::<5>();
    }

    /// Eliminates one row of the base block.
    #[inline(always)]
    fn eliminate_base<const K: usize>(&mut self) {
        let inverse = split(self.base[K][K], &mut self.base_root[K]);
        for r in K + 1..6 {
            let a = self.base[r][K] * inverse;
            for c in K + 1..=r {
                self.base[r][c] = a.neg_mul_add(self.base[c][K], self.base[r][c]);
            }
        }
        for r in K + 1..6 {
            self.base[r][K] = self.base[r][K] * inverse;
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

    /// Replaces `b` by `G^-T b`, with `G` the factor of the base.
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
    pub fn half_solve(&self, topology: &Topology, base: &mut [S; 6], joints: &mut [[S; BLOCK]]) {
        let roots = self.root.as_chunks::<BLOCK>().0;
        for (b, shape) in topology.blocks().iter().enumerate().rev() {
            let own = &self.blocks[b];
            let [l10, l20, l21] = own.inner;
            let [x0, x1, x2] = joints[b];
            let x1 = l21.neg_mul_add(x2, x1);
            let x0 = l10.neg_mul_add(x1, l20.neg_mul_add(x2, x0));
            for (l, carrier) in self.couplings[shape.first_coupling..].iter().zip(topology.carriers_of(shape)) {
                let on = &mut joints[carrier.block];
                for t in 0..BLOCK {
                    let y = l[2][t].neg_mul_add(x2, on[t]);
                    on[t] = l[0][t].neg_mul_add(x0, l[1][t].neg_mul_add(x1, y));
                }
            }
            for r in 0..6 {
                let y = own.base[2][r].neg_mul_add(x2, base[r]);
                base[r] = own.base[0][r].neg_mul_add(x0, own.base[1][r].neg_mul_add(x1, y));
            }
            let root = &roots[b];
            joints[b] = [x0 * root[0][1], x1 * root[1][1], x2 * root[2][1]];
        }
        if topology.floating {
            self.base_forward(base);
        }
        for (x, root) in base.iter_mut().zip(&self.base_root) {
            *x = *x * root[1];
        }
    }

    /// `H u`: a velocity in the coordinates in which constraint rows are sparse.
    #[inline(always)]
    pub fn to_sparse(&self, topology: &Topology, base: &mut [S; 6], joints: &mut [[S; BLOCK]]) {
        let roots = self.root.as_chunks::<BLOCK>().0;
        // leaves first: a joint's new value uses its ancestors' old ones
        for (b, shape) in topology.blocks().iter().enumerate().rev() {
            let own = &self.blocks[b];
            let [l10, l20, l21] = own.inner;
            let [x0, x1, x2] = joints[b];
            let mut x = [x0, l10.mul_add(x0, x1), l21.mul_add(x1, l20.mul_add(x0, x2))];
            for (l, carrier) in self.couplings[shape.first_coupling..].iter().zip(topology.carriers_of(shape)) {
                let from = &joints[carrier.block];
                for s in 0..BLOCK {
                    for t in 0..BLOCK {
                        x[s] = l[s][t].mul_add(from[t], x[s]);
                    }
                }
            }
            for s in 0..BLOCK {
                for r in 0..6 {
                    x[s] = own.base[s][r].mul_add(base[r], x[s]);
                }
                joints[b][s] = x[s] * roots[b][s][0];
            }
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
    pub fn to_dense(&self, topology: &Topology, base: &mut [S; 6], joints: &mut [[S; BLOCK]]) {
        for (x, root) in base.iter_mut().zip(&self.base_root) {
            *x = *x * root[1];
        }
        if topology.floating {
            self.base_backward(base);
        }
        let roots = self.root.as_chunks::<BLOCK>().0;
        for (b, shape) in topology.blocks().iter().enumerate() {
            let own = &self.blocks[b];
            let mut x = [S::zero(); BLOCK];
            for s in 0..BLOCK {
                x[s] = joints[b][s] * roots[b][s][1];
                for r in 0..6 {
                    x[s] = own.base[s][r].neg_mul_add(base[r], x[s]);
                }
            }
            for (l, carrier) in self.couplings[shape.first_coupling..].iter().zip(topology.carriers_of(shape)) {
                let from = &joints[carrier.block];
                for s in 0..BLOCK {
                    for t in 0..BLOCK {
                        x[s] = l[s][t].neg_mul_add(from[t], x[s]);
                    }
                }
            }
            let [l10, l20, l21] = own.inner;
            let x1 = l10.neg_mul_add(x[0], x[1]);
            joints[b] = [x[0], x1, l21.neg_mul_add(x1, l20.neg_mul_add(x[0], x[2]))];
        }
    }
}

/// Splits a pivot evenly: its root and the inverse go into `root`; the inverse of the pivot.
#[inline(always)]
fn split<S: Real>(pivot: S, root: &mut [S; 2]) -> S {
    let whole = pivot.sqrt();
    let inverse = S::one() / whole;
    *root = [whole, inverse];
    inverse * inverse
}
