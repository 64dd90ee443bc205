//! Proof that the machine has an instruction set, without which no lanes of it exist.
//!
//! A [`SimdToken`] is found at run time. It gives a [`WithLanes`] computation the lane type of its
//! instruction set, as a generic parameter: code that holds no token has no name for the type.
//!
//! ```compile_fail,E0200
//! struct Unchecked;
//! // an unsafe trait: safe code cannot vouch for instructions that nobody looked for
//! impl polypod_lanes::Proof for Unchecked {}
//! ```

#![allow(unsafe_code)]

use std::fmt::Debug;

use super::{Lanes, Pair, Portable};

/// Parameter of the native lane types. It vouches that the machine has their instructions, so that
/// computing with them is safe.
///
/// # Safety
/// Whoever implements it keeps the type to themselves. They let others compute with lanes of this
/// proof only through generic code, which they call with the token of that instruction set in hand.
pub unsafe trait Proof: Copy + Debug + Send + Sync + 'static {}

/// Proof behind [`SimdToken::with_sixteen_lanes`].
#[derive(Clone, Copy, Debug)]
struct Found;

// SAFETY: the type is private, and `with_sixteen_lanes` asks for the token
unsafe impl Proof for Found {}

/// Proof that this machine has AVX-512 F, DQ and VL, AVX2 and FMA.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy, Debug)]
pub struct Avx512Token(());

#[cfg(target_arch = "x86_64")]
impl Avx512Token {
    /// Asks the machine; `None` if it lacks one of them.
    pub fn detect() -> Option<Self> {
        let found = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512vl")
            && Avx2Token::detect().is_some();
        found.then_some(Self(()))
    }
}

/// Proof that this machine has AVX2 and FMA.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy, Debug)]
pub struct Avx2Token(());

#[cfg(target_arch = "x86_64")]
impl Avx2Token {
    /// Asks the machine; `None` if it lacks one of them.
    pub fn detect() -> Option<Self> {
        (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")).then_some(Self(()))
    }
}

/// An instruction set that this machine has. [`Simd::token`](super::Simd::token) finds it.
#[derive(Clone, Copy, Debug)]
pub enum SimdToken {
    /// See [`Simd::Avx512`](super::Simd::Avx512).
    #[cfg(target_arch = "x86_64")]
    Avx512(Avx512Token),
    /// See [`Simd::Avx2`](super::Simd::Avx2).
    #[cfg(target_arch = "x86_64")]
    Avx2(Avx2Token),
    /// See [`Simd::Neon`](super::Simd::Neon).
    #[cfg(target_arch = "aarch64")]
    Neon,
    /// Plain code, for any machine.
    Portable,
}

/// A computation that is written for any lane type.
pub trait WithLanes {
    /// Result of the computation.
    type Output;
    /// The computation.
    fn run<L: Lanes>(self) -> Self::Output;
}

impl SimdToken {
    /// Calls a computation with sixteen lanes of the instruction set, in one or more registers.
    #[inline]
    pub fn with_sixteen_lanes<C: WithLanes>(self, computation: C) -> C::Output {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(_) => computation.run::<super::Avx512<Found>>(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(_) => computation.run::<super::Avx2<Found>>(),
            #[cfg(target_arch = "aarch64")]
            Self::Neon => computation.run::<Pair<super::Neon<Found>>>(),
            Self::Portable => computation.run::<Pair<Portable>>(),
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::Simd;

    #[test]
    fn instruction_sets_of_other_machines_have_no_token() {
        let foreign = if cfg!(target_arch = "aarch64") { Simd::Avx512 } else { Simd::Neon };
        assert!(foreign.token().is_none());
        assert!(Simd::Portable.token().is_some());
    }
}
