//! Elementary functions of lanes and of single numbers, of IEEE operations only: the bits are the
//! same on every machine.
//!
//! All are of single precision. [`Real::sin_cos`] calls `sin_cos` for lanes and `f32`, and the
//! standard library's for `f64`.

use super::Real;

/// Sine and cosine by range reduction to `[-pi/4, pi/4]` and minimax polynomials (the
/// single-precision coefficients of the Cephes library); absolute error below 1.2e-7 for |x| < 1e4.
#[inline(always)]
pub(super) fn sin_cos<S: Real>(x: S) -> (S, S) {
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

/// `e^x`, relative error below 4e-7; zero below -87, `e^88` above 88. Range reduction and a
/// polynomial (the single-precision coefficients of the Cephes library).
#[inline(always)]
pub fn exp<S: Real>(x: S) -> S {
    let least = S::splat(-87.0);
    let bounded = x.min(S::splat(88.0)).max(least);
    let k = (bounded * S::splat(std::f64::consts::LOG2_E)).round();
    let r = k.neg_mul_add(S::splat(-2.121_944_4e-4), k.neg_mul_add(S::splat(0.693_359_4), bounded));
    let p = S::splat(1.987_569_2e-4).mul_add(r, S::splat(1.398_199_9e-3));
    let p = p.mul_add(r, S::splat(8.333_452e-3)).mul_add(r, S::splat(4.166_579_6e-2));
    let p = p.mul_add(r, S::splat(0.166_666_66)).mul_add(r, S::splat(0.5));
    let y = p.mul_add(r * r, r) + S::one();
    S::select(x.lt(least), S::zero(), y * k.power_of_two())
}

/// Hyperbolic tangent of a non-negative number, absolute error below 2e-7.
#[inline(always)]
pub fn tanh_positive<S: Real>(x: S) -> S {
    let e = exp(S::splat(-2.0) * x);
    (S::one() - e) / (S::one() + e)
}

/// Angle of the vector (x, y), rad; error below 1e-6. A polynomial on the first octant (Abramowitz
/// and Stegun 4.4.49) and reflections, with IEEE operations only.
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
    fn sine_and_cosine_are_accurate_over_many_turns() {
        for i in -200_000..200_000 {
            let x = i as f32 * 1e-3;
            let (s, c) = Real::sin_cos(x);
            assert!((f64::from(s) - f64::from(x).sin()).abs() < 1.5e-7, "sin {x}: {s}");
            assert!((f64::from(c) - f64::from(x).cos()).abs() < 1.5e-7, "cos {x}: {c}");
        }
    }

    #[test]
    fn exponential_and_tangent_are_accurate() {
        for i in -8000..8000 {
            let x = i as f32 * 0.01;
            let exact = f64::from(x).exp();
            assert!((f64::from(exp(x)) - exact).abs() <= 4e-7 * exact + 1e-37, "{x}: {} {exact}", exp(x));
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
