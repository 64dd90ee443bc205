//! Control flow of kernels: what a mask decides, and what each lane looks up by itself.
//!
//! A kernel is straight-line code but for three operations of [`Real`]: [`when`](Real::when) skips
//! what no lane needs, [`repeat`](Real::repeat) ends a loop when every lane has left it, and
//! [`gather`](Real::gather) reads a table at the place that each lane names. With one lane they are
//! an `if`, a `while` and a load, so that a thread of a device takes the same steps as a lane.
//!
//! They return values where a functional language would take a function: a closure cannot be
//! `#[inline(always)]`, and one that is not inlined is compiled without the instruction set.

use super::Real;

/// Most lanes that a lane type has.
pub const MOST_LANES: usize = 16;

/// A table in which each lane looks up numbers by `KEYS` keys.
pub trait Table<const KEYS: usize> {
    /// Numbers that are found, an array of [`MOST_LANES`] for each.
    type Found;

    /// Looks up the first `lanes` keys; must be `#[inline(always)]`.
    fn look_up(&self, keys: &[[f32; MOST_LANES]; KEYS], lanes: usize) -> Self::Found;
}

/// Rounds of a loop that each lane leaves by itself:
///
/// ```
/// use polypod_lanes::Real;
///
/// // halves each number until it is below one, three times at most
/// fn halve<S: Real>(x: S) -> S {
///     let (mut x, one) = (x, S::one());
///     let mut rounds = S::repeat(3, S::not(x.lt(one)));
///     while let Some(lanes) = rounds.next() {
///         x = S::select(lanes, x * S::splat(0.5), x);
///         rounds.keep(S::not(x.lt(one)));
///     }
///     x
/// }
/// assert_eq!([0.75, 5.0, 64.0].map(halve), [0.75, 0.625, 8.0]);
/// ```
///
/// The body must change nothing in lanes that have left, since they are there for as long as a
/// neighbour stays.
#[derive(Clone, Copy, Debug)]
pub struct Rounds<S: Real> {
    lanes: S::Mask,
    /// Whether any lane is left.
    goes_on: bool,
    round: usize,
    most: usize,
}

impl<S: Real> Rounds<S> {
    #[inline(always)]
    pub(super) fn new(most: usize, lanes: S::Mask) -> Self {
        Self { lanes, goes_on: true, round: 0, most }
    }

    /// The lanes of the next round; none when all have left or the last round is over.
    #[expect(clippy::should_implement_trait, reason = "`keep` is called while the loop runs")]
    #[inline(always)]
    pub fn next(&mut self) -> Option<S::Mask> {
        if !self.goes_on || self.round >= self.most {
            return None;
        }
        self.round += 1;
        Some(self.lanes)
    }

    /// Number of the present round, from 1.
    #[inline(always)]
    pub fn round(&self) -> usize {
        self.round
    }

    /// Lets only lanes of this mask go on. Returns those that do, if any.
    #[inline(always)]
    pub fn keep(&mut self, lanes: S::Mask) -> Option<S::Mask> {
        self.lanes = S::and(self.lanes, lanes);
        let left = S::when(self.lanes);
        self.goes_on = left.is_some();
        left
    }
}
