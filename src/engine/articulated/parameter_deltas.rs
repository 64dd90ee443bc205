//! Per-env parameter deltas. A pack starts from the morphology's parameters, which stay in the
//! cache, and overwrites those that differ in its lanes.

use crate::dynamics::Parameters;
use crate::dynamics::lanes::{Lanes, Real};

/// Largest number of places that are kept as deltas. Beyond it all parameters are kept, pack by
/// pack.
const FEW: usize = 64;

/// Parameters of all bodies of a morphology, one body a row, as numbers `T`.
pub(super) enum ParameterDeltas<L, T> {
    /// Parameters that differ from the morphology's in some body, and their ascending places among
    /// all of the [`Parameters`]: `[rows][places]`.
    Few { places: Vec<u32>, values: Vec<T> },
    /// All parameters, in packs of `L::LANES` rows; lists without a difference are the
    /// morphology's.
    All(Vec<Parameters<L>>),
}

impl<L: Lanes, T: Real> ParameterDeltas<L, T> {
    /// No deltas: all bodies have the morphology's parameters.
    pub(super) fn none() -> Self {
        Self::Few { places: Vec::new(), values: Vec::new() }
    }

    /// Whether any rows may share a pack, or only those whose numbers lie together.
    pub(super) fn may_mix(&self) -> bool {
        matches!(self, Self::Few { .. })
    }

    /// Takes over the numbers of the body in one of `count` rows; `nominal` are the morphology's.
    pub(super) fn set_row(&mut self, row: usize, count: usize, body: &Parameters<T>, nominal: &Parameters<L>) {
        if let Self::Few { places, values } = self {
            let new = set_known(places, row_of(values, row, places.len()), body, nominal);
            if new.is_empty() {
                return;
            }
            if places.len() + new.len() > FEW {
                self.keep_all(count, nominal);
            } else {
                (*places, *values) = with_places(places, values, count, &new);
            }
        }
        match self {
            Self::Few { places, values } => {
                set_known(places, row_of(values, row, places.len()), body, nominal);
            }
            Self::All(packs) => {
                let lane = row % L::LANES;
                // idle lanes shadow the last robot, so that they cost and break nothing
                let end = if row + 1 == count { L::LANES } else { lane + 1 };
                (lane..end).for_each(|lane| packs[row / L::LANES].set_lane(lane, body));
            }
        }
    }

    fn keep_all(&mut self, count: usize, nominal: &Parameters<L>) {
        let mut packs = vec![nominal.clone(); count.div_ceil(L::LANES)];
        for (pack, numbers) in packs.iter_mut().enumerate() {
            let first = pack * L::LANES;
            let rows: Vec<usize> = (first..count.min(first + L::LANES)).collect();
            self.put(0, &rows, numbers);
        }
        *self = Self::All(packs);
    }

    /// The parameters of a pack, for some `rows`, counted from `first`. Unless packs [may
    /// mix](Self::may_mix), these are the rows of pack `pack`. `nominal` holds the morphology's
    /// parameters, or the result of an earlier call.
    pub(super) fn of_pack<'a>(
        &'a self,
        first: usize,
        pack: usize,
        rows: &[usize],
        nominal: &'a mut Parameters<L>,
    ) -> &'a Parameters<L> {
        match self {
            Self::Few { .. } => {
                self.put(first, rows, nominal);
                nominal
            }
            Self::All(packs) => &packs[first / L::LANES + pack],
        }
    }

    /// The numbers of a pack whose actuators have no gains, written into `numbers`; see
    /// [`of_pack`](Self::of_pack).
    pub(super) fn of_pack_without_gains<'a>(
        &self,
        first: usize,
        pack: usize,
        rows: &[usize],
        numbers: &'a mut Parameters<L>,
    ) -> &'a Parameters<L> {
        match self {
            Self::Few { .. } => self.put(first, rows, numbers),
            Self::All(packs) => numbers.clone_from(&packs[first / L::LANES + pack]),
        }
        numbers.stiffness.fill(L::zero());
        numbers.damping.fill(L::zero());
        numbers
    }

    /// Writes the deltas of `rows`, counted from `first`, into lanes; lanes beyond them shadow the
    /// last row.
    fn put(&self, first: usize, rows: &[usize], numbers: &mut Parameters<L>) {
        if let Self::Few { places, values } = self {
            numbers.for_each_at(places, |k, x| {
                let value = |row: usize| values[(first + row) * places.len() + k];
                for (lane, &row) in rows.iter().enumerate() {
                    x.set_lane(lane, value(row).lane(0));
                }
                for lane in rows.len()..L::LANES {
                    x.set_lane(lane, value(rows[rows.len() - 1]).lane(0));
                }
            });
        }
    }
}

