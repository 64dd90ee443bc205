//! The joints of a tree in blocks of three.
//!
//! The coupling of joints (the mass matrix, its factors, constraint rows) is laid out by blocks of
//! a fixed size and worked on block by block: loops over a block are unrolled, and indices are
//! computed once for nine numbers. A leg of three joints is one block. A block of fewer joints has
//! places left over: the joints that are not there have the mass one, no coupling and no velocity,
//! and change nothing.

use super::articulation::JointTopology;
use super::lanes::Real;

/// Places for joints in a block.
pub const BLOCK: usize = 3;

/// Joints in a row of one chain, the nearest to the base first.
#[derive(Clone, Debug)]
pub struct Block {
    /// The first [`len`](Self::len) are its joints.
    pub joints: [usize; BLOCK],
    /// How many they are.
    pub len: usize,
    /// The joints that carry all of it, nearest block first.
    pub carriers: Vec<Carrier>,
    /// Where its couplings with them start in a factor.
    pub first_coupling: usize,
}

/// The first `count` joints of a block, which carry a link or another block.
#[derive(Clone, Copy, Debug)]
pub struct Carrier {
    /// Index of the block in the topology.
    pub block: usize,
    /// Number of its first joints that carry, at least one.
    pub count: usize,
}

/// A part of a path.
#[derive(Clone, Debug)]
pub(super) struct PathPart {
    pub(super) joints: Carrier,
    /// Where the carriers of its block stand in the path.
    pub(super) carriers: Vec<usize>,
}

/// All blocks of a tree, each after those that carry it.
#[derive(Clone, Debug, Default)]
pub(super) struct Blocks {
    pub(super) blocks: Vec<Block>,
    /// The block of each joint, and its place there.
    place: Vec<(usize, usize)>,
    pub(super) num_couplings: usize,
    /// The blocks of each tree that the base carries, in their order.
    pub(super) trees: Vec<Vec<usize>>,
    /// The place of each link among those of its tree, which are counted from 1; that of the base
    /// is 0.
    pub(super) slots: Vec<usize>,
}

impl Blocks {
    pub(super) fn new(joints: &[JointTopology]) -> Self {
        let mut all = Self { slots: vec![0; joints.len() + 1], ..Self::default() };
        for (j, joint) in joints.iter().enumerate() {
            let parent = joint.parent.checked_sub(1).map(|parent| all.place[parent]);
            match parent {
                Some((b, place)) if place + 1 == all.blocks[b].len && place + 1 < BLOCK => {
                    let block = &mut all.blocks[b];
                    block.joints[block.len] = j;
                    all.place.push((b, block.len));
                    block.len += 1;
                }
                _ => {
                    let carriers = parent.map_or(Vec::new(), |(block, place)| all.carriers(block, place));
                    all.place.push((all.blocks.len(), 0));
                    all.num_couplings += carriers.len();
                    let first_coupling = all.num_couplings - carriers.len();
                    let root = carriers.last().map(|root: &Carrier| root.block);
                    match all.trees.iter_mut().find(|tree| Some(tree[0]) == root) {
                        Some(tree) => tree.push(all.blocks.len()),
                        None => all.trees.push(vec![all.blocks.len()]),
                    }
                    all.blocks.push(Block { joints: [j; BLOCK], len: 1, carriers, first_coupling });
                }
            }
        }
        for tree in &all.trees {
            let joints = tree.iter().flat_map(|&b| &all.blocks[b].joints[..all.blocks[b].len]);
            for (place, joint) in joints.enumerate() {
                all.slots[joint + 1] = place + 1;
            }
        }
        all
    }

    /// The joints from one at a place of a block to the base.
    fn carriers(&self, block: usize, place: usize) -> Vec<Carrier> {
        let own = Carrier { block, count: place + 1 };
        std::iter::once(own).chain(self.blocks[block].carriers.iter().copied()).collect()
    }

    /// The joints that carry a link, nearest first.
    pub(super) fn path(&self, link: usize) -> Vec<PathPart> {
        let joints = link.checked_sub(1).map_or(Vec::new(), |j| self.carriers(self.place[j].0, self.place[j].1));
        self.with_places(joints)
    }

    /// The joints that carry one of two links or both, each before those that carry it.
    pub(super) fn path_of_both(&self, links: [usize; 2]) -> Vec<PathPart> {
        let mut joints: Vec<Carrier> = links.into_iter().flat_map(|link| self.path(link)).map(|p| p.joints).collect();
        // the larger count of a block that both paths have
        joints.sort_unstable_by_key(|part| std::cmp::Reverse((part.block, part.count)));
        joints.dedup_by_key(|part| part.block);
        self.with_places(joints)
    }

    fn with_places(&self, joints: Vec<Carrier>) -> Vec<PathPart> {
        let place = |of: &Carrier| joints.iter().position(|part| part.block == of.block);
        let carriers = |part: &Carrier| self.blocks[part.block].carriers.iter().filter_map(place).collect();
        joints.iter().map(|part| PathPart { joints: *part, carriers: carriers(part) }).collect()
    }
}

/// Numbers of joints by blocks; zero at places without a joint.
#[inline(always)]
pub(super) fn gather<S: Real>(blocks: &[Block], joints: &[S], by_block: &mut [[S; BLOCK]]) {
    for out in by_block.iter_mut().skip(blocks.len()) {
        *out = [S::zero(); BLOCK];
    }
    for (block, out) in blocks.iter().zip(by_block) {
        for place in 0..BLOCK {
            out[place] = if place < block.len { joints[block.joints[place]] } else { S::zero() };
        }
    }
}

/// The inverse of [`gather`].
#[inline(always)]
pub(super) fn scatter<S: Real>(blocks: &[Block], by_block: &[[S; BLOCK]], joints: &mut [S]) {
    for (block, from) in blocks.iter().zip(by_block) {
        for place in 0..block.len {
            joints[block.joints[place]] = from[place];
        }
    }
}
