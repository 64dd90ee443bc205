//! Vectors, matrices and spatial vectors over lanes.

use super::lanes::Real;

/// A vector of three.
pub type Vec3<S> = [S; 3];
/// A 3 x 3 matrix, `m[row][column]`.
pub type Mat3<S> = [[S; 3]; 3];
/// A symmetric 3 x 3 matrix: xx, yy, zz, xy, xz, yz.
pub type Sym3<S> = [S; 6];

/// `a x b`.
#[inline(always)]
pub fn cross<S: Real>(a: &Vec3<S>, b: &Vec3<S>) -> Vec3<S> {
    [a[2].neg_mul_add(b[1], a[1] * b[2]), a[0].neg_mul_add(b[2], a[2] * b[0]), a[1].neg_mul_add(b[0], a[0] * b[1])]
}

/// `a x b + c`.
#[inline(always)]
pub fn cross_add<S: Real>(a: &Vec3<S>, b: &Vec3<S>, c: &Vec3<S>) -> Vec3<S> {
    [
        a[2].neg_mul_add(b[1], a[1].mul_add(b[2], c[0])),
        a[0].neg_mul_add(b[2], a[2].mul_add(b[0], c[1])),
        a[1].neg_mul_add(b[0], a[0].mul_add(b[1], c[2])),
    ]
}

/// Copies numbers into every lane.
#[inline(always)]
pub fn splat<S: Real>(a: &[f64; 3]) -> Vec3<S> {
    [S::splat(a[0]), S::splat(a[1]), S::splat(a[2])]
}

/// `a + 0`, which turns -0 into +0: what a lane's neighbours need may add zeros of either sign.
#[inline(always)]
pub fn normalised<S: Real, const N: usize>(a: &[S; N]) -> [S; N] {
    let mut out = *a;
    for x in &mut out {
        *x = *x + S::zero();
    }
    out
}

