//! Velocity, gravity and heading, in the frame of the base.

use super::super::command::heading;
use super::{SensedRobot, Sensor};
use crate::components::Imu;
use crate::config::TaskConfig;
use crate::dynamics::math::{Mat3, add, cross, mul_vec_transposed, quat_to_mat};
use crate::morphology::MorphologyModel;

impl Sensor for Imu {
    type Settings = ();

    fn settings(_: &TaskConfig) -> Option<()> {
        Some(())
    }

    fn new((): &(), _: &MorphologyModel) -> Self {
        Self::default()
    }

    #[inline(always)]
    fn measure(&mut self, (): &(), robot: &SensedRobot) {
        let (pose, velocity, com) = (robot.pose, robot.velocity, &robot.body.com[0]);
        let rotation = quat_to_mat(&pose.rotation);
        *self = Self {
            linear_velocity: add(&mul_vec_transposed(&rotation, &velocity.linear), &cross(&velocity.angular, com)),
            angular_velocity: velocity.angular,
            projected_gravity: in_base_axes(&rotation, &robot.ground.down),
            heading: heading(&pose.rotation),
        };
    }
}

/// A direction of the world in base axes; `rotation` turns base axes to world axes.
#[inline(always)]
fn in_base_axes(rotation: &Mat3<f32>, [x, y, z]: &[f32; 3]) -> [f32; 3] {
    let mut out = rotation[2].map(|up| up * z);
    // sums with zeros would change the signs of zeros
    if *x != 0.0 || *y != 0.0 {
        for k in 0..3 {
            out[k] = rotation[0][k].mul_add(*x, rotation[1][k].mul_add(*y, out[k]));
        }
    }
    out
}
