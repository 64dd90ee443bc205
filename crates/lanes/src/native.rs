//! Lanes of native vector registers: AVX-512, AVX2, NEON.

#![allow(unsafe_code)]

use std::marker::PhantomData;
use std::ops::{Add, Div, Mul, Neg, Sub};

use super::{Kernel, Lanes, Real};
use crate::elementary;
use crate::token::Proof;

/// Place of the exponent in the bits of a single-precision number, and its bias.
const EXPONENT_SHIFT: i32 = 23;
/// See [`EXPONENT_SHIFT`].
const EXPONENT_BIAS: i32 = 127;

/// Defines a lane type over some native vector registers, from the intrinsics of one. Several
/// registers hide the latency of an operation behind its neighbour's.
macro_rules! native_lanes {
    ($(#[$doc:meta])* $name:ident, $reg:ty, $registers:literal x $width:literal of $all:literal, $features:literal, {
        add: $add:path, sub: $sub:path, mul: $mul:path, div: $div:path, fma: $fma:expr, fnma: $fnma:expr,
        sqrt: $sqrt:path, round: $round:expr, floor: $floor:expr, splat: $splat:path, lt: $lt:expr, select: $select:expr, any: $any:expr,
        or: $or:expr, and: $and:expr, not: $not:expr, count: $count:expr, store_some: $store_some:expr,
        gather_pair: $gather_pair:expr, abs: $abs:expr, neg: $neg:expr, min: $min:expr, max: $max:expr, power_of_two: $power_of_two:expr,
        mask: $mask:ty
    }) => {
        $(#[$doc])*
        ///
        /// `P` vouches that the machine has the instructions; see [`Proof`].
        #[derive(Clone, Copy, Debug)]
        #[repr(transparent)]
        pub struct $name<P: Proof>([$reg; $registers], PhantomData<P>);

        native_lanes!(@operator $name, $registers, Add, add, $add);
        native_lanes!(@operator $name, $registers, Sub, sub, $sub);
        native_lanes!(@operator $name, $registers, Mul, mul, $mul);
        native_lanes!(@operator $name, $registers, Div, div, $div);
        impl<P: Proof> Neg for $name<P> {
            type Output = Self;
            #[inline(always)]
            fn neg(self) -> Self {
                native_lanes!(@each $registers, $neg, self)
            }
        }
        impl<P: Proof> Real for $name<P> {
            type Mask = [$mask; $registers];
            const LANES: usize = $registers * $width;
            const READS_UNIFORM: bool = true;
            #[inline(always)]
            fn splat(x: f64) -> Self {
                // SAFETY: as in `each`
                Self([unsafe { $splat(x as f32) }; $registers], PhantomData)
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
            fn floor(self) -> Self {
                native_lanes!(@each $registers, $floor, self)
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
            fn not(mask: Self::Mask) -> Self::Mask {
                let (mut out, mut i) = (mask, 0);
                while i < $registers {
                    // SAFETY: as in `each`
                    out[i] = unsafe { $not(mask[i]) };
                    i += 1;
                }
                out
            }
            #[inline(always)]
            fn count(mask: Self::Mask) -> usize {
                let (mut count, mut i) = (0, 0);
                while i < $registers {
                    // SAFETY: as in `each`
                    count += unsafe { $count(mask[i]) };
                    i += 1;
                }
                count
            }
            #[inline(always)]
            fn store_some(self, mask: Self::Mask, to: &mut [f32]) {
                let to = &mut to[..$registers * $width];
                let (mut count, mut i) = (0, 0);
                while i < $registers {
                    // SAFETY: as in `each`; a register writes `$width` numbers at most, and the
                    // registers before it have no more lanes than that each
                    count += unsafe { $store_some(mask[i], self.0[i], to.as_mut_ptr().add(count)) };
                    i += 1;
                }
            }
            #[inline(always)]
            fn gather_pair(table: &[f32], row: Self, stride: u32, column: Self) -> [Self; 2] {
                assert!(table.len() > 1, "a pair needs two numbers");
                // instructions know places as numbers with a sign
                let last = (table.len() - 2).min(i32::MAX as usize) as i32;
                let (mut out, mut i) = ([row, column], 0);
                while i < $registers {
                    // SAFETY: as in `each`; places are limited to `last`, behind which a number
                    // follows
                    let pair = unsafe { $gather_pair(table.as_ptr(), last, row.0[i], stride as i32, column.0[i]) };
                    [out[0].0[i], out[1].0[i]] = pair;
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
                // SAFETY: the registers are `$registers * $width` consecutive f32
                (unsafe { &*std::ptr::from_ref(self).cast::<[f32; $registers * $width]>() })[lane]
            }
            #[inline(always)]
            fn set_lane_f32(&mut self, lane: usize, value: f32) {
                // SAFETY: the registers are `$registers * $width` consecutive f32
                let lanes = unsafe { &mut *std::ptr::from_mut(self).cast::<[f32; $registers * $width]>() };
                lanes[lane] = value;
            }
            #[inline(always)]
            fn broadcast(x: f32) -> Self {
                // SAFETY: as in `each`
                Self([unsafe { $splat(x) }; $registers], PhantomData)
            }
            #[inline(always)]
            fn load(from: &[f32]) -> Self {
                let mut out = Self::zero();
                // SAFETY: the registers are `$registers * $width` consecutive f32
                let lanes = unsafe { &mut *std::ptr::from_mut(&mut out).cast::<[f32; $registers * $width]>() };
                lanes.copy_from_slice(&from[..$registers * $width]);
                out
            }
            #[inline(always)]
            fn store(self, to: &mut [f32]) {
                // SAFETY: the registers are `$registers * $width` consecutive f32
                let lanes = unsafe { &*std::ptr::from_ref(&self).cast::<[f32; $registers * $width]>() };
                to[..$registers * $width].copy_from_slice(lanes);
            }
            #[inline(always)]
            fn power_of_two(self) -> Self {
                native_lanes!(@each $registers, $power_of_two, self)
            }
            #[inline(always)]
            fn sin_cos(self) -> (Self, Self) {
                elementary::sin_cos(self)
            }
        }
        impl<P: Proof> Lanes for $name<P> {
            const REGISTERS: usize = $all / $registers;

            fn vectorize<K: Kernel<Self>>(kernel: K) -> K::Output {
                #[target_feature(enable = $features)]
                fn compiled<P: Proof, K: Kernel<$name<P>>>(kernel: K) -> K::Output {
                    kernel.run()
                }
                // SAFETY: as in `each`
                unsafe { compiled(kernel) }
            }

            #[inline(always)]
            fn call<K: Kernel<Self>>(part: K) -> K::Output {
                #[target_feature(enable = $features)]
                #[inline(never)]
                fn compiled<P: Proof, K: Kernel<$name<P>>>(part: K) -> K::Output {
                    part.run()
                }
                // SAFETY: as in `each`
                unsafe { compiled(part) }
            }
        }
    };
    // the operation on each register
    (@each $registers:literal, $f:expr, $first:expr $(, $other:expr)*) => {{
        let (mut out, mut i) = ($first, 0);
        while i < $registers {
            // SAFETY: the type has a `Proof` that the machine has the instruction set
            out.0[i] = unsafe { $f($first.0[i] $(, $other.0[i])*) };
            i += 1;
        }
        out
    }};
    (@operator $name:ident, $registers:literal, $trait:ident, $f:ident, $intrinsic:path) => {
        impl<P: Proof> $trait for $name<P> {
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
    use super::{
        Add, Div, EXPONENT_BIAS, EXPONENT_SHIFT, Kernel, Lanes, Mul, Neg, PhantomData, Proof, Real, Sub, elementary,
    };
    use std::arch::x86_64::*;

    /// For each mask of eight lanes the lanes for which it is true, in their order.
    static ORDERS: [[i32; 8]; 256] = {
        let (mut orders, mut mask) = ([[0; 8]; 256], 0);
        while mask < 256 {
            let (mut count, mut lane) = (0, 0);
            while lane < 8 {
                if mask >> lane & 1 == 1 {
                    orders[mask][count] = lane;
                    count += 1;
                }
                lane += 1;
            }
            mask += 1;
        }
        orders
    };

    /// Writes the lanes of a mask and returns their number.
    ///
    /// # Safety
    /// The machine has AVX2; eight numbers may be written to `to`.
    #[inline(always)]
    unsafe fn store_some_of_8(mask: __m256, x: __m256, to: *mut f32) -> usize {
        // SAFETY: as the function says
        unsafe {
            let bits = _mm256_movemask_ps(mask) as u8;
            let order = _mm256_loadu_si256(ORDERS[usize::from(bits)].as_ptr().cast());
            _mm256_storeu_ps(to, _mm256_permutevar8x32_ps(x, order));
            bits.count_ones() as usize
        }
    }

    /// Writes the lanes of a mask and returns their number.
    ///
    /// # Safety
    /// The machine has AVX-512 F; sixteen numbers may be written to `to`.
    #[inline(always)]
    unsafe fn store_some_of_16(mask: __mmask16, x: __m512, to: *mut f32) -> usize {
        // SAFETY: as the function says
        unsafe { _mm512_storeu_ps(to, _mm512_maskz_compress_ps(mask, x)) };
        mask.count_ones() as usize
    }

    /// See [`Real::gather_pair`]; places beyond `last` are `last`.
    ///
    /// # Safety
    /// The machine has AVX2; the table has two numbers at `last`, which is not negative.
    #[inline(always)]
    unsafe fn gather_8_pairs(table: *const f32, last: i32, row: __m256, stride: i32, column: __m256) -> [__m256; 2] {
        // SAFETY: as the function says
        unsafe {
            let place = _mm256_mullo_epi32(_mm256_cvttps_epi32(row), _mm256_set1_epi32(stride));
            let place = _mm256_add_epi32(place, _mm256_cvttps_epi32(column));
            let place = _mm256_min_epu32(place, _mm256_set1_epi32(last));
            let low = _mm256_i32gather_pd::<4>(table.cast(), _mm256_castsi256_si128(place));
            let high = _mm256_i32gather_pd::<4>(table.cast(), _mm256_extracti128_si256::<1>(place));
            let (low, high) = (_mm256_castpd_ps(low), _mm256_castpd_ps(high));
            let first = _mm256_castps_pd(_mm256_shuffle_ps::<0b10_00_10_00>(low, high));
            let second = _mm256_castps_pd(_mm256_shuffle_ps::<0b11_01_11_01>(low, high));
            // the halves of `low` and `high` took turns
            [
                _mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(first)),
                _mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(second)),
            ]
        }
    }

    /// See [`Real::gather_pair`]; places beyond `last` are `last`.
    ///
    /// # Safety
    /// The machine has AVX-512 F; the table has two numbers at `last`, which is not negative.
    #[inline(always)]
    unsafe fn gather_16_pairs(table: *const f32, last: i32, row: __m512, stride: i32, column: __m512) -> [__m512; 2] {
        // SAFETY: as the function says
        unsafe {
            let place = _mm512_mullo_epi32(_mm512_cvttps_epi32(row), _mm512_set1_epi32(stride));
            let place = _mm512_add_epi32(place, _mm512_cvttps_epi32(column));
            let place = _mm512_min_epu32(place, _mm512_set1_epi32(last));
            let low = _mm512_i32gather_pd::<4>(_mm512_castsi512_si256(place), table.cast());
            let high = _mm512_i32gather_pd::<4>(_mm512_extracti64x4_epi64::<1>(place), table.cast());
            let (low, high) = (_mm512_castpd_ps(low), _mm512_castpd_ps(high));
            let even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
            let odd = _mm512_add_epi32(even, _mm512_set1_epi32(1));
            [_mm512_permutex2var_ps(low, even, high), _mm512_permutex2var_ps(low, odd, high)]
        }
    }

    native_lanes!(
        /// Sixteen lanes in two AVX registers.
        Avx2, __m256, 2 x 8 of 16, "avx2,fma", {
            add: _mm256_add_ps, sub: _mm256_sub_ps, mul: _mm256_mul_ps, div: _mm256_div_ps,
            fma: _mm256_fmadd_ps, fnma: _mm256_fnmadd_ps, sqrt: _mm256_sqrt_ps,
            round: _mm256_round_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>,
            floor: _mm256_round_ps::<{ _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC }>,
            splat: _mm256_set1_ps, lt: _mm256_cmp_ps::<_CMP_LT_OQ>,
            select: |m, a, b| _mm256_blendv_ps(b, a, m), any: |m| _mm256_movemask_ps(m) != 0,
            or: _mm256_or_ps, and: _mm256_and_ps,
            not: |m| _mm256_xor_ps(m, _mm256_castsi256_ps(_mm256_set1_epi32(-1))),
            count: |m| _mm256_movemask_ps(m).count_ones() as usize, store_some: store_some_of_8,
            gather_pair: gather_8_pairs,
            abs: |x| _mm256_andnot_ps(_mm256_set1_ps(-0.0), x), neg: |x| _mm256_xor_ps(x, _mm256_set1_ps(-0.0)),
            // the second operand when either is NaN, as wanted
            min: _mm256_min_ps, max: _mm256_max_ps,
            power_of_two: |x| _mm256_castsi256_ps(_mm256_slli_epi32::<{ EXPONENT_SHIFT }>(_mm256_add_epi32(
                _mm256_cvtps_epi32(x), _mm256_set1_epi32(EXPONENT_BIAS)))),
            mask: __m256
        }
    );
    native_lanes!(
        /// Sixteen lanes in an AVX-512 register.
        Avx512, __m512, 1 x 16 of 32, "avx512f,avx512dq,avx512vl,avx2,fma", {
            add: _mm512_add_ps, sub: _mm512_sub_ps, mul: _mm512_mul_ps, div: _mm512_div_ps,
            fma: _mm512_fmadd_ps, fnma: _mm512_fnmadd_ps, sqrt: _mm512_sqrt_ps,
            round: _mm512_roundscale_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>,
            floor: _mm512_roundscale_ps::<{ _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC }>,
            splat: _mm512_set1_ps, lt: _mm512_cmp_ps_mask::<_CMP_LT_OQ>,
            select: |m, a, b| _mm512_mask_blend_ps(m, b, a), any: |m| _mm512_mask2int(m) != 0,
            or: _kor_mask16, and: _kand_mask16, not: _knot_mask16,
            count: |m| _mm512_mask2int(m).count_ones() as usize, store_some: store_some_of_16,
            gather_pair: gather_16_pairs,
            abs: |x| _mm512_andnot_ps(_mm512_set1_ps(-0.0), x), neg: |x| _mm512_xor_ps(x, _mm512_set1_ps(-0.0)),
            min: _mm512_min_ps, max: _mm512_max_ps,
            power_of_two: |x| _mm512_castsi512_ps(_mm512_slli_epi32::<{ EXPONENT_SHIFT as u32 }>(_mm512_add_epi32(
                _mm512_cvtps_epi32(x), _mm512_set1_epi32(EXPONENT_BIAS)))),
            mask: __mmask16
        }
    );
}
#[cfg(target_arch = "x86_64")]
pub use x86::{Avx2, Avx512};

#[cfg(target_arch = "aarch64")]
mod arm {
    use super::{
        Add, Div, EXPONENT_BIAS, EXPONENT_SHIFT, Kernel, Lanes, Mul, Neg, PhantomData, Proof, Real, Sub, elementary,
    };
    use std::arch::aarch64::*;

    /// Writes the lanes of a mask and returns their number.
    ///
    /// # Safety
    /// Four numbers may be written to `to`.
    #[inline(always)]
    unsafe fn store_some_of_4(mask: uint32x4_t, x: float32x4_t, to: *mut f32) -> usize {
        let (mut is_some, mut numbers, mut count) = ([0u32; 4], [0.0f32; 4], 0);
        // SAFETY: the arrays are as long as registers; fewer than four numbers are before `count`
        unsafe {
            vst1q_u32(is_some.as_mut_ptr(), mask);
            vst1q_f32(numbers.as_mut_ptr(), x);
            for (is_some, number) in is_some.into_iter().zip(numbers) {
                to.add(count).write(number);
                count += usize::from(is_some != 0);
            }
        }
        count
    }

    /// See [`Real::gather_pair`]; places beyond `last` are `last`.
    ///
    /// # Safety
    /// The table has two numbers at `last`, which is not negative.
    #[inline(always)]
    unsafe fn gather_4_pairs(
        table: *const f32,
        last: i32,
        row: float32x4_t,
        stride: i32,
        column: float32x4_t,
    ) -> [float32x4_t; 2] {
        let (mut places, mut first, mut second) = ([0u32; 4], [0.0f32; 4], [0.0f32; 4]);
        // SAFETY: the arrays are as long as registers; no place is beyond `last`
        unsafe {
            let place = vmlaq_n_u32(vcvtq_u32_f32(column), vcvtq_u32_f32(row), stride as u32);
            vst1q_u32(places.as_mut_ptr(), vminq_u32(place, vdupq_n_u32(last as u32)));
            for k in 0..4 {
                first[k] = *table.add(places[k] as usize);
                second[k] = *table.add(places[k] as usize + 1);
            }
            [vld1q_f32(first.as_ptr()), vld1q_f32(second.as_ptr())]
        }
    }

    native_lanes!(
        /// Eight lanes in two NEON registers.
        Neon, float32x4_t, 2 x 4 of 32, "neon", {
            add: vaddq_f32, sub: vsubq_f32, mul: vmulq_f32, div: vdivq_f32,
            fma: |a, b, c| vfmaq_f32(c, a, b), fnma: |a, b, c| vfmsq_f32(c, a, b), sqrt: vsqrtq_f32,
            round: vrndnq_f32, floor: vrndmq_f32, splat: vdupq_n_f32, lt: vcltq_f32,
            select: vbslq_f32, any: |m| vmaxvq_u32(m) != 0,
            or: vorrq_u32, and: vandq_u32, not: vmvnq_u32,
            count: |m| vaddvq_u32(vshrq_n_u32::<31>(m)) as usize, store_some: store_some_of_4,
            gather_pair: gather_4_pairs, abs: vabsq_f32, neg: vnegq_f32,
            // vminq and vmaxq would give NaN when either is
            min: |a, b| vbslq_f32(vcltq_f32(a, b), a, b), max: |a, b| vbslq_f32(vcltq_f32(b, a), a, b),
            power_of_two: |x| vreinterpretq_f32_s32(vshlq_n_s32::<{ EXPONENT_SHIFT }>(vaddq_s32(
                vcvtnq_s32_f32(x), vdupq_n_s32(EXPONENT_BIAS)))),
            mask: uint32x4_t
        }
    );
}
#[cfg(target_arch = "aarch64")]
pub use arm::Neon;
