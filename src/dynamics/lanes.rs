//! SIMD lanes: the one place that knows instruction sets, and but for `thread_team.rs` the only file of the crate with `unsafe` code.
//!
//! The kernels of [`dynamics`](super) are written once, over the [`Real`] trait. A value of a `Real` type holds
//! [`Real::LANES`] independent numbers, one per robot of a pack; no operation mixes lanes, and each operation is one
//! correctly rounded IEEE 754 operation per lane. A lane's bits therefore depend neither on its position, nor on its
//! neighbours, nor on the instruction set.
//!
//! Kernels are `#[inline(always)]` generic functions entered through [`Lanes::vectorize`], a function compiled for the
//! instruction set, so that everything is inlined into code that may use it.

#![allow(unsafe_code)]

use std::ops::{Add, Div, Mul, Neg, Sub};

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
    /// Whether steps of bodies that are alike read the numbers that lanes share from where they are held once. Where that is no
    /// faster, it is not compiled.
    const READS_ALIKE: bool = false;
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
    /// `self < other`, false for NaN.
    fn lt(self, other: Self) -> Self::Mask;
    /// `yes` where the mask is true, else `no`.
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;
    /// True if any lane of the mask is true.
    fn any(mask: Self::Mask) -> bool;
    /// Logical or.
    fn or(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Logical and.
    fn and(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Reads one lane in single precision.
    fn lane_f32(&self, lane: usize) -> f32;
    /// Writes one lane in single precision.
    fn set_lane_f32(&mut self, lane: usize, value: f32);
    /// Sine and cosine of an angle in radians.
    fn sin_cos(self) -> (Self, Self);
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
    /// `2^x` of a whole number from -126 to 127.
    fn exp2_of_whole(self) -> Self;

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

/// Sine and cosine by range reduction to `[-pi/4, pi/4]` and minimax polynomials (the single-precision coefficients of
/// the Cephes library); absolute error below 1.2e-7 for |x| < 1e4.
#[inline(always)]
fn sin_cos_f32<S: Real>(x: S) -> (S, S) {
    let quadrant = (x * S::splat(std::f64::consts::FRAC_2_PI)).round();
    // pi/2 in three parts, so that the products with small integers are exact
    let r = quadrant.neg_mul_add(S::splat(1.570_312_5), x);
    let r = quadrant.neg_mul_add(S::splat(4.837_512_969_970_703e-4), r);
    let r = quadrant.neg_mul_add(S::splat(7.549_789_948_768_648e-8), r);
    let r2 = r * r;
    let s = S::splat(-1.951_529_589_1e-4).mul_add(r2, S::splat(8.332_160_873_6e-3));
    let s = s.mul_add(r2, S::splat(-1.666_665_461_1e-1));
    let s = (s * r2).mul_add(r, r);
    let c = S::splat(2.443_315_711_809_948e-5).mul_add(r2, S::splat(-1.388_731_625_493_765e-3));
    let c = c.mul_add(r2, S::splat(4.166_664_568_298_827e-2));
    let c = (c * r2).mul_add(r2, S::splat(-0.5).mul_add(r2, S::one()));
    // quadrant modulo 4, in {-2, -1, 0, 1, 2}
    let turn = (quadrant * S::splat(0.25)).round().neg_mul_add(S::splat(4.0), quadrant);
    let odd = {
        let a = turn.abs();
        S::and(S::splat(0.5).lt(a), a.lt(S::splat(1.5)))
    };
    let (s, c) = (S::select(odd, c, s), S::select(odd, s, c));
    // sine changes sign in quadrants -2, 2 and -1; cosine in -2, 2 and 1
    let half = S::splat(1.5).lt(turn.abs());
    let sin_negative = S::or(half, S::and(turn.lt(S::splat(-0.5)), S::splat(-1.5).lt(turn)));
    let cos_negative = S::or(half, S::and(S::splat(0.5).lt(turn), turn.lt(S::splat(1.5))));
    (S::select(sin_negative, -s, s), S::select(cos_negative, -c, c))
}

macro_rules! impl_scalar {
    ($t:ty, $sin_cos:expr, $exp2:expr) => {
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
            fn sin_cos(self) -> (Self, Self) {
                $sin_cos(self)
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
            fn exp2_of_whole(self) -> Self {
                $exp2(self)
            }
        }
    };
}
impl_scalar!(f32, sin_cos_f32, |x| f32::from_bits(((x as i32 + 127) as u32) << 23));
impl_scalar!(f64, f64::sin_cos, |x| f64::from_bits(((x as i64 + 1023) as u64) << 52));

/// A computation over lanes of type `S`, with its arguments.
pub trait Kernel<S: Real> {
    /// What it returns.
    type Output;
    /// The computation; must be `#[inline(always)]`, as must all it calls.
    fn run(self) -> Self::Output;
}

/// The number of lanes in the portable fallback.
const PORTABLE_LANES: usize = 8;

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

/// `a * b + c`, rounded once. A function of its own: where the machine has no such instruction, every lane is a call. Thousands of them
/// in line would make a kernel many times as large.
#[inline(never)]
fn fused_multiply_add(a: &Portable, b: &Portable, c: &Portable) -> Portable {
    Portable(std::array::from_fn(|i| a.0[i].mul_add(b.0[i], c.0[i])))
}

impl Real for Portable {
    type Mask = [bool; PORTABLE_LANES];
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
        std::array::from_fn(|i| self.0[i] < other.0[i])
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        Portable(std::array::from_fn(|i| if mask[i] { yes.0[i] } else { no.0[i] }))
    }
    #[inline(always)]
    fn any(mask: Self::Mask) -> bool {
        mask.iter().any(|&m| m)
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
    fn lane_f32(&self, lane: usize) -> f32 {
        self.0[lane]
    }
    #[inline(always)]
    fn set_lane_f32(&mut self, lane: usize, value: f32) {
        self.0[lane] = value;
    }
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        sin_cos_f32(self)
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
    fn exp2_of_whole(self) -> Self {
        Portable(self.0.map(Real::exp2_of_whole))
    }
}

/// A lane type that packs of robots are stored in, with the way into code compiled for its instruction set.
pub trait Lanes: Real {
    /// Runs a kernel, compiled for this lane type's instruction set.
    fn vectorize<K: Kernel<Self>>(kernel: K) -> K::Output;
}

macro_rules! run_as_it_is {
    ($($t:ty),*) => {
        $(impl Lanes for $t {
            fn vectorize<K: Kernel<Self>>(kernel: K) -> K::Output {
                kernel.run()
            }
        })*
    };
}
run_as_it_is!(Portable, f32, f64);

/// Defines a lane type over some native vector registers, from the intrinsics of one. Several registers hide the latency of
/// an operation behind its neighbour's.
macro_rules! native_lanes {
    ($(#[$doc:meta])* $name:ident, $reg:ty, $registers:literal x $width:literal, $features:literal, {
        add: $add:path, sub: $sub:path, mul: $mul:path, div: $div:path, fma: $fma:expr, fnma: $fnma:expr,
        sqrt: $sqrt:path, round: $round:expr, splat: $splat:path, lt: $lt:expr, select: $select:expr, any: $any:expr,
        or: $or:expr, and: $and:expr, abs: $abs:expr, neg: $neg:expr, min: $min:expr, max: $max:expr,
        exp2: $exp2:expr, mask: $mask:ty
    }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug)]
        #[repr(transparent)]
        pub struct $name([$reg; $registers]);

        native_lanes!(@operator $name, $registers, Add, add, $add);
        native_lanes!(@operator $name, $registers, Sub, sub, $sub);
        native_lanes!(@operator $name, $registers, Mul, mul, $mul);
        native_lanes!(@operator $name, $registers, Div, div, $div);
        impl Neg for $name {
            type Output = Self;
            #[inline(always)]
            fn neg(self) -> Self {
                native_lanes!(@each $registers, $neg, self)
            }
        }
        impl Real for $name {
            type Mask = [$mask; $registers];
            const LANES: usize = $registers * $width;
            const READS_ALIKE: bool = true;
            #[inline(always)]
            fn splat(x: f64) -> Self {
                // SAFETY: as in `each`
                Self([unsafe { $splat(x as f32) }; $registers])
            }
            #[inline(always)]
            fn mul_add(self, b: Self, c: Self) -> Self {
                native_lanes!(@each $registers, $fma, self, b, c)
            }
            #[inline(always)]
            fn neg_mul_add(self, b: Self, c: Self) -> Self {
                native_lanes!(@each $registers, $fnma, self, b, c)
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                native_lanes!(@each $registers, $sqrt, self)
            }
            #[inline(always)]
            fn abs(self) -> Self {
                native_lanes!(@each $registers, $abs, self)
            }
            #[inline(always)]
            fn round(self) -> Self {
                native_lanes!(@each $registers, $round, self)
            }
            #[inline(always)]
            fn lt(self, other: Self) -> Self::Mask {
                // SAFETY: as in `each`
                let (mut out, mut i) = ([unsafe { $lt(self.0[0], other.0[0]) }; $registers], 1);
                while i < $registers {
                    // SAFETY: as in `each`
                    out[i] = unsafe { $lt(self.0[i], other.0[i]) };
                    i += 1;
                }
                out
            }
            #[inline(always)]
            fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
                let (mut out, mut i) = (no, 0);
                while i < $registers {
                    // SAFETY: as in `each`
                    out.0[i] = unsafe { $select(mask[i], yes.0[i], no.0[i]) };
                    i += 1;
                }
                out
            }
            #[inline(always)]
            fn any(mask: Self::Mask) -> bool {
                let (mut all, mut i) = (mask[0], 1);
                while i < $registers {
                    // SAFETY: as in `each`
                    all = unsafe { $or(all, mask[i]) };
                    i += 1;
                }
                // SAFETY: as in `each`
                unsafe { $any(all) }
            }
            #[inline(always)]
            fn or(a: Self::Mask, b: Self::Mask) -> Self::Mask {
                let (mut out, mut i) = (a, 0);
                while i < $registers {
                    // SAFETY: as in `each`
                    out[i] = unsafe { $or(a[i], b[i]) };
                    i += 1;
                }
                out
            }
            #[inline(always)]
            fn and(a: Self::Mask, b: Self::Mask) -> Self::Mask {
                let (mut out, mut i) = (a, 0);
                while i < $registers {
                    // SAFETY: as in `each`
                    out[i] = unsafe { $and(a[i], b[i]) };
                    i += 1;
                }
                out
            }
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                native_lanes!(@each $registers, $min, self, other)
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                native_lanes!(@each $registers, $max, self, other)
            }
            #[inline(always)]
            fn lane_f32(&self, lane: usize) -> f32 {
                // SAFETY: the registers are so many consecutive f32
                (unsafe { &*std::ptr::from_ref(self).cast::<[f32; $registers * $width]>() })[lane]
            }
            #[inline(always)]
            fn set_lane_f32(&mut self, lane: usize, value: f32) {
                // SAFETY: the registers are so many consecutive f32
                let lanes = unsafe { &mut *std::ptr::from_mut(self).cast::<[f32; $registers * $width]>() };
                lanes[lane] = value;
            }
            #[inline(always)]
            fn sin_cos(self) -> (Self, Self) {
                sin_cos_f32(self)
            }
            #[inline(always)]
            fn broadcast(x: f32) -> Self {
                // SAFETY: as in `each`
                Self([unsafe { $splat(x) }; $registers])
            }
            #[inline(always)]
            fn load(from: &[f32]) -> Self {
                let mut out = Self::zero();
                // SAFETY: the registers are so many consecutive f32
                let lanes = unsafe { &mut *std::ptr::from_mut(&mut out).cast::<[f32; $registers * $width]>() };
                lanes.copy_from_slice(&from[..$registers * $width]);
                out
            }
            #[inline(always)]
            fn store(self, to: &mut [f32]) {
                // SAFETY: the registers are so many consecutive f32
                let lanes = unsafe { &*std::ptr::from_ref(&self).cast::<[f32; $registers * $width]>() };
                to[..$registers * $width].copy_from_slice(lanes);
            }
            #[inline(always)]
            fn exp2_of_whole(self) -> Self {
                native_lanes!(@each $registers, $exp2, self)
            }
        }
        impl Lanes for $name {
            fn vectorize<K: Kernel<Self>>(kernel: K) -> K::Output {
                #[target_feature(enable = $features)]
                fn compiled<K: Kernel<$name>>(kernel: K) -> K::Output {
                    kernel.run()
                }
                // SAFETY: packs of this type are only built after `Simd` has found the instruction set
                unsafe { compiled(kernel) }
            }
        }
    };
    // the operation on each register
    (@each $registers:literal, $f:expr, $first:expr $(, $other:expr)*) => {{
        let (mut out, mut i) = ($first, 0);
        while i < $registers {
            // SAFETY: reached only through `vectorize`, whose caller has checked the instruction set
            out.0[i] = unsafe { $f($first.0[i] $(, $other.0[i])*) };
            i += 1;
        }
        out
    }};
    (@operator $name:ident, $registers:literal, $trait:ident, $f:ident, $intrinsic:path) => {
        impl $trait for $name {
            type Output = Self;
            #[inline(always)]
            fn $f(self, other: Self) -> Self {
                native_lanes!(@each $registers, $intrinsic, self, other)
            }
        }
    };
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{Add, Div, Kernel, Lanes, Mul, Neg, Real, Sub, sin_cos_f32};
    use std::arch::x86_64::*;

    native_lanes!(
        /// Sixteen lanes in two AVX registers.
        Avx2, __m256, 2 x 8, "avx2,fma", {
            add: _mm256_add_ps, sub: _mm256_sub_ps, mul: _mm256_mul_ps, div: _mm256_div_ps,
            fma: _mm256_fmadd_ps, fnma: _mm256_fnmadd_ps, sqrt: _mm256_sqrt_ps,
            round: _mm256_round_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>,
            splat: _mm256_set1_ps, lt: _mm256_cmp_ps::<_CMP_LT_OQ>,
            select: |m, a, b| _mm256_blendv_ps(b, a, m), any: |m| _mm256_movemask_ps(m) != 0,
            or: _mm256_or_ps, and: _mm256_and_ps,
            abs: |x| _mm256_andnot_ps(_mm256_set1_ps(-0.0), x), neg: |x| _mm256_xor_ps(x, _mm256_set1_ps(-0.0)),
            // the second operand when either is NaN, as wanted
            min: _mm256_min_ps, max: _mm256_max_ps,
            exp2: |x| _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_add_epi32(
                _mm256_cvtps_epi32(x), _mm256_set1_epi32(127)
            ))),
            mask: __m256
        }
    );
    native_lanes!(
        /// Sixteen lanes in an AVX-512 register.
        Avx512, __m512, 1 x 16, "avx512f,avx512dq,avx512vl,avx2,fma", {
            add: _mm512_add_ps, sub: _mm512_sub_ps, mul: _mm512_mul_ps, div: _mm512_div_ps,
            fma: _mm512_fmadd_ps, fnma: _mm512_fnmadd_ps, sqrt: _mm512_sqrt_ps,
            round: _mm512_roundscale_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>,
            splat: _mm512_set1_ps, lt: _mm512_cmp_ps_mask::<_CMP_LT_OQ>,
            select: |m, a, b| _mm512_mask_blend_ps(m, b, a), any: |m| _mm512_mask2int(m) != 0,
            or: _kor_mask16, and: _kand_mask16,
            abs: |x| _mm512_andnot_ps(_mm512_set1_ps(-0.0), x), neg: |x| _mm512_xor_ps(x, _mm512_set1_ps(-0.0)),
            min: _mm512_min_ps, max: _mm512_max_ps,
            exp2: |x| _mm512_castsi512_ps(_mm512_slli_epi32::<23>(_mm512_add_epi32(
                _mm512_cvtps_epi32(x), _mm512_set1_epi32(127)
            ))),
            mask: __mmask16
        }
    );
}
#[cfg(target_arch = "x86_64")]
pub use x86::{Avx2, Avx512};

