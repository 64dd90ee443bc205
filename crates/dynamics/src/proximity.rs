//! Distances between the simple shapes that stand for links among themselves: capsules and boxes.
//!
//! All lanes of a pack take the same path through these functions; cases are told apart by masks.

use super::lanes::Real;
use super::math::{Mat3, Vec3, add, add_scaled, dot, mul_vec, mul_vec_transposed, scale, sub};
use super::settings::{MIN_SQUARED_LENGTH, SEGMENT_HALVINGS};

/// Two shapes nearest to each other: the distance of their surfaces (negative when they overlap),
/// the unit normal from the second to the first, and the middle between the nearest points.
#[derive(Clone, Copy, Debug)]
pub struct Proximity<S> {
    /// Distance of the surfaces, m.
    pub gap: S,
    /// Unit vector.
    pub normal: Vec3<S>,
    /// Middle between the nearest points, m.
    pub point: Vec3<S>,
}

/// Points within `radius` of a segment: `centre +- half`.
#[derive(Clone, Copy, Debug)]
pub struct Capsule<S> {
    /// Middle of the segment, m.
    pub centre: Vec3<S>,
    /// Way from the middle to an end, m; zero makes a sphere.
    pub half: Vec3<S>,
    /// Radius, m.
    pub radius: S,
}

impl<S: Real> Capsule<S> {
    /// The same capsule seen from a frame at `origin` with axes `rotation`.
    #[inline(always)]
    pub fn seen_from(&self, origin: &Vec3<S>, rotation: &Mat3<S>) -> Self {
        Self {
            centre: mul_vec_transposed(rotation, &sub(&self.centre, origin)),
            half: mul_vec_transposed(rotation, &self.half),
            radius: self.radius,
        }
    }
}

impl<S: Real> Proximity<S> {
    /// The inverse of [`Capsule::seen_from`].
    #[inline(always)]
    pub fn out_of_frame(&self, origin: &Vec3<S>, rotation: &Mat3<S>) -> Self {
        Self {
            gap: self.gap,
            normal: mul_vec(rotation, &self.normal),
            point: add(origin, &mul_vec(rotation, &self.point)),
        }
    }
}

/// Where two capsules come nearest: places on their axes, whose ends are -1 and 1, on that of the
/// first between `from` and `to` (the nearest points of two segments: Ericson, Real-Time Collision
/// Detection, 2005, section 5.1.9, with parallel segments taken at the middle of that part).
#[inline(always)]
pub fn nearest_on_capsules<S: Real>(a: &Capsule<S>, [from, to]: [f64; 2], b: &Capsule<S>) -> [S; 2] {
    let (one, tiny) = (S::one(), S::splat(MIN_SQUARED_LENGTH));
    let between = sub(&a.centre, &b.centre);
    let (aa, bb, ab) = (dot(&a.half, &a.half), dot(&b.half, &b.half), dot(&a.half, &b.half));
    let (ac, bc) = (dot(&a.half, &between), dot(&b.half, &between));
    let middle = S::splat(0.5 * (from + to));
    let (from, to) = (S::splat(from), S::splat(to));
    let determinant = ab.neg_mul_add(ab, aa * bb);
    let crosses = (tiny * (aa * bb).max(tiny)).lt(determinant);
    let s = S::select(crosses, ab.mul_add(bc, -(bb * ac)) / determinant.max(tiny * tiny), middle).clamp(from, to);
    let t = (ab.mul_add(s, bc) / bb.max(tiny)).clamp(-one, one);
    [(ab.mul_add(t, -ac) / aa.max(tiny)).clamp(from, to), t]
}

/// Distance of two capsules at the places `s` and `t` of their axes.
#[inline(always)]
pub fn capsules<S: Real>(a: &Capsule<S>, s: S, b: &Capsule<S>, t: S) -> Proximity<S> {
    rounded(&add_scaled(&a.centre, &a.half, s), &add_scaled(&b.centre, &b.half, t), a.radius, b.radius)
}

/// The point of a box about the origin that is nearest to `p`.
#[inline(always)]
fn clamped<S: Real>(p: &Vec3<S>, box_half: &Vec3<S>) -> Vec3<S> {
    let [x, y, z] = box_half;
    [p[0].clamp(-*x, *x), p[1].clamp(-*y, *y), p[2].clamp(-*z, *z)]
}

/// `yes` where the mask is true, else `no`.
#[inline(always)]
fn select<S: Real>(mask: S::Mask, yes: &Vec3<S>, no: &Vec3<S>) -> Vec3<S> {
    [S::select(mask, yes[0], no[0]), S::select(mask, yes[1], no[1]), S::select(mask, yes[2], no[2])]
}

