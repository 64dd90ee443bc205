//! SIMD lanes and elementary functions: the one place that knows instruction sets.
//!
//! Kernels of physics and of learning are written once, over the [`Real`] trait. A value of a
//! `Real` type holds [`Real::LANES`] independent numbers, one per robot of a pack; no operation
//! mixes lanes, and each operation is one correctly rounded IEEE 754 operation per lane. A lane's
//! bits therefore depend neither on its position, nor on its neighbours, nor on the instruction
//! set.
//!
//! Kernels are `#[inline(always)]` generic functions entered through [`Lanes::vectorize`], a
//! function compiled for the instruction set, so that everything is inlined into code that may use
//! it. [`Lanes::call`] keeps a part of a kernel as a separate function.

#![deny(unsafe_code)]
#![warn(missing_docs)]

mod control;
mod dispatch;
pub mod elementary;
mod native;
mod pair;
mod portable;
mod token;

use std::ops::{Add, Div, Mul, Neg, Sub};

pub use control::{MOST_LANES, Rounds, Table};
pub use dispatch::{Simd, SimdDispatch, SimdError, prefetch};
#[cfg(target_arch = "aarch64")]
pub use native::Neon;
#[cfg(target_arch = "x86_64")]
pub use native::{Avx2, Avx512};
pub use pair::Pair;
pub use portable::Portable;
#[cfg(target_arch = "x86_64")]
pub use token::{Avx2Token, Avx512Token};
pub use token::{Proof, SimdToken, WithLanes};

/// A scalar or a vector of independent numbers on which the kernels compute.
pub trait Real:
    Copy
    + Send
    + Sync
    + 'static
    + std::fmt::Debug
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    /// The result of a comparison, one truth value per lane.
    type Mask: Copy + Send + Sync + std::fmt::Debug;
    /// Number of independent numbers in a value.
    const LANES: usize;
    /// Whether a step of uniform bodies reads their common numbers from one copy. Where that is no
    /// faster, it is not compiled.
    const READS_UNIFORM: bool = false;
    /// The same number in every lane.
    fn splat(x: f64) -> Self;
    /// `self * b + c`, rounded once.
    fn mul_add(self, b: Self, c: Self) -> Self;
    /// `c - self * b`, rounded once.
    fn neg_mul_add(self, b: Self, c: Self) -> Self;
    /// Correctly rounded square root.
    fn sqrt(self) -> Self;
    /// Absolute value.
    fn abs(self) -> Self;
    /// Nearest integer, ties to even.
    fn round(self) -> Self;
    /// Largest integer that is not above the number.
    #[inline(always)]
    fn floor(self) -> Self {
        let nearest = self.round();
        Self::select(self.lt(nearest), nearest - Self::one(), nearest)
    }
    /// `self < other`, false for NaN.
    fn lt(self, other: Self) -> Self::Mask;
    /// `yes` where the mask is true, else `no`.
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;
    /// Returns whether any lane of the mask is true. [`when`](Real::when) and
    /// [`repeat`](Real::repeat) call it; kernels call those two.
    fn any(mask: Self::Mask) -> bool;
    /// The mask, if it is true in any lane. Kernels skip by it what no lane needs, so what is
    /// skipped must change no lane for which the mask is false.
    #[inline(always)]
    fn when(mask: Self::Mask) -> Option<Self::Mask> {
        if Self::any(mask) { Some(mask) } else { None }
    }
    /// Rounds of a loop that each lane leaves by itself, at most `most`: see [`Rounds`]. The first
    /// round is for all `lanes`, even if there are none.
    #[inline(always)]
    fn repeat(most: usize, lanes: Self::Mask) -> Rounds<Self> {
        Rounds::new(most, lanes)
    }
    /// Numbers of a table for each lane, by the lane's own keys. Apart from
    /// [`gather_pair`](Real::gather_pair), the one place where lanes are looked at one by one.
    #[inline(always)]
    fn gather<T: Table<KEYS>, const KEYS: usize>(table: &T, keys: [Self; KEYS]) -> T::Found {
        const { assert!(Self::LANES <= MOST_LANES) }
        let mut of_lanes = [[0.0; MOST_LANES]; KEYS];
        for k in 0..KEYS {
            keys[k].store(&mut of_lanes[k]);
        }
        table.look_up(&of_lanes, Self::LANES)
    }
    /// Logical or.
    fn or(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Logical and.
    fn and(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Logical not.
    fn not(mask: Self::Mask) -> Self::Mask;
    /// Number of lanes for which a mask is true.
    fn count(mask: Self::Mask) -> usize;
    /// Writes the lanes for which a mask is true to the first numbers of a slice, in their order.
    /// The first [`Real::LANES`] numbers of the slice may all be overwritten.
    ///
    /// # Panics
    /// If the slice is shorter than [`Real::LANES`].
    fn store_some(self, mask: Self::Mask, to: &mut [f32]);
    /// Reads one lane in single precision.
    fn lane_f32(&self, lane: usize) -> f32;
    /// Writes one lane in single precision.
    fn set_lane_f32(&mut self, lane: usize, value: f32);
    /// The same number in every lane.
    fn broadcast(x: f32) -> Self;
    /// The first [`Real::LANES`] numbers of a slice, one per lane.
    ///
    /// # Panics
    /// If there are fewer.
    fn load(from: &[f32]) -> Self;
    /// Writes the lanes to the first numbers of a slice.
    ///
    /// # Panics
    /// If it is shorter than [`Real::LANES`].
    fn store(self, to: &mut [f32]);
    /// Two neighbouring numbers of a table per lane: the number at `row * stride + column` and the
    /// next one. Rows and columns are whole numbers from 0 to 2^24; every place is within the
    /// table. Other places give unspecified numbers of the table.
    ///
    /// # Panics
    /// If the table has fewer than two numbers.
    #[inline(always)]
    fn gather_pair(table: &[f32], row: Self, stride: u32, column: Self) -> [Self; 2] {
        let (mut first, mut second) = (Self::zero(), Self::zero());
        for lane in 0..Self::LANES {
            let place = (row.lane_f32(lane) as u32).wrapping_mul(stride).wrapping_add(column.lane_f32(lane) as u32);
            let place = (place as usize).min(table.len() - 2);
            first.set_lane_f32(lane, table[place]);
            second.set_lane_f32(lane, table[place + 1]);
        }
        [first, second]
    }
    /// Two to the power of a whole number from -126 to 127.
    fn power_of_two(self) -> Self;
    /// Sine and cosine of an angle in radians.
    fn sin_cos(self) -> (Self, Self);

    /// Reads one lane.
    #[inline(always)]
    fn lane(&self, lane: usize) -> f64 {
        f64::from(self.lane_f32(lane))
    }
    /// Writes one lane.
    #[inline(always)]
    fn set_lane(&mut self, lane: usize, value: f64) {
        self.set_lane_f32(lane, value as f32);
    }
    /// `self < other ? self : other` (the second when either is NaN).
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self::select(self.lt(other), self, other)
    }
    /// `other < self ? self : other` (the second when either is NaN).
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self::select(other.lt(self), self, other)
    }
    /// Limits to `[lower, upper]`.
    #[inline(always)]
    fn clamp(self, lower: Self, upper: Self) -> Self {
        self.max(lower).min(upper)
    }
    /// Zero in every lane.
    #[inline(always)]
    fn zero() -> Self {
        Self::splat(0.0)
    }
    /// One in every lane.
    #[inline(always)]
    fn one() -> Self {
        Self::splat(1.0)
    }
}