#[cfg(target_arch = "aarch64")]
mod arm {
    use super::{Add, Div, Kernel, Lanes, Mul, Neg, Real, Sub, sin_cos_f32};
    use std::arch::aarch64::*;

    native_lanes!(
        /// Eight lanes in two NEON registers.
        Neon, float32x4_t, 2 x 4, "neon", {
            add: vaddq_f32, sub: vsubq_f32, mul: vmulq_f32, div: vdivq_f32,
            fma: |a, b, c| vfmaq_f32(c, a, b), fnma: |a, b, c| vfmsq_f32(c, a, b), sqrt: vsqrtq_f32,
            round: vrndnq_f32, splat: vdupq_n_f32, lt: vcltq_f32,
            select: vbslq_f32, any: |m| vmaxvq_u32(m) != 0,
            or: vorrq_u32, and: vandq_u32, abs: vabsq_f32, neg: vnegq_f32,
            // vminq and vmaxq would give NaN when either is
            min: |a, b| vbslq_f32(vcltq_f32(a, b), a, b), max: |a, b| vbslq_f32(vcltq_f32(b, a), a, b),
            exp2: |x| vreinterpretq_f32_s32(vshlq_n_s32::<23>(vaddq_s32(vcvtnq_s32_f32(x), vdupq_n_s32(127)))),
            mask: uint32x4_t
        }
    );
}
#[cfg(target_arch = "aarch64")]
pub use arm::Neon;

