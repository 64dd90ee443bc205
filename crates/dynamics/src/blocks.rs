//! The joints of a tree in blocks of three.
//!
//! The coupling of joints (the mass matrix, its factors, constraint rows) is laid out by blocks of
//! a fixed size and worked on block by block: loops over a block are unrolled, and indices are
//! computed once for nine numbers. A leg of three joints is one block. A block of fewer joints has
//! places left over: the joints that are not there have the mass one, no coupling and no velocity,
//! and change nothing.

use super::articulation::JointTopology;
use super::lanes::Real;
use super::lists::Lists;

/// Places for joints in a block.
pub const BLOCK: usize = 3;

/// Joints in a row of one chain, the nearest to the base first.
#[derive(Clone, Copy, Debug)]
pub struct Block {
    /// Joints of the block, the first [`len`](Self::len).
    pub joints: [usize; BLOCK],
    /// Number of the joints.
    pub len: usize,
    /// Number of blocks that carry it.
    pub num_carriers: usize,
    /// Start of the block's carriers among those of all blocks, and of its couplings with them in a
    /// factor.
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
#[derive(Clone, Copy, Debug)]
pub(super) struct PathPart {
    pub(super) joints: Carrier,
    /// Start of the places of the part's carriers in [`Paths::carriers`].
    first_carrier: usize,
    /// Number of these carriers.
    num_carriers: usize,
}

/// The ways from links to the base.
#[derive(Clone, Debug, Default)]
pub(super) struct Paths {
    parts: Lists<PathPart>,
    /// Places in the path of the carriers of each part's block.
    carriers: Vec<usize>,
}

impl Paths {
    /// Appends the path of joints that each come before those that carry them.
    pub(super) fn push(&mut self, blocks: &Blocks, joints: &[Carrier]) {
        let place = |of: &Carrier| joints.iter().position(|part| part.block == of.block);
        let mut parts = Vec::new();
        for &part in joints {
            let first_carrier = self.carriers.len();
            self.carriers.extend(blocks.carriers_of(&blocks.blocks[part.block]).iter().filter_map(place));
            parts.push(PathPart { joints: part, first_carrier, num_carriers: self.carriers.len() - first_carrier });
        }
        self.parts.push(parts);
    }

    /// Forgets all paths from number `len` on.
    pub(super) fn truncate(&mut self, len: usize) {
        self.parts.truncate(len);
        self.carriers.truncate(
            self.parts.iter().flatten().map(|part| part.first_carrier + part.num_carriers).max().unwrap_or(0),
        );
    }

    /// Number of paths.
    pub(super) fn len(&self) -> usize {
        self.parts.len()
    }

    /// The parts of a path.
    #[inline(always)]
    pub(super) fn parts(&self, path: usize) -> &[PathPart] {
        &self.parts[path]
    }

    /// Number of parts of the longest path.
    pub(super) fn longest(&self) -> usize {
        self.parts.iter().map(<[PathPart]>::len).max().unwrap_or(0)
    }

    /// Places in the path of the blocks that carry a part.
    #[inline(always)]
    pub(super) fn carriers_of(&self, part: &PathPart) -> &[usize] {
        &self.carriers[part.first_carrier..][..part.num_carriers]
    }
}

/// All blocks of a tree, each after those that carry it.
#[derive(Clone, Debug, Default)]
pub(super) struct Blocks {
    pub(super) blocks: Vec<Block>,
    /// The block of each joint, and its place there.
    place: Vec<(usize, usize)>,
    /// The joints that carry each block, nearest block first, block by block.
    pub(super) carriers: Vec<Carrier>,
    /// The blocks of each tree that the base carries, in their order.
    pub(super) trees: Lists<usize>,
    /// The place of each link among those of its tree, which are counted from 1; that of the base
    /// is 0.
    pub(super) slots: Vec<usize>,
}

impl Blocks {
    pub(super) fn new(joints: &[JointTopology]) -> Self {
        let mut all = Self { slots: vec![0; joints.len() + 1], ..Self::default() };
        let mut trees: Vec<Vec<usize>> = Vec::new();
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
                    let carriers = parent.map_or(Vec::new(), |(block, place)| all.carriers_from(block, place));
                    all.place.push((all.blocks.len(), 0));
                    let root = carriers.last().map(|root: &Carrier| root.block);
                    match trees.iter_mut().find(|tree| Some(tree[0]) == root) {
                        Some(tree) => tree.push(all.blocks.len()),
                        None => trees.push(vec![all.blocks.len()]),
                    }
                    let (num_carriers, first_coupling) = (carriers.len(), all.carriers.len());
                    all.blocks.push(Block { joints: [j; BLOCK], len: 1, num_carriers, first_coupling });
                    all.carriers.extend(carriers);
                }
            }
        }
        for tree in &trees {
            let joints = tree.iter().flat_map(|&b| &all.blocks[b].joints[..all.blocks[b].len]);
            for (place, joint) in joints.enumerate() {
                all.slots[joint + 1] = place + 1;
            }
        }
        all.trees = trees.into_iter().collect();
        all
    }

    /// The joints that carry all of a block, nearest block first.
    #[inline(always)]
    pub(super) fn carriers_of(&self, block: &Block) -> &[Carrier] {
        &self.carriers[block.first_coupling..][..block.num_carriers]
    }

    /// The joints from one at a place of a block to the base.
    fn carriers_from(&self, block: usize, place: usize) -> Vec<Carrier> {
        let own = Carrier { block, count: place + 1 };
        std::iter::once(own).chain(self.carriers_of(&self.blocks[block]).iter().copied()).collect()
    }

    /// The joints that carry a link, nearest first.
    pub(super) fn path(&self, link: usize) -> Vec<Carrier> {
        link.checked_sub(1).map_or(Vec::new(), |j| self.carriers_from(self.place[j].0, self.place[j].1))
    }

    /// The joints that carry one of two links or both, each before those that carry it.
    pub(super) fn path_of_both(&self, links: [usize; 2]) -> Vec<Carrier> {
        let mut joints: Vec<Carrier> = links.into_iter().flat_map(|link| self.path(link)).collect();
        // the larger count of a block that both paths have
        joints.sort_unstable_by_key(|part| std::cmp::Reverse((part.block, part.count)));
        joints.dedup_by_key(|part| part.block);
        joints
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