/// Two points with radii about them.
#[inline(always)]
fn rounded<S: Real>(on_a: &Vec3<S>, on_b: &Vec3<S>, radius_a: S, radius_b: S) -> Proximity<S> {
    let apart = sub(on_a, on_b);
    let squared = dot(&apart, &apart);
    let meets = squared.lt(S::splat(MIN_SQUARED_LENGTH));
    let distance = squared.max(S::splat(MIN_SQUARED_LENGTH)).sqrt();
    let inverse = S::one() / distance;
    // where the points coincide any direction will do
    let up = [S::zero(), S::zero(), S::one()];
    let normal = select(meets, &up, &scale(&apart, inverse));
    let gap = S::select(meets, S::zero(), distance) - radius_a - radius_b;
    let surface = add_scaled(on_b, &normal, radius_b);
    Proximity { gap, normal, point: add_scaled(&surface, &normal, gap * S::splat(0.5)) }
}

/// Whether a capsule (first) comes within `margin` of a box about the origin on each of the box's
/// axes; if not, it does not come within it at all.
#[inline(always)]
pub fn may_touch_box<S: Real>(a: &Capsule<S>, box_half: &Vec3<S>, margin: S) -> S::Mask {
    let reach = a.radius + margin;
    let mut apart = -reach;
    for i in 0..3 {
        apart = apart.max(a.centre[i].abs() - a.half[i].abs() - box_half[i]);
    }
    apart.lt(reach)
}

/// Half of how the squared distance of a point of a capsule's axis from a box changes along the
/// axis.
#[inline(always)]
fn slope_to_box<S: Real>(a: &Capsule<S>, t: S, box_half: &Vec3<S>) -> S {
    let p = add_scaled(&a.centre, &a.half, t);
    dot(&sub(&p, &clamped(&p, box_half)), &a.half)
}

/// Where on a capsule's axis, whose ends are -1 and 1, it comes nearest to a box about the origin
/// with half edge lengths `box_half` along its axes: on either half of the axis with `halves`, else
/// on all of it, and the two are the same.
///
/// Found by halving the range in which the distance still falls. Along a line the distance to a box
/// falls and then rises: one half of the axis is nearest in the middle, and only the other is
/// searched.
#[inline(always)]
pub fn nearest_to_box<S: Real>(a: &Capsule<S>, box_half: &Vec3<S>, halves: bool) -> [S; 2] {
    let zero = S::zero();
    let (mut t, mut quarter, mut first) = (zero, 0.5, zero);
    if halves {
        first = slope_to_box(a, zero, box_half);
        quarter = 0.25;
        t = S::select(first.lt(zero), S::splat(0.5), S::splat(-0.5));
    }
    for halving in 0..SEGMENT_HALVINGS {
        let slope = slope_to_box(a, t, box_half);
        let step = S::splat(quarter);
        let down = S::select(zero.lt(slope), -step, zero);
        t = t + S::select(slope.lt(zero), step, down);
        // the last step is as long as the one before it, which leads to the very end
        if halving + 2 < SEGMENT_HALVINGS {
            quarter *= 0.5;
        }
    }
    if halves { [S::select(first.lt(zero), zero, t), S::select(first.lt(zero), t, zero)] } else { [t; 2] }
}

