//! What the bodies of a pack have of their own. A pack steps with its morphology's numbers, which a thread has in its cache,
//! and puts its own into their places for that time.

use crate::dynamics::{Parameters, Real};

/// A pack that has more numbers of its own keeps all.
const FEW: usize = 64;

pub(super) enum PackNumbers<L> {
    /// Those that differ in some lane, by their places among all of the [`Parameters`], which ascend.
    Few { places: Vec<u32>, values: Vec<L> },
    /// All; lists without a difference are the morphology's.
    All(Box<Parameters<L>>),
}

impl<L: Real> PackNumbers<L> {
    /// None: the bodies are as the morphology has them.
    pub(super) fn none() -> Self {
        Self::Few { places: Vec::new(), values: Vec::new() }
    }

    /// Takes over the numbers of the body in a lane; `nominal` are the morphology's.
    pub(super) fn set_lane(&mut self, lane: usize, body: &Parameters<f32>, nominal: &Parameters<L>) {
        match self {
            Self::All(all) => all.set_lane(lane, body),
            Self::Few { places, values } => {
                let (mut place, mut known) = (0, 0);
                let too_many = nominal.any_with(body, |&shared, &x| {
                    let x = f64::from(x);
                    if places.get(known) != Some(&place) && shared.lane(lane).to_bits() != x.to_bits() {
                        if values.len() == FEW {
                            return true;
                        }
                        places.insert(known, place);
                        values.insert(known, shared);
                    }
                    if places.get(known) == Some(&place) {
                        values[known].set_lane(lane, x);
                        known += 1;
                    }
                    place += 1;
                    false
                });
                if too_many {
                    let mut all = Box::new(nominal.clone());
                    self.swap(&mut all);
                    all.set_lane(lane, body);
                    *self = Self::All(all);
                }
            }
        }
    }

    /// Puts the numbers into their places among the morphology's, and those into theirs; a second call undoes it.
    pub(super) fn swap(&mut self, nominal: &mut Parameters<L>) {
        if let Self::Few { places, values } = self {
            for (&place, value) in places.iter().zip(values) {
                if let Some(x) = nominal.number_mut(place as usize) {
                    std::mem::swap(x, value);
                }
            }
        }
    }

    /// All numbers, where `nominal` holds those that this has [swapped](Self::swap) into it.
    pub(super) fn all<'a>(&'a self, nominal: &'a Parameters<L>) -> &'a Parameters<L> {
        match self {
            Self::Few { .. } => nominal,
            Self::All(all) => all,
        }
    }
}
