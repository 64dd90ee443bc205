//! Activation functions and their derivatives.

use polypod_lanes::Real;
use polypod_lanes::elementary::{exp, tanh_positive};
use serde::{Deserialize, Serialize};

/// Function after a hidden layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// `x` where positive, else `e^x - 1`.
    Elu,
    /// `x` where positive, else 0.
    Relu,
    /// Hyperbolic tangent.
    Tanh,
}

impl Activation {
    /// The function of `x`.
    #[inline(always)]
    pub(crate) fn apply<L: Real>(self, x: L) -> L {
        let zero = L::zero();
        match self {
            Self::Elu => L::select(zero.lt(x), x, exp(x.min(zero)) - L::one()),
            Self::Relu => L::select(zero.lt(x), x, zero),
            Self::Tanh => {
                let y = tanh_positive(x.abs());
                L::select(x.lt(zero), -y, y)
            }
        }
    }

    /// The derivative where the function is `y`.
    #[inline(always)]
    pub(crate) fn derivative<L: Real>(self, y: L) -> L {
        let (zero, one) = (L::zero(), L::one());
        match self {
            Self::Elu => L::select(zero.lt(y), one, y + one),
            Self::Relu => L::select(zero.lt(y), one, zero),
            Self::Tanh => y.neg_mul_add(y, one),
        }
    }
}