/// Distance of the point `t` of a capsule's axis (first), whose ends are -1 and 1, with the
/// capsule's radius about it, and a box about the origin with half edge lengths `box_half` along
/// its axes.
#[inline(always)]
pub fn capsule_and_box<S: Real>(a: &Capsule<S>, t: S, box_half: &Vec3<S>) -> Proximity<S> {
    let (zero, one) = (S::zero(), S::one());
    let Capsule { centre, half, radius } = a;
    let p = add_scaled(centre, half, t);
    let c = clamped(&p, box_half);
    let out = sub(&p, &c);
    let squared = dot(&out, &out);
    let inside = squared.lt(S::splat(MIN_SQUARED_LENGTH));
    let distance = squared.max(S::splat(MIN_SQUARED_LENGTH)).sqrt();
    // inside, the nearest face is the way out
    let depth = [box_half[0] - p[0].abs(), box_half[1] - p[1].abs(), box_half[2] - p[2].abs()];
    let (x_side, y_side, z_side) =
        (S::select(p[0].lt(zero), -one, one), S::select(p[1].lt(zero), -one, one), S::select(p[2].lt(zero), -one, one));
    let x_first = S::and(depth[0].lt(depth[1]), depth[0].lt(depth[2]));
    let y_first = depth[1].lt(depth[2]);
    let x_out = S::select(x_first, x_side, zero);
    let y_out = S::select(x_first, zero, S::select(y_first, y_side, zero));
    let z_out = S::select(x_first, zero, S::select(y_first, zero, z_side));
    let shallow = depth[0].min(depth[1]).min(depth[2]);
    let inverse = one / distance;
    let faces = [x_out, y_out, z_out];
    let normal = select(inside, &faces, &scale(&out, inverse));
    let signed = S::select(inside, -shallow, distance);
    let gap = signed - *radius;
    let surface = sub(&p, &scale(&normal, signed));
    Proximity { gap, normal, point: add_scaled(&surface, &normal, gap * S::splat(0.5)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(a: f64, b: f64) {
        assert!((a - b).abs() < 1e-6, "{a} is not {b}");
    }

    fn of_capsules(a: &Capsule<f64>, b: &Capsule<f64>) -> Proximity<f64> {
        let [s, t] = nearest_on_capsules(a, [-1.0, 1.0], b);
        capsules(a, s, b, t)
    }

    #[test]
    fn crossed_capsules() {
        let a = Capsule { centre: [0.0, 0.0, 1.0], half: [1.0, 0.0, 0.0], radius: 0.25 };
        let b = Capsule { centre: [0.5, 0.0, 0.0], half: [0.0, 2.0, 0.0], radius: 0.5 };
        let p = of_capsules(&a, &b);
        near(p.gap, 0.25);
        near(p.normal[2], 1.0);
        near(p.point[0], 0.5);
        near(p.point[2], 0.625);
    }

    #[test]
    fn capsules_by_search() {
        // against the smallest distance over a fine grid of both segments
        let mut x = 1u64;
        let mut random = || {
            x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (x >> 33) as f64 / f64::from(1u32 << 31) * 2.0 - 1.0
        };
        for _ in 0..200 {
            let mut capsule = || Capsule {
                centre: std::array::from_fn(|_| random()),
                half: std::array::from_fn(|_| random()),
                radius: 0.1,
            };
            let (a, b) = (capsule(), capsule());
            let mut best = f64::INFINITY;
            for i in -200..=200 {
                let p = add_scaled(&a.centre, &a.half, f64::from(i) / 200.0);
                let t = (dot(&sub(&p, &b.centre), &b.half) / dot(&b.half, &b.half)).clamp(-1.0, 1.0);
                let d = sub(&p, &add_scaled(&b.centre, &b.half, t));
                best = best.min(dot(&d, &d).sqrt());
            }
            let found = of_capsules(&a, &b).gap + 0.2;
            assert!(found <= best + 1e-6 && found > best - 0.01, "{found} against {best}: {a:?} {b:?}");
        }
    }

    fn at_nearest(a: &Capsule<f64>, box_half: &Vec3<f64>) -> Proximity<f64> {
        capsule_and_box(a, nearest_to_box(a, box_half, false)[0], box_half)
    }

    #[test]
    fn halves_of_a_capsule_against_a_box_by_search() {
        let mut x = 1u64;
        let mut random = || {
            x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (x >> 33) as f64 / f64::from(1u32 << 31) * 2.0 - 1.0
        };
        let box_half = [0.5, 0.3, 0.2];
        for _ in 0..500 {
            let capsule = Capsule {
                centre: std::array::from_fn(|_| random()),
                half: std::array::from_fn(|_| random()),
                radius: 0.1,
            };
            let distance = |t: f64| {
                let p = add_scaled(&capsule.centre, &capsule.half, t);
                let out = sub(&p, &clamped(&p, &box_half));
                dot(&out, &out).sqrt()
            };
            for (t, from) in nearest_to_box(&capsule, &box_half, true).into_iter().zip([-1.0, 0.0]) {
                assert!((from..=from + 1.0).contains(&t), "{t} is not in the half from {from}");
                let best = (0..=1000).map(|i| distance(from + f64::from(i) / 1000.0)).fold(f64::INFINITY, f64::min);
                assert!(distance(t) < best + 0.01, "{} at {t} against {best}: {capsule:?}", distance(t));
            }
        }
    }

    #[test]
    fn capsule_on_a_box() {
        let b = [1.0, 0.5, 0.25];
        let above = Capsule { centre: [0.2, 0.0, 0.5], half: [0.0, 0.0, 0.1], radius: 0.05 };
        let p = at_nearest(&above, &b);
        near(p.gap, 0.1);
        near(p.normal[2], 1.0);
        let through = Capsule { centre: [0.2, 0.0, 0.2], half: [0.1, 0.0, 0.0], radius: 0.05 };
        let p = at_nearest(&through, &b);
        near(p.gap, -0.1);
        near(p.normal[2], 1.0);
        let beside = Capsule { centre: [1.5, 1.0, 0.0], half: [0.0, 0.0, 2.0], radius: 0.1 };
        let p = at_nearest(&beside, &b);
        near(p.gap, 0.5f64.sqrt() - 0.1);
    }
}
