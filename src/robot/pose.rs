//! Rigid transforms in double precision.

use std::ops::Mul;

use glam::{DMat3, DVec3};

/// Rigid transform: `point_in_parent = rotation * point_in_child + translation` (m).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Axes of the child frame as columns, in the parent frame.
    pub rotation: DMat3,
    /// Origin of the child frame in the parent frame, m.
    pub translation: DVec3,
}

impl Pose {
    /// The frame itself.
    pub const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// URDF `<origin>`: `xyz` in m, `rpy` in rad about the fixed x, y and z axes, in this order
    /// (`R = Rz(yaw) Ry(pitch) Rx(roll)`).
    pub fn from_xyz_rpy(xyz: DVec3, rpy: DVec3) -> Self {
        Self {
            rotation: DMat3::from_rotation_z(rpy.z) * DMat3::from_rotation_y(rpy.y) * DMat3::from_rotation_x(rpy.x),
            translation: xyz,
        }
    }

    pub(super) fn from_urdf(origin: &urdf_rs::Pose) -> Self {
        Self::from_xyz_rpy(DVec3::from_array(*origin.xyz), DVec3::from_array(*origin.rpy))
    }

    /// Rotation by `angle` (rad) about the unit vector `axis`.
    pub fn from_axis_angle(axis: DVec3, angle: f64) -> Self {
        Self { rotation: DMat3::from_axis_angle(axis, angle), translation: DVec3::ZERO }
    }

    /// Pure translation, m.
    pub fn from_translation(translation: DVec3) -> Self {
        Self { rotation: DMat3::IDENTITY, translation }
    }

    /// The inverse transform.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// A point of the child frame, in the parent frame.
    pub fn transform_point(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// Whether every entry is a finite number, and no coordinate larger than `largest` (m).
    pub fn is_within(&self, largest: f64) -> bool {
        self.rotation.is_finite() && self.translation.to_array().iter().all(|number| number.abs() <= largest)
    }
}

impl Mul for Pose {
    type Output = Pose;

    fn mul(self, child: Pose) -> Pose {
        Pose { rotation: self.rotation * child.rotation, translation: self.transform_point(child.translation) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roll_acts_before_yaw() {
        let half = std::f64::consts::FRAC_PI_2;
        let pose = Pose::from_xyz_rpy(DVec3::X, DVec3::new(half, 0.0, half));
        // y -> z by the roll, and z stays z under the yaw
        assert!((pose.transform_point(DVec3::Y) - DVec3::new(1.0, 0.0, 1.0)).length() < 1e-15);
    }

    #[test]
    fn inverse_undoes() {
        let pose = Pose::from_xyz_rpy(DVec3::new(1.0, -2.0, 0.5), DVec3::new(0.3, -0.7, 2.0));
        let identity = pose * pose.inverse();
        assert!(identity.translation.length() < 1e-15);
        assert!(identity.rotation.abs_diff_eq(DMat3::IDENTITY, 1e-15));
    }
}
