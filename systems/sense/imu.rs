//! Velocity, gravity and heading, in the frame of the base.

use super::super::command::heading;
use super::{SensedRobot, Sensor};
use crate::components::Imu;
use crate::config::TaskConfig;
use crate::dynamics::math::{add, cross, mul_vec_transposed, quat_to_mat};
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
            projected_gravity: rotation[2].map(|x| -x),
            heading: heading(&pose.rotation),
        };
    }
}