macro_rules! impl_scalar {
    ($t:ty, $bits:ty, $signed:ty, $sin_cos:expr) => {
        impl Real for $t {
            type Mask = bool;
            const LANES: usize = 1;
            #[inline(always)]
            fn splat(x: f64) -> Self {
                x as $t
            }
            #[inline(always)]
            fn mul_add(self, b: Self, c: Self) -> Self {
                <$t>::mul_add(self, b, c)
            }
            #[inline(always)]
            fn neg_mul_add(self, b: Self, c: Self) -> Self {
                <$t>::mul_add(-self, b, c)
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                <$t>::sqrt(self)
            }
            #[inline(always)]
            fn abs(self) -> Self {
                <$t>::abs(self)
            }
            #[inline(always)]
            fn round(self) -> Self {
                self.round_ties_even()
            }
            #[inline(always)]
            fn lt(self, other: Self) -> bool {
                self < other
            }
            #[inline(always)]
            fn select(mask: bool, yes: Self, no: Self) -> Self {
                if mask { yes } else { no }
            }
            #[inline(always)]
            fn any(mask: bool) -> bool {
                mask
            }
            #[inline(always)]
            fn or(a: bool, b: bool) -> bool {
                a | b
            }
            #[inline(always)]
            fn and(a: bool, b: bool) -> bool {
                a & b
            }
            #[inline(always)]
            fn not(mask: bool) -> bool {
                !mask
            }
            #[inline(always)]
            fn count(mask: bool) -> usize {
                usize::from(mask)
            }
            #[inline(always)]
            fn store_some(self, _: bool, to: &mut [f32]) {
                to[0] = self as f32;
            }
            #[inline(always)]
            fn lane(&self, _: usize) -> f64 {
                f64::from(*self)
            }
            #[inline(always)]
            fn set_lane(&mut self, _: usize, value: f64) {
                *self = value as $t;
            }
            #[inline(always)]
            fn lane_f32(&self, _: usize) -> f32 {
                *self as f32
            }
            #[inline(always)]
            fn set_lane_f32(&mut self, _: usize, value: f32) {
                *self = value.into();
            }
            #[inline(always)]
            fn broadcast(x: f32) -> Self {
                x.into()
            }
            #[inline(always)]
            fn load(from: &[f32]) -> Self {
                from[0].into()
            }
            #[inline(always)]
            fn store(self, to: &mut [f32]) {
                to[0] = self as f32;
            }
            #[inline(always)]
            fn power_of_two(self) -> Self {
                const EXPONENT_SHIFT: u32 = <$t>::MANTISSA_DIGITS - 1;
                const BIAS: $signed = <$t>::MAX_EXP as $signed - 1;
                <$t>::from_bits(((self as $signed + BIAS) as $bits) << EXPONENT_SHIFT)
            }
            #[inline(always)]
            fn sin_cos(self) -> (Self, Self) {
                $sin_cos(self)
            }
        }
    };
}
impl_scalar!(f32, u32, i32, elementary::sin_cos);
impl_scalar!(f64, u64, i64, f64::sin_cos);