fn row_of<T>(values: &mut [T], row: usize, width: usize) -> &mut [T] {
    &mut values[row * width..(row + 1) * width]
}

/// Writes a body's numbers at the known places to its row. Returns further places where it differs,
/// with the morphology's numbers, up to one more than fits.
fn set_known<L: Lanes, T: Real>(
    places: &[u32],
    row: &mut [T],
    body: &Parameters<T>,
    nominal: &Parameters<L>,
) -> Vec<(u32, T)> {
    let mut new = Vec::new();
    let (mut place, mut known) = (0, 0);
    nominal.any_with(body, |shared, &x| {
        let shared = T::splat(shared.lane(0));
        if places.get(known) == Some(&place) {
            row[known] = x;
            known += 1;
        } else if shared.lane(0).to_bits() != x.lane(0).to_bits() {
            new.push((place, shared));
        }
        place += 1;
        places.len() + new.len() > FEW
    });
    new
}

/// Places and values with new places among them, where all rows have the same number so far.
fn with_places<T: Real>(places: &[u32], values: &[T], count: usize, new: &[(u32, T)]) -> (Vec<u32>, Vec<T>) {
    let old = places.iter().enumerate().map(|(k, &place)| (place, Err(k)));
    let mut all: Vec<(u32, Result<T, usize>)> = old.chain(new.iter().map(|&(place, x)| (place, Ok(x)))).collect();
    all.sort_unstable_by_key(|&(place, _)| place);
    let value = |row: usize, from: Result<T, usize>| from.unwrap_or_else(|k| values[row * places.len() + k]);
    let values = (0..count).flat_map(|row| all.iter().map(move |&(_, from)| value(row, from)));
    let values = values.collect();
    (all.iter().map(|&(place, _)| place).collect(), values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Library;
    use crate::dynamics::lanes::Portable;
    use crate::dynamics::lanes::Real;
    use crate::morphology::MorphologyModel;

    /// All numbers of one lane.
    fn numbers<L: Real>(of: &Parameters<L>, lane: usize) -> Vec<u32> {
        let mut all = Vec::new();
        of.any_with(of, |x, _| {
            all.push(x.lane_f32(lane).to_bits());
            false
        });
        all
    }

    #[test]
    fn every_lane_has_the_numbers_of_its_row() {
        let library = Library::new(Vec::new());
        let robot = library.robots().unwrap().swap_remove(0).name;
        let model = MorphologyModel::new(&library.robot(&robot).unwrap()).unwrap();
        let nominal: Parameters<Portable> = Parameters::from_scalars(&model.topology, &model.nominal);
        let count = 2 * Portable::LANES + 3;
        let mut bodies = vec![model.nominal.clone(); count];
        let mut own = ParameterDeltas::none();
        let mut of_pack = nominal.clone();
        let few: [fn(&mut Parameters<f32>, f32); 4] = [
            |body, x| body.mass[0] += x,
            |body, x| body.com[0][1] -= x,
            |body, x| body.stiffness.iter_mut().for_each(|k| *k *= 1.0 + x),
            |body, x| body.static_friction += x,
        ];
        let many: fn(&mut Parameters<f32>, f32) =
            |body, x| body.inertia.as_flattened_mut().iter_mut().for_each(|i| *i += x);
        // one number after the other differs in some body, until more than a few do
        for (round, change) in few.into_iter().chain([many]).enumerate() {
            for row in (round % 3..count).step_by(3).chain([count - 1]) {
                change(&mut bodies[row], 0.001 * (row + 7 * round) as f32);
                own.set_row(row, count, &bodies[row], &nominal);
            }
            assert_eq!(own.may_mix(), round < 4);
            let mixed: Vec<usize> = (0..count).map(|k| (k * 11 + round) % count).collect();
            let sorted: Vec<usize> = (0..count).collect();
            let order = if own.may_mix() { mixed } else { sorted };
            for (pack, rows) in order.chunks(Portable::LANES).enumerate() {
                let found = own.of_pack(0, pack, rows, &mut of_pack);
                for lane in 0..Portable::LANES {
                    // idle lanes shadow the last row
                    let row = rows[lane.min(rows.len() - 1)];
                    assert!(numbers(found, lane) == numbers(&bodies[row], 0), "round {round}, row {row}");
                }
            }
        }
    }
}
