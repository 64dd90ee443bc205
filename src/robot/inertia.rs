//! Mass, centre of mass and inertia of rigidly joined parts.

use glam::{DMat3, DVec3};

use super::pose::Pose;

/// Largest violation of the triangle inequality by principal moments, relative to the largest one:
/// published figures are rounded.
const TRIANGLE_TOLERANCE: f64 = 1e-6;

/// Largest share of the largest principal moment at which a moment counts as zero.
const RANK_TOLERANCE: f64 = 1e-9;

/// Mass (kg), centre of mass (m) and inertia about it (kg m^2), in one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct MassProperties {
    pub mass: f64,
    pub com: DVec3,
    pub inertia: DMat3,
}

impl MassProperties {
    pub const ZERO: Self = Self { mass: 0.0, com: DVec3::ZERO, inertia: DMat3::ZERO };

    /// Masses of the body in the frame in which `pose` places the present one.
    pub fn transformed(&self, pose: &Pose) -> Self {
        let turned = pose.rotation * self.inertia * pose.rotation.transpose();
        Self {
            mass: self.mass,
            com: pose.transform_point(self.com),
            // exactly symmetric in spite of rounding
            inertia: (turned + turned.transpose()) * 0.5,
        }
    }

    /// Both bodies as one, by the parallel-axis theorem about the common centre of mass.
    pub fn joined(&self, other: &Self) -> Self {
        let mass = self.mass + other.mass;
        let com = if mass > 0.0 { (self.com * self.mass + other.com * other.mass) / mass } else { DVec3::ZERO };
        let about_com = |part: &Self| part.inertia + point_inertia(part.mass, part.com - com);
        Self { mass, com, inertia: about_com(self) + about_com(other) }
    }

    /// Whether every number is finite and at most this large.
    pub fn is_within(&self, largest: f64) -> bool {
        let numbers = self.com.to_array().into_iter().chain(self.inertia.to_cols_array()).chain([self.mass]);
        numbers.into_iter().all(|number| number.abs() <= largest)
    }

    /// Reason why the inertia cannot be that of a rigid body.
    pub fn inertia_fault(&self) -> Option<InertiaFault> {
        let [small, middle, large] = principal_moments(&self.inertia);
        if large <= 0.0 || small <= RANK_TOLERANCE * large {
            Some(InertiaFault::NotPositiveDefinite([small, middle, large]))
        } else if small + middle < large * (1.0 - TRIANGLE_TOLERANCE) {
            Some(InertiaFault::TriangleInequality([small, middle, large]))
        } else {
            None
        }
    }
}

/// Reason why an inertia tensor is impossible; with the principal moments in ascending order, kg
/// m^2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum InertiaFault {
    NotPositiveDefinite([f64; 3]),
    TriangleInequality([f64; 3]),
}

/// Inertia of a point mass at `offset` about the origin.
fn point_inertia(mass: f64, offset: DVec3) -> DMat3 {
    let outer = DMat3::from_cols(offset * offset.x, offset * offset.y, offset * offset.z);
    (DMat3::from_diagonal(DVec3::splat(offset.length_squared())) - outer) * mass
}

/// Eigenvalues of a symmetric matrix in ascending order, by cyclic Jacobi rotations.
pub(super) fn principal_moments(inertia: &DMat3) -> [f64; 3] {
    let mut a = inertia.to_cols_array_2d();
    // Jacobi converges quadratically; a 3x3 needs about five sweeps.
    for _ in 0..12 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q] == 0.0 {
                continue;
            }
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
            let c = 1.0 / t.hypot(1.0);
            let s = t * c;
            for row in &mut a {
                (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
            }
            let (old_p, old_q) = (a[p], a[q]);
            a[p] = std::array::from_fn(|k| c * old_p[k] - s * old_q[k]);
            a[q] = std::array::from_fn(|k| s * old_p[k] + c * old_q[k]);
        }
    }
    let mut moments = [a[0][0], a[1][1], a[2][2]];
    moments.sort_by(f64::total_cmp);
    moments
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_points_make_a_dumbbell() {
        let point = |mass, x| MassProperties { mass, com: DVec3::new(x, 0.0, 0.0), inertia: DMat3::ZERO };
        // reduced mass 1 * 3 / 4 at distance 2: 0.75 * 4 = 3
        let both = point(1.0, -1.0).joined(&point(3.0, 1.0));
        assert_eq!(both.mass, 4.0);
        assert_eq!(both.com, DVec3::new(0.5, 0.0, 0.0));
        assert_eq!(both.inertia, DMat3::from_diagonal(DVec3::new(0.0, 3.0, 3.0)));
    }

    #[test]
    fn a_turned_body_has_the_same_principal_moments() {
        let body =
            MassProperties { mass: 1.0, com: DVec3::ZERO, inertia: DMat3::from_diagonal(DVec3::new(2.0, 1.0, 2.5)) };
        let turned = body.transformed(&Pose::from_xyz_rpy(DVec3::X, DVec3::new(0.4, -1.1, 2.2)));
        for (moment, expected) in principal_moments(&turned.inertia).iter().zip([1.0, 2.0, 2.5]) {
            assert!((moment - expected).abs() < 1e-14, "{moment} {expected}");
        }
        assert_eq!(turned.inertia_fault(), None);
    }

    #[test]
    fn faults_are_told_apart() {
        let with = |inertia| MassProperties { inertia, ..MassProperties::ZERO };
        let flat = with(DMat3::from_diagonal(DVec3::new(1.0, 1.0, 3.0)));
        assert!(matches!(flat.inertia_fault(), Some(InertiaFault::TriangleInequality(_))));
        let singular = with(DMat3::from_cols_array(&[1e-3; 9]));
        assert!(matches!(singular.inertia_fault(), Some(InertiaFault::NotPositiveDefinite(_))));
    }
}