/// Writes numbers of one robot into a lane; the shorter slice decides how many.
#[inline]
pub fn write_lane<L: Real, T: Real>(to: &mut [L], from: &[T], lane: usize) {
    for (x, y) in to.iter_mut().zip(from) {
        x.set_lane(lane, y.lane(0));
    }
}

/// Reads the numbers of one robot from a lane; the shorter slice decides how many.
#[inline]
pub fn read_lane<L: Real, T: Real>(from: &[L], to: &mut [T], lane: usize) {
    for (y, x) in from.iter().zip(to) {
        x.set_lane(0, y.lane(lane));
    }
}

/// A computation over lanes of type `S`, with its arguments.
pub trait Kernel<S: Real> {
    /// Result of the kernel.
    type Output;
    /// The computation; must be `#[inline(always)]`, as must all it calls.
    fn run(self) -> Self::Output;
}

/// A lane type that packs of robots are stored in, with the way into code compiled for its
/// instruction set.
pub trait Lanes: Real {
    /// Number of values that the machine's vector registers hold.
    const REGISTERS: usize;

    /// Runs a kernel, compiled for this lane type's instruction set.
    fn vectorize<K: Kernel<Self>>(kernel: K) -> K::Output;

    /// Calls a part of a kernel. The part is compiled once, as a separate function; code in line is
    /// compiled once per kernel and place. Worth it for parts that several kernels share or that
    /// few steps need.
    fn call<K: Kernel<Self>>(part: K) -> K::Output;
}

/// Lane types whose code needs no instruction set beyond the architecture's.
macro_rules! run_as_it_is {
    ($($t:ty),*) => {
        $(impl Lanes for $t {
            // in sixteen registers of four numbers
            const REGISTERS: usize = 64 / Self::LANES;

            fn vectorize<K: Kernel<Self>>(kernel: K) -> K::Output {
                kernel.run()
            }

            #[inline(never)]
            fn call<K: Kernel<Self>>(part: K) -> K::Output {
                part.run()
            }
        })*
    };
}
run_as_it_is!(Portable, Pair<Portable>, f32, f64);

#[cfg(test)]
mod tests {
    use super::*;