/// An instruction set that packs can run on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Simd {
    /// 16 lanes, x86-64 with AVX-512 F, DQ and VL.
    Avx512,
    /// 16 lanes, x86-64 with AVX2 and FMA.
    Avx2,
    /// 8 lanes, 64-bit Arm.
    Neon,
    /// 8 lanes of plain code, for any machine.
    Portable,
}

/// The way into code on single numbers that is compiled for an instruction set: fused multiply-adds are then instructions
/// instead of function calls, and the compiler may put loops into lanes. Bits do not depend on it.
#[derive(Clone, Copy, Debug)]
pub struct SimdDispatch {
    /// AVX2 with FMA, which the machine has; else what all machines of the architecture have.
    avx2: bool,
}

impl SimdDispatch {
    /// Runs a computation.
    #[inline]
    pub fn vectorize<K: Kernel<f32>>(self, kernel: K) -> K::Output {
        #[cfg(target_arch = "x86_64")]
        if self.avx2 {
            #[target_feature(enable = "avx2,fma")]
            fn compiled<K: Kernel<f32>>(kernel: K) -> K::Output {
                kernel.run()
            }
            // SAFETY: `Simd::dispatch` has found that the machine has what it is compiled for
            return unsafe { compiled(kernel) };
        }
        kernel.run()
    }
}