/// `a . b`.
#[inline(always)]
pub fn dot<S: Real>(a: &Vec3<S>, b: &Vec3<S>) -> S {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

/// `a + b`.
#[inline(always)]
pub fn add<S: Real>(a: &Vec3<S>, b: &Vec3<S>) -> Vec3<S> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// `a - b`.
#[inline(always)]
pub fn sub<S: Real>(a: &Vec3<S>, b: &Vec3<S>) -> Vec3<S> {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// `a s`.
#[inline(always)]
pub fn scale<S: Real>(a: &Vec3<S>, s: S) -> Vec3<S> {
    [a[0] * s, a[1] * s, a[2] * s]
}

/// `a + b s`.
#[inline(always)]
pub fn add_scaled<S: Real>(a: &Vec3<S>, b: &Vec3<S>, s: S) -> Vec3<S> {
    [b[0].mul_add(s, a[0]), b[1].mul_add(s, a[1]), b[2].mul_add(s, a[2])]
}

/// `A B`.
#[inline(always)]
pub fn mul_mat<S: Real>(a: &Mat3<S>, b: &Mat3<S>) -> Mat3<S> {
    [mul_vec_transposed(b, &a[0]), mul_vec_transposed(b, &a[1]), mul_vec_transposed(b, &a[2])]
}

/// `M v`.
#[inline(always)]
pub fn mul_vec<S: Real>(m: &Mat3<S>, v: &Vec3<S>) -> Vec3<S> {
    [dot(&m[0], v), dot(&m[1], v), dot(&m[2], v)]
}

/// `M^T v`.
#[inline(always)]
pub fn mul_vec_transposed<S: Real>(m: &Mat3<S>, v: &Vec3<S>) -> Vec3<S> {
    [
        m[0][0].mul_add(v[0], m[1][0].mul_add(v[1], m[2][0] * v[2])),
        m[0][1].mul_add(v[0], m[1][1].mul_add(v[1], m[2][1] * v[2])),
        m[0][2].mul_add(v[0], m[1][2].mul_add(v[1], m[2][2] * v[2])),
    ]
}

/// `S v` of a symmetric matrix.
#[inline(always)]
pub fn mul_sym<S: Real>(s: &Sym3<S>, v: &Vec3<S>) -> Vec3<S> {
    [
        s[0].mul_add(v[0], s[3].mul_add(v[1], s[4] * v[2])),
        s[3].mul_add(v[0], s[1].mul_add(v[1], s[5] * v[2])),
        s[4].mul_add(v[0], s[5].mul_add(v[1], s[2] * v[2])),
    ]
}

/// `R S R^T`: a symmetric matrix in rotated axes.
#[inline(always)]
pub fn rotate_sym<S: Real>(r: &Mat3<S>, s: &Sym3<S>) -> Sym3<S> {
    let t = [mul_sym(s, &r[0]), mul_sym(s, &r[1]), mul_sym(s, &r[2])];
    [dot(&t[0], &r[0]), dot(&t[1], &r[1]), dot(&t[2], &r[2]), dot(&t[0], &r[1]), dot(&t[0], &r[2]), dot(&t[1], &r[2])]
}

/// The rotation matrix of a unit quaternion (w, x, y, z).
#[inline(always)]
pub fn quat_to_mat<S: Real>(q: &[S; 4]) -> Mat3<S> {
    let [w, x, y, z] = *q;
    let (x2, y2, z2) = (x + x, y + y, z + z);
    let (xx, yy, zz) = (x * x2, y * y2, z * z2);
    let (xy, xz, yz) = (x * y2, x * z2, y * z2);
    let (wx, wy, wz) = (w * x2, w * y2, w * z2);
    let one = S::one();
    [[one - (yy + zz), xy - wz, xz + wy], [xy + wz, one - (xx + zz), yz - wx], [xz - wy, yz + wx, one - (xx + yy)]]
}

/// `q` turned by the rotation vector `w` (rad) in the body frame, normalised.
///
/// The exponential map is a Taylor polynomial, exact to single precision for |w| < 1 rad.
#[inline(always)]
pub fn integrate_quat<S: Real>(q: &[S; 4], w: &Vec3<S>) -> [S; 4] {
    let h = scale(w, S::splat(0.5));
    let h2 = dot(&h, &h);
    let c = S::splat(-1.0 / 720.0).mul_add(h2, S::splat(1.0 / 24.0));
    let c = c.mul_add(h2, S::splat(-0.5)).mul_add(h2, S::one());
    let s = S::splat(-1.0 / 5040.0).mul_add(h2, S::splat(1.0 / 120.0));
    let s = s.mul_add(h2, S::splat(-1.0 / 6.0)).mul_add(h2, S::one());
    let d = scale(&h, s);
    let v = [q[1], q[2], q[3]];
    let real = q[0].mul_add(c, -dot(&v, &d));
    let imaginary = add_scaled(&add_scaled(&cross(&v, &d), &v, c), &d, q[0]);
    let [x, y, z] = imaginary;
    let norm = real.mul_add(real, dot(&imaginary, &imaginary)).sqrt();
    let inverse = S::one() / norm;
    [real * inverse, x * inverse, y * inverse, z * inverse]
}

/// A spatial motion or force vector about the base origin, in base axes.
#[derive(Clone, Copy, Debug)]
pub struct Spatial<S> {
    /// Angular part: rad/s, or N m.
    pub ang: Vec3<S>,
    /// Linear part: m/s, or N.
    pub lin: Vec3<S>,
}

impl<S: Real> Spatial<S> {
    /// The zero vector.
    #[inline(always)]
    pub fn zero() -> Self {
        Self { ang: [S::zero(); 3], lin: [S::zero(); 3] }
    }

    /// Vector of six components, angular first.
    #[inline(always)]
    pub fn from_array([ax, ay, az, lx, ly, lz]: [S; 6]) -> Self {
        Self { ang: [ax, ay, az], lin: [lx, ly, lz] }
    }

    /// The six components, angular first.
    #[inline(always)]
    pub fn to_array(self) -> [S; 6] {
        [self.ang[0], self.ang[1], self.ang[2], self.lin[0], self.lin[1], self.lin[2]]
    }

    /// Velocity of the point of a body that is at `point`, where `self` is the body's motion about
    /// the origin.
    #[inline(always)]
    pub fn at(&self, point: &Vec3<S>) -> Vec3<S> {
        add(&self.lin, &cross(&self.ang, point))
    }

    /// Power of a force on a motion, or component along an axis.
    #[inline(always)]
    pub fn dot(&self, other: &Self) -> S {
        let a = dot(&self.lin, &other.lin);
        self.ang[0].mul_add(other.ang[0], self.ang[1].mul_add(other.ang[1], self.ang[2].mul_add(other.ang[2], a)))
    }

    /// `self + other`.
    #[inline(always)]
    pub fn plus(&self, other: &Self) -> Self {
        Self { ang: add(&self.ang, &other.ang), lin: add(&self.lin, &other.lin) }
    }

    /// `self - other`.
    #[inline(always)]
    pub fn minus(&self, other: &Self) -> Self {
        Self { ang: sub(&self.ang, &other.ang), lin: sub(&self.lin, &other.lin) }
    }

    /// `self + other s`.
    #[inline(always)]
    pub fn plus_scaled(&self, other: &Self, s: S) -> Self {
        Self { ang: add_scaled(&self.ang, &other.ang, s), lin: add_scaled(&self.lin, &other.lin, s) }
    }

    /// `self x m` of two motion vectors (Featherstone's crm).
    #[inline(always)]
    pub fn cross_motion(&self, m: &Self) -> Self {
        Self { ang: cross(&self.ang, &m.ang), lin: cross_add(&self.ang, &m.lin, &cross(&self.lin, &m.ang)) }
    }
}

/// The spatial inertia of a rigid body about the base origin, in base axes.
#[derive(Clone, Copy, Debug)]
pub struct SpatialInertia<S> {
    /// Mass, kg.
    pub mass: S,
    /// Mass times centre of mass, kg m.
    pub moment: Vec3<S>,
    /// Rotational inertia about the base origin, kg m^2.
    pub inertia: Sym3<S>,
}

impl<S: Real> SpatialInertia<S> {
    /// No mass.
    #[inline(always)]
    pub fn zero() -> Self {
        Self { mass: S::zero(), moment: [S::zero(); 3], inertia: [S::zero(); 6] }
    }

    /// Spatial inertia of a body with mass, centre of mass `c` and inertia about `c`, all in base
    /// axes.
    #[inline(always)]
    pub fn new(mass: S, c: &Vec3<S>, about_com: &Sym3<S>) -> Self {
        let h = scale(c, mass);
        let d = [c[0] * h[0], c[1] * h[1], c[2] * h[2]];
        Self {
            mass,
            moment: h,
            inertia: [
                about_com[0] + (d[1] + d[2]),
                about_com[1] + (d[0] + d[2]),
                about_com[2] + (d[0] + d[1]),
                h[0].neg_mul_add(c[1], about_com[3]),
                h[0].neg_mul_add(c[2], about_com[4]),
                h[1].neg_mul_add(c[2], about_com[5]),
            ],
        }
    }

    /// Two bodies as one.
    #[inline(always)]
    pub fn plus(&self, other: &Self) -> Self {
        let mut inertia = self.inertia;
        for k in 0..6 {
            inertia[k] = inertia[k] + other.inertia[k];
        }
        Self { mass: self.mass + other.mass, moment: add(&self.moment, &other.moment), inertia }
    }

    /// Momentum of a motion: `I m`.
    #[inline(always)]
    pub fn apply(&self, m: &Spatial<S>) -> Spatial<S> {
        Spatial {
            ang: cross_add(&self.moment, &m.lin, &mul_sym(&self.inertia, &m.ang)),
            lin: cross_add(&m.ang, &self.moment, &scale(&m.lin, self.mass)),
        }
    }
}
