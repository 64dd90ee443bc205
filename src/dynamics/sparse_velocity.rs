//! The sparse velocity `y` of [`rows`](super::rows) along the path of a constraint: reading it and adding impulses.

use super::lanes::Real;
use super::rows::dot6;

/// The entries of the sparse velocity `y` along a path.
pub(super) trait PathVelocity<S: Real> {
    /// How many.
    fn len(&self) -> usize;
    fn get(&self, p: usize) -> S;
    fn set(&mut self, p: usize, y: S);
}

/// A copy of them, of a length known beforehand: loops over it are unrolled.
pub(super) struct Copied<S, const N: usize>([S; N]);

impl<S: Real, const N: usize> Copied<S, N> {
    #[inline(always)]
    pub(super) fn new(path: &[usize], y_joint: &[S]) -> Self {
        let mut y = [S::zero(); N];
        for (y, &j) in y.iter_mut().zip(path) {
            *y = y_joint[j];
        }
        Self(y)
    }

    #[inline(always)]
    pub(super) fn put_back(&self, path: &[usize], y_joint: &mut [S]) {
        for (&y, &j) in self.0.iter().zip(path) {
            y_joint[j] = y;
        }
    }
}

impl<S: Real, const N: usize> PathVelocity<S> for Copied<S, N> {
    #[inline(always)]
    fn len(&self) -> usize {
        N
    }
    #[inline(always)]
    fn get(&self, p: usize) -> S {
        self.0[p]
    }
    #[inline(always)]
    fn set(&mut self, p: usize, y: S) {
        self.0[p] = y;
    }
}

/// They themselves.
pub(super) struct Along<'a, S> {
    pub(super) path: &'a [usize],
    pub(super) y_joint: &'a mut [S],
}

impl<S: Real> PathVelocity<S> for Along<'_, S> {
    #[inline(always)]
    fn len(&self) -> usize {
        self.path.len()
    }
    #[inline(always)]
    fn get(&self, p: usize) -> S {
        self.y_joint[self.path[p]]
    }
    #[inline(always)]
    fn set(&mut self, p: usize, y: S) {
        self.y_joint[self.path[p]] = y;
    }
}

/// Velocities of three rows.
#[inline(always)]
pub(super) fn velocities<S: Real>(
    base: &[[S; 6]; 3],
    joint: &[[S; 3]],
    y_base: &[S; 6],
    y_joint: &impl PathVelocity<S>,
) -> [S; 3] {
    let mut w = [dot6(&base[0], y_base), dot6(&base[1], y_base), dot6(&base[2], y_base)];
    let joint = &joint[..y_joint.len()];
    for p in 0..y_joint.len() {
        let y = y_joint.get(p);
        for d in 0..3 {
            w[d] = joint[p][d].mul_add(y, w[d]);
        }
    }
    w
}

/// Adds what impulses of three rows change to the velocity.
#[inline(always)]
pub(super) fn apply<S: Real>(
    base: &[[S; 6]; 3],
    joint: &[[S; 3]],
    impulse: &[S; 3],
    y_base: &mut [S; 6],
    y_joint: &mut impl PathVelocity<S>,
) {
    for r in 0..6 {
        let y = base[0][r].mul_add(impulse[0], y_base[r]);
        let y = base[1][r].mul_add(impulse[1], y);
        y_base[r] = base[2][r].mul_add(impulse[2], y);
    }
    let joint = &joint[..y_joint.len()];
    for p in 0..y_joint.len() {
        let z = &joint[p];
        let y = z[0].mul_add(impulse[0], y_joint.get(p));
        let y = z[1].mul_add(impulse[1], y);
        y_joint.set(p, z[2].mul_add(impulse[2], y));
    }
}