/// Bytes that a processor fetches at once, at least.
const CACHE_LINE: usize = 64;

/// Asks for a value's memory ahead of its use, where the machine can be asked.
#[inline(always)]
pub fn prefetch<T>(value: &T) {
    #[cfg(target_arch = "x86_64")]
    for offset in (0..size_of::<T>()).step_by(CACHE_LINE) {
        use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
        let at = std::ptr::from_ref(value).cast::<i8>().wrapping_add(offset);
        // SAFETY: a prefetch is a hint, which reads nothing, wherever it points
        unsafe { _mm_prefetch::<_MM_HINT_T1>(at) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _no_hint = value;
}

/// An instruction set was asked for that this machine does not have, or that does not exist.
#[derive(Clone, Debug, thiserror::Error)]
#[error("instruction set: `{0}` is not available here; use one of {1}, or leave it and POLYPOD_SIMD unset")]
pub struct SimdError(String, String);

impl Simd {
    /// The way into code on single numbers that is compiled for this instruction set, as far as this machine has it.
    pub fn dispatch(self) -> SimdDispatch {
        #[cfg(target_arch = "x86_64")]
        let avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        #[cfg(not(target_arch = "x86_64"))]
        let avx2 = false;
        SimdDispatch { avx2: avx2 && matches!(self, Simd::Avx512 | Simd::Avx2) }
    }

    /// Those this machine has, fastest first.
    pub fn available() -> Vec<Simd> {
        let mut found = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
            {
                found.push(Simd::Avx512);
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                found.push(Simd::Avx2);
            }
        }
        #[cfg(target_arch = "aarch64")]
        found.push(Simd::Neon);
        found.push(Simd::Portable);
        found
    }

    /// The lower-case name, as `POLYPOD_SIMD` takes it.
    pub fn name(self) -> &'static str {
        match self {
            Simd::Avx512 => "avx512",
            Simd::Avx2 => "avx2",
            Simd::Neon => "neon",
            Simd::Portable => "portable",
        }
    }

    /// Robots per pack.
    pub fn lanes(self) -> usize {
        match self {
            Simd::Avx512 => 16,
            Simd::Avx2 => 16,
            Simd::Neon => 8,
            Simd::Portable => PORTABLE_LANES,
        }
    }

    /// The one asked for, else the one that the environment variable `POLYPOD_SIMD` names, else the fastest.
    ///
    /// # Errors
    /// When it is unknown or this machine lacks it.
    pub fn choose(wanted: Option<Simd>) -> Result<Simd, SimdError> {
        let wanted = match wanted {
            Some(simd) => Some(simd.name().to_string()),
            None => std::env::var("POLYPOD_SIMD").ok().filter(|name| !name.is_empty()),
        };
        match wanted {
            Some(name) => Self::named(&name),
            None => Ok(Self::available().first().copied().unwrap_or(Simd::Portable)),
        }
    }

    /// The one of that name, in letters of any case.
    ///
    /// # Errors
    /// When it is unknown or this machine lacks it.
    pub fn named(name: &str) -> Result<Simd, SimdError> {
        let available = Self::available();
        let known = || available.iter().map(|simd| simd.name()).collect::<Vec<_>>().join(", ");
        let found = available.iter().copied().find(|simd| simd.name() == name.to_lowercase());
        found.ok_or_else(|| SimdError(name.to_string(), known()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sine_and_cosine_are_accurate_over_many_turns() {
        for i in -200_000..200_000 {
            let x = i as f32 * 1e-3;
            let (s, c) = Real::sin_cos(x);
            assert!((f64::from(s) - f64::from(x).sin()).abs() < 1.5e-7, "sin {x}: {s}");
            assert!((f64::from(c) - f64::from(x).cos()).abs() < 1.5e-7, "cos {x}: {c}");
        }
    }

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
            d[5] = S::select(S::or(a.lt(b), S::and(b.lt(c), c.lt(a))), s, k);
        }
    }

    fn run_on<L: Lanes>(inputs: &[[f32; 3]]) -> Vec<[u32; 3]> {
        let mut out = Vec::new();
        for chunk in inputs.chunks(L::LANES) {
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
        assert_eq!(scalar, run_on::<Portable>(&inputs));
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
        #[cfg(target_arch = "x86_64")]
        for simd in Simd::available() {
            match simd {
                Simd::Avx2 => assert_eq!(scalar, run_on::<Avx2>(&inputs)),
                Simd::Avx512 => assert_eq!(scalar, run_on::<Avx512>(&inputs)),
                _ => {}
            }
        }
    }
}
