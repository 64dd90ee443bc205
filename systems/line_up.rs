//! Which robots share a pack.
//!
//! A pack works on each contact that any of its lanes has. So robots that have the same bodies near the ground are put side by side, in
//! every control step anew, by what was near in the one before. What a robot does depends neither on its lane nor on its neighbours.

use crate::dynamics::Real;
use crate::robot::BodyGroup;

/// Bits by which contact bodies decide a robot's place, `[bodies]`.
pub(super) struct BodyBits(Vec<u32>);

impl BodyBits {
    /// Feet decide last: they are near the ground in nearly all robots. The nearer another body is to the base, the fewer robots
    /// have it there, for whose sake all lanes of a pack bear its cost.
    pub(super) fn new(groups: &[BodyGroup]) -> Self {
        let rank = |&body: &usize| match groups[body] {
            BodyGroup::Other => 0,
            BodyGroup::Base => 1,
            BodyGroup::Hip => 2,
            BodyGroup::Thigh => 3,
            BodyGroup::Shank => 4,
            BodyGroup::Foot => 5,
        };
        let mut order: Vec<usize> = (0..groups.len()).collect();
        order.sort_by_key(rank);
        let mut bits = vec![0; groups.len()];
        for (bit, body) in (0..u32::BITS).rev().chain(std::iter::repeat(0)).zip(order) {
            // beyond 32 bodies the last ones share a bit
            bits[body] = 1 << bit;
        }
        Self(bits)
    }

    /// The key of the robot in a lane that has these bodies `near`, `[bodies]`.
    pub(super) fn key<L: Real>(&self, near: &[L], lane: usize) -> u32 {
        let bits = self.0.iter().zip(near).map(|(bit, near)| bit * u32::from(near.lane_f32(lane) > 0.0));
        bits.fold(0, |key, bit| key | bit)
    }
}

/// Rows in the order of their keys; a scratch list that threads keep.
#[derive(Default)]
pub(super) struct LineUp {
    /// Key, then row.
    keyed: Vec<u64>,
    rows: Vec<usize>,
}

impl LineUp {
    /// All rows as they are.
    pub(super) fn keep(&mut self, count: usize) -> &[usize] {
        self.rows.clear();
        self.rows.extend(0..count);
        &self.rows
    }

    /// All rows, one for each key, in the order of the keys.
    pub(super) fn sort(&mut self, keys: &[u32]) -> &[usize] {
        self.keyed.clear();
        self.keyed.extend((0..).zip(keys).map(|(row, &key)| u64::from(key) << 32 | row));
        self.keyed.sort_unstable();
        self.rows.clear();
        self.rows.extend(self.keyed.iter().map(|&keyed| keyed as u32 as usize));
        &self.rows
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn robots_with_the_same_bodies_near_stand_together() {
        let leg = [BodyGroup::Thigh, BodyGroup::Shank, BodyGroup::Foot];
        let groups = [&[BodyGroup::Base][..], &leg, &leg].concat();
        let bits = BodyBits::new(&groups);
        // a foot alone in the last robot, then in turn: the other thigh with all feet, the base, all feet, the first thigh
        let near = |row: usize, body: usize| match (row % 4, groups[body]) {
            _ if row == 40 => body == 3,
            (1, BodyGroup::Base) => true,
            (0, BodyGroup::Thigh) => body == 4,
            (3, BodyGroup::Thigh) => body == 1,
            (_, group) => group == BodyGroup::Foot,
        };
        let key = |row| {
            let near: Vec<f32> = (0..groups.len()).map(|body| f32::from(u8::from(near(row, body)))).collect();
            bits.key(&near, 0)
        };
        let keys: Vec<u32> = (0..41).map(key).collect();
        let mut line_up = LineUp::default();
        let order = line_up.sort(&keys).to_vec();
        let kind = |&row: &usize| if row == 40 { 9 } else { row % 4 };
        let mut kinds: Vec<usize> = order.iter().map(kind).collect();
        kinds.dedup();
        assert_eq!(kinds, [9, 2, 0, 3, 1], "{order:?}");
        let mut rows = order;
        rows.sort_unstable();
        assert!(rows.iter().copied().eq(0..41));
        assert_eq!(line_up.keep(3), [0, 1, 2]);
    }

    #[test]
    fn more_bodies_than_bits_still_have_a_place() {
        let groups = [[BodyGroup::Shank; 40].as_slice(), &[BodyGroup::Base]].concat();
        let BodyBits(bits) = BodyBits::new(&groups);
        assert_eq!(bits[40], 1 << 31);
        assert_eq!(bits[..31].iter().fold(0, |all, bit| all | bit), u32::MAX >> 1);
        assert!(bits[31..40].iter().all(|&bit| bit == 1));
    }
}
