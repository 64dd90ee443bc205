//! The sparse velocity `y` of [`rows`](super::rows) along the path of a constraint: reading it and adding impulses.
//!
//! From one constraint to the next only the base's part of the velocity passes, mostly: it is added last when read and first
//! when written, so that little waits for it.

use super::blocks::{BLOCK, PathPart};
use super::lanes::Real;

/// Joint parts of three rows in one block: `[joint][row]`.
pub(super) type JointRows<S> = [[S; 3]; BLOCK];

/// `a . b + c`.
#[inline(always)]
pub(super) fn dot6_onto<S: Real>(a: &[S; 6], b: &[S; 6], c: S) -> S {
    // two chains, for latency
    let even = a[0].mul_add(b[0], a[2].mul_add(b[2], a[4].mul_add(b[4], c)));
    let odd = a[1].mul_add(b[1], a[3].mul_add(b[3], a[5] * b[5]));
    even + odd
}

/// Velocities of three rows.
#[inline(always)]
pub(super) fn velocities<S: Real>(
    path: &[PathPart],
    base: &[[S; 6]; 3],
    joint: &[JointRows<S>],
    y_base: &[S; 6],
    y_joint: &[[S; BLOCK]],
) -> [S; 3] {
    let mut w = [S::zero(); 3];
    for (part, z) in path.iter().zip(joint) {
        let y = &y_joint[part.joints.block];
        for s in 0..BLOCK {
            for d in 0..3 {
                w[d] = z[s][d].mul_add(y[s], w[d]);
            }
        }
    }
    [dot6_onto(&base[0], y_base, w[0]), dot6_onto(&base[1], y_base, w[1]), dot6_onto(&base[2], y_base, w[2])]
}

/// Adds what impulses of three rows change to the velocity.
#[inline(always)]
pub(super) fn apply<S: Real>(
    path: &[PathPart],
    base: &[[S; 6]; 3],
    joint: &[JointRows<S>],
    impulse: &[S; 3],
    y_base: &mut [S; 6],
    y_joint: &mut [[S; BLOCK]],
) {
    for r in 0..6 {
        let y = base[0][r].mul_add(impulse[0], y_base[r]);
        let y = base[1][r].mul_add(impulse[1], y);
        y_base[r] = base[2][r].mul_add(impulse[2], y);
    }
    for (part, z) in path.iter().zip(joint) {
        let y = &mut y_joint[part.joints.block];
        for s in 0..BLOCK {
            let x = z[s][0].mul_add(impulse[0], y[s]);
            let x = z[s][1].mul_add(impulse[1], x);
            y[s] = z[s][2].mul_add(impulse[2], x);
        }
    }
}

/// Velocity of the first of three rows.
#[inline(always)]
pub(super) fn first_velocity<S: Real>(
    path: &[PathPart],
    base: &[S; 6],
    joint: &[JointRows<S>],
    y_base: &[S; 6],
    y_joint: &[[S; BLOCK]],
) -> S {
    let mut w = S::zero();
    for (part, z) in path.iter().zip(joint) {
        let y = &y_joint[part.joints.block];
        for s in 0..BLOCK {
            w = z[s][0].mul_add(y[s], w);
        }
    }
    dot6_onto(base, y_base, w)
}

/// Adds what an impulse of the first of three rows changes to the velocity.
#[inline(always)]
pub(super) fn apply_first<S: Real>(
    path: &[PathPart],
    base: &[S; 6],
    joint: &[JointRows<S>],
    impulse: S,
    y_base: &mut [S; 6],
    y_joint: &mut [[S; BLOCK]],
) {
    for (y, &z) in y_base.iter_mut().zip(base) {
        *y = z.mul_add(impulse, *y);
    }
    for (part, z) in path.iter().zip(joint) {
        let y = &mut y_joint[part.joints.block];
        for s in 0..BLOCK {
            y[s] = z[s][0].mul_add(impulse, y[s]);
        }
    }
}