    struct Everything<'a, S>(&'a mut [S; 6]);
    impl<S: Real> Kernel<S> for Everything<'_, S> {
        type Output = ();
        #[inline(always)]
        fn run(self) {
            let d = self.0;
            let (a, b, c) = (d[0], d[1], d[2]);
            let (s, k) = a.sin_cos();
            d[3] = a.mul_add(b, c) + a.neg_mul_add(b, c) * s - k / b.abs().max(S::splat(0.1));
            d[4] = S::select(a.lt(b), a.min(c), -b.max(c)) + (a * a).sqrt() + (b * S::splat(3.0)).round();
            d[5] = S::select(S::or(a.lt(b), S::and(b.lt(c), S::not(a.lt(c)))), s, k) + elementary::exp(b);
            let [first, second] = S::gather_pair(&TABLE, (a.abs() + b.abs()).floor(), 3, c.abs().floor());
            d[4] = second.mul_add(a, d[4] + first);
        }
    }

    /// Numbers that places of three times 16 plus 8 at most are gathered from.
    const TABLE: [f32; 64] = {
        let (mut table, mut k) = ([0.0; 64], 0);
        while k < 64 {
            table[k] = (k * k % 29) as f32 - 7.5;
            k += 1;
        }
        table
    };

    struct Sorted<'a>(&'a [[f32; 3]]);
    impl WithLanes for Sorted<'_> {
        type Output = Vec<f32>;
        fn run<L: Lanes>(self) -> Self::Output {
            struct Sort<'a>(&'a [[f32; 3]], &'a mut Vec<f32>);
            impl<S: Real> Kernel<S> for Sort<'_> {
                type Output = ();
                #[inline(always)]
                fn run(self) {
                    let mut room = vec![0.0; self.0.len() + S::LANES];
                    let mut len = 0;
                    for chunk in self.0.chunks_exact(S::LANES) {
                        let (mut a, mut b) = (S::zero(), S::zero());
                        for (lane, x) in chunk.iter().enumerate() {
                            a.set_lane_f32(lane, x[0]);
                            b.set_lane_f32(lane, x[1]);
                        }
                        a.store_some(a.lt(b), &mut room[len..]);
                        len += S::count(a.lt(b));
                    }
                    self.1.extend_from_slice(&room[..len]);
                }
            }
            let mut out = Vec::new();
            L::vectorize(Sort(self.0, &mut out));
            out
        }
    }

    #[test]
    fn lanes_of_a_mask_are_stored_in_their_order() {
        let mut x = 7u32;
        let mut next = || {
            x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (x >> 8) as f32
        };
        let inputs: Vec<[f32; 3]> = (0..4096).map(|_| [next(), next(), next()]).collect();
        let expected: Vec<f32> = inputs.iter().filter(|x| x[0] < x[1]).map(|x| x[0]).collect();
        assert!(expected.len() > 1000 && expected.len() < 3000);
        assert_eq!(expected, Sorted(&inputs).run::<f32>());
        assert_eq!(expected, Sorted(&inputs).run::<Portable>());
        for simd in Simd::available() {
            let token = simd.token().expect("it is available");
            assert_eq!(expected, token.with_sixteen_lanes(Sorted(&inputs)), "{simd:?}");
        }
    }

    #[test]
    fn floors_are_whole_and_not_above() {
        for x in [-2.0f32, -1.5, -0.5, -1e-9, -0.0, 0.0, 0.49999997, 0.5, 1.0, 2.5, 3.999_999_8, 8_388_607.5] {
            assert_eq!(Real::floor(x), f32::floor(x), "{x}");
        }
    }

    struct OnInputs<'a>(&'a [[f32; 3]]);
    impl WithLanes for OnInputs<'_> {
        type Output = Vec<[u32; 3]>;
        fn run<L: Lanes>(self) -> Self::Output {
            let mut out = Vec::new();
            for chunk in self.0.chunks(L::LANES) {
                let mut d = [L::zero(); 6];
                for (lane, x) in chunk.iter().enumerate() {
                    for k in 0..3 {
                        d[k].set_lane(lane, f64::from(x[k]));
                    }
                }
                L::vectorize(Everything(&mut d));
                for lane in 0..chunk.len() {
                    out.push([3, 4, 5].map(|k: usize| (d[k].lane(lane) as f32).to_bits()));
                }
            }
            out
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let mut x = 12345u32;
        let mut next = || {
            x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (x >> 8) as f32 / 1_048_576.0 - 8.0
        };
        let inputs: Vec<[f32; 3]> = (0..1000).map(|_| [next(), next(), next()]).collect();
        let scalar: Vec<[u32; 3]> = inputs
            .iter()
            .map(|x| {
                let mut d = [x[0], x[1], x[2], 0.0, 0.0, 0.0];
                Everything(&mut d).run();
                [d[3].to_bits(), d[4].to_bits(), d[5].to_bits()]
            })
            .collect();
        assert_eq!(scalar, OnInputs(&inputs).run::<Portable>());
        for simd in Simd::available() {
            let entered: Vec<[u32; 3]> = inputs
                .iter()
                .map(|x| {
                    let mut d = [x[0], x[1], x[2], 0.0, 0.0, 0.0];
                    simd.dispatch().vectorize(Everything(&mut d));
                    [d[3].to_bits(), d[4].to_bits(), d[5].to_bits()]
                })
                .collect();
            assert_eq!(scalar, entered, "{simd:?}");
        }
        for simd in Simd::available() {
            let token = simd.token().expect("it is available");
            assert_eq!(scalar, token.with_sixteen_lanes(OnInputs(&inputs)), "{simd:?}");
        }
    }
}
