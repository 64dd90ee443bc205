//! Lanes of plain code, for any machine.

use std::ops::{Add, Div, Mul, Neg, Sub};

use super::Real;
use crate::elementary;

/// The number of lanes in the portable fallback.
pub(super) const PORTABLE_LANES: usize = 8;

/// Lanes as a plain array: the same bits on any machine, at the speed the compiler finds.
#[derive(Clone, Copy, Debug)]
#[repr(align(32))]
pub struct Portable([f32; PORTABLE_LANES]);

macro_rules! portable_op {
    ($trait:ident, $f:ident, $op:tt) => {
        impl $trait for Portable {
            type Output = Self;
            #[inline(always)]
            fn $f(self, o: Self) -> Self {
                Portable(std::array::from_fn(|i| self.0[i] $op o.0[i]))
            }
        }
    };
}
portable_op!(Add, add, +);
portable_op!(Sub, sub, -);
portable_op!(Mul, mul, *);
portable_op!(Div, div, /);
impl Neg for Portable {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Portable(self.0.map(|x| -x))
    }
}

/// `a * b + c`, rounded once. A separate function: where the machine has no such instruction, every
/// lane is a call. Thousands of them in line would make a kernel many times as large.
#[inline(never)]
fn fused_multiply_add(a: &Portable, b: &Portable, c: &Portable) -> Portable {
    Portable(std::array::from_fn(|i| a.0[i].mul_add(b.0[i], c.0[i])))
}

impl Real for Portable {
    /// All bits of a lane that is true: selections are then operations on bits, not branches.
    type Mask = [u32; PORTABLE_LANES];
    const LANES: usize = PORTABLE_LANES;
    #[inline(always)]
    fn splat(x: f64) -> Self {
        Portable([x as f32; PORTABLE_LANES])
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        fused_multiply_add(&self, &b, &c)
    }
    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        fused_multiply_add(&-self, &b, &c)
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Portable(self.0.map(f32::sqrt))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Portable(self.0.map(f32::abs))
    }
    #[inline(always)]
    fn round(self) -> Self {
        Portable(self.0.map(f32::round_ties_even))
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Self::Mask {
        std::array::from_fn(|i| if self.0[i] < other.0[i] { u32::MAX } else { 0 })
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        Portable(std::array::from_fn(|i| f32::from_bits(yes.0[i].to_bits() & mask[i] | no.0[i].to_bits() & !mask[i])))
    }
    #[inline(always)]
    fn any(mask: Self::Mask) -> bool {
        mask.iter().fold(0, |all, lane| all | lane) != 0
    }
    #[inline(always)]
    fn or(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        std::array::from_fn(|i| a[i] | b[i])
    }
    #[inline(always)]
    fn and(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        std::array::from_fn(|i| a[i] & b[i])
    }
    #[inline(always)]
    fn not(mask: Self::Mask) -> Self::Mask {
        mask.map(|lane| !lane)
    }
    #[inline(always)]
    fn count(mask: Self::Mask) -> usize {
        mask.into_iter().map(|lane| (lane & 1) as usize).sum()
    }
    #[inline(always)]
    fn store_some(self, mask: Self::Mask, to: &mut [f32]) {
        let to = &mut to[..PORTABLE_LANES];
        let mut count = 0;
        for (number, is_some) in self.0.into_iter().zip(mask) {
            to[count] = number;
            count += (is_some & 1) as usize;
        }
    }
    #[inline(always)]
    fn lane_f32(&self, lane: usize) -> f32 {
        self.0[lane]
    }
    #[inline(always)]
    fn set_lane_f32(&mut self, lane: usize, value: f32) {
        self.0[lane] = value;
    }
    #[inline(always)]
    fn broadcast(x: f32) -> Self {
        Portable([x; PORTABLE_LANES])
    }
    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        let mut lanes = [0.0; PORTABLE_LANES];
        lanes.copy_from_slice(&from[..PORTABLE_LANES]);
        Portable(lanes)
    }
    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        to[..PORTABLE_LANES].copy_from_slice(&self.0);
    }
    #[inline(always)]
    fn power_of_two(self) -> Self {
        Portable(self.0.map(Real::power_of_two))
    }
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        elementary::sin_cos(self)
    }
}
