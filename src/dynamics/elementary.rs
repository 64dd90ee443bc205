//! Elementary functions of single numbers, with IEEE operations only: the bits are the same on every machine.
//!
//! Sine and cosine of lanes are [`Real`](crate::Real)'s.

use crate::lanes::Real;

/// `e^x`, relative error below 3e-7: range reduction and a polynomial (the single-precision coefficients of the Cephes
/// library), with IEEE operations only, so that the bits are the same on every machine.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    if x < -87.0 {
        return 0.0;
    }
    let x = x.min(88.0);
    let k = (x * std::f32::consts::LOG2_E).round_ties_even();
    let r = (-k).mul_add(-2.121_944_4e-4, (-k).mul_add(0.693_359_4, x));
    let series = [1.987_569_2e-4, 1.398_199_9e-3, 8.333_452e-3, 4.166_579_6e-2, 0.166_666_66, 0.5];
    let p = series.iter().fold(0.0f32, |p, &c: &f32| p.mul_add(r, c));
    let y = p.mul_add(r * r, r) + 1.0;
    y * f32::from_bits(((k as i32 + 127) as u32) << 23)
}

/// `e^x` of lanes: the polynomial of [`exp`], with arguments limited to -87 and 88.
#[inline(always)]
pub fn exp_of_lanes<S: Real>(x: S) -> S {
    let x = x.clamp(S::broadcast(-87.0), S::broadcast(88.0));
    let k = (x * S::broadcast(std::f32::consts::LOG2_E)).round();
    let r = k.neg_mul_add(S::broadcast(-2.121_944_4e-4), k.neg_mul_add(S::broadcast(0.693_359_4), x));
    let p = S::broadcast(1.987_569_2e-4).mul_add(r, S::broadcast(1.398_199_9e-3));
    let p = p.mul_add(r, S::broadcast(8.333_452e-3));
    let p = p.mul_add(r, S::broadcast(4.166_579_6e-2));
    let p = p.mul_add(r, S::broadcast(0.166_666_66));
    let p = p.mul_add(r, S::broadcast(0.5));
    (p.mul_add(r * r, r) + S::one()) * k.exp2_of_whole()
}

/// Hyperbolic tangent of a non-negative number.
#[inline(always)]
pub fn tanh_positive(x: f32) -> f32 {
    let e = exp(-2.0 * x);
    (1.0 - e) / (1.0 + e)
}

/// Angle of the vector (x, y), rad; error below 1e-6. A polynomial on the first octant (Abramowitz and Stegun 4.4.49)
/// and reflections, with IEEE operations only.
#[inline(always)]
pub fn atan2(y: f32, x: f32) -> f32 {
    use std::f32::consts::{FRAC_PI_2, PI};
    let (ax, ay) = (x.abs(), y.abs());
    let (small, large) = if ay < ax { (ay, ax) } else { (ax, ay) };
    let t = if large > 0.0 { small / large } else { 0.0 };
    let t2 = t * t;
    let series = [
        0.002_866_225_7,
        -0.016_165_737,
        0.042_909_614,
        -0.075_289_64,
        0.106_562_64,
        -0.142_089,
        0.199_935_51,
        -0.333_331_45,
    ];
    let p = series.iter().fold(0.0f32, |p, &c: &f32| p.mul_add(t2, c));
    let a = (p * t2).mul_add(t, t);
    let a = if ay < ax { a } else { FRAC_PI_2 - a };
    let a = if x < 0.0 { PI - a } else { a };
    if y < 0.0 { -a } else { a }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponential_and_tangent_are_accurate() {
        for i in -8000..8000 {
            let x = i as f32 * 0.01;
            let exact = f64::from(x).exp();
            assert!((f64::from(exp(x)) - exact).abs() <= 4e-7 * exact + 1e-37, "{x}: {} {exact}", exp(x));
            assert!(x < -87.0 || exp_of_lanes(x).to_bits() == exp(x).to_bits(), "{x}");
            let x = x.abs();
            assert!((f64::from(tanh_positive(x)) - f64::from(x).tanh()).abs() < 2e-7, "{x}");
        }
    }

    #[test]
    fn atan2_is_accurate_all_around() {
        for i in 0..10_000 {
            let angle = (f64::from(i) - 5000.0) * std::f64::consts::PI / 5000.0;
            for radius in [1e-3, 1.0, 50.0] {
                let (y, x) = ((radius * angle.sin()) as f32, (radius * angle.cos()) as f32);
                let exact = f64::from(y).atan2(f64::from(x));
                assert!((f64::from(atan2(y, x)) - exact).abs() < 1.5e-6, "{y} {x}");
            }
        }
    }
}
