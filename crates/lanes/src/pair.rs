//! Lanes of two narrower values.

use std::ops::{Add, Div, Mul, Neg, Sub};

use super::Real;
#[cfg(target_arch = "aarch64")]
use super::{Kernel, Lanes};

/// Two values side by side: sixteen lanes on a machine with lanes of eight.
#[derive(Clone, Copy, Debug)]
pub struct Pair<L>(L, L);

macro_rules! pair_operator {
    ($trait:ident, $f:ident) => {
        impl<L: Real> $trait for Pair<L> {
            type Output = Self;
            #[inline(always)]
            fn $f(self, other: Self) -> Self {
                Self($trait::$f(self.0, other.0), $trait::$f(self.1, other.1))
            }
        }
    };
}
pair_operator!(Add, add);
pair_operator!(Sub, sub);
pair_operator!(Mul, mul);
pair_operator!(Div, div);

impl<L: Real> Neg for Pair<L> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self(-self.0, -self.1)
    }
}

impl<L: Real> Real for Pair<L> {
    type Mask = (L::Mask, L::Mask);
    const LANES: usize = 2 * L::LANES;
    #[inline(always)]
    fn splat(x: f64) -> Self {
        Self(L::splat(x), L::splat(x))
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        Self(self.0.mul_add(b.0, c.0), self.1.mul_add(b.1, c.1))
    }
    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        Self(self.0.neg_mul_add(b.0, c.0), self.1.neg_mul_add(b.1, c.1))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(self.0.sqrt(), self.1.sqrt())
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0.abs(), self.1.abs())
    }
    #[inline(always)]
    fn round(self) -> Self {
        Self(self.0.round(), self.1.round())
    }
    #[inline(always)]
    fn floor(self) -> Self {
        Self(self.0.floor(), self.1.floor())
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Self::Mask {
        (self.0.lt(other.0), self.1.lt(other.1))
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        Self(L::select(mask.0, yes.0, no.0), L::select(mask.1, yes.1, no.1))
    }
    #[inline(always)]
    fn any(mask: Self::Mask) -> bool {
        L::any(mask.0) | L::any(mask.1)
    }
    #[inline(always)]
    fn or(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        (L::or(a.0, b.0), L::or(a.1, b.1))
    }
    #[inline(always)]
    fn and(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        (L::and(a.0, b.0), L::and(a.1, b.1))
    }
    #[inline(always)]
    fn not(mask: Self::Mask) -> Self::Mask {
        (L::not(mask.0), L::not(mask.1))
    }
    #[inline(always)]
    fn count(mask: Self::Mask) -> usize {
        L::count(mask.0) + L::count(mask.1)
    }
    #[inline(always)]
    fn store_some(self, mask: Self::Mask, to: &mut [f32]) {
        self.0.store_some(mask.0, to);
        self.1.store_some(mask.1, &mut to[L::count(mask.0)..]);
    }
    #[inline(always)]
    fn gather_pair(table: &[f32], row: Self, stride: u32, column: Self) -> [Self; 2] {
        let [a, b] = L::gather_pair(table, row.0, stride, column.0);
        let [c, d] = L::gather_pair(table, row.1, stride, column.1);
        [Self(a, c), Self(b, d)]
    }
    #[inline(always)]
    fn lane_f32(&self, lane: usize) -> f32 {
        if lane < L::LANES { self.0.lane_f32(lane) } else { self.1.lane_f32(lane - L::LANES) }
    }
    #[inline(always)]
    fn set_lane_f32(&mut self, lane: usize, value: f32) {
        if lane < L::LANES { self.0.set_lane_f32(lane, value) } else { self.1.set_lane_f32(lane - L::LANES, value) }
    }
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        let (a, b) = (self.0.sin_cos(), self.1.sin_cos());
        (Self(a.0, b.0), Self(a.1, b.1))
    }
    #[inline(always)]
    fn broadcast(x: f32) -> Self {
        Self(L::broadcast(x), L::broadcast(x))
    }
    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        Self(L::load(from), L::load(&from[L::LANES..]))
    }
    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        self.0.store(to);
        self.1.store(&mut to[L::LANES..]);
    }
    #[inline(always)]
    fn power_of_two(self) -> Self {
        Self(self.0.power_of_two(), self.1.power_of_two())
    }
}

#[cfg(target_arch = "aarch64")]
impl<P: super::Proof> Lanes for Pair<super::Neon<P>> {
    const REGISTERS: usize = super::Neon::<P>::REGISTERS / 2;

    fn vectorize<K: Kernel<Self>>(kernel: K) -> K::Output {
        // every machine of the architecture has the instructions
        kernel.run()
    }

    #[inline(never)]
    fn call<K: Kernel<Self>>(part: K) -> K::Output {
        part.run()
    }
}
