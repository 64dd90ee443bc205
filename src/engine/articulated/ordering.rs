//! Order of robots in packs.
//!
//! A pack works on each contact and each joint limit that any of its lanes has. So robots that have
//! the same bodies near the ground, or the same legs at their limits, share a pack. They are sorted
//! again in every control step by the demands of the one before. A robot's motion depends neither
//! on its lane nor on its neighbours.

use crate::dynamics::lanes::{MOST_LANES, Real};
use crate::robot::BodyGroup;

/// Bits of the sort key for each demand of a robot, in the order of
/// [`Report::demands`](crate::dynamics::Report::demands).
pub(super) struct DemandBits(Vec<u32>);

impl DemandBits {
    /// Bits for a robot whose bodies are of `groups` and whose joints form `blocks` blocks.
    ///
    /// Contacts near the base are rare and cost every lane of the pack, so they are the primary
    /// sort key. Joint limits come next, and then feet, which are near the ground in nearly all
    /// robots.
    pub(super) fn new(groups: &[BodyGroup], blocks: usize) -> Self {
        let rank = |&demand: &usize| match groups.get(demand) {
            Some(BodyGroup::Other | BodyGroup::Arm | BodyGroup::Head) => 0,
            Some(BodyGroup::Base | BodyGroup::Torso) => 1,
            Some(BodyGroup::Hip) => 2,
            Some(BodyGroup::Thigh) => 3,
            Some(BodyGroup::Shank) => 4,
            None if demand < groups.len() + blocks => 5,
            Some(BodyGroup::Foot) => 6,
            None => 7,
        };
        let mut order: Vec<usize> = (0..=groups.len() + blocks).collect();
        order.sort_by_key(rank);
        let mut bits = vec![0; order.len()];
        for (bit, demand) in (0..u32::BITS).rev().chain(std::iter::repeat(0)).zip(order) {
            // beyond 32 the last ones share a bit
            bits[demand] = 1 << bit;
        }
        Self(bits)
    }

    /// The keys of the robots in a pack's lanes.
    pub(super) fn keys<L: Real>(&self, demands: &[L]) -> [u32; MOST_LANES] {
        let (mut keys, mut asked) = ([0; MOST_LANES], [0.0; MOST_LANES]);
        for (&bit, demand) in self.0.iter().zip(demands) {
            demand.store(&mut asked);
            for lane in 0..MOST_LANES {
                keys[lane] |= if asked[lane] > 0.0 { bit } else { 0 };
            }
        }
        keys
    }
}

/// Rows in the order of their keys. A list that each thread keeps as scratch memory.
#[derive(Default)]
pub(super) struct PackOrder {
    /// Key, then row.
    keyed: Vec<u64>,
    rows: Vec<usize>,
}

impl PackOrder {
    /// Keeps all rows in their order.
    pub(super) fn keep(&mut self, count: usize) -> &[usize] {
        self.rows.clear();
        self.rows.extend(0..count);
        &self.rows
    }

    /// Sorts all rows by their keys, one for each row.
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
    fn robots_that_ask_for_the_same_stand_together() {
        let leg = [BodyGroup::Thigh, BodyGroup::Shank, BodyGroup::Foot];
        let groups = [&[BodyGroup::Base][..], &leg, &leg].concat();
        let bits = DemandBits::new(&groups, 2);
        // demands of each robot beyond its feet, in the expected order: bodies 0 to 6, blocks 7 and
        // 8, a push
        let near: [&[usize]; 6] = [&[], &[9], &[8], &[4], &[1, 9], &[0]];
        // an order unlike the expected one, with a robot without its second foot, which comes first
        // of all
        let group = |row: usize| if row == 42 { None } else { Some((row * 5 + 2) % near.len()) };
        let key = |row| {
            let asks = |demand| match group(row) {
                Some(group) => near[group].contains(&demand) || demand == 3 || demand == 6,
                None => demand == 3,
            };
            let demands: Vec<f32> = (0..10).map(|demand| f32::from(u8::from(asks(demand)))).collect();
            bits.keys(&demands)[0]
        };
        let keys: Vec<u32> = (0..43).map(key).collect();
        let mut pack_ordering = PackOrder::default();
        let order = pack_ordering.sort(&keys).to_vec();
        let mut stand: Vec<Option<usize>> = order.iter().map(|&row| group(row)).collect();
        stand.dedup();
        assert_eq!(stand, [None, Some(0), Some(1), Some(2), Some(3), Some(4), Some(5)], "{order:?}");
        let mut rows = order;
        rows.sort_unstable();
        assert!(rows.iter().copied().eq(0..43));
        assert_eq!(pack_ordering.keep(3), [0, 1, 2]);
    }

    #[test]
    fn more_demands_than_bits_still_have_a_place() {
        let groups = [[BodyGroup::Shank; 40].as_slice(), &[BodyGroup::Base]].concat();
        let DemandBits(bits) = DemandBits::new(&groups, 1);
        assert_eq!((bits.len(), bits[40]), (43, 1 << 31));
        assert_eq!(bits[..31].iter().fold(0, |all, bit| all | bit), u32::MAX >> 1);
        assert!(bits[31..40].iter().chain(&bits[41..]).all(|&bit| bit == 1));
    }
}
