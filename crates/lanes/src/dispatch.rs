//! Instruction sets of the machine, and calls of code that is compiled for one of them.

#![allow(unsafe_code)]

use super::Kernel;
use super::portable::PORTABLE_LANES;
use super::token::SimdToken;
#[cfg(target_arch = "x86_64")]
use super::token::{Avx2Token, Avx512Token};

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

/// The way into code on single numbers that is compiled for an instruction set: fused multiply-adds
/// are then instructions instead of function calls, and the compiler may put loops into lanes. Bits
/// do not depend on it.
#[derive(Clone, Copy, Debug)]
pub struct SimdDispatch {
    /// AVX2 with FMA, which the machine has; else what all machines of the architecture have.
    #[cfg(target_arch = "x86_64")]
    avx2: Option<Avx2Token>,
}

impl SimdDispatch {
    /// Runs a computation.
    #[inline]
    pub fn vectorize<K: Kernel<f32>>(self, kernel: K) -> K::Output {
        #[cfg(target_arch = "x86_64")]
        if self.avx2.is_some() {
            #[target_feature(enable = "avx2,fma")]
            fn compiled<K: Kernel<f32>>(kernel: K) -> K::Output {
                kernel.run()
            }
            // SAFETY: the token says that the machine has what it is compiled for
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
    /// Dispatch to code on single numbers that is compiled for this instruction set, as far as this
    /// machine supports the set.
    pub fn dispatch(self) -> SimdDispatch {
        SimdDispatch {
            #[cfg(target_arch = "x86_64")]
            avx2: matches!(self, Simd::Avx512 | Simd::Avx2).then(Avx2Token::detect).flatten(),
        }
    }

    /// Proof that this machine has the instruction set; `None` if it lacks it.
    pub fn token(self) -> Option<SimdToken> {
        match self {
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => Avx512Token::detect().map(SimdToken::Avx512),
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => Avx2Token::detect().map(SimdToken::Avx2),
            #[cfg(target_arch = "aarch64")]
            Simd::Neon => Some(SimdToken::Neon),
            Simd::Portable => Some(SimdToken::Portable),
            _ => None,
        }
    }

    /// Instruction sets of this machine, fastest first.
    pub fn available() -> Vec<Simd> {
        let all = [Simd::Avx512, Simd::Avx2, Simd::Neon, Simd::Portable];
        all.into_iter().filter(|simd| simd.token().is_some()).collect()
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

    /// The one asked for, else the one that the environment variable `POLYPOD_SIMD` names, else the
    /// fastest.
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
